"""A velocity loop over CAN through the shipped image: the robot's controller sets the motor's current, on a real bus.

Two CAN boards of the guest are on one bus: the robot's own, and the drive's, for which an emulator runs in the guest,
because this computer may have no CAN. Time is the host's: only what comes of the loop is judged.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from images.builder import paths
from tests.conftest import GuestFactory, RobotGuest

pytestmark = pytest.mark.boot

BOARDS = ("-object", "can-bus,id=bus", *("-device", "kvaser_pci,canbus=bus") * 2)
PLACE = "/run/drive"
EMULATOR = ("tests/emulators/can_bus.py", "tests/emulators/epos2.py")
TARGET_RAD_S = 5.0

# Ends when its input does, and says then how the drive was left.
DRIVE = """
import sys
from tests.emulators.can_bus import SocketCanBus
from tests.emulators.epos2 import Epos2, Epos2Server
drive = Epos2(3)
with Epos2Server(SocketCanBus("can1"), drive).running():
    print("drive is on", flush=True)
    sys.stdin.read()
    print(drive.axis.name, flush=True)
"""

TASK = """
period: 10 ms
priority: 60
overruns: 0
blocks:
  drive:
    type: epos2
    in: {{target: limit.out, enable: 1}}
    parameters: {{interface: can0, node: 3, mode: current, counts: 2000, gear: 10, heartbeat: 0.5, timeout: 0.5}}
  before: {{type: delay, in: {{in: drive.velocity}}}}
  controller:
    type: pid
    in: {{set_point: {target}, measurement: before.out}}
    parameters: {{kp: 0.05, ki: 0.2, min: -1, max: 1}}
  limit: {{type: limit, in: {{in: controller.out}}, parameters: {{min: -1, max: 1}}}}
"""


@pytest.fixture(scope="module")
def robot(module_guest: GuestFactory) -> RobotGuest:
    """Robot 4, which has no task of its own, with a drive on its bus."""
    robot = module_guest(4, qemu_options={"extra": BOARDS})
    files = {name: (paths.PROJECT / name).read_text() for name in EMULATOR}
    files |= {"drive.py": DRIVE, "tests/__init__.py": "", "tests/emulators/__init__.py": ""}
    files["velocity.yml"] = TASK.format(target=TARGET_RAD_S)
    for name, content in files.items():
        robot.shell.run(["sudo", "mkdir", "-p", str(Path(PLACE, name).parent)])
        robot.shell.run(["sudo", "tee", f"{PLACE}/{name}"], stdin=content)
    for interface in ("can0", "can1"):
        robot.shell.run(["sudo", "ip", "link", "set", interface, "up", "type", "can", "bitrate", "1000000"])
    return robot


def test_velocity_is_held(robot: RobotGuest) -> None:
    """Drive and task in one command: the drive ends with the task, by the pipe between them."""
    run = f"flotilla-run --steps 1500 --watch drive.velocity,drive.enabled,drive.flag,drive.abort {PLACE}/velocity.yml"
    script = (
        f"cd {PLACE} && mkfifo stop said && {{ python3 drive.py <stop >said & }} && exec 3>stop && "
        f"exec 4<said && read -r line <&4 && [ \"$line\" = 'drive is on' ] && {run} && exec 3>&- && cat <&4 >&2"
    )
    done = robot.shell.run(["sudo", "sh", "-c", script], timeout=180)
    rows: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["drive.abort"] for row in rows} == {0}
    late = rows[len(rows) // 2 :]
    assert sum(row["drive.enabled"] for row in late) > 0.95 * len(late), "the drive is not enabled all the time"
    mean = sum(row["drive.velocity"] for row in late) / len(late)
    print(f"mean {mean:.2f} rad/s, {len(late)} steps")
    assert math.isclose(mean, TARGET_RAD_S, rel_tol=0.05)
    assert done.stderr.strip().splitlines()[-1] == "SWITCH_ON_DISABLED", "the drive keeps its power"
