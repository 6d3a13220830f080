"""Control loops inside one guest in virtual time: every figure repeats to the byte, so it may be judged.

The board's shipped system with our kernel, booted from memory as for latency measurements. Tasks and the plug-in with
the loop's other end enter from outside.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from images.builder import paths, runtime
from images.builder.fleet import Board, Fleet
from tests.latency import machine, results, subject
from tests.latency.subject import DIRECTORY

pytestmark = pytest.mark.boot

PLUGIN = paths.PROJECT / "runtime" / "tests" / "plugin" / "loopback.c"
SECONDS = 5
SETTLED = 300
"""Steps after which the velocity loop, whose drive first has to be configured, has to hold."""

CHAIN = """
period: 10 ms
priority: 80
blocks:
  frames: {{type: frames, parameters: {{device: {device}}}}}
  gyro: {{type: dsp3000, parameters: {{device: {device}}}}}
  attitude: {{type: pid, in: {{set_point: 0, measurement: gyro.rate}}, parameters: {{kp: 1000, min: -1, max: 1}}}}
  valve: {{type: schmitt-trigger, in: {{in: attitude.out}}, parameters: {{on: 0.01, off: 0}}}}
  relays: {{type: ir104-pbf, in: {{command: valve.on, flag: gyro.flag}}, parameters: {{channels: [1]}}}}
  chain: {{type: chain, in: {{rate: gyro.rate, after: relays.mismatch}}, parameters: {{file: /run/latencies.json}}}}
"""

FAST = """
period: 10 ms
priority: 80
blocks:
  wave: {type: trajectory, parameters: {waypoints: [0, 1], times: [0, 10]}}
  out: {type: queue-send, in: {data: wave.position}, parameters: {name: /wave}}
"""

SLOW = """
period: 100 ms
phase: 5 ms
priority: 70
blocks:
  in: {type: queue-receive, parameters: {name: /wave}}
  filtered: {type: low-pass, in: {in: in.data}, parameters: {time_constant: 1}}
"""

# The robot's controller sets the motor's current. Two CAN boards are on one bus: the robot's own, and the drive's, for
# which an emulator runs in the guest, because the host may have no CAN.
CAN_BOARDS = ("-object", "can-bus,id=bus", *("-device", "kvaser_pci,canbus=bus") * 2)
EMULATOR = ("tests/emulators/can_bus.py", "tests/emulators/epos2.py")
TARGET_RAD_S = 5.0
VELOCITY = f"""
period: 10 ms
priority: 60
blocks:
  drive:
    type: epos2
    in: {{target: limit.out, enable: 1}}
    parameters: {{interface: can0, node: 3, mode: current, counts: 2000, gear: 10, heartbeat: 0.5, timeout: 0.5}}
  before: {{type: delay, in: {{in: drive.velocity}}}}
  controller:
    type: pid
    in: {{set_point: {TARGET_RAD_S}, measurement: before.out}}
    parameters: {{kp: 0.05, ki: 0.2, min: -1, max: 1}}
  limit: {{type: limit, in: {{in: controller.out}}, parameters: {{min: -1, max: 1}}}}
"""
WATCH = ("--watch", "drive.velocity,drive.enabled,drive.flag,drive.abort")
# The drive's state after the task is the last line.
DRIVE = """
import subprocess, sys
from tests.emulators.can_bus import SocketCanBus
from tests.emulators.epos2 import Epos2, Epos2Server
for interface in ("can0", "can1"):
    subprocess.run(["ip", "link", "set", interface, "up", "type", "can", "bitrate", "1000000"], check=True)
drive = Epos2(3)
with Epos2Server(SocketCanBus("can1"), drive).running():
    status = subprocess.run(sys.argv[1:]).returncode
    print(drive.axis.name)
