"""Signal blocks in tasks of the real executive: what a unit test of one block cannot show."""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.station import convert, recording
from tests.running import PATIENCE, Row

Rows = list[Row]


@pytest.fixture
def rows(flotilla_run: Path, tmp_path: Path) -> Callable[[str, int, str], Rows]:
    """What the watched signals are in each of so many steps, by a clock that counts."""

    def run(text: str, steps: int, watched: str) -> Rows:
        path = tmp_path / "task.yml"
        path.write_text(text)
        command = [str(flotilla_run), "--no-wait", "--steps", str(steps), "--watch", watched, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        return [json.loads(line) for line in done.stdout.splitlines()]

    return run


def test_delay_is_of_one_step_wherever_it_stands(rows: Callable[[str, int, str], Rows]) -> None:
    """In a row, out of order in the file, and two of them after each other."""
    found = rows(
        """
period: 10 ms
blocks:
  twice: {type: delay, in: {in: once.out}, parameters: {initial: -2}}
  clock: {type: clock}
  once: {type: delay, in: {in: clock.time}, parameters: {initial: -1}}
  later: {type: sum, in: {in0: once.out, in1: twice.out}, parameters: {signs: "++"}}
""",
        20,
        "clock.time,once.out,twice.out,later.out",
    )
    times = [row["clock.time"] for row in found]
    assert times == pytest.approx([0.01 * step for step in range(20)])
    assert [row["once.out"] for row in found] == [-1, *times[:-1]]
    assert [row["twice.out"] for row in found] == [-2, -1, *times[:-2]]
    assert [row["later.out"] for row in found] == [row["once.out"] + row["twice.out"] for row in found]


def test_integrators_close_a_loop(rows: Callable[[str, int, str], Rows]) -> None:
    """x'' = -w² x by Euler's forward steps: x[n] = Re((1 + i w h)^n), which grows by sqrt(1 + w² h²) each step."""
    omega, period = 2.0, 0.01
    found = rows(
        f"""
period: 10 ms
blocks:
  accelerate: {{type: gain, in: {{in: position.out}}, parameters: {{factor: {-omega * omega}}}}}
  velocity: {{type: integrator, in: {{in: accelerate.out}}}}
  position: {{type: integrator, in: {{in: velocity.out}}, parameters: {{initial: 1}}}}
""",
        500,
        "position.out",
    )
    expected = [((1 + 1j * omega * period) ** step).real for step in range(500)]
    assert [row["position.out"] for row in found] == pytest.approx(expected, abs=1e-9)


def test_controller_brings_a_plant_to_its_set_point(rows: Callable[[str, int, str], Rows]) -> None:
    """A PID on a plant of one integrator with a steady disturbance: no error is left, and no limit exceeded."""
    found = rows(
        """
period: 10 ms
blocks:
  control:
    type: pid
    in: {set_point: 1.0, measurement: plant.out}
    parameters: {kp: 4, ki: 4, min: -2, max: 2}
  push: {type: sum, in: {in0: control.out, in1: 0.5}}
  plant: {type: integrator, in: {in: push.out}}
""",
        1000,
        "plant.out,control.out",
    )
    commands = [row["control.out"] for row in found]
    assert max(commands) == 2
    assert min(commands) >= -2
    assert found[-1]["plant.out"] == pytest.approx(1, abs=1e-4)
    assert commands[-1] == pytest.approx(-0.5, abs=1e-3)
    assert max(row["plant.out"] for row in found) < 1.3


def test_packed_signals_come_back(rows: Callable[[str, int, str], Rows]) -> None:
    found = rows(
        """
period: 10 ms
blocks:
  clock: {type: clock}
  pack:
    type: pack
    in: {time: clock.time, wall: clock.wall_ns, step: clock.step}
    parameters: {types: [double, int64, uint64], names: [time, wall, step], byte_order: big}
  unpack:
    type: unpack
    in: {in: pack.out, length: 24}
    parameters: {types: [double, int64, uint64], names: [time, wall, step], byte_order: big, check_length: true}
""",
        5,
        "clock.time,clock.wall_ns,clock.step,unpack.time,unpack.wall,unpack.step,unpack.flag",
    )
    for row in found:
        assert row["unpack.flag"] == 1
        for sent, received in [("time", "time"), ("wall_ns", "wall"), ("step", "step")]:
            assert row[f"unpack.{received}"] == row[f"clock.{sent}"]


RECORDED = """
period: 1 ms
priority: 0
blocks:
  clock: {{type: clock}}
  square:
    type: trajectory
    parameters: {{dimensions: 2, waypoints: [0, 0, 1, 0, 1, 1, 0, 1, 0, 0], speed: 0.01}}
  log:
    type: recorder
    in: {{position: square.position, done: square.done, step_number: clock.step}}
    parameters:
      directory: {directory}
      types: [double, boolean, uint64]
      widths: [2, 1, 1]
      names: [position, done, step_number]
"""


def check_square(found: recording.Recording) -> None:
    assert (found.name, found.period_ns, found.damaged) == ("log", 1_000_000, 0)
    wall_ns = found.records[0]["time_ns"]
    assert isinstance(wall_ns, int)
    assert abs(wall_ns + found.wall_less_monotonic_ns - time.time_ns()) < 60e9
    for record in found.records:
        assert record["step"] == record["step_number"]
        assert record["lost"] == 0
        assert record["done"] is False
        time_ns, position = record["time_ns"], record["position"]
        assert isinstance(time_ns, int)
        assert isinstance(position, tuple)
        assert position == pytest.approx((1e-11 * (time_ns - wall_ns), 0), abs=1e-12)


def test_recording_is_read_back(flotilla_run: Path, tmp_path: Path) -> None:
    task = tmp_path / "task.yml"
    task.write_text(RECORDED.format(directory=tmp_path))
    subprocess.run([flotilla_run, "--no-wait", "--steps", "100", task], check=True, timeout=PATIENCE)
    path = tmp_path / "log-000001.rec"
    found = recording.read(path)
    check_square(found)
    assert len(found.records) == 100
    assert found.rest == 0
    convert.convert([path], tmp_path / "log.csv")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert lines[0] == "time_s,wall_ns,time_ns,step,lost,position[0],position[1],done,step_number"
    assert lines[100].split(",")[3:5] == ["99", "0"]
    assert math.isclose(float(lines[100].split(",")[5]), 0.00099)


def test_recording_of_a_killed_task_is_readable(flotilla_run: Path, tmp_path: Path) -> None:
    task = tmp_path / "task.yml"
    task.write_text(RECORDED.format(directory=tmp_path))
    path = tmp_path / "log-000001.rec"
    command = [str(flotilla_run), "--watch", "log.recorded", str(task)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        try:
            recorded = next(n for line in process.stdout if (n := json.loads(line)["log.recorded"]) >= 100)
        finally:
            process.kill()
    found = recording.read(path)
    check_square(found)
    assert len(found.records) >= recorded


def test_damage_is_left_out(flotilla_run: Path, tmp_path: Path) -> None:
    task = tmp_path / "task.yml"
    task.write_text(RECORDED.format(directory=tmp_path))
    subprocess.run([flotilla_run, "--no-wait", "--steps", "10", task], check=True, timeout=PATIENCE)
    data = bytearray((tmp_path / "log-000001.rec").read_bytes())
    size = 20 + 16 + 1 + 8 + 4
    data[-2 * size + 25] ^= 1  # in the last but one
    found = recording.parse(bytes(data[:-3]))  # and half of the last
    assert [record["step"] for record in found.records] == list(range(8))
    assert (found.damaged, found.rest) == (1, size - 3)
    for broken in (b"", bytes(data[:40]), b"X" + data[1:], bytes(data).replace(b'"uint64"', b'"uint63"')):
        with pytest.raises(recording.RecordingError):
            recording.parse(broken)
