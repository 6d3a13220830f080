"""Serves the station's page: its files, and a WebSocket for each browser, to whoever has the token."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import mimetypes
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

from aiohttp import WSCloseCode, web

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.station.access import HEADERS, Access, RefusedError
from flotilla.station.admission import Admission, Door
from flotilla.station.desk import Desk
from flotilla.station.page_requests import LONGEST
from flotilla.station.session import Session

PAGE = Path(__file__).parent / "page"
STOP_ALL = "/stop-all"
BROWSERS = 16
"""At once."""
_HEARTBEAT_S = 4.0
_CLOSE_S = 2.0
_BACKLOG = 64
"""Connections that the kernel keeps until they are accepted, which is all of them at once: fewer than files."""
_NOTE_EVERY_S = 1.0
_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Web:
    """At an address of this computer; port 0: any."""

    def __init__(self, desk: Desk, address: str, port: int) -> None:
        self._desk = desk
        self._address, self._port = address, port
        self._access: Access
        self._numbers = itertools.count(1)
        self._sessions: set[Session] = set()
        self._refused = self._ended = 0
        self._admission = Admission(self._note_ended)
        self._listening: asyncio.Server
        self._noted_s = 0.0
        self._files = {f"/{file.relative_to(PAGE).as_posix()}": file for file in PAGE.rglob("*") if file.is_file()}
        self._runner: web.AppRunner

    async def begin(self) -> str:
        """Listen; the page's address, with the token."""
        app = web.Application(middlewares=[self._guard], client_max_size=LONGEST)
        app.router.add_get("/socket", self._socket)
        app.router.add_post(STOP_ALL, self._stop_all)
        app.router.add_get("/{file:.*}", self._file)
        self._runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=1)
        await self._runner.setup()
        server = self._runner.server
        assert server
        try:
            self._listening = await asyncio.get_running_loop().create_server(
                lambda: Door(server(), self._admission), self._address, self._port, backlog=_BACKLOG, reuse_address=True
            )
        except OSError as error:
            remedy = "give another port or address of this computer: PORT= ADDRESS="
            raise UserError(f"TCP port {self._port} of {self._address}: {error.strerror}; {remedy}") from error
        port = self._listening.sockets[0].getsockname()[1]
        self._access = Access(self._address, port, paths.BUILD / "run" / f"page-{port}.token")
        return self._access.url

    async def end(self) -> None:
        self._listening.close()
        await self._runner.cleanup()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            self._access.check(
                request.headers,
                request.cookies.get(self._access.cookie, ""),
                request.query.get("token", ""),
                socket=request.path in ("/socket", STOP_ALL),
            )
        except RefusedError as error:
            self._note_refused(request, f"{error}")
            text = f"{error}.\nOpen the address that the station printed when it started: it has the token.\n"
            response = web.Response(status=403, text=text, headers=HEADERS)
            response.force_close()
            return response
        self._admission.proven(request.transport)
        return await handler(request)

    def _note_ended(self, address: str) -> None:
        self._ended += 1
        if time.monotonic() - self._noted_s >= _NOTE_EVERY_S:
            self._noted_s = time.monotonic()
            self._desk.note(f"ended a connection of {address} that has not shown the token ({self._ended} in all)")

    def _note_refused(self, request: web.Request, reason: str) -> None:
        """At most once a second: whoever asks sets the pace."""
        self._refused += 1
        if time.monotonic() - self._noted_s >= _NOTE_EVERY_S:
            self._noted_s = time.monotonic()
            self._desk.note(f"refused a request from {request.remote}: {reason} ({self._refused} in all)")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = "/index.html" if request.path == "/" else request.path
        file = self._files.get(name)
        if not file:
            return web.Response(status=404, text="there is no such file\n", headers=HEADERS)
        kind = _TYPES.get(file.suffix) or mimetypes.guess_type(file.name)[0] or "application/octet-stream"
        headers = dict(HEADERS)
        # Not whatever the address has: a cookie alone brings a request here, too, and would be overwritten.
        if self._access.is_token(request.query.get("token", "")):
            headers["Set-Cookie"] = self._access.set_cookie
        return web.Response(
            body=file.read_bytes(),
            content_type=kind,
            charset="utf-8" if kind.startswith("text") else None,
            headers=headers,
        )

    async def _stop_all(self, request: web.Request) -> web.StreamResponse:
        """By a request of its own: never behind what a browser has sent before, and never limited. The answer says that
        the station has it; what robots say of it comes to all browsers."""
        return web.json_response({"robots": self._desk.stop_all(f"a browser at {request.remote}")}, headers=HEADERS)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self._sessions) >= BROWSERS:
            return web.Response(status=503, text=f"{BROWSERS} browsers are the most; close one\n", headers=HEADERS)
        socket = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_S, max_msg_size=LONGEST, compress=False, timeout=_CLOSE_S, decode_text=True
        )
        await socket.prepare(request)
        transport = request.transport
        session = Session(
            socket, next(self._numbers), request.remote or "", self._desk.note,
            transport.abort if transport else lambda: None,
        )  # fmt: skip
        self._sessions.add(session)
        self._desk.enter(session)
        reason = ""
        try:
            reason = await session.serve(lambda asked: self._desk.do(session, asked))
        finally:
            self._desk.leave(session)
            self._sessions.discard(session)
            with contextlib.suppress(ConnectionError, asyncio.CancelledError):
                code = WSCloseCode.POLICY_VIOLATION if reason else WSCloseCode.GOING_AWAY
                await socket.close(code=code, message=reason.encode()[:120])
        return socket
