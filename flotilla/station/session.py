"""One browser that has the page open: what it is sent, how much it may ask, and what becomes of it when it asks for
nonsense."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from flotilla.station import page_requests
from flotilla.station.driving import Operator
from flotilla.station.page_requests import NoRequestError, Request

RATE_HZ = 50
"""Requests a second for long: driving takes 10 to 20."""
_BURST = 100
GARBAGE = 20
"""That many things that are no request end the connection."""
EXCESS = 500
"""Likewise, requests beyond the rate."""
_KEPT = 500
"""Messages that wait for a browser; a slow one loses rows of signals first."""
_SEND_S = 10
"""A browser that takes nothing for so long is gone."""
_BROKEN: dict[int | None, str] = {
    WSCloseCode.PROTOCOL_ERROR: "what is no WebSocket frame",
    WSCloseCode.INVALID_TEXT: "text that is not UTF-8",
    WSCloseCode.MESSAGE_TOO_BIG: f"a request of more than {page_requests.LONGEST} bytes",
}


def _is_urgent(data: str | bytes) -> bool:
    """Whether it asks for a stop, which is never limited."""
    with contextlib.suppress(NoRequestError):
        return len(data) < 64 and isinstance(page_requests.read(data), page_requests.StopAll)
    return False


class Session:
    """`number`: other browsers know it by this. `note`: says what an operator has to know, on terminal and page.
    `abort`: ends the connection at once."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        number: int,
        place: str,
        note: Callable[[str], None],
        abort: Callable[[], None],
    ) -> None:
        self.number = number
        self.operator = Operator(f"{number}-{secrets.token_hex(8)}", f"browser {number} at {place}")
        """Who drives, if it does."""
        self._socket = socket
        self._note = note
        self._abort = abort
        self._wake = asyncio.Event()
        self._waiting: deque[str] = deque()
        self._state: str | None = None
        self._allowance, self._since_s = float(_BURST), time.monotonic()
        self.garbage = self.excess = self.dropped = 0
        """Counts: no requests, those beyond the rate, messages that it was too slow for."""

    def tell(self, message: dict[str, Any]) -> None:
        """It gets it in its turn."""
        if len(self._waiting) >= _KEPT:
            self._waiting.popleft()
            self.dropped += 1
        self._waiting.append(json.dumps(message, separators=(",", ":"), allow_nan=False))
        self._wake.set()

    def show(self, state: str) -> None:
        """JSON that takes the place of the one before, if that has not been sent yet."""
        self._state = state
        self._wake.set()

    async def serve(self, do: Callable[[Request], None]) -> str:
        """Hand over its requests until it is gone, or has to go: then why."""
        sending = asyncio.create_task(self._send())
        reason = ""
        try:
            async for message in self._socket:
                if message.type is WSMsgType.ERROR:
                    reason = _BROKEN.get(getattr(message.data, "code", None), "")
                if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                    break
                if reason := self._take(message.data, do):
                    break
                if self.excess:
                    await asyncio.sleep(0)  # a flood must not keep the loop from all else
        finally:
            sending.cancel()
        if reason:
            self._note(f"{self.operator.name}: {reason}; its connection is closed")
        return reason

    def _take(self, data: str | bytes, do: Callable[[Request], None]) -> str:
        """Why it has to go, or nothing."""
        now_s = time.monotonic()
        self._allowance = min(_BURST, self._allowance + (now_s - self._since_s) * RATE_HZ)
        self._since_s = now_s
        if self._allowance < 1 and not _is_urgent(data):
            self.excess += 1
            if self.excess == 1:
                self._note(f"{self.operator.name}: more than {RATE_HZ} requests a second; left out")
            return f"{self.excess} requests too many" if self.excess >= EXCESS else ""
        self._allowance = max(0.0, self._allowance - 1)
        try:
            request = page_requests.read(data)
        except NoRequestError as error:
            self.garbage += 1
            if self.garbage == 1:
                self._note(f"{self.operator.name}: no request: {error}")
            if error.number is not None:  # who asked waits for an answer
                self.tell({"type": "answer", "id": error.number, "good": False, "text": str(error)})
            return f"{self.garbage} things that are no request" if self.garbage >= GARBAGE else ""
        do(request)
        return ""

    async def _send(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._waiting:
                if not await self._sent(self._waiting.popleft()):
                    return
            if self._state:
                state, self._state = self._state, None
                if not await self._sent(state):
                    return

    async def _sent(self, text: str) -> bool:
        """False: it is gone."""
        try:
            async with asyncio.timeout(_SEND_S):
                await self._socket.send_str(text)
        except (TimeoutError, ConnectionError):
            self._abort()
            return False
        return True
