"""Processes that this computer starts."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence

from flotilla.common.errors import UserError

DIE_WITH_PARENT = ["setpriv", "--pdeathsig", "KILL"]
"""Prefix of a command that must not outlive the thread that starts it, however that ends."""
ANSWER_BYTES = 16 << 20
"""Of what a program on a robot may write, where nobody says otherwise: the longest true answers have one."""


def bounded(
    argv: Sequence[str], stdin: bytes = b"", timeout_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a program, which may be ssh to a robot in other hands; what it wrote.

    UserError where it writes ANSWER_BYTES: files take what it writes, to which the kernel's limit applies.
    """
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        given.write(stdin)
        given.seek(0)
        limited = ["prlimit", f"--fsize={ANSWER_BYTES}", "--", *argv]
        done = subprocess.run(limited, stdin=given, stdout=out, stderr=err, check=False, timeout=timeout_s)
        if max(out.seek(0, os.SEEK_END), err.seek(0, os.SEEK_END)) >= ANSWER_BYTES:
            raise UserError(f"an answer of more than {ANSWER_BYTES >> 20} MiB; nothing was done with it")
        out.seek(0)
        err.seek(0)
        said, complained = (stream.read().decode("utf-8", "replace") for stream in (out, err))
        return subprocess.CompletedProcess(argv, done.returncode, said, complained)
