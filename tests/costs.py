"""What the suite costs, by tier: tests, failures, time and processor time, and the files that cost most; a table at the
end of `make test`.

A pytest plugin that measures each test, and a command that measures what is no test, `python -m tests.costs run NAME
COMMAND…`. Both append to the file that `COSTS` names, if it does; `python -m tests.costs show FILE` prints the table.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.tiers import TIERS

PROPERTY = "processor_s"
_DEAREST = 12
"""Files of tests in the table: those that take most processor time."""
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_FILE = pytest.StashKey[str | None]()
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
    config.stash[_FILE] = os.environ.pop("COSTS", None)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ:
        return  # its reports are among those of the process that started it
    reports = [each for kind in terminalreporter.stats.values() for each in kind if isinstance(each, pytest.TestReport)]
    for tier in [*dict.fromkeys(TIERS.values()), "nightly"]:
        own = [report for report in reports if tier_of(report) == tier]
        if own:
            record(config.stash[_FILE], tier, **_sums(own))
    by_file: dict[str, list[pytest.TestReport]] = {}
    for report in reports:
        by_file.setdefault(report.nodeid.partition("::")[0], []).append(report)
    for name, own in by_file.items():
        record(config.stash[_FILE], name, **_sums(own))


def _sums(reports: Sequence[pytest.TestReport]) -> dict[str, float]:
    """Of tests."""
    return {
        "tests": len({report.nodeid for report in reports}),
        "failed": len({report.nodeid for report in reports if report.failed}),
        "seconds": sum(report.duration for report in reports),
        "processor_s": sum(
            float(str(value)) for report in reports for name, value in report.user_properties if name == PROPERTY
        ),
    }


def tier_of(report: pytest.TestReport) -> str:
    return "nightly" if "nightly" in report.keywords else TIERS[report.nodeid.split("/")[1]]


def record(file: str | None, name: str, **row: float) -> None:
    if file:
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        with Path(file).open("a") as to:
            to.write(json.dumps({"tier": name, **row}) + "\n")


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


def table(file: Path) -> str:
    """Rows of the same tier are added up. Minutes are of each test, so of two at once both count."""
    tiers: dict[str, dict[str, float]] = {}
    for row in rows(file):
        total = tiers.setdefault(row.pop("tier"), dict.fromkeys(row, 0))
        for key, value in row.items():
            total[key] += value
    files = [name for name in tiers if name.endswith(".py")]
    dearest = sorted(files, key=lambda name: -tiers[name]["processor_s"])[:_DEAREST]
    width = max(map(len, ["tier" + " " * 9, *dearest]))
    lines = [f"{'tier':<{width}} {'tests':>6} {'failed':>6} {'minutes':>8} {'processor':>9}"]
    for tier in [*(name for name in tiers if name not in files), *dearest]:
        row = tiers[tier]
        minutes, processor = row["seconds"] / 60, row["processor_s"] / 60
        lines.append(f"{tier:<{width}} {row['tests'] or '':>6} {row['failed']:>6.0f} {minutes:>8.1f} {processor:>9.1f}")
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    if argv[0] == "run":
        return run(argv[1], argv[2:])
    print(table(Path(argv[1])))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
