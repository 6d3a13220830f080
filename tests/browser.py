"""A browser without a window, told what to do over the Chrome DevTools Protocol (chromedevtools.github.io)."""

from __future__ import annotations

import base64
import itertools
import json
import subprocess
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

_PROGRAM = "chromium"
_TIMEOUT_S = 60
_LISTENING = "DevTools listening on "
_OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
_EMPTY = (
    "[...document.images, ...document.querySelectorAll('svg')].filter(e => !e.getBoundingClientRect().height).length"
)


@dataclass(frozen=True)
class Look:
    """What a page was like."""

    text: str
    """What a reader sees of it."""
    pictures: int
    empty_pictures: int
    """Those without height."""
    requests: list[str]
    """What it asked for besides itself."""
    complaints: list[str]
    """What the browser said of it: scripts that failed, things that were not found."""
    overflow_px: int
    """How much wider than the window it is."""


class Browser:
    """A browser of its own, which forgets everything when it ends; a context manager."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._events: list[dict[str, Any]] = []
        self._closing = ExitStack()

    def __enter__(self) -> Browser:
        with ExitStack() as on_failure:
            home = on_failure.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
            argv = [_PROGRAM, "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run"]
            argv += [f"--user-data-dir={home}", "--remote-debugging-port=0", "about:blank"]
            process = on_failure.enter_context(subprocess.Popen(argv, stderr=subprocess.PIPE, text=True))
            on_failure.callback(process.kill)
            self._socket = on_failure.enter_context(connect(_address(process), max_size=None))
            target = self._call("Target.createTarget", url="about:blank")["targetId"]
            self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Network", "Log", "Runtime"):
                self._ask(f"{domain}.enable")
            self._closing = on_failure.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def look(self, page: Path, picture: Path, *, width_px: int = 1400) -> Look:
        """Open `page` in a window of that width, and leave the whole of it as `picture`, a PNG."""
        url = page.resolve().as_uri()
        self._ask("Emulation.setDeviceMetricsOverride", width=width_px, height=900, deviceScaleFactor=1, mobile=False)
        self._events.clear()
        self._ask("Page.navigate", url=url)
        while not any(event["method"] == "Page.loadEventFired" for event in self._events):
            self._events.append(self._receive())
        drawn = self._ask("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        picture.write_bytes(base64.b64decode(drawn["data"]))
        asked = [event["params"]["request"]["url"] for event in self._of("Network.requestWillBeSent")]
        return Look(
            text=self._value("document.body.innerText"),
            pictures=self._value("document.querySelectorAll('img, svg').length"),
            empty_pictures=self._value(_EMPTY),
            requests=[other for other in asked if other != url],
            complaints=[event["params"]["entry"]["text"] for event in self._of("Log.entryAdded")]
            + [event["params"]["exceptionDetails"]["text"] for event in self._of("Runtime.exceptionThrown")],
            overflow_px=self._value(_OVERFLOW),
        )

    def _of(self, method: str) -> list[dict[str, Any]]:
        return [event for event in self._events if event["method"] == method]

    def _value(self, expression: str) -> Any:
        return self._ask("Runtime.evaluate", expression=expression, returnByValue=True)["result"]["value"]

    def _ask(self, method: str, **params: Any) -> dict[str, Any]:
        return self._call(method, self._session, **params)

    def _call(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params} | ({"sessionId": session} if session else {})
        self._socket.send(json.dumps(message))
        while True:  # what comes before the answer are events; the browser's silence ends it
            received = self._receive()
            if received.get("id") == number:
                if "error" in received:
                    raise RuntimeError(f"{method}: {received['error']['message']}")
                return dict(received["result"])
            self._events.append(received)

    def _receive(self) -> dict[str, Any]:
        return dict(json.loads(self._socket.recv(_TIMEOUT_S)))


def _address(process: subprocess.Popen[str]) -> str:
    """Of its protocol, which it tells once it listens."""
    assert process.stderr
    said: list[str] = []
    for line in process.stderr:  # which ends when the program does
        if line.startswith(_LISTENING):
            return line.removeprefix(_LISTENING).strip()
        said.append(line)
    raise RuntimeError(f"{_PROGRAM} ended: {''.join(said)}")
