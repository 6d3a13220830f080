"""A process that keeps guests running, as others see it: a file that it has locked, with its number in it.

Without the lock, whatever the process left is only left behind, in whatever way it ended.
"""

from __future__ import annotations

import fcntl
import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import IO

END_SECONDS = 300


def free(file: Path) -> IO[str] | None:
    """The file, empty and locked until it is closed; None while a process holds it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = file.open("a+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    lock.truncate(0)  # a killed holder's process may be another by now
    return lock


def sign(lock: IO[str]) -> None:
    """Name this process as the one that holds it."""
    lock.write(str(os.getpid()))
    lock.flush()


def end(file: Path, seconds: float = END_SECONDS) -> tuple[IO[str] | None, bool]:
    """End the holder by SIGTERM, if there is one: the lock, or None if it did not end; whether there was one."""
    signalled = False
    deadline = time.monotonic() + seconds
    while (lock := free(file)) is None:
        if not signalled and (holder := file.read_text()):
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(int(holder), signal.SIGTERM)
            signalled = True
        if time.monotonic() > deadline:
            return None, signalled
        time.sleep(0.05)  # the lock tells nobody when it becomes free within a bound
    return lock, signalled
