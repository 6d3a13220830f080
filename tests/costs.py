"""What the suite costs, by tier: tests, failures, time and processor time, and the slowest tests; a table at the end of
`make test`, and an estimate before it begins.

A pytest plugin that measures each test, and commands, `python -m tests.costs`:

    run NAME COMMAND…   measures a command that is no test
    show FILE           prints the table
    keep FILE…          takes the costs of tests into costs.json: the estimate, the order of tests and the parts of
                        `make test-all` come from there

Both measurements append to the file that the variable COSTS names, if any: a row for each test, as it ends.
"""

from __future__ import annotations

import functools
import json
import os
import resource
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.tiers import tier

PROPERTY = "processor_s"
KEPT = Path(__file__).with_suffix(".json")
"""Processor seconds of tests; those that need no guest and take less than _WORTH_S are left out."""
_WORTH_S = 0.5
_OTHERS_S = {"unit": 0.05, "runtime": 0.3, "image": 0.5, "boot": 10.0}
"""Estimates for tests that it does not have, by the tier of their folders."""
_SLOWEST = 10
"""Tests in the table."""
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_so_far = 0.0
"""Processor time of this process and its descendants when the last test ended."""


def processor_s() -> float:
    """Of this process and its descendants, those that have ended included."""
    usage = (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in usage) + _of_children(os.getpid())


def _of_children(process: int) -> float:
    """Of the descendants that still run: proc(5)."""
    total = 0.0
    try:
        for task in Path(f"/proc/{process}/task").iterdir():
            for child in map(int, (task / "children").read_text().split()):
                fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
                total += sum(map(int, fields[11:15])) / _TICKS_PER_S + _of_children(child)
    except OSError:
        pass  # it has ended meanwhile: its parent's account has it
    return total


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What a test took includes what was done for it: fixtures, and guests that go on."""
    global _so_far
    report = yield
    if report.when == "teardown":
        now = processor_s()
        report.user_properties.append((PROPERTY, now - _so_far))
        _so_far = now
    return report


def pytest_configure(config: pytest.Config) -> None:
    """What tests run is a part of them, and has no row of its own."""
    file = os.environ.pop("COSTS", None)
    if not hasattr(config, "workerinput"):  # its reports come to the process that started it
        config.pluginmanager.register(_Recorder(file))


class _Recorder:
    """Writes a row when a test has ended."""

    def __init__(self, file: str | None) -> None:
        self._file = file
        self._seconds: dict[str, float] = defaultdict(float)
        self._failed: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] += report.duration
        if report.failed:
            self._failed.add(report.nodeid)
        if report.when == "teardown":
            taken = [float(str(value)) for name, value in report.user_properties if name == PROPERTY]
            record(
                self._file,
                tier_of(report),
                test=report.nodeid,
                tests=1,
                failed=int(report.nodeid in self._failed),
                seconds=self._seconds[report.nodeid],
                processor_s=sum(taken),
            )


def tier_of(report: pytest.TestReport) -> str:
    return "nightly" if "nightly" in report.keywords else tier(report.nodeid)


@functools.cache
def kept() -> dict[str, float]:
    """By test: the processor seconds that costs.json has."""
    read: dict[str, float] = json.loads(KEPT.read_text())
    return read


def of(nodeid: str) -> float:
    """Processor seconds that a test is likely to take."""
    return kept().get(nodeid, _OTHERS_S[tier(nodeid)])


def estimate(nodeids: Iterable[str]) -> str:
    """Of a run, before it begins."""
    each = [of(nodeid) for nodeid in nodeids]
    return f"{len(each)} tests, about {sum(each) / 60:.1f} processor minutes by tests/costs.json"


def record(file: str | None, name: str, test: str = "", **row: float) -> None:
    if file:
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        with Path(file).open("a") as to:
            to.write(json.dumps({"tier": name, "test": test, **row}) + "\n")


def run(name: str, command: list[str]) -> int:
    begun = time.monotonic()
    status = subprocess.run(command, check=False).returncode
    record(
        os.environ.get("COSTS"),
        name,
        tests=0,
        failed=int(status != 0),
        seconds=time.monotonic() - begun,
        processor_s=processor_s(),
    )
    return status


def rows(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def keep(file: Path, *, to: Path = KEPT) -> None:
    """Take what tests cost by a run that passed into costs.json."""
    costs = json.loads(to.read_text()) if to.exists() else {}
    for row in rows(file):
        if row["test"] and not row["failed"]:
            costs.pop(row["test"], None)
            if row["processor_s"] >= _WORTH_S or tier(row["test"]) == "boot":
                costs[row["test"]] = round(row["processor_s"], 1)
    to.write_text(json.dumps(costs, indent=0, sort_keys=True, ensure_ascii=False) + "\n")


def table(file: Path) -> str:
    """Rows of the same tier are added up. Minutes are of each test, so of two at once both count."""
    tiers: dict[str, Counter[str]] = {}
    tests: dict[str, Counter[str]] = {}
    for row in rows(file):
        own = Counter({key: row[key] for key in ("tests", "failed", "seconds", "processor_s")})
        tiers.setdefault(row["tier"], Counter()).update(own)
        if row["test"]:
            tests.setdefault(row["test"], Counter()).update(own)
    slowest = sorted(tests, key=lambda name: -tests[name]["seconds"])[:_SLOWEST]
    width = max(map(len, ["tier" + " " * 9, *slowest]))
    lines = [f"{'tier':<{width}} {'tests':>6} {'failed':>6} {'minutes':>8} {'processor':>9}"]
    for name, row in [*tiers.items(), *((name, tests[name]) for name in slowest)]:
        minutes, processor = row["seconds"] / 60, row["processor_s"] / 60
        lines.append(f"{name:<{width}} {row['tests'] or '':>6} {row['failed']:>6} {minutes:>8.1f} {processor:>9.1f}")
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    if argv[0] == "run":
        return run(argv[1], argv[2:])
    for file in argv[1:]:
        if argv[0] == "keep":
            keep(Path(file))
        else:
            print(table(Path(file)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
