"""Tests on a slow or busy computer."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from tests import throttled


@pytest.mark.parametrize("second", [True, False], ids=["cgroup v2", "cgroup v1"])
def test_a_share_is_of_all_processors(tmp_path: Path, second: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    if second:
        (tmp_path / "cgroup.controllers").touch()
    else:
        (tmp_path / "cpu").mkdir()
    with throttled.group(0.25, tmp_path) as procs:
        files = {file.name: file.read_text() for file in procs.parent.iterdir()}
    limits = {"cpu.max": "100000 100000"}, {"cpu.cfs_period_us": "100000", "cpu.cfs_quota_us": "100000"}
    assert files == limits[0 if second else 1]
    assert not procs.parent.exists()


def test_a_computer_without_control_groups_is_said_so(tmp_path: Path) -> None:
    with (
        pytest.raises(UserError, match=r"no limit of the processor can be set.*as root"),
        throttled.group(0.5, tmp_path),
    ):
        pass


@pytest.mark.parametrize("text", ["0%", "101%", "50", "half", "%"])
def test_a_share_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="25%"):
        throttled.share_of(text)


def test_what_was_ever_red_is_listed() -> None:
    red = Counter({"tests/a.py::test_1": 2, "tests/a.py::test_2": 1})
    assert throttled.table("50%", 3, [0, 1, 1], red).splitlines() == [
        "50%: 3 runs, 2 of them red", "   2 of 3  tests/a.py::test_1", "   1 of 3  tests/a.py::test_2"
    ]  # fmt: skip


def test_runs_beside_busy_neighbours(tmp_path: Path) -> None:
    """A test that is red each second time."""
    folder = tmp_path / "tests" / "unit"
    folder.mkdir(parents=True)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  unit: x\n")
    text = "import pathlib\ndef test_a():\n  f = pathlib.Path('seen')\n  assert not f.exists()\n  f.touch()\n"
    (folder / "test_it.py").write_text(text)
    plugins = [word for name in ("tiers", "costs", "suite") for word in ("-p", f"tests.{name}")]
    argv = [sys.executable, "-m", "tests.throttled", "busy", "2", "--", "-p", "no:cacheprovider", *plugins]
    environment = os.environ | {"PYTHONPATH": str(paths.PROJECT)}
    done = subprocess.run(argv, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines()[-2:] == ["busy: 2 runs, 1 of them red", "   1 of 2  tests/unit/test_it.py::test_a"]
