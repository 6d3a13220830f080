"""What holds for all tests, however the suite was started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

IGNORING = 'trap "" INT; exec "$@"'
"""What a shell does with what it starts in the background."""
SAY = "import signal; print(signal.getsignal(signal.SIGINT) == signal.SIG_IGN)"


def test_programs_can_be_interrupted() -> None:
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
    assert subprocess.run([sys.executable, "-c", SAY], capture_output=True, text=True, check=True).stdout == "False\n"


def test_a_make_of_a_test_is_the_first_one(tmp_path: Path) -> None:
    """Seen to fail below `make test`: a test's own make warned that it had no access to the jobs of that one."""
    (tmp_path / "Makefile").write_text("all: ; $(MAKE) part\npart: ; @echo $(MAKELEVEL)\n")
    done = subprocess.run(["make", "-C", str(tmp_path)], capture_output=True, text=True, check=True)
    assert (done.stderr, "1" in done.stdout.split()) == ("", True), done.stdout


def test_a_suite_below_make_starts_the_first_one() -> None:
    test = f"{__file__}::{test_a_make_of_a_test_is_the_first_one.__name__}"
    argv = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    above = {"MAKEFLAGS": "k -j3 --jobserver-auth=13,14", "MAKELEVEL": "2"}
    done = subprocess.run(argv, env=os.environ | above, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_programs_of_a_suite_in_the_background_can_be_interrupted() -> None:
    test = f"{__file__}::{test_programs_can_be_interrupted.__name__}"
    argv = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    done = subprocess.run(["sh", "-c", IGNORING, "sh", *argv], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
