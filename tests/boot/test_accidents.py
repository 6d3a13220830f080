"""Power that is cut, a damaged slot, a system that hangs, a boot block that says nothing: on guests of their own."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from flotilla.debian import tools
from flotilla.debian.lock import read_lock
from flotilla.debian.tools import Tools
from flotilla.fleet.model import Fleet
from flotilla.images import card, environment_block
from flotilla.images.manifest import Manifest
from flotilla.lab.qemu import qemu
from tests.boot.guests import PENTIUM, SECONDS, boot_state, has_its_identity, nothing_failed, sh, tries, until
from tests.conftest import GuestFactory, RobotGuest


@pytest.fixture(scope="module")
def toolset() -> Tools:
    lock = read_lock("tools")
    return Tools(tools.tree(lock), lock.epoch)


def test_power_cut_while_writing(fresh_guest: GuestFactory, fleet: Fleet, toolset: Tools, tmp_path: Path) -> None:
    robot = fresh_guest(PENTIUM)
    sh(robot, "systemctl is-system-running --wait", check=False)
    # Each line is on the card before the next is begun; what has no fsync is written too, all the time.
    writer = 'n=0; while :; do n=$((n+1)); echo "line $n" >>/data/lines; sync /data/lines; '
    writer += "dd if=/dev/urandom of=/data/bulk-$((n % 8)) bs=64k count=8 status=none; done"
    robot.shell.run(["sudo", "systemd-run", "--quiet", "sh", "-c", writer])
    until(robot, "grep -q 'line 20' /data/lines")
    count = int(sh(robot, "wc -l </data/lines"))
    robot.machine.cut()

    robot.machine.on()
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    messages = sh(robot, "dmesg")
    assert re.search(r"EXT4-fs \(sd.4\): recovery complete", messages), (
        f"the journal had nothing to replay:\n{messages}"
    )
    lines = sh(robot, "cat /data/lines").splitlines()
    assert lines == [f"line {number}" for number in range(1, len(lines) + 1)], f"torn: {lines}"
    # One more than was seen may have been under way.
    assert len(lines) >= count - 1, f"{count} lines were on the card, {len(lines)} are"
    has_its_identity(robot, fleet)
    nothing_failed(robot)
    assert sh(robot, "cat /sys/fs/ext4/sd?4/errors_count") == "0"
    sh(robot, "systemctl --no-block poweroff", check=False)  # there is no logind to heed a power button
    robot.machine.wait_off(SECONDS)

    whole, data = tmp_path / "card", tmp_path / "data"
    overlay = robot.machine.directory / "card.qcow2"
    subprocess.run([qemu.find_tool("qemu-img"), "convert", "-O", "raw", str(overlay), str(whole)], check=True)
    size = (qemu.CARD_BYTES - card.DATA.start) // card.MIB
    copy = ["dd", f"if={whole}", f"of={data}", "bs=1M", f"skip={card.DATA.start // card.MIB}", f"count={size}"]
    subprocess.run([*copy, "conv=sparse", "status=none"], check=True)
    toolset.run("usr/sbin/e2fsck", "-f", "-n", data)


@pytest.mark.nightly  # each time, test_boot_loader.py damages slots, test_bad_releases.py tries a bad one
def test_damaged_slot_falls_back_and_a_hang_ends(fresh_guest: GuestFactory, tmp_path: Path) -> None:
    """Slot A is damaged and has one try left, slot B is good; then the running system hangs. One card for both."""
    robot = fresh_guest(PENTIUM, boot=False)
    broken = _with_broken_first_slot(robot.image, tmp_path)
    qemu.make_overlay(broken, robot.machine.directory / "card.qcow2", qemu.CARD_BYTES)
    robot.machine.on()
    robot.machine.console.expect(r"Kernel panic", 2 * SECONDS)
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    words = sh(robot, "cat /proc/cmdline").split()
    described = Manifest.model_validate_json(robot.image.with_suffix(".manifest.json").read_bytes())
    (uuid,) = (each.partuuid for each in described.partitions if each.name == "B")
    assert {"flotilla.slot=B", f"root=PARTUUID={uuid}"} <= set(words), f"booted {' '.join(words)}"
    assert re.search(r"sd.3$", sh(robot, "findmnt -n -o SOURCE /"))
    state = boot_state(robot)
    assert {name: state["slots"][name]["ok"] for name in "AB"} == {"A": False, "B": True}
    assert (state["running"], tries(robot)) == ("B", [0, 0])
    nothing_failed(robot)

    # The service manager alone stands still; the kernel, and all else, goes on.
    robot.machine.execute("watchdog-set-action", action="pause")
    sh(robot, "echo 1 >/sys/fs/cgroup/init.scope/cgroup.freeze")
    while robot.machine.wait_event("WATCHDOG", SECONDS)["data"]["action"] != "pause":
        pass  # of a boot that took the host longer than the watchdog waits


@pytest.mark.nightly  # every state is tried with the boot loader and, in tests/runtime/test_slot.py, with the program
def test_boot_state_is_repaired(fresh_guest: GuestFactory) -> None:
    """States that only the running system can repair, and a boot with all of them lost."""
    robot = fresh_guest(PENTIUM)
    sh(robot, "systemctl is-system-running --wait", check=False)
    disk = "/dev/sda"
    places = {"tries": card.STATE.start, **{f"copy {n}": card.STATE.start + at for n, at in enumerate(card.COPIES)}}
    damage = "dd if={source} of={disk} bs=512 seek={sector} count=2 conv=notrunc oflag=direct"
    sequence = boot_state(robot)["sequence"]
    for name, place in places.items():
        for source in ("/dev/zero", "/dev/urandom"):
            sh(robot, damage.format(source=source, disk=disk, sector=place // 512))
            assert _bytes_started_writes(robot) > 0, f"{name} of {source}: not repaired"
            state = boot_state(robot)
            assert (state["sequence"], state["trial"], state["slots"]["A"]["ok"]) == (
                sequence + (name != "tries"),
                None,
                True,
            ), f"{name} of {source}: {state}"
            sequence = state["sequence"]
            assert _bytes_started_writes(robot) == 0, f"{name}: a sound state was written again"

    for place in places.values():
        sh(robot, damage.format(source="/dev/zero", disk=disk, sector=place // 512))
    robot.machine.reset()
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    state = boot_state(robot)
    assert (state["running"], state["sequence"], tries(robot)) == ("A", 1, [0, 0])
    nothing_failed(robot)


def _bytes_started_writes(robot: RobotGuest) -> int:
    """Bytes that `flotilla-slot started` writes, as the kernel counts them for a shell and its children."""
    return int(sh(robot, "sh -c 'flotilla-slot started; sed -n s/^write_bytes:.//p /proc/$$/io'"))


def _with_broken_first_slot(image: Path, directory: Path) -> Path:
    """A copy of a card whose slot B is what slot A was, and A's root erased; A has one try left."""
    broken = directory / "card"
    subprocess.run(["cp", "--sparse=always", str(image), str(broken)], check=True)
    first, second = card.SLOTS
    with broken.open("r+b") as file:
        for start, end in ((0, first.size - card.HEADER_ROOM), (first.size - card.HEADER_ROOM, first.size)):
            file.seek(first.start + start)
            content = file.read(end - start)
            file.seek(second.start + start)
            file.write(content.rstrip(b"\0"))
        file.seek(first.start)
        file.write(bytes(16 * card.MIB))
        for place in card.COPIES:
            file.seek(card.STATE.start + place)
            file.write(card.state_copy(7, good="AB"))
        file.seek(card.STATE.start + card.TRIES)
        file.write(environment_block.make({"FOR": "7", "A_TRIES": "2", "B_TRIES": "0"}, card.SECTOR))
    return broken
