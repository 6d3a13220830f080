"""The board for any 64-bit PC with UEFI boots on computers with other devices than its own guest has."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from flotilla.common import paths
from flotilla.fleet import inventory
from flotilla.fleet.model import Board, Fleet
from flotilla.images import build
from tests.boot.guests import boot_state, nothing_failed, sh
from tests.conftest import GuestFactory

pytestmark = pytest.mark.nightly  # a boot of each computer
NAME = "pc_uefi"
ROBOT = 2
"""A robot of the example fleet, as if it had the board."""


class Pc(NamedTuple):
    """A computer of QEMU."""

    machine: str
    disk: str
    network: str
    cpu: str
    memory_mib: int

    def __str__(self) -> str:
        return "-".join(map(str, self))


PCS = [
    Pc("pc-q35-7.2", "nvme", "e1000e", "Nehalem", 512),
    Pc("pc-q35-7.2", "ahci", "e1000e", "Skylake-Client", 4096),
    Pc("pc-q35-7.2", "usb", "rtl8139", "Denverton", 1024),
    Pc("pc-q35-6.2", "nvme", "e1000-82545em", "EPYC", 2048),
    Pc("pc-i440fx-7.2", "ahci", "e1000", "Westmere", 1024),
    Pc("pc-i440fx-7.2", "usb", "e1000e", "Broadwell", 768),
]


@pytest.fixture(scope="module")
def board() -> Board:
    described = yaml.safe_load((paths.BOARDS / f"group_vars/board_{NAME}.yml").read_text(encoding="utf-8"))
    return Board.model_validate(described["board"] | {"name": NAME})


@pytest.fixture(scope="module")
def image(fleet: Fleet, board: Board) -> Path:
    robot = inventory.robot(fleet, ROBOT).model_copy(update={"board": NAME})
    (made,) = build.build(_with(fleet, board), [robot], paths.IMAGES / NAME)
    return made


def _with(fleet: Fleet, board: Board) -> Fleet:
    robots = fleet.robots | {ROBOT: fleet.robots[ROBOT].model_copy(update={"board": NAME})}
    return fleet.model_copy(update={"boards": fleet.boards | {NAME: board}, "robots": robots})


@pytest.mark.parametrize("pc", PCS, ids=str)
def test_the_card_boots(pc: Pc, board: Board, image: Path, fleet: Fleet, fresh_guest: GuestFactory) -> None:
    """With each disk and network adapter that the board has modules for, and the watchdog of the chipset."""
    values = pc._asdict()
    computer = board.model_copy(update={"qemu": board.qemu.model_copy(update=values)})
    robot = fresh_guest(ROBOT, image=image, of=_with(fleet, computer), cold=True)
    sh(robot, "systemctl is-system-running --wait", check=False)
    state = boot_state(robot)
    assert (state["running"], state["slots"]["A"]["ok"]) == ("A", True)
    found = sh(robot, "cat /sys/class/watchdog/*/identity 2>/dev/null || true")
    assert found == ("iTCO_wdt" if "q35" in pc.machine else ""), "the watchdog of this chipset, and no other"
    nothing_failed(robot)
