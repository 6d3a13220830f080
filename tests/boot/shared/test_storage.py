"""What of the card can be written, and where it goes."""

from __future__ import annotations

import re

import pytest

from flotilla.images import card
from flotilla.lab.qemu import qemu
from tests.boot.guests import sh
from tests.conftest import RobotGuest


def test_root_is_read_only(robot: RobotGuest) -> None:
    kind, options = sh(robot, "findmnt -n -o FSTYPE,OPTIONS /").split()
    assert kind == "squashfs"
    assert "ro" in options.split(","), f"the root is mounted {options}"
    for path in ("/new", "/usr/bin/new", "/root/new"):
        done = robot.shell.run(["sudo", "touch", path], check=False)
        assert "Read-only file system" in done.stderr, f"touch {path}: status {done.returncode}: {done.stderr}"


@pytest.mark.parametrize(("layer", "upper"), [("etc", "A/etc"), ("var", "var"), ("home", "home")])
def test_layer_is_writable_and_on_the_data_partition(robot: RobotGuest, layer: str, upper: str) -> None:
    """The one above /etc is the running slot's."""
    try:
        sh(robot, f"echo kept >/{layer}/a-test")
        assert sh(robot, f"cat /data/{upper}/a-test") == "kept"
    finally:
        sh(robot, f"rm -f /{layer}/a-test")


def test_data_partition_has_grown_to_the_card(robot: RobotGuest) -> None:
    disk, partition = sh(robot, 'findmnt -n -o SOURCE /data | sed "s/\\(.*\\)4/\\1 \\14/"').split()
    whole, data = (int(sh(robot, f"blockdev --getsize64 {device}")) for device in (disk, partition))
    size = int(sh(robot, "findmnt -n -b -o SIZE /data"))
    assert whole == qemu.CARD_BYTES // 512 * 512
    assert data > whole - card.DATA.start - card.MIB, f"{partition} has {data} bytes of a card of {whole}"
    assert size > 0.9 * data, f"the file system has {size} bytes of a partition of {data}"


def test_swap_is_in_memory_only(robot: RobotGuest) -> None:
    devices = [line.split()[0] for line in sh(robot, "cat /proc/swaps").splitlines()[1:]]
    assert devices == ["/dev/zram0"]


def test_journal_is_kept_and_bounded(robot: RobotGuest) -> None:
    lines = sh(robot, "journalctl --no-pager -o cat -b SYSLOG_IDENTIFIER=systemd-journald")
    found = re.search(r"System Journal \(/var/log/journal/\w+\) is \S+, max (\S+),", lines)
    assert found, f"no journal on the card:\n{lines}"
    assert found[1] in ("16.0M", "16M"), f"the journal may take {found[1]}"


def test_the_updater_finds_both_slots(robot: RobotGuest) -> None:
    """Whatever partition table the card has. Seen to fail with a GPT: it read an MBR, so no robot took a release."""
    program = "import sys; sys.path.insert(0, '/usr/lib/flotilla'); import update"
    program += "; print(*(update.Slot(name).header().get('BOARD', 'empty') for name in 'AB'))"
    assert sh(robot, f'python3 -ISc "{program}"').split() == [robot.robot.board, "empty"]
