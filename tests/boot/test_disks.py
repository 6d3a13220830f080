"""The card of a 64-bit PC on buses that its guest does not have otherwise: what finds and grows it goes by no name."""

from __future__ import annotations

import pytest

from flotilla.images import card
from flotilla.lab.qemu import qemu
from tests.boot.guests import boot_state, nothing_failed, sh
from tests.conftest import GuestFactory

PC = 2


@pytest.mark.nightly  # a boot each; how a slot is found and confirmed on SATA, each run shows
@pytest.mark.parametrize(("disk", "name"), [("nvme", "nvme0n1p"), ("usb", "sda")])
def test_a_card_on_another_bus(fresh_guest: GuestFactory, disk: str, name: str) -> None:
    """Seen to fail without the bus's module among `disk_modules:`: no disk with the root partition appeared."""
    robot = fresh_guest(PC, disk=disk)
    sh(robot, "systemctl is-system-running --wait", check=False)
    assert sh(robot, "findmnt -n -o SOURCE /") == f"/dev/{name}2"
    assert sh(robot, "findmnt -n -o SOURCE /data") == f"/dev/{name}4"
    size = int(sh(robot, f"blockdev --getsize64 /dev/{name}4"))
    assert size > qemu.CARD_BYTES - card.DATA.start - card.MIB, f"the data partition has {size} bytes"
    state = boot_state(robot)
    assert (state["running"], state["slots"]["A"]["ok"]) == ("A", True)
    nothing_failed(robot)
