"""A host that schedules QEMU's threads at random, for tests of what must not depend on it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from flotilla.debian import runtime
from flotilla.debian.lock import HOST

OFTEN = 1000
"""Stops of one process, below which it cannot be said that its threads were disturbed."""


@contextmanager
def perturbed_host() -> Iterator[None]:
    """QEMU that the body runs is stopped thousands of times where its threads hand over: see perturb.c.

    A busy host does the same, but seldom at the wrong moment.
    """
    with tempfile.TemporaryDirectory() as directory:
        library, log = Path(directory, "perturb.so"), Path(directory, "perturb.log")
        library.write_bytes(runtime.compile_plugin(Path(__file__).with_name("perturb.c"), HOST))
        with mock.patch.dict(os.environ, LD_PRELOAD=str(library), PERTURB_LOG=str(log)):
            yield
        stops = [int(line) for line in log.read_text().split()]
    assert max(stops) > OFTEN, f"QEMU was not disturbed: {stops}"
