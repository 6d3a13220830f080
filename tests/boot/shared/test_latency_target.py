"""The latency of a robot in real time, by the scenarios that are measured in virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.fleet.model import Fleet
from lab.latency import report, run, target
from tests.conftest import GuestFactory


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
    tracer = samples.pop("timerlat-everything")
    assert samples == {"idle": 1000, "scheduler": 1000, "uart-own": 33, "uart-own-everything": 33}
    # A host that is slow enough makes the tracer miss periods, which the report names.
    assert 0 < tracer <= 167
    page = report.write([found], artefacts).read_text()
    assert "real time" in page
    assert (f": interrupt: {tracer} of 167 samples" in page) == (tracer < 167)
    left = robot.shell.run(["ls", "/run/latency", "/dev/robot/uart_own"], check=False)
    assert left.stderr.count("No such file") == 2, left.stdout
