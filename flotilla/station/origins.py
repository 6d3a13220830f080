"""Before a WebSocket server that accepts every web page: connections of pages with a foreign Origin are rejected.

Foxglove's library has no option for this. Its server listens at a random address of 127.0.0.0/8 and a random port, some
2^38 places, which no web page finds by trying. This relay listens at the known address, reads the request, and passes
on the bytes of connections that it accepts. A browser sends the Origin of its page (RFC 6455, 10.2), programs none.
"""

from __future__ import annotations

import contextlib
import io
import secrets
import socket
import threading
from collections.abc import Collection
from http.client import HTTPException, parse_headers

from flotilla.common.errors import UserError

FOXGLOVE = ("https://app.foxglove.dev", "file://")
"""Origins of Foxglove in a browser, and as a program of its own, whose pages are files."""
_MOST = 32
"""Connections at once, each with two threads."""
_REQUEST_BYTES, _REQUEST_S = 8192, 5.0
_BUFFER_BYTES = 1 << 16
"""Small, so that the library sees soon which client is slow."""


def hidden_address() -> str:
    """A random address of this computer's loopback."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


class Relay:
    """Listens at an address of this computer until `end`; port 0: any. UserError where it cannot."""

    def __init__(self, address: str, port: int, allowed: Collection[str]) -> None:
        self._allowed = allowed
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        try:
            self._listening = socket.create_server((address, port), family=family)
        except OSError as error:
            remedy = "give another port or address of this computer: PORT= ADDRESS="
            raise UserError(f"TCP port {port} of {address}: {error.strerror}; {remedy}") from error
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)  # connections inherit it
        self.port: int = self._listening.getsockname()[1]
        self._free = threading.BoundedSemaphore(_MOST)
        self.rejected = 0
        """Connections of pages that are not allowed."""

    def begin(self, server: tuple[str, int]) -> None:
        """Pass connections on to the server at an address and port, by threads that end with the process."""
        threading.Thread(target=self._accept, args=(server,), daemon=True).start()

    def end(self) -> None:
        with contextlib.suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)  # which ends `accept`
        self._listening.close()

    def _accept(self, server: tuple[str, int]) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return  # ended
            if self._free.acquire(blocking=False):
                threading.Thread(target=self._serve, args=(client, server), daemon=True).start()
            else:
                client.close()

    def _serve(self, client: socket.socket, server: tuple[str, int]) -> None:
        try:
            with client, contextlib.suppress(OSError):
                request = _request(client)
                if status := self._rejection(request):
                    client.sendall(f"HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode())
                    return
                with socket.socket() as there:
                    there.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
                    there.connect(server)
                    there.sendall(request)
                    back = threading.Thread(target=_pass, args=(there, client), daemon=True)
                    back.start()
                    _pass(client, there)
                    back.join()
        finally:
            self._free.release()

    def _rejection(self, request: bytes) -> str:
        """HTTP's status for a request that is not served; empty for one that is."""
        try:
            headers = parse_headers(io.BytesIO(request.partition(b"\r\n")[2]))
        except HTTPException:
            return "400 Bad Request"
        if headers.get("Upgrade", "").strip().lower() != "websocket":  # else a second request could follow, unread
            return "426 Upgrade Required"
        if not all(origin.strip() in self._allowed for origin in headers.get_all("Origin", [])):
            self.rejected += 1
            return "403 Forbidden"
        return ""


def _request(client: socket.socket) -> bytes:
    """All up to the end of the request's headers, and more if it has come. TimeoutError, or OSError without an end."""
    client.settimeout(_REQUEST_S)
    data = b""
    while b"\r\n\r\n" not in data:
        more = client.recv(_REQUEST_BYTES)
        data += more
        if not more or len(data) > _REQUEST_BYTES:
            raise OSError("no request of HTTP")
    client.settimeout(None)
    return data


def _pass(source: socket.socket, to: socket.socket) -> None:
    """Until one of them ends, which ends both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_BUFFER_BYTES):
            to.sendall(data)
    for each in (source, to):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)
