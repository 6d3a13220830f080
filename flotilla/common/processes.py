"""Processes that this computer starts."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from typing import BinaryIO

from flotilla.common.errors import UserError

DIE_WITH_PARENT = ["setpriv", "--pdeathsig", "KILL"]
"""Prefix of a command that must not outlive the thread that starts it, however that ends."""
ANSWER_BYTES = 16 << 20
"""Of what a program on a robot may write, where nobody says otherwise: the longest true answers have one."""


def limited(most_bytes: int) -> list[str]:
    """Prefix of a command that is ended, by SIGXFSZ, where it writes so much into a file."""
    return ["prlimit", f"--fsize={most_bytes}", "--"]


def content(file: BinaryIO) -> str:
    """All of a file that a program has written to."""
    file.seek(0)
    return file.read().decode("utf-8", "replace")


def bounded(
    argv: Sequence[str], stdin: bytes = b"", timeout_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a program, which may be ssh to a robot in other hands; what it wrote.

    UserError where it writes ANSWER_BYTES: files take what it writes, to which the kernel's limit applies.
    """
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        given.write(stdin)
        given.seek(0)
        done = subprocess.run(
            [*limited(ANSWER_BYTES), *argv], stdin=given, stdout=out, stderr=err, check=False, timeout=timeout_s
        )
        if max(out.seek(0, os.SEEK_END), err.seek(0, os.SEEK_END)) >= ANSWER_BYTES:
            raise UserError(f"an answer of more than {ANSWER_BYTES >> 20} MiB; nothing was done with it")
        return subprocess.CompletedProcess(argv, done.returncode, content(out), content(err))
