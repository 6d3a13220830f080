"""pytest plugin: what `make test` runs of what there is, in which order, and in which of several parts.

`make test-all` runs every test; `make test` those without the mark `nightly`, which all others get here: it runs what
suite.yml names, and what needs no guest and is cheap.
"""

from __future__ import annotations

import functools
import heapq
import os
import re
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from tests import costs
from tests.tiers import SAME_PLACE, tier, together

FILE = Path(__file__).with_suffix(".yml")
CHEAP_S = 3.0
"""Processor seconds by costs.json up to which a test that needs no guest runs always."""
CHECKS_S = 240
"""Processor seconds of what is no test, which the first part does: lint, the C unit tests, fuzzing."""


@functools.cache
def named() -> Mapping[str, Sequence[str]]:
    """By area: the tests of suite.yml."""
    read: dict[str, list[str]] = yaml.safe_load(FILE.read_text())
    return read


def stays(nodeid: str, names: Collection[str] | None = None) -> bool:
    """Whether suite.yml names it (the test, its function, its file, its file with parameters), or it is cheap."""
    names = names if names is not None else {name for area in named().values() for name in area}
    test = nodeid.removeprefix("tests/")
    function, bracket, parameters = test.partition("[")
    file = function.partition("::")[0]
    cheap = tier(nodeid) != "boot" and costs.of(nodeid) <= CHEAP_S
    return cheap or any(name in names for name in (test, function, file, file + bracket + parameters))


def by_cost(nodeids: Iterable[str]) -> dict[str, float]:
    """What goes to one process, the dearest first, and what that costs."""
    groups: dict[str, float] = {}
    for nodeid in nodeids:
        groups[together(nodeid)] = groups.get(together(nodeid), 0) + costs.of(nodeid)
    return dict(sorted(groups.items(), key=lambda one: (-one[1], one[0])))


def parts(groups: Mapping[str, float], count: int) -> list[set[str]]:
    """Groups in so many parts of about the same cost: each, the dearest first, into the cheapest part so far."""
    found: list[set[str]] = [set() for _ in range(count)]
    cheapest = [(CHECKS_S if number == 0 else 0.0, number) for number in range(count)]
    heapq.heapify(cheapest)
    for name, cost in sorted(groups.items(), key=lambda one: (-one[1], one[0])):
        so_far, number = heapq.heappop(cheapest)
        found[number].add(name)
        heapq.heappush(cheapest, (so_far + cost, number))
    return found


def asked_part(text: str) -> tuple[int, int]:
    """`3/8`: part 3 of 8."""
    match = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", text)
    if not match or int(match[1]) > int(match[2]):
        raise UserError(f"PART={text}: write which part of how many, for example PART=3/8")
    return int(match[1]), int(match[2])


class _Marks:
    """First, so that `-m` finds them; order and part last, of what `-m` has left."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            nightly = item.get_closest_marker("nightly") or not stays(item.nodeid)
            item.add_marker("nightly" if nightly else tier(item.nodeid))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    groups = by_cost(item.nodeid for item in items)
    if asked := os.environ.get("PART"):
        number, count = asked_part(asked)
        own = parts(groups, count)[number - 1]
        config.hook.pytest_deselected(items=[item for item in items if together(item.nodeid) not in own])
        items[:] = [item for item in items if together(item.nodeid) in own]
    rank = {name: number for number, name in enumerate(groups)}
    items.sort(key=lambda item: (rank[together(item.nodeid)], Path(item.nodeid.partition("::")[0]).name in SAME_PLACE))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """A part may have none of the tests that `-m` leaves."""
    if os.environ.get("PART") and exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED:
        session.exitstatus = pytest.ExitCode.OK


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(_Marks())
    if not hasattr(config, "workerinput"):  # of pytest-xdist, whose reports come to the process that started it
        config.pluginmanager.register(_Reporter())


class _Reporter:
    """Where the results come together: what the run is going to do, and with each failure how to repeat it."""

    _said = False

    def pytest_report_collectionfinish(self, items: Sequence[pytest.Item]) -> str:
        return costs.estimate(item.nodeid for item in items) if items else ""

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: Sequence[str]) -> None:
        if not self._said:
            self._said = True
            _write(node.config, costs.estimate(ids))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and report.longrepr:
            report.longrepr = Repeated(repeat(report.nodeid), report.longrepr)  # type: ignore[assignment]


def repeat(nodeid: str) -> str:
    """The command that runs a test alone."""
    return f"to repeat it alone: {paths.shown(paths.BUILD / 'venv')}/bin/pytest {shlex.quote(nodeid)}"


class Repeated:
    """Why a test failed, below the command that repeats it."""

    def __init__(self, command: str, reason: Any) -> None:
        self._command = command
        self._reason = reason

    def toterminal(self, terminal: Any) -> None:
        terminal.line(self._command)
        if hasattr(self._reason, "toterminal"):
            self._reason.toterminal(terminal)
        else:
            terminal.line(str(self._reason))

    def __str__(self) -> str:
        return f"{self._command}\n{self._reason}"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._reason, name)


def _write(config: pytest.Config, line: str) -> None:
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter:
        reporter.ensure_newline()
        reporter.write_line(line)
