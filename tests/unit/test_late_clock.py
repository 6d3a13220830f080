"""When the first programs of a robot set its clock back: beyond 2037, where 32-bit programs fail, and never else."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from flotilla.common import paths

SCRIPTS = [paths.PROJECT / "flotilla/images/init", paths.OVERLAY / "usr/lib/flotilla/preinit"]
DECISION = re.compile(r"^late=\n.*?^esac$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
@pytest.mark.parametrize(
    ("began", "machine", "late"),
    [
        ("", "i686", ""),
        ("0", "i686", ""),
        ("86400", "i686", ""),
        ("604800", "i686", ""),
        ("1796000000", "i686", ""),
        ("2119999999", "i686", ""),
        ("2120000000", "i686", "yes"),
        ("2147483647", "i686", "yes"),
        ("2208988800", "i586", "yes"),
        ("4102444800", "i686", "yes"),
        ("10000000000", "i686", "yes"),
        ("2208988800", "x86_64", ""),
    ],
)
def test_a_clock_is_set_back_beyond_2037_only(script: Path, began: str, machine: str, late: str) -> None:
    """Before, a clock of 1970 counted as one beyond 2037."""
    (decision,) = DECISION.findall(script.read_text())
    text = f'uname() {{ echo {machine}; }}\nbusybox() {{ "$@"; }}\nbegan=$1\n{decision}\necho "$late"'
    done = subprocess.run(["sh", "-c", text, "sh", began], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"{late}\n", "")
