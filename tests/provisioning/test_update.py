"""Releases over the air, on guests of the shipped image: one that does well stays, others go back by themselves.

How releases are made bad is in tests/releases.py. That a robot is back within fifteen minutes, whatever the station
does, is in tests/boot/test_bad_releases.py, by the robot's own time.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.images import build
from flotilla.lab.emulators.dsp3000 import Dsp3000
from flotilla.lab.emulators.serial_line import SerialLine, UnixSocket
from flotilla.lab.qemu import qemu
from flotilla.robot import release
from flotilla.updates import delta
from tests.figures import PROPERTY
from tests.provisioning.test_fleet import BOOT_SECONDS, Guests, Playbook, running
from tests.releases import successor

ROBOT = 1
"""It has a control task and a gyro."""
NAME = f"robot{ROBOT}"
MEMORY_KIB = 16 << 10
SECONDS = 600
STOP = ("-e", "stop_tasks=true", "-e", "settle_s=2")
ONE = ("-l", NAME)
GOOD = (
    f"timeout {SECONDS} sh -c 'until flotilla-param --status=json heading | grep -q gyro.:...flag.:.true; do :; done'"
)
"""Until the control task says that its gyro is good."""
UPDATER = "/usr/lib/flotilla/update.py"

Make = Callable[..., Path]


@contextlib.contextmanager
def with_a_gyro(fleet: Fleet, numbers: Sequence[int], directory: Path) -> Iterator[Guests]:
    """Guests of these robots; ROBOT's gyro is there."""
    robots = [inventory.robot(fleet, number) for number in numbers]
    with tempfile.TemporaryDirectory(prefix="lab-") as scratch:  # sockets' paths must be short
        gyro = Path(scratch, "gyro")
        plugged = {NAME: {inventory.robot(fleet, ROBOT).devices["gyro"].port: qemu.unix_socket(gyro)}}
        with running(fleet, robots, directory, **plugged) as guests, SerialLine(Dsp3000(), UnixSocket(str(gyro))):
            yield guests


@pytest.fixture(scope="module")
def guests(fleet: Fleet, session_artefacts: Path) -> Iterator[Guests]:
    with with_a_gyro(fleet, [ROBOT], session_artefacts / "update") as guests:
        yield guests


@pytest.fixture(scope="module")
def make(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Make]:
    """`make(2)`: the bundle of release 2, `make(3, "panic")` of one with that fault, `more=` with further arguments.

    Their content is another than that of the robots' cards: the station has the delta.
    """
    made = build.board_build(fleet.boards[inventory.robot(fleet, ROBOT).board], fleet.releases)
    content = successor(made, fleet.releases, tmp_path_factory.mktemp("content"))
    base = json.loads((made.slot / "header.json").read_text())["BLOB"]
    file = release.delta_of(base, content.header["BLOB"])
    file.parent.mkdir(parents=True, exist_ok=True)
    delta.make(made.slot / "slot.img", content.directory / "slot.img", file)

    def make(number: int, fault: str = "", more: str = "") -> Path:
        return content.release(number, tmp_path_factory.mktemp("release"), fault, more).bundle(fleet.releases)

    yield make
    file.unlink()


def state(guests: Guests, name: str = NAME) -> dict[str, Any]:
    """Of the slots. The robot may be on its way back."""
    guests.shells[name].connect(BOOT_SECONDS)
    shown: dict[str, Any] = json.loads(guests.sudo(name, "flotilla-slot show"))
    return shown


def runs(guests: Guests, name: str = NAME) -> tuple[str, str]:
    """Slot and release."""
    now = state(guests, name)
    return now["running"], now["slots"][now["running"]]["release"]


def boot_of(guests: Guests, name: str) -> str:
    return guests.sudo(name, "cat /proc/sys/kernel/random/boot_id")


def update(guests: Guests, release: Path, *more: str) -> Playbook:
    return guests.play("-e", f"bundle={release}", *more, playbook="update")


def within_limit(guests: Guests, command: str, content: bytes) -> tuple[dict[str, Any], int]:
    """What the updater says to a command, and the KiB that it took, all of it: by the kernel's account of a group.

    The group has its processes, what the kernel keeps for them, and all pages of files that they were the first to
    need, programs and libraries too: nothing is in memory beforehand. It gets no more than the limit, and no swap.
    """
    guests.shells[NAME].write("/tmp/input", content)
    group = "/sys/fs/cgroup/updater"
    updater = f"sh -c 'echo $$ >{group}/cgroup.procs && exec {UPDATER} {command}'"
    script = f"""
        sync
        echo 3 >/proc/sys/vm/drop_caches
        mkdir {group}
        echo {MEMORY_KIB}K >{group}/memory.max
        echo 0 >{group}/memory.swap.max
        cat /tmp/input | {updater} || exit
        cat {group}/memory.peak
        grep oom_kill {group}/memory.events
        rmdir {group}
    """
    said = guests.shells[NAME].script(script, timeout=SECONDS).stdout
    told, peak, killed = said.strip().splitlines()[:3]
    assert killed == "oom_kill 0", said
    return json.loads(told), int(peak) >> 10


