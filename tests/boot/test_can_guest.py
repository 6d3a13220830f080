"""A card with a CAN interface and a control task on it: both work from power on, with the CAN board and without."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.fleet import identity, inventory
from flotilla.fleet.model import Can, Fleet
from flotilla.images import build
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.segment import station_address
from flotilla.lab.qemu.ssh import Ssh
from tests.conftest import RobotGuest

ROBOT = 3
BUS = Can(bitrate=500_000, restart_ms=250)
BOARDS = ("-object", "can-bus,id=bus", *("-device", "kvaser_pci,canbus=bus") * 2)
"""The robot's own, and one for what else is on the bus."""
TASK = """
period: 100 ms
priority: 80
overruns: 0
blocks:
  out: {type: can-send, in: {data: 7, age: 0}, parameters: {id: 0x123, length: 1}}
  back: {type: can-receive, parameters: {id: 0x321}}
"""
# What passes on the bus, seen by the second board: the frame of the task, and one for it.
LISTEN = f"""
import socket, struct, subprocess
subprocess.run(["ip", "link", "set", "can1", "up", "type", "can", "bitrate", "{BUS.bitrate}"], check=True)
bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
bus.bind(("can1",))
bus.settimeout(60)
print(bus.recv(16).hex())
bus.send(struct.pack("<IB3x8s", 0x321, 2, b"ab"))
"""


@pytest.fixture(scope="module")
def image(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Fleet, Path]]:
    """The fleet in which robot 3 has CAN and a task, and its card."""
    tasks = tmp_path_factory.mktemp("tasks")
    (tasks / "bus.yml").write_text(TASK)
    robot = inventory.robot(fleet, ROBOT).model_copy(update={"can": {"can0": BUS}, "control_tasks": ["bus"]})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "TASKS", tasks)
        identity._environment.cache_clear()
        other = fleet.model_copy(update={"robots": fleet.robots | {ROBOT: robot}})
        (image,) = build.build(other, [robot], paths.IMAGES / "can")
        yield other, image
    identity._environment.cache_clear()


def booted(image: tuple[Fleet, Path], directory: Path, *extra: str) -> Iterator[RobotGuest]:
    fleet, card = image
    robot = fleet.robots[ROBOT]
    board = fleet.boards[robot.board]
    link = qemu.UserLink(subnet=fleet.network.subnet, guest=robot.address, station=station_address(fleet))
    options = qemu.Options(name=robot.name, mac=qemu.robot_mac(ROBOT), link=link, extra=extra)
    with Guest(board, card, directory, options) as machine, Ssh(robot, "127.0.0.1", machine.ssh_port) as shell:
        guest = RobotGuest(robot, board, card, machine, shell)
        machine.on()
        guest.wait_booted()
        yield guest


@pytest.fixture
def with_board(image: tuple[Fleet, Path], artefacts: Path) -> Iterator[RobotGuest]:
    yield from booted(image, artefacts / "with-board", *BOARDS)


@pytest.fixture
def without_board(image: tuple[Fleet, Path], artefacts: Path) -> Iterator[RobotGuest]:
    yield from booted(image, artefacts / "without-board")


def sh(robot: RobotGuest, script: str, stdin: str = "") -> str:
    return robot.shell.run(["sudo", "sh", "-c", script], stdin=stdin).stdout.strip()


def sensors(robot: RobotGuest) -> dict[str, Any]:
    """Sensors of the task by its own report."""
    found: dict[str, Any] = json.loads(sh(robot, "flotilla-param --status=json bus"))["sensors"]
    return found


def test_the_interface_is_up_and_the_task_sends(with_board: RobotGuest) -> None:
    # networkd does it when the module is there, which may be after the log-in prompt.
    sh(with_board, "until ip link show can0 up 2>/dev/null | grep -q can0; do sleep 0.2; done")
    (link,) = json.loads(sh(with_board, "ip -json -details link show can0"))
    assert "UP" in link["flags"]
    settings = link["linkinfo"]["info_data"]
    assert settings["bittiming"]["bitrate"] == BUS.bitrate
    assert settings["restart_ms"] == BUS.restart_ms
    (other,) = json.loads(sh(with_board, "ip -json link show can1"))
    assert "UP" not in other["flags"], "can1 is not in the inventory"
    frame = bytes.fromhex(sh(with_board, "python3 -", LISTEN))
    assert frame == b"\x23\x01\0\0" + b"\x01\0\0\0" + b"\x07".ljust(8, b"\0")
    assert sh(with_board, "systemctl is-active flotilla-task@bus") == "active"
    assert sh(with_board, "systemctl --failed --plain --no-legend") == ""


def test_without_the_board_the_task_runs_on(without_board: RobotGuest) -> None:
    """It waits for its interface, and is not given up after five failures as a task that cannot start is."""
    sh(without_board, "systemctl is-system-running --wait || true")
    assert sh(without_board, "systemctl is-active flotilla-task@bus") == "active"
    assert sensors(without_board), "the task reports no block with a flag"
    assert not any(sensor["flag"] for sensor in sensors(without_board).values()), sensors(without_board)
    said = sh(without_board, "journalctl --no-pager -u flotilla-task@bus")
    assert "there is no CAN interface can0" in said, said
    assert sh(without_board, "systemctl --failed --plain --no-legend") == ""
