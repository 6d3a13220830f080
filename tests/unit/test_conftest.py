"""What holds for all tests, however the suite was started."""

from __future__ import annotations

import signal
import subprocess
import sys

IGNORING = 'trap "" INT; exec "$@"'
"""What a shell does with what it starts in the background."""
SAY = "import signal; print(signal.getsignal(signal.SIGINT) == signal.SIG_IGN)"


def test_programs_can_be_interrupted() -> None:
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
    assert subprocess.run([sys.executable, "-c", SAY], capture_output=True, text=True, check=True).stdout == "False\n"


def test_programs_of_a_suite_in_the_background_can_be_interrupted() -> None:
    test = f"{__file__}::{test_programs_can_be_interrupted.__name__}"
    argv = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    done = subprocess.run(["sh", "-c", IGNORING, "sh", *argv], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
