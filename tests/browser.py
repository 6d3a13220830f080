"""A browser without a window, told what to do over the Chrome DevTools Protocol (chromedevtools.github.io)."""

from __future__ import annotations

import base64
import itertools
import json
import subprocess
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

_PROGRAM = "chromium"
_OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-quic",
)  # fmt: skip
_TIMEOUT_S = 300
_LISTENING = "DevTools listening on "
_OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
_EMPTY = (
    "[...document.images, ...document.querySelectorAll('svg')].filter(e => !e.getBoundingClientRect().height).length"
)
_KEYS = {"ArrowUp": 38, "ArrowLeft": 37, "ArrowRight": 39, "KeyW": 87, "KeyA": 65, "Space": 32}
"""Windows' key codes by the standard's `code`."""


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
            argv = [_PROGRAM, *_OPTIONS, f"--user-data-dir={home}", "--remote-debugging-port=0", "about:blank"]
            process = on_failure.enter_context(subprocess.Popen(argv, stderr=subprocess.PIPE, text=True))
            on_failure.callback(process.kill)
            self._socket = on_failure.enter_context(connect(_address(process), max_size=None, ping_interval=None))
            self._closing = on_failure.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def page(self, *, width_px: int = 1400, height_px: int = 900, mobile: bool = False, dark: bool = False) -> Page:
        """A window with cookies of its own, as if it was another browser."""
        context = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, target, session)
        for domain in ("Page", "Network", "Log", "Runtime"):
            page.ask(f"{domain}.enable")
        page.size(width_px, height_px, mobile=mobile)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.ask("Emulation.setEmulatedMedia", features=[scheme])
        page.ask("Emulation.setFocusEmulationEnabled", enabled=True)  # windows that nobody sees have none
        return page

    def look(self, page: Path, picture: Path, *, width_px: int = 1400) -> Look:
        """Open `page` in a window of that width, and leave the whole of it as `picture`, a PNG."""
        shown = self.page(width_px=width_px)
        url = page.resolve().as_uri()
        shown.open(url)
        shown.picture(picture)
        asked = [event["params"]["request"]["url"] for event in shown.events("Network.requestWillBeSent")]
        look = Look(
            text=shown.value("document.body.innerText"),
            pictures=shown.value("document.querySelectorAll('img, svg').length"),
            empty_pictures=shown.value(_EMPTY),
            requests=[other for other in asked if other != url],
            complaints=shown.complaints,
            overflow_px=shown.overflow_px,
        )
        shown.close()
        return look

    def events(self, session: str, method: str) -> list[dict[str, Any]]:
        return [event for event in self._events if event["method"] == method and event.get("sessionId") == session]

    def forget(self, session: str) -> None:
        """Its events so far."""
        self._events = [event for event in self._events if event.get("sessionId") != session]

    def call(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
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

    def wait(self, session: str, method: str) -> None:
        while not self.events(session, method):
            self._events.append(self._receive())

    def _receive(self) -> dict[str, Any]:
        return dict(json.loads(self._socket.recv(_TIMEOUT_S)))


class Page:
    """A window."""

    def __init__(self, browser: Browser, target: str, session: str) -> None:
        self._browser, self._target, self._session = browser, target, session

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        return self._browser.call(method, self._session, **params)

    def size(self, width_px: int, height_px: int = 900, *, mobile: bool = False) -> None:
        self.ask("Emulation.setDeviceMetricsOverride", width=width_px, height=height_px, deviceScaleFactor=1,
                 mobile=mobile)  # fmt: skip

    def open(self, url: str) -> None:
        """And wait until it is loaded."""
        self._browser.forget(self._session)
        self.ask("Page.navigate", url=url)
        self._browser.wait(self._session, "Page.loadEventFired")

    def picture(self, file: Path, *, whole: bool = True) -> None:
        """A PNG of the page, or of what the window shows of it."""
        drawn = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        file.write_bytes(base64.b64decode(drawn["data"]))

    def value(self, expression: str) -> Any:
        """Of JavaScript; a promise's when it is kept. RuntimeError with what it throws."""
        done = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in done:
            raise RuntimeError(f"{expression}: {done['exceptionDetails']}")
        return done["result"].get("value")

    def until(self, expression: str, timeout_s: float = _TIMEOUT_S) -> Any:
        """Look at each frame, until the expression is true; its value."""
        end = time.monotonic() + timeout_s
        test = f"(found => found instanceof Node || found)({expression})"  # an element has no value
        while not (found := self.value(test)):
            assert time.monotonic() < end, f"not within {timeout_s} s: {expression}\n{self.text()}\n{self.complaints}"
            self.value("new Promise(resolve => setTimeout(resolve, 30))")
        return found

    def text(self, selector: str = "body") -> str:
        """What a reader sees of an element."""
        return str(self.value(f"document.querySelector({json.dumps(selector)}).innerText"))

    def key(self, code: str, down: bool) -> None:
        kind = "rawKeyDown" if down else "keyUp"
        self.ask("Input.dispatchKeyEvent", type=kind, code=code, key=code, windowsVirtualKeyCode=_KEYS[code])

    def click(self, selector: str) -> None:
        """With the mouse, in its middle."""
        x, y = self.middle(selector)
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def mouse(self, kind: str, x: float, y: float) -> None:
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def middle(self, selector: str) -> tuple[float, float]:
        """Of an element, which is brought into the window."""
        name = json.dumps(selector)
        self.value(f"document.querySelector({name}).scrollIntoView({{block: 'center'}})")
        x, y = self.value(
            f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])"
            f"(document.querySelector({name}).getBoundingClientRect())"
        )
        return x, y

    def events(self, method: str) -> list[dict[str, Any]]:
        return self._browser.events(self._session, method)

    @property
    def complaints(self) -> list[str]:
        """What the browser said of it."""
        return [event["params"]["entry"]["text"] for event in self.events("Log.entryAdded")] + [
            str(event["params"]["exceptionDetails"].get("exception", {}).get("description", event["params"]))
            for event in self.events("Runtime.exceptionThrown")
        ]

    @property
    def overflow_px(self) -> int:
        """How much wider than the window it is."""
        return int(self.value(_OVERFLOW))

    def close(self) -> None:
        self._browser.call("Target.closeTarget", targetId=self._target)


def _address(process: subprocess.Popen[str]) -> str:
    """Of its protocol, which it tells once it listens."""
    assert process.stderr
    said: list[str] = []
    for line in process.stderr:  # which ends when the program does
        if line.startswith(_LISTENING):
            return line.removeprefix(_LISTENING).strip()
        said.append(line)
    raise RuntimeError(f"{_PROGRAM} ended: {''.join(said)}")
