"""A small web server and proxy on this computer that fails as networks do."""

from __future__ import annotations

import ssl
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import unquote, urlsplit

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from flotilla.debian import mirror
from flotilla.debian.mirror import Mirrors

PAGE = b"<!DOCTYPE html><title>Log in</title>" * 20


class Answer:
    """What is wrong with the answer to a request; nothing is, by default."""

    def __init__(
        self,
        status: int = 200,
        body: bytes | None = None,
        kind: str = "application/octet-stream",
        cut: int | None = None,
        pause: threading.Event | None = None,
        **headers: str,
    ) -> None:
        self.status = status
        self.body = body
        """Instead of the file's."""
        self.headers = {"Content-Type": kind} | {name.replace("_", "-"): value for name, value in headers.items()}
        self.cut = cut
        """Bytes of the body after which the connection ends; 0: without an answer."""
        self.pause = pause
        """Until then the connection stays, and nothing more comes."""


class FaultServer:
    """Serves `files` by path, whole or from where a transfer broke off; `fault` may answer something else.

    An address of another host in a request, as proxies get it, counts by its path.
    """

    def __init__(self, tls: ssl.SSLContext | None = None) -> None:
        self.files: dict[str, bytes] = {}
        self.kinds: dict[str, str] = {}
        """Types of files, where they matter."""
        self.fault: Callable[[str, int], Answer | None] = lambda path, number: None
        """Given a path and how often it was asked for, this request included."""
        self.requests: list[str] = []
        """As they were written: a proxy's have a host."""
        self.headers: list[Message] = []
        """Of the requests."""
        self._mutex = threading.Lock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True
        if tls:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True, do_handshake_on_connect=False)
        self.base = f"{'https' if tls else 'http'}://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01})
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    @property
    def mirrors(self) -> Mirrors:
        return Mirrors({archive: f"{self.base}/{archive}" for archive in mirror.ARCHIVES})

    def asked(self, path: str) -> int:
        """How often a file was asked for."""
        return sum(unquote(urlsplit(each).path) == path for each in self.requests)

    def _answer(self, request: str) -> tuple[str, Answer]:
        with self._mutex:
            self.requests.append(request)
            path = unquote(urlsplit(request).path)
            return path, self.fault(path, self.asked(path)) or self._whole(path)

    def _whole(self, path: str) -> Answer:
        if path not in self.files:
            return Answer(404)
        return Answer(kind=self.kinds[path]) if path in self.kinds else Answer()

    def _handler(server) -> type[BaseHTTPRequestHandler]:
        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                server.headers.append(self.headers)
                path, answer = server._answer(self.path)
                if answer.cut == 0:
                    self.close_connection = True
                    return
                body = answer.body if answer.body is not None else server.files.get(path, b"")
                start = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").split("-")[0])
                if answer.status == 200 and start:
                    self.send_response(206)
                    self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
                    body = body[start:]
                else:
                    self.send_response(answer.status)
                for name, value in answer.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.send_header("Last-Modified", "Fri, 02 Jan 2026 03:04:05 GMT")
                self.end_headers()
                if self.command == "HEAD":
                    return
                self.wfile.write(body[: answer.cut])
                if answer.pause:
                    self.wfile.flush()
                    answer.pause.wait()
                self.close_connection = answer.cut is not None

            do_HEAD = do_GET

            def log_message(self, *_: object) -> None:
                pass

        return Handler


def certificate(directory: Path) -> ssl.SSLContext:
    """For a server on this computer, by an authority of its own, whose certificate is then in `ca.pem`."""
    authority, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    (directory / "ca.pem").write_bytes(_signed("authority", authority, authority, authority=True))
    (directory / "server.pem").write_bytes(
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        + _signed("server", key, authority, authority=False)
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(directory / "server.pem")
    return context


def _signed(name: str, key: ec.EllipticCurvePrivateKey, by: ec.EllipticCurvePrivateKey, *, authority: bool) -> bytes:
    now = datetime.now(UTC)
    built = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
        .issuer_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "authority")]))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))]), critical=False)
    )
    return built.sign(by, hashes.SHA256()).public_bytes(Encoding.PEM)
