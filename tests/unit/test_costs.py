"""The table at the end of `make test`."""

from __future__ import annotations

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


def test_the_dearest_files_come_below(tmp_path: Path) -> None:
    """By processor time, and no more of them than help."""
    file = tmp_path / "costs"
    for number in range(20):
        costs.record(str(file), f"tests/unit/test_{number}.py", tests=1, failed=0, seconds=60, processor_s=number)
    costs.record(str(file), "unit", tests=20, failed=0, seconds=1200, processor_s=190)
    first, *others = [line.split()[0] for line in costs.table(file).splitlines()[1:]]
    assert first == "unit"
    assert others == [f"tests/unit/test_{number}.py" for number in range(19, 19 - costs._DEAREST, -1)]


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
