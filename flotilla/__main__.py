"""The program `flotilla`, and `python -m flotilla` where that is not on the path."""

from __future__ import annotations

import codecs
import io
import locale
import os
import re
import select
import sys
from pathlib import Path


def main() -> int:
    """Run the command line: imported when the home is known, because places are read from the environment once."""
    from flotilla.cli.main import main

    return main()


BROKEN_PIPE = 141
"""As a shell reports a program that SIGPIPE ended."""


def program() -> int:
    """Run the command line; the exit status."""
    _use_utf8()
    _find_home()
    try:
        try:
            return main()
        finally:
            if sys.stdout:
                sys.stdout.flush()
    except BrokenPipeError:
        if not (gone := [fd for fd in (1, 2) if _reader_left(fd)]):
            raise  # of another pipe
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for fd in gone:  # what Python still holds goes there when it ends
            os.dup2(nowhere, fd)
        return BROKEN_PIPE


def _use_utf8() -> None:
    """Read and write files in UTF-8 in every locale; print in the locale's characters, with `?` for others."""
    encoding = codecs.lookup(locale.getencoding()).name
    if encoding not in ("utf-8", "ascii") and not sys.flags.utf8_mode:
        os.environ["PYTHONUTF8"] = "1"  # which Python reads when it starts
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    given = os.environ.pop("PYTHONIOENCODING", None)  # programs started from here are read as UTF-8
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # The locale C says nothing of the terminal.
            stream.reconfigure(encoding=None if given or encoding == "ascii" else encoding, errors="replace")


def _find_home() -> None:
    """A command in a fleet's home, or below it, is about that fleet; one in the tool's checkout is not.

    Only a home of this user's own, or of root: a file that somebody put into a common directory chooses nothing.
    """
    here, checkout = Path.cwd(), Path(__file__).resolve().parents[1]
    if "FLEET" in os.environ or here.is_relative_to(checkout):
        return
    for directory in (here, *here.parents):
        file = directory / "fleet.yml"
        # A playbook may have this name, too.
        if file.is_file() and re.search(rb"(?m)^flotilla:", file.read_bytes()):
            if {file.stat().st_uid, directory.stat().st_uid} <= {0, os.geteuid()}:
                os.environ["FLEET"] = str(directory)
            return


def _reader_left(fd: int) -> bool:
    poll = select.poll()
    poll.register(fd, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


if __name__ == "__main__":
    sys.exit(program())
