"""The whole suite, `python -m tests`, called by `make test`: tests in virtual time run beside the others.

What else the computer does changes nothing in them but their duration; they give way, so that they disturb no other.
"""

from __future__ import annotations

import subprocess
import sys

from images.builder import paths

VIRTUAL_TIME = "virtual_time"
"""The marker of tests in virtual time."""
_PYTEST = (sys.executable, "-m", "pytest", "tests", "--ignore=tests/unit")


def main() -> int:
    log = paths.BUILD / "test-virtual-time.log"
    with log.open("w") as out:
        argv = ["nice", "-n", "5", *_PYTEST, "-m", VIRTUAL_TIME, "--session", "virtual-time"]
        beside = subprocess.Popen(argv, stdout=out, stderr=out)
        try:
            others = subprocess.run([*_PYTEST, "-m", f"not {VIRTUAL_TIME}"], check=False).returncode
            beside.wait()
        finally:
            beside.kill()
    print(log.read_text(), flush=True)
    return others or beside.returncode


if __name__ == "__main__":
    sys.exit(main())
