"""A serial console: recorded without a gap, searched with deadlines.

Not pexpect: it measures its time-outs on the wall clock, and it reads only while somebody expects something. A guest
that many checks share would stall once the socket to an idle reader is full, and nothing would know when a line came.
"""

from __future__ import annotations

import codecs
import re
import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from flotilla.lab.qemu.timing import Deadline, Expired, LabError

TAIL = 2000
"""Characters of the console that an error shows."""


class Line(Protocol):
    """The wire: a socket to QEMU; a serial port needs only a thin wrapper."""

    def recv(self, size: int, /) -> bytes:
        """Wait for bytes; none at the end."""

    def sendall(self, data: bytes, /) -> None: ...

    def close(self) -> None: ...


class SerialConsole:
    """Implements `protocols.Console`. It outlives power cycles: each one attaches a new line."""

    def __init__(self, log: Path, explain: Callable[[], str]) -> None:
        """`log` gets every byte as it comes; `explain` says why the line ended."""
        self._log = log.open("ab", buffering=0)
        self._explain = explain
        self._changed = threading.Condition()
        self._text = ""
        self._arrivals: list[tuple[int, float]] = []
        """Length of the text after each arrival, and its time."""
        self._searched = 0
        """Where the next `expect` starts."""
        self._attached = 0
        """Where the text of the present line starts."""
        self._line: Line | None = None
        self._reader: threading.Thread | None = None

    def attach(self, line: Line) -> None:
        """Listen to a line that was just powered on; what its predecessor said no longer counts."""
        self.detach()
        with self._changed:
            self._line = line
            self._searched = self._attached = len(self._text)
        self._reader = threading.Thread(target=self._read, args=(line,), name="console", daemon=True)
        self._reader.start()

    def detach(self) -> None:
        """Take in the last words of a line that ended."""
        if self._reader:
            self._reader.join()
            self._reader = None

    def close(self) -> None:
        self.detach()
        self._log.close()

    @property
    def text(self) -> str:
        with self._changed:
            return self._text

    def expect(self, pattern: str, timeout: float) -> re.Match[str]:
        expression = re.compile(pattern, re.MULTILINE)
        deadline = Deadline(timeout)
        with self._changed:
            while not (match := expression.search(self._text, self._searched)):
                if self._line is None:
                    raise LabError(f"console: {pattern!r} did not come; {self._explain()}\n{self._tail()}")
                if deadline.expired:
                    raise Expired(f"console: {pattern!r} did not come within {timeout:g} s\n{self._tail()}")
                self._changed.wait(deadline.left)
            self._searched = match.end()
            return match

    def send(self, text: str) -> None:
        line = self._line
        if line is None:
            raise LabError(f"console: cannot send {text!r}; {self._explain()}\n{self._tail()}")
        line.sendall(text.encode())

    def arrival(self, pattern: str) -> float:
        """When (`time.monotonic()`) the first match on the present line was complete. It must have come already."""
        with self._changed:
            match = re.compile(pattern, re.MULTILINE).search(self._text, self._attached)
            if not match:
                raise LabError(f"console: {pattern!r} has not come\n{self._tail()}")
            return self._arrivals[bisect_left(self._arrivals, (match.end(), 0.0))][1]

    def _tail(self) -> str:
        tail = self._text[-TAIL:] or "(nothing)"
        return f"--- console, last of {self._log.name} ---\n{tail}\n---"

    def _read(self, line: Line) -> None:
        decode = codecs.getincrementaldecoder("utf-8")(errors="replace").decode
        data = b"first"
        while data:
            try:
                data = line.recv(65536)
            except ConnectionError:  # killed with our input unread: the same end, said otherwise
                data = b""
            now = time.monotonic()
            self._log.write(data)
            with self._changed:
                self._text += decode(data)
                self._arrivals.append((len(self._text), now))
                if not data:
                    self._line = None
                self._changed.notify_all()
        line.close()
