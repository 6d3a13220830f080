"""What parses an update's bytes on a robot does so without root's privileges."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import namespace, paths
from flotilla.fleet import privileges

_SEED = paths.PROJECT / "runtime/tests/fuzz/corpus/patch/add"
_ASK = """
import subprocess, sys
program, base, seed = sys.argv[1:]
with subprocess.Popen([program, base], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as patch:
    patch.stdin.write(open(seed, "rb").read())
    patch.stdin.flush()
    assert patch.stdout.read(20) == b"abcdefghijklmnopqrst"
    print(open(f"/proc/{patch.pid}/status").read())
"""


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """That root alone reads, as a slot's device."""
    (tmp_path / "base").write_bytes(bytes(4096))
    (tmp_path / "base").chmod(0o600)
    return tmp_path / "base"


def test_a_delta_is_read_without_privileges(flotilla_run: Path, base: Path) -> None:
    """Seen to fail: it was read as root, with all capabilities."""
    argv = [sys.executable, "-c", _ASK, str(flotilla_run.with_name("flotilla-patch")), str(base), str(_SEED)]
    done = subprocess.run(
        [*namespace.prefix("--mount-proc"), *argv], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    found = dict(re.findall(r"^(\w+):[ \t]*(.*?)[ \t]*$", done.stdout, re.MULTILINE))
    assert found["Uid"].split() == found["Gid"].split() == [str(privileges.UPDATE_NUMBER)] * 4
    assert found["Groups"] == ""
    assert {found[name] for name in ("CapPrm", "CapEff", "CapInh", "CapAmb")} == {"0" * 16}
    assert found["NoNewPrivs"] == "1"


def test_who_cannot_give_up_privileges_reads_nothing(flotilla_run: Path, base: Path) -> None:
    """In a user namespace that has no other user."""
    argv = ["unshare", "--user", "--map-root-user", str(flotilla_run.with_name("flotilla-patch")), str(base)]
    done = subprocess.run(argv, input=_SEED.read_bytes(), capture_output=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (1, b"")
    assert done.stderr.startswith(b"flotilla-patch: user 903: ")


def test_the_number_is_the_images() -> None:
    source = (paths.PROJECT / "runtime/programs/flotilla_patch.c").read_text()
    assert re.findall(r"\bUSER = (\d+),", source) == [str(privileges.UPDATE_NUMBER)]
    assert privileges.UPDATE_NUMBER not in privileges.USERS.values()
