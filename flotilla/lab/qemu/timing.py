"""Time in the test lab: deadlines for every wait, and a record of what happened when. All on the monotonic clock."""

from __future__ import annotations

import time
from pathlib import Path


class LabError(Exception):
    """Something in the test lab did not do what it should; the message carries the evidence."""


class Expired(LabError):
    """A deadline passed."""


class Deadline:
    """A point in time by which something must have happened, however many waits that takes."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._end = time.monotonic() + seconds

    @property
    def left(self) -> float:
        """Seconds left, never negative: what the next wait may take."""
        return max(0.0, self._end - time.monotonic())

    @property
    def expired(self) -> bool:
        return self.left == 0.0


class Steps:
    """What was done and when, one line each in a file: read beside a console log it tells whose turn it was."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._start = time.monotonic()

    def note(self, text: str) -> None:
        with self._file.open("a") as file:
            file.write(f"{time.monotonic() - self._start:9.3f} {text}\n")
