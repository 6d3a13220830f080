"""Who may use the station's page: whoever has the token that the program prints, by the address that it names.

A page of somebody else, in the same browser, can send requests here, too. The cookie does not go with them (SameSite),
the origin of a WebSocket has to be this page, and `Host` has to be an address of this computer, so that no name that is
made to lead here (DNS rebinding) has an origin of its own.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from ipaddress import ip_address

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


class RefusedError(Exception):
    """A request that is not answered; says why."""


class Access:
    """To a page at an address and a TCP port of this computer."""

    def __init__(self, address: str, port: int) -> None:
        self._address, self._port = address, port
        self._token = secrets.token_urlsafe(32)
        self.cookie = f"flotilla-{port}"
        """Its name: cookies know no ports, and two stations may run on one computer."""

    @property
    def url(self) -> str:
        """With the token."""
        shown = ip_address(self._address)
        host = "127.0.0.1" if shown.is_unspecified else f"[{shown}]" if shown.version == 6 else str(shown)
        return f"http://{host}:{self._port}/?token={self._token}"

    def set_cookie(self, token: str) -> str:
        """The header that makes the browser send the token from now on."""
        return f"{self.cookie}={token}; Path=/; HttpOnly; SameSite=Strict"

    def check(self, headers: Mapping[str, str], cookie: str, token: str, *, socket: bool) -> None:
        """RefusedError. `token`: of the address; `socket`: a WebSocket is asked for."""
        host = headers.get("Host", "")
        name, _, port = host.rpartition(":")
        if not self._is_ours(name) or port != str(self._port):
            raise RefusedError("Host is no address of this page")
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            raise RefusedError("Origin is another page")
        if socket and origin is None:
            raise RefusedError("a WebSocket without Origin")
        given = [each for each in (cookie, token) if each]
        if not any(hmac.compare_digest(each.encode(), self._token.encode()) for each in given):
            raise RefusedError("no token, or not this program's")

    def _is_ours(self, name: str) -> bool:
        """An address cannot be made to lead elsewhere, other than a name."""
        if name in (*_LOOPBACK, self._address, f"[{self._address}]"):
            return True
        try:
            return ip_address(self._address).is_unspecified and bool(ip_address(name.strip("[]")))
        except ValueError:
            return False