@pytest.mark.nightly  # with a delta that large; each time, tests/runtime/test_update.py takes deltas on this computer
def test_the_updater_fits_into_its_memory(
    guests: Guests, make: Make, record_property: Callable[[str, object], None]
) -> None:
    """With a delta that is really applied, between two contents of 80 MB."""
    offered = release.read(make(2))
    told, peak = within_limit(guests, "begin", offered.offer())
    peaks = {"begin": (told["memory_kib"], peak)}
    assert len(told["missing"]) > 100
    sent = release.delta_of(told["base"], offered.header["BLOB"]).read_bytes()
    for command, content in (("delta", sent), ("finish", b"")):
        told, peak = within_limit(guests, command, content)
        peaks[command] = told["memory_kib"], peak
    record_property(
        PROPERTY, f"KiB of the updater's processes, and of their control group: {peaks}; a delta of {len(sent)} B"
    )
    assert (told["staged"], told["missing"]) == (True, [])
    assert max(largest for largest, _ in peaks.values()) <= MEMORY_KIB
    assert max(peak for _, peak in peaks.values()) < MEMORY_KIB, "it would have taken more"


@pytest.mark.nightly  # ten minutes; each time, test_update_virtual.py brings one, and test_boot_loader.py tries it
def test_a_release_is_brought_tried_and_kept(guests: Guests, make: Make) -> None:
    """With the word of the station."""
    done = update(guests, make(2), *STOP, *ONE)
    assert done.status == 0, done.said
    now = state(guests)
    assert (runs(guests), now["trial"], now["order"]) == (("B", "2"), None, ["B", "A"])


@pytest.mark.nightly  # four plays more
def test_a_release_goes_back_when_told_so(guests: Guests, make: Make) -> None:
    """What runs already is not started once more, and nothing is started while a task runs."""
    boot = boot_of(guests, NAME)
    staged = update(guests, make(2), "--tags", "stage", *ONE)
    assert (staged.status, boot_of(guests, NAME)) == (0, boot), staged.said
    again = update(guests, make(2), *STOP, *ONE)
    assert (again.status, runs(guests)) == (0, ("B", "2")), again.said
    refused = guests.play("-e", "go=back", *ONE, playbook="update")
    assert refused.status != 0
    assert "runs flotilla-task@" in refused.said
    assert (runs(guests), state(guests)["trial"]) == (("B", "2"), None)
    back = guests.play("-e", "go=back", *STOP, *ONE, playbook="update")
    assert (back.status, runs(guests), state(guests)["order"]) == (0, ("A", "1"), ["A", "B"]), back.said


@pytest.mark.nightly  # the play is that of an unwell robot; the panic is tried in tests/boot/test_bad_releases.py
def test_a_release_that_does_not_start_goes_back(guests: Guests, make: Make) -> None:
    """Its first program is not there, so the kernel panics. What it changed below /etc is gone with it."""
    before = runs(guests)
    done = update(guests, make(4, "panic"), *STOP, *ONE)
    assert done.status != 0
    assert "the other one did not start" in done.said, done.said
    assert runs(guests) == before
    assert state(guests)["trial"] is None


@pytest.mark.nightly  # the play does as before; the robot is tried in tests/boot/test_bad_releases.py
def test_a_release_that_nobody_reaches_goes_back(guests: Guests, make: Make) -> None:
    """It has no driver of its network, so nobody can tell it so."""
    before = runs(guests)
    done = update(guests, make(5, "no network", "flotilla.trial_s=10"), *STOP, *ONE)
    assert done.status != 0
    assert "the other one did not start" in done.said, done.said
    assert runs(guests) == before
    assert state(guests)["slots"]["A" if before[0] == "B" else "B"]["ok"] is False
    back = guests.play("-e", "go=back", *STOP, *ONE, playbook="update")
    assert back.status != 0
    assert "there is nothing to go back to" in back.said, back.said


@pytest.mark.nightly  # a guest more
def test_a_robot_with_uefi_takes_a_release(fleet: Fleet, tmp_path: Path, session_artefacts: Path) -> None:
    """Its card has a GPT. Seen to fail: `begin` ended with EINVAL on each such robot."""
    robot = next(each for each in fleet.robots.values() if fleet.boards[each.board].firmware == "uefi")
    made = build.board_build(fleet.boards[robot.board], fleet.releases)
    content = successor(made, fleet.releases, tmp_path / "content")
    offered = content.release(2, tmp_path / "release").bundle(fleet.releases)
    with running(fleet, [robot], session_artefacts / "update-uefi") as guests:
        done = update(guests, offered, *STOP, "-l", robot.name)
        assert done.status == 0, done.said
        assert runs(guests, robot.name) == ("B", "2")
