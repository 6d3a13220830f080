"""The command line on a terminal of its own, where it may ask for a passphrase."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import subprocess
import sys

from flotilla.common import paths


def answered(arguments: list[str], dialogue: dict[str, str]) -> str:
    """What `flotilla` shows there. `dialogue`: pattern of each question, in order, and its answer."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "flotilla", *arguments], cwd=paths.PROJECT, env=os.environ | {"KEYS": str(paths.KEYS)},
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),  # which makes it the session's terminal
    )  # fmt: skip
    os.close(theirs)
    said = ""
    with contextlib.suppress(OSError):  # nobody has the other end any more
        for question, answer in dialogue.items():
            while not re.search(question, said):
                said += os.read(ours, 4096).decode()
            os.write(ours, f"{answer}\n".encode())
        while more := os.read(ours, 4096):
            said += more.decode()
    os.close(ours)
    assert process.wait() == 0, said
    return said
