"""Who may use the station's page: whoever has the token that the program prints, by the address that it names.

A page of somebody else, in the same browser, can send requests here, too. The cookie does not go with them (SameSite),
the origin of a WebSocket has to be this page, and `Host` has to be an address of this computer, so that no name that is
made to lead here (DNS rebinding) has an origin of its own.
"""

from __future__ import annotations

import contextlib
import hmac
import os
import re
import secrets
import stat
import time
from collections.abc import Mapping
from ipaddress import ip_address
from pathlib import Path

_LOOPBACK = ("127.0.0.1", "[::1]", "localhost")
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


_BYTES = 32
_KEPT_S = 24 * 3600
"""For so long a token is that of the next start, too."""


def _kept(file: Path) -> str:
    """The token in a file that only this user reads; a new one where there is none, or it is old."""
    with contextlib.suppress(OSError, ValueError):
        status = file.stat()
        token = file.read_text()
        private = status.st_uid == os.geteuid() and not stat.S_IMODE(status.st_mode) & 0o077
        if private and 0 <= time.time() - status.st_mtime < _KEPT_S and re.fullmatch(r"[\w-]{43}", token):
            return token
    token = secrets.token_urlsafe(_BYTES)
    with contextlib.suppress(OSError):  # without it, open pages say that they need the new address
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        file.touch(0o600, exist_ok=False)
        file.write_text(token)
    return token


class RefusedError(Exception):
    """A request that is not answered; says why."""


class Access:
    """To a page at an address and a TCP port of this computer."""

    def __init__(self, address: str, port: int, kept: Path | None = None) -> None:
        """`kept`: a file of the token, so that open pages reach the program again after it was started anew."""
        self._address, self._port = address, port
        self._token = _kept(kept) if kept else secrets.token_urlsafe(_BYTES)
        self.cookie = f"flotilla-{port}"
        """Its name: cookies know no ports, and two stations may run on one computer."""

    @property
    def url(self) -> str:
        """With the token."""
        shown = ip_address(self._address)
        host = "127.0.0.1" if shown.is_unspecified else f"[{shown}]" if shown.version == 6 else str(shown)
        return f"http://{host}:{self._port}/?token={self._token}"

    @property
    def set_cookie(self) -> str:
        """The header that makes the browser send the token from now on."""
        return f"{self.cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"

    def is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(errors="surrogateescape"), self._token.encode())

    def check(self, headers: Mapping[str, str], cookie: str, token: str, *, socket: bool) -> None:
        """RefusedError. `token`: of the address; `socket`: a WebSocket is asked for, or something is to be done."""
        host = headers.get("Host", "")
        name, _, port = host.rpartition(":")
        if not self._is_ours(name) or port != str(self._port):
            raise RefusedError("Host is no address of this page")
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            raise RefusedError("Origin is another page")
        if socket and origin is None:
            raise RefusedError("a request without Origin")
        if not (self.is_token(cookie) or self.is_token(token)):
            raise RefusedError("no token, or not this program's")

    def _is_ours(self, name: str) -> bool:
        """An address cannot be made to lead elsewhere, other than a name."""
        if name in (*_LOOPBACK, self._address, f"[{self._address}]"):
            return True
        try:
            return ip_address(self._address).is_unspecified and bool(ip_address(name.strip("[]")))
        except ValueError:
            return False
