"""The plant's blocks in tasks of the real executive: the same robot as Python's, and frames as the gyro's.

The plug-in is built here as a stranger would build one. That `relay-register` reads a port is for a guest to show.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from flotilla.common import paths
from flotilla.lab.emulators import dsp3000
from flotilla.lab.emulators.serial_line import Pty
from flotilla.lab.plants.plant import DIRECTORY, ROBOT, Plant
from tests.running import PATIENCE, Row

PERIOD_S = 0.01
PARAMETERS: dict[str, Any] = yaml.safe_load(ROBOT.read_text())
GEOMETRY = {name: PARAMETERS[name] for name in ("positions", "directions", "force")}
FRAME_BYTES = 21


@pytest.fixture(scope="module")
def command(flotilla_run: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str | Path]:
    """flotilla-run with the plant's blocks."""
    directory = tmp_path_factory.mktemp("blocks")
    argv = ["cc", "-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-O2", "-shared", "-fPIC"]
    argv += [f"-I{paths.PROJECT}/runtime/include", "-o", str(directory / "plant.so")]
    subprocess.run([*argv, *map(str, sorted(DIRECTORY.glob("*.c"))), "-lm"], check=True)
    return [flotilla_run, "--blocks", directory]


Blocks = dict[str, dict[str, Any]]
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(command: list[str | Path], tmp_path: Path) -> Run:
    """Run a task to its end, by a clock that counts."""

    def run(blocks: Blocks, *options: str, under: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
        path = tmp_path / "task.yml"
        path.write_text(yaml.safe_dump({"period": f"{PERIOD_S:g} s", "priority": 0, "blocks": blocks}))
        argv = [*under, *command, "--no-wait", *options, path]
        return subprocess.run(argv, capture_output=True, text=True, timeout=PATIENCE, check=False)

    return run


def rows(done: subprocess.CompletedProcess[str]) -> list[Row]:
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def robot(valves: object, **changes: object) -> dict[str, Any]:
    return {"type": "floating-robot", "in": {"valves": valves}, "parameters": PARAMETERS | changes}


# --- robot ---

SIGNALS = ("pose", "velocity", "igps", "rate_deg_s", "on_time", "switches")
HOLDING: Blocks = {
    "robot": robot("mapping.valves", initial_pose=[1, 2, 0.3], seed=5),
    "attitude": {
        "type": "pid",
        "in": {"set_point": 0, "measurement": "robot.pose[2]"},
        "parameters": {"kp": 0.04, "kd": 0.1, "min": -0.02, "max": 0.02},
    },
    "mapping": {
        "type": "thruster-mapping",
        "in": {"force_x": 0.02, "force_y": 0, "torque": "attitude.out"},
        "parameters": GEOMETRY | {"steps": 10, "minimum": 0.02},
    },
}
"""The robot turns back to its heading, by what the blocks of a robot would do, and pushes forward meanwhile."""


def test_block_is_the_robot_of_python(run: Run) -> None:
    """Number for number, noise included, with loop and physics in one task. Seen to fail with a robot that moves by the
    valves of this step, one that moves before its first step, and a parameter that the block passes over."""
    watch = ",".join(["mapping.valves", *(f"robot.{name}" for name in SIGNALS)])
    found = rows(run(HOLDING, "--steps", "2000", "--watch", watch))
    plant = Plant(initial_pose=[1, 2, 0.3], seed=5)
    valves = [0] * 8
    for step, row in enumerate(found):
        plant.step(PERIOD_S if step else 0, [bool(valve) for valve in valves])
        igps = plant.igps()
        expected = (plant.pose, plant.velocity, igps, [plant.gyro_deg_s()], plant.on_time, plant.switches)
        for name, wanted in zip(SIGNALS, expected, strict=True):
            said = row[f"robot.{name}"]
            assert (said if isinstance(said, list) else [said]) == list(wanted), (step, name)
        valves = row["mapping.valves"]
    assert abs(plant.pose[2]) < 0.05
    assert min(plant.on_time[0], plant.pose[0] - 1) > 0.1, "it did not fly"


def test_time_passes_in_steps_that_are_left_out(run: Run) -> None:
    """Seen to fail with a robot that moves by its period."""
    blocks = {"robot": robot([1, 1, 0, 0, 0, 0, 0, 0]) | {"every": 5}}
    found = rows(run(blocks, "--steps", "101", "--watch", "robot.on_time"))
    assert found[-1]["robot.on_time"][0] == 1 - PARAMETERS["opening_delay"]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "count": ({"tilt": [0, 0, 0]}, "parameter tilt: 3 numbers, not 2"),
    "one for all": ({"positions": 1}, "parameter positions: 1 numbers, not 16"),
    "range": ({"mass": 0}, "parameter mass: 0 is not from 0.001 to 1e+06 kg"),
    "direction": ({"directions": [0] * 16}, "parameter directions: thruster 0 pushes nowhere"),
}


