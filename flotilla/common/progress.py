"""Progress of long work on standard error: what runs, how far it is, how long still. `V=1` also shows the commands.

A terminal shows one line that moves each second. Without one there is a line at each part's end, or each quarter of
work that has no parts, and nothing that overwrites itself.
"""

from __future__ import annotations

import os
import select
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

VERBOSE = os.environ.get("V", "0") not in ("", "0")
_TERMINAL = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
_COLOUR = _TERMINAL and not os.environ.get("NO_COLOR")
_SPINNER = "⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏"
_TICK_MS = 1000
_TITLE = 16
"""Characters of a title that stay on a narrow terminal."""
_SHOWN_S = 0.1
"""Between two pictures at least, until the work is done."""
_QUIET_S = 30
"""Between two quarters' lines at least: short work needs none."""
_SURE_S = 10
"""For which a rate is known at least, before it says how long work still takes."""
_now = time.monotonic
_output = threading.RLock()
"""Held while a line is written, and while a step's state changes."""
_running: list[Step] = []
"""One within the other, or at the same time; the one that began last is shown."""


@dataclass(frozen=True)
class Far:
    """How far work is."""

    done: float = 0
    total: float = 0
    """In the same unit; 0: nobody knows."""
    unit: str = ""
    """Of the total, where that says something."""
    part: str = ""
    """What runs now. Parts follow each other."""
    line: str = ""
    """The last line of work that itself shows its parts' ends."""

    @property
    def text(self) -> str:
        amount = f"{self._percent} %" if self.total else ""
        if self.unit:
            amount += f" of {self.total:g} {self.unit}"
        return ", ".join(each for each in (self.part, self.line, amount) if each)

    @property
    def _percent(self) -> int:
        """Estimates of the total may be too low: 100 % is what has ended."""
        return min(int(100 * self.done / self.total), 99 if self.done < self.total else 100)

    @property
    def quarter(self) -> int:
        return self._percent // 25 if self.total else 0


class Step:
    """Handle of a running step: `at` says how far it is."""

    def __init__(self, title: str, far: Callable[[], Far] | None = None) -> None:
        self.title = title
        self.started = _now()
        self._look = far
        self._far = Far()
        self._note = ""
        self._first: tuple[float, float] | None = None
        """When something was known first, and how much was done then: the rate counts from there."""
        self._moved = self._part_began = self._written = self._shown = self.started
        self._ticks = 0

    def at(self, done: float, total: float, unit: str = "", part: str = "") -> None:
        """It is that far, and `part` runs now."""
        with _output:
            self._take(Far(done, total, unit, part))
            if _now() - self._shown >= _SHOWN_S or done >= total:
                self.show()

    def note(self, text: str) -> None:
        """Show how far it is where nobody knows the whole; only a terminal sees it."""
        self._note = text

    def tick(self) -> None:
        """Look how far it is, and show it; once a second."""
        far = self._look() if self._look else None
        with _output:
            if far:
                self._take(far)
            self.show()

    def show(self) -> None:
        """On a terminal, with a spinner that has moved; nothing while a step within this one is shown."""
        self._ticks += 1
        self._shown = _now()
        if _moving() and _running[-1] is self:
            _show(self._picture())

    def _take(self, far: Far) -> None:
        now, before, self._far = _now(), self._far, far
        if far.total and self._first is None:
            self._first = (now, far.done)
        if far.done != before.done:
            self._moved = now
        if not _moving():
            self._write_ends(before, now)
        if far.part != before.part:
            self._part_began = now

    def _write_ends(self, before: Far, now: float) -> None:
        """Where nothing moves: what has ended."""
        if before.part and self._far.part != before.part:
            self._line(f"{before.part}: {now - self._part_began:.1f} s", now)
        elif self._far.line and self._far.line != before.line:
            self._line(self._far.line, now)
        elif not self._far.part and self._far.quarter > before.quarter and now - self._written >= _QUIET_S:
            self._line(f"{self._far.text} after {clock(now - self.started)}", now)

    def _line(self, text: str, now: float) -> None:
        self._written = now
        left = f"; {self._left()}" if self._left() else ""
        say(f"{self.title}: {text}{left}")

    def end_part(self) -> None:
        """The last part has ended, with its step."""
        if self._far.part and self._part_began > self.started and not _moving():
            say(f"{self.title}: {self._far.part}: {_now() - self._part_began:.1f} s")

    def _left(self) -> str:
        """How long it still takes at the rate so far; nothing where that is not known."""
        if self._first is None or self._far.done <= self._first[1] or self._far.done >= self._far.total:
            return ""
        begun, done = self._first
        if self._moved - begun < _SURE_S:
            return ""
        seconds = (self._far.total - self._far.done) * (self._moved - begun) / (self._far.done - done)
        return f"about {clock(max(seconds - (_now() - self._moved), 0))} left"

    def _picture(self) -> str:
        """One line of the terminal, whatever its width."""
        passed = clock(_now() - self.started)
        state = ", ".join(each for each in (self._far.text, self._note, passed, self._left()) if each)
        spinner = _SPINNER[self._ticks % len(_SPINNER)]
        width = shutil.get_terminal_size().columns - 1
        room = max(width - len(f"{spinner} : {state}"), _TITLE)  # how far it is matters more than its whole title
        title = self.title if len(self.title) <= room else f"{self.title[: room - 1]}…"
        line = f"{spinner} {title}: {state}"[:width]
        return f"\033[36m{line[:1]}\033[0m{line[1:]}" if _COLOUR else line


