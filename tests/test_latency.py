"""Latency in virtual time, really run: the same bytes on a busy host as on a quiet one, and a gate that notices."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from images.builder.boot import DIE_WITH_PARENT
from images.builder.errors import UserError
from images.builder.fleet import Board, Fleet
from tests.conftest import GuestFactory
from tests.latency import gate, machine, report, run, subject, target
from tests.latency.results import Latency, Results

pytestmark = pytest.mark.boot

BOARD = "smartcoret3"


@contextlib.contextmanager
def busy_host() -> Iterator[None]:
    """A process for each processor that only computes, for as long as the body takes.

    It is nice: QEMU's two threads hand over thousands of times a second, and would take ten times as long, not twice.
    """
    argv = [*DIE_WITH_PARENT, "nice", "-n", "10", sys.executable, "-c", "while True: pass"]
    hogs = [subprocess.Popen(argv) for _ in range(os.cpu_count() or 1)]
    try:
        yield
        assert [hog.poll() for hog in hogs] == [None] * len(hogs), "the host was not busy all the time"
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


@pytest.fixture(scope="module")
def board(fleet: Fleet) -> Board:
    return fleet.boards[BOARD]


@pytest.fixture(scope="module")
def measured(board: Board, session_artefacts: Path) -> Results:
    """The short run on the host as it is."""
    return run.measure(board, "quick", session_artefacts / "latency")


def test_a_run_repeats_to_the_byte_on_a_busy_host(measured: Results, board: Board, artefacts: Path) -> None:
    with busy_host():
        again = run.measure(board, "quick", artefacts)
    assert gate.compare(again, measured) == []
    assert again.text() == measured.text()


def test_the_loads_are_loads(measured: Results) -> None:
    busy = {name: outcome.activity.busy_percent for name, outcome in measured.scenarios.items() if outcome.activity}
    assert busy["idle"] < 50
    assert busy["scheduler"] > 90


def test_the_system_is_up_as_shipped(measured: Results) -> None:
    assert measured.boot.failed_units == []
    assert 0 < measured.boot.userspace_us < measured.boot.first_step_us < measured.boot.finished_us
    assert "PREEMPT_RT" in measured.version


def test_gate_notices_one_sample_elsewhere(measured: Results, tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    gate.accept(measured, file)
    assert gate.check(measured, file).startswith("every figure is that of")
    idle = measured.scenarios["idle"]
    histogram = dict(idle.latencies["wake-up"].histogram_us)
    latest = max(histogram)
    histogram |= {latest: histogram[latest] - 1, latest + 1: 1}
    moved = idle.model_copy(update={"latencies": {"wake-up": Latency.of(histogram)}})
    changed = measured.model_copy(update={"scenarios": measured.scenarios | {"idle": moved}})
    with pytest.raises(UserError, match=rf"idle: wake-up: .*100 % {latest} → {latest + 1} µs"):
        gate.check(changed, file)


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
    assert samples == {"idle": 1000, "scheduler": 1000, "uart-own": 33}
    assert "real time" in (report.write([found], artefacts)).read_text()
    left = robot.shell.run(["ls", "/run/latency", "/dev/robot/uart_own"], check=False)
    assert left.stderr.count("No such file") == 2, left.stdout


def test_a_guest_that_does_not_end_is_ended(board: Board, tmp_path: Path) -> None:
    """A kernel without a root, told to stand still when it panics."""
    initrd = tmp_path / "initrd.img"
    initrd.write_bytes(bytes(512))
    guest = machine.Machine(board, subject.build(board).kernel, initrd, ("panic=0",))
    with pytest.raises(UserError, match="the guest did not end within 3 s"):
        guest.run(tmp_path, 3)
