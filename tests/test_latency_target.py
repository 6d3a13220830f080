"""The latency of a robot in real time, by the scenarios that are measured in virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest

from images.builder.fleet import Fleet
from tests.conftest import GuestFactory
from tests.latency import report, run, target

pytestmark = [pytest.mark.boot, pytest.mark.alone]


def test_the_same_scenarios_on_a_robot_in_real_time(
    guest: GuestFactory, fleet: Fleet, artefacts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A guest stands in for the robot. How late it is depends on this host and is not judged."""
    monkeypatch.setitem(run.SECONDS, "quick", 1)
    robot = guest(3)
    found = target.measure(robot.robot, fleet.boards[robot.robot.board], robot.shell, "quick", artefacts)
    samples = {
        name: outcome.latencies[next(iter(outcome.latencies))].samples for name, outcome in found.scenarios.items()
    }
    assert samples == {"idle": 1000, "scheduler": 1000, "timerlat-everything": 167, "uart-own": 33}
    assert "real time" in (report.write([found], artefacts)).read_text()
    left = robot.shell.run(["ls", "/run/latency", "/dev/robot/uart_own"], check=False)
    assert left.stderr.count("No such file") == 2, left.stdout