def clock(seconds: float) -> str:
    """`0:07`, `12:30`, `1:02:03`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _moving() -> bool:
    return _TERMINAL and not VERBOSE


def _show(line: str) -> None:
    sys.stderr.write(f"\r\033[K{line}")
    sys.stderr.flush()


def say(text: str) -> None:
    """A line that stays: on a terminal, in the place of the one that moves."""
    with _output:
        sys.stderr.write(("\r\033[K" if _moving() else "") + text + "\n")
        sys.stderr.flush()


@contextmanager
def step(title: str, far: Callable[[], Far] | None = None) -> Iterator[Step]:
    """Show `title` while the body runs and its duration once it is done, or has failed.

    `far` is asked about once a second, by another thread.
    """
    handle = Step(title, far)
    with _output:
        _running.append(handle)
    try:
        with _ticking(handle):
            handle.show()
            yield handle
    except BaseException:
        say(f"{title}: failed after {_now() - handle.started:.1f} s")
        raise
    finally:
        _running.remove(handle)
    handle.end_part()
    say(f"{title}: {_now() - handle.started:.1f} s")


@contextmanager
def _ticking(handle: Step) -> Iterator[None]:
    """By poll(2), not by a deadline: `make verify` moves the clock by which other waits would judge."""
    if not (_moving() or handle._look):
        yield
        return
    end = os.eventfd(0)
    ended = select.poll()
    ended.register(end, select.POLLIN)

    def tick() -> None:
        while not ended.poll(_TICK_MS):
            handle.tick()

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.eventfd_write(end, 1)
        thread.join()
        os.close(end)


def text(log: Path) -> str:
    """What a program has written so far; nothing where it has not begun to."""
    try:
        return log.read_text(errors="replace")
    except FileNotFoundError:
        return ""


def command(argv: Sequence[str]) -> None:
    """Show a command that is about to run, when the user asked for it."""
    if VERBOSE:
        sys.stderr.write("+ " + shlex.join(argv) + "\n")
        sys.stderr.flush()


def size(count: int) -> str:
    """`count` bytes in words, powers of 1024."""
    value = float(count)
    for unit in ("B", "KiB", "MiB"):
        if value < 1024:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1024
    return f"{value:.1f} GiB"


def main(title: str, *argv: str) -> int:
    """A command of the Makefile as a step. What it says matters when it fails."""
    command(argv)
    with tempfile.TemporaryFile() as log:
        try:
            with step(title):
                subprocess.run(argv, stdout=log, stderr=log, check=True)
        except subprocess.CalledProcessError as failed:
            log.seek(0)
            sys.stderr.buffer.write(log.read())
            return failed.returncode if failed.returncode > 0 else 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
