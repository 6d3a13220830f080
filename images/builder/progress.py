"""Progress of long work on standard error: what runs, how far, how long. `V=1` also shows the commands."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

VERBOSE = os.environ.get("V", "0") not in ("", "0")
_TERMINAL = sys.stderr.isatty() and "NO_COLOR" not in os.environ


def _line(text: str, *, keep: bool) -> None:
    if _TERMINAL and not VERBOSE:
        sys.stderr.write(f"\r\033[K{text}" + ("\n" if keep else ""))
    elif keep:
        sys.stderr.write(text + "\n")
    sys.stderr.flush()


class Step:
    """Handle of a running step: `at` shows how far it is."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.started = time.monotonic()
        self._shown = 0.0

    def at(self, done: int, total: int, unit: str = "") -> None:
        """Show progress, at most ten times a second; only a terminal sees it."""
        now = time.monotonic()
        if now - self._shown < 0.1 and done < total:
            return
        self._shown = now
        percent = 100 * done // total if total else 100
        _line(f"{self.title} … {percent} % of {total} {unit}".rstrip(), keep=False)

    def note(self, text: str) -> None:
        """Show how far it is where nobody knows the whole; only a terminal sees it."""
        _line(f"{self.title} … {text}, {time.monotonic() - self.started:.0f} s", keep=False)


@contextmanager
def step(title: str) -> Iterator[Step]:
    """Show `title` while the body runs and its duration once it is done, or has failed."""
    handle = Step(title)
    _line(f"{title} …", keep=False)
    try:
        yield handle
    except BaseException:
        _line(f"{title}: failed after {time.monotonic() - handle.started:.1f} s", keep=True)
        raise
    _line(f"{title}: {time.monotonic() - handle.started:.1f} s", keep=True)


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
