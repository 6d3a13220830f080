"""A host that has something else to do, for tests of what must not depend on it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

from images.builder.boot import DIE_WITH_PARENT


@contextlib.contextmanager
def busy_host() -> Iterator[None]:
    """A process for each processor that only computes, for as long as the body takes.

    It is nice: QEMU's two threads hand over thousands of times a second, and would take ten times as long, not twice.
    """
    argv = [*DIE_WITH_PARENT, "nice", "-n", "10", sys.executable, "-c", "while True: pass"]
    hogs = [subprocess.Popen(argv) for _ in range(os.cpu_count() or 1)]
    try:
        yield
        assert [hog.poll() for hog in hogs] == [None] * len(hogs), "the host was not busy all the time"
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()