@pytest.mark.parametrize("case", list(REFUSED))
def test_wrong_parameters(run: Run, case: str) -> None:
    changes, reason = REFUSED[case]
    done = run({"robot": robot([0] * 8, **changes)}, "--check")
    assert done.returncode == 2
    assert reason in done.stderr


# --- gyro ---


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A serial line: the end that is read here, and the path of the other."""
    pty = Pty()
    master = pty.plug()
    yield master, pty.path
    pty.unplug()


def frames(device: str, valid: int, **parameters: object) -> dict[str, Any]:
    return {
        "type": "dsp3000-frames",
        "in": {"rate_deg_s": "robot.rate_deg_s", "valid": valid},
        "parameters": {"device": device} | parameters,
    }


@pytest.mark.parametrize(("valid", "rate"), [(1, 0.0), (0, -4.5), (1, 90.0)])
def test_frames_are_the_gyros(run: Run, line: tuple[int, str], valid: int, rate: float) -> None:
    """Byte for byte as the emulated gyro's. Seen to fail with a digit less, without the minus, and with a flag of 1
    for good."""
    master, device = line
    blocks = {"robot": robot([0] * 8, initial_velocity=[0, 0, rate]), "frames": frames(device, valid)}
    found = rows(run(blocks, "--steps", "50", "--watch", "robot.rate_deg_s,frames.lost"))
    sent = b"".join(dsp3000.text(row["robot.rate_deg_s"], bool(valid)) for row in found)
    assert len(sent) == 50 * FRAME_BYTES
    received = b""
    while len(received) < len(sent):
        received += os.read(master, 4096)
    assert received == sent
    assert found[-1]["frames.lost"] == 0


def test_a_full_line_holds_up_nothing(run: Run, line: tuple[int, str]) -> None:
    """Seen to fail with a blocking port, which hangs, and with a count that stays 0."""
    blocks = {"robot": robot([0] * 8), "frames": frames(line[1], 1)}
    found = rows(run(blocks, "--steps", "20000", "--watch", "frames.lost"))
    assert 0 < found[-1]["frames.lost"] < 20000


def test_line_that_cannot_be_used(run: Run, line: tuple[int, str], tmp_path: Path) -> None:
    for device, loopback, reason in (
        (str(tmp_path / "port"), False, "No such file or directory"),
        ("/dev/null", False, "Inappropriate ioctl for device"),
        (line[1], True, "Inappropriate ioctl for device"),
    ):
        blocks = {"robot": robot([0] * 8), "frames": frames(device, 1, loopback=loopback)}
        done = run(blocks, "--steps", "1")
        assert done.returncode != 0
        assert f"{device}: {reason}" in done.stderr


# --- relays ---


def test_ports_need_a_privilege(run: Run) -> None:
    """Seen to fail with a block that does not ask."""
    under = ("setpriv", "--bounding-set=-sys_rawio", "--inh-caps=-sys_rawio") if os.geteuid() == 0 else ()
    done = run({"relays": {"type": "relay-register"}}, "--steps", "1", under=under)
    assert done.returncode == 1
    assert "I/O port 0x300: " in done.stderr
    assert "it needs the privilege CAP_SYS_RAWIO" in done.stderr