sys.exit(status)
"""

RUN = "flotilla-run --blocks {directory} --steps {steps} --statistics /run/{name}.json {directory}/{name}.yml"


@pytest.fixture(scope="module")
def board(fleet: Fleet) -> Board:
    return fleet.boards["smartcoret3"].model_copy(update={"kernel": "lean"})


def run(board: Board, out: Path) -> dict[str, str]:
    """What the commands in the guest said, as text."""
    device = f"/dev/{board.ports[subject.tested_ports(board)['uart_own']].tty}"
    chain = RUN.format(name="chain", steps=SECONDS * 100, directory=DIRECTORY)
    fast = RUN.format(name="fast", steps=SECONDS * 100, directory=DIRECTORY)
    slow = RUN.format(name="slow", steps=SECONDS * 10, directory=DIRECTORY)
    velocity = RUN.format(name="velocity", steps=SECONDS * 100, directory=DIRECTORY).split()
    commands = {  # which run in the order of their names
        "chain": ["sh", "-c", f"{chain} && cat /run/latencies.json"],
        "drive": ["python3", f"{DIRECTORY}/drive.py", *velocity, *WATCH],
        "both": ["sh", "-c", f"{{ {fast}; echo fast: $?; }} 2>&1 & {{ {slow}; echo slow: $?; }} 2>&1; wait"],
        "fast": ["cat", "/run/fast.json"],
        "slow": ["cat", "/run/slow.json"],
    }
    files = {
        "chain.yml": CHAIN.format(device=device).encode(),
        "fast.yml": FAST.encode(),
        "slow.yml": SLOW.encode(),
        "velocity.yml": VELOCITY.encode(),
        "drive.py": DRIVE.encode(),
        "loopback.so": runtime.compile_plugin(PLUGIN, board.architecture),
    }
    files |= {name: (paths.PROJECT / name).read_bytes() for name in EMULATOR}
    measured = subject.build(board)
    out.mkdir(parents=True, exist_ok=True)
    initrd = out / "initrd.img"
    subject.write_initrd(
        measured, initrd, {"scenarios": [], "commands": commands},
        {str(DIRECTORY / name): content for name, content in files.items()},
    )  # fmt: skip
    guest = machine.Machine(machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=CAN_BOARDS)
    document = results.received(guest.run(out, 600))
    initrd.unlink()
    said: dict[str, str] = document["commands"]
    return said


@pytest.fixture(scope="module")
def said(board: Board, session_artefacts: Path) -> dict[str, str]:
    return run(board, session_artefacts / "virtual-loop")


def read(text: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(text)
    return content


def test_a_frame_becomes_a_valve_within_two_periods(said: dict[str, str]) -> None:
    """From the first byte's write to the port, through line, driver, controller and relay board's I/O port."""
    chain = read(said["chain"])
    histogram = {int(us): count for us, count in chain["histogram_us"].items()}
    assert chain["late"] == 0
    assert sum(histogram.values()) >= SECONDS * 100 - 60, "frames are lost"
    print(f"frame to valve: {min(histogram)} to {max(histogram)} µs")
    assert max(histogram) < 20_000


def test_two_rates_on_one_computer_keep_their_time(said: dict[str, str]) -> None:
    assert sorted(said["both"].splitlines()) == ["fast: 0", "slow: 0"]
    fast, slow = read(said["fast"]), read(said["slow"])
    assert (fast["overruns"], slow["overruns"]) == (0, 0)
    assert fast["step"]["count"] == SECONDS * 100
    assert slow["step"]["count"] == SECONDS * 10
    print(f"jitter: {fast['jitter']['max_ns'] / 1000} µs at 10 ms, {slow['jitter']['max_ns'] / 1000} µs at 100 ms")
    assert fast["jitter"]["max_ns"] < 100_000
    assert slow["jitter"]["max_ns"] < 100_000


def test_a_drive_on_can_holds_its_velocity(said: dict[str, str]) -> None:
    """Driver, bus, drive and back at 100 Hz. Seen to fail with a controller whose gains are zero."""
    *lines, left = said["drive"].splitlines()
    rows = [read(line) for line in lines][SETTLED:]
    assert len(rows) == SECONDS * 100 - SETTLED
    assert {(row["drive.enabled"], row["drive.flag"], row["drive.abort"]) for row in rows} == {(1, 1, 0)}
    velocities = [row["drive.velocity"] for row in rows]
    print(f"velocity: {min(velocities):.2f} to {max(velocities):.2f} rad/s")
    assert all(math.isclose(velocity, TARGET_RAD_S, rel_tol=0.05) for velocity in velocities)
    assert left == "SWITCH_ON_DISABLED", "the drive keeps its power"


def test_loops_repeat_to_the_byte(said: dict[str, str], board: Board, artefacts: Path) -> None:
    """Seen to fail with a plug-in that writes its process number into a file that is shown."""
    assert run(board, artefacts) == said
