"""The table at the end of `make test`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import paths
from tests import costs

SPIN = "import time\nwhile time.process_time() < 0.5: pass\n"


def test_rows_of_a_tier_are_added_up(tmp_path: Path) -> None:
    file = tmp_path / "reports" / "costs"
    costs.record(str(file), "runtime", tests=180, failed=1, seconds=240, processor_s=30)
    costs.record(str(file), "kernel", tests=0, failed=0, seconds=390, processor_s=600)
    costs.record(str(file), "runtime", tests=20, failed=0, seconds=60, processor_s=60)
    assert [line.split() for line in costs.table(file).splitlines()] == [
        ["tier", "tests", "failed", "minutes", "processor"],
        ["runtime", "200", "1", "5.0", "1.5"],
        ["kernel", "0", "6.5", "10.0"],
    ]


def test_the_slowest_tests_come_below(tmp_path: Path) -> None:
    """Ten of them."""
    file = tmp_path / "costs"
    for number in range(20):
        name = f"tests/unit/test_a.py::test_{number}"
        costs.record(str(file), "unit", name, tests=1, failed=0, seconds=number, processor_s=1)
    first, *others = [line.split()[0] for line in costs.table(file).splitlines()[1:]]
    assert first == "unit"
    assert others == [f"tests/unit/test_a.py::test_{number}" for number in range(19, 9, -1)]


def test_costs_of_good_runs_are_kept(tmp_path: Path) -> None:
    file, kept = tmp_path / "costs", tmp_path / "costs.json"
    kept.write_text('{"tests/unit/test_a.py::old": 9.0, "tests/unit/test_a.py::cheaper": 9.0}')
    for name, failed, processor_s in (("dear", 0, 7.123), ("cheaper", 0, 0.1), ("red", 1, 60), ("old", 1, 70)):
        record = {"tests": 1, "failed": failed, "seconds": 1, "processor_s": processor_s}
        costs.record(str(file), "unit", f"tests/unit/test_a.py::{name}", **record)
    costs.record(str(file), "lint", tests=0, failed=0, seconds=1, processor_s=90)
    costs.keep(file, to=kept)
    assert json.loads(kept.read_text()) == {"tests/unit/test_a.py::dear": 7.1, "tests/unit/test_a.py::old": 9.0}


@pytest.mark.parametrize("status", [0, 3])
def test_a_command_is_measured_whatever_comes_of_it(tmp_path: Path, status: int) -> None:
    file = tmp_path / "costs"
    command = [sys.executable, "-c", f"{SPIN}raise SystemExit({status})"]
    argv = [sys.executable, "-m", "tests.costs", "run", "spin", *command]
    done = subprocess.run(argv, cwd=paths.PROJECT, env={"COSTS": str(file)}, timeout=60, check=False)
    assert done.returncode == status
    (row,) = costs.rows(file)
    assert (row["tier"], row["tests"], row["failed"]) == ("spin", 0, int(status != 0))
    assert row["processor_s"] >= 0.5


def test_a_child_that_still_runs_counts() -> None:
    """As a guest does that tests share. Seen to fail with getrusage alone, which knows the ended ones."""
    before = costs.processor_s()
    with subprocess.Popen(
        [sys.executable, "-c", f"{SPIN}print(flush=True)\ninput()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout
        child.stdout.readline()
        assert costs.processor_s() - before >= 0.4, "the kernel counts in ticks"
        child.communicate(b"\n")
