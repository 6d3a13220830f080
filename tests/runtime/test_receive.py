"""How a robot begins and ends to receive a file: its own script, in a directory, with a service manager that tells."""

from __future__ import annotations

import stat
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.updates import multicast

SCRIPT = paths.OVERLAY / "usr/lib/flotilla/receive"
SPOOL = "/data/update/spool"
SYSTEMCTL = """#!/bin/sh
echo "$@" >>{directory}/calls
case $1 in show) cat {directory}/state ;; reset-failed) exit 1 ;; esac
"""
STAT = """#!/bin/sh
echo "{blocks} * 4096 / 1024"
"""
SIZE = 3 << 20


@dataclass
class Robot:
    directory: Path
    spool: Path

    def state(self, word: str) -> None:
        (self.directory / "state").write_text(f"{word}\n")

    def free(self, kib: int) -> None:
        program(self.directory / "bin" / "stat", STAT.format(blocks=kib // 4))

    def receive(self, *arguments: str, description: str = "", status: int = 0) -> str:
        """What it says, on either output; and with that status."""
        done = subprocess.run(
            [str(self.directory / "receive"), *arguments], input=description, capture_output=True, text=True,
            env={"PATH": f"{self.directory}/bin:/usr/bin:/bin"}, check=False,
        )  # fmt: skip
        assert done.returncode == status, done.stderr
        return done.stdout + done.stderr

    def begin(self, number: int, size: int = SIZE, status: int = 0, key: int = 1) -> str:
        text = f"transfer {number:08x}\nsize {size}\nblock 00000001\n"
        order = multicast.order(bytes([key]) * multicast.KEY_BYTES, text)
        return self.receive("begin", "10.0.0.254", "10.0.0.1", description=order, status=status)

    def calls(self) -> list[str]:
        """Of the service manager, since this was asked before."""
        file = self.directory / "calls"
        found = file.read_text().splitlines() if file.exists() else []
        file.write_text("")
        return [line for line in found if not line.startswith("show")]


def program(file: Path, text: str) -> None:
    file.write_text(text)
    file.chmod(0o755)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    robot = Robot(tmp_path, tmp_path / "update" / "spool")
    (tmp_path / "bin").mkdir()
    text = SCRIPT.read_text()
    assert text.count(SPOOL) == 2
    program(tmp_path / "receive", text.replace(SPOOL, str(robot.spool)))
    # The user is the image's.
    program(tmp_path / "bin" / "chgrp", f'#!/bin/sh\necho "$@" >>{tmp_path}/given\n')
    program(tmp_path / "bin" / "install", '#!/bin/sh\nwhile [ $# -gt 1 ]; do shift; done\nmkdir -p -m 700 "$1"\n')
    program(tmp_path / "bin" / "systemctl", SYSTEMCTL.format(directory=tmp_path))
    robot.state("dead")
    robot.free(1 << 20)
    return robot


def test_what_was_received_of_the_same_file_stays(robot: Robot) -> None:
    """And a service that runs is left alone. Seen to fail where each call begins anew."""
    assert robot.begin(1) == ""
    assert robot.calls() == ["stop flotilla-receive"] * 2 + ["restart flotilla-receive"]
    assert (robot.spool / "key").read_text() == f"{'01' * 32}\n"
    modes = {
        each.name: stat.S_IMODE(each.stat().st_mode) for each in (robot.spool.parent, *robot.spool.parent.rglob("*"))
    }
    assert modes == {
        "update": 0o711, "spool": 0o711, "in": 0o700, "addresses": 0o600, "description": 0o640, "key": 0o640
    }  # fmt: skip
    assert (robot.directory / "given").read_text().splitlines() == [
        f"update {robot.spool}/{name}.new" for name in ("description", "key")
    ]
    assert (robot.spool / "addresses").read_text() == "STATION=10.0.0.254\nROBOT=10.0.0.1\n"
    (robot.spool / "in/file.part").touch()
    robot.state("running")
    robot.begin(1)
    assert robot.calls() == []
    robot.state("exited")
    robot.begin(1)
    assert robot.calls() == ["restart flotilla-receive"]
    assert sorted(file.name for file in robot.spool.iterdir()) == ["addresses", "description", "in", "key"]
    assert (robot.spool / "in/file.part").exists()


def test_another_key_begins_anew_with_what_was_received(robot: Robot) -> None:
    """Otherwise the service would continue with the former key, and take no datagram any more."""
    robot.begin(1)
    (robot.spool / "in/file.part").touch()
    robot.calls()
    robot.state("running")
    robot.begin(1, key=2)
    assert "stop flotilla-receive" in robot.calls()
    assert (robot.spool / "key").read_text() == f"{'02' * 32}\n"
    assert (robot.spool / "in/file.part").exists()


def test_what_is_not_what_it_should_be_is_discarded(robot: Robot) -> None:
    robot.begin(1)
    (robot.spool / "in/file").touch()
    robot.calls()
    assert robot.receive("discard") == ""
    assert robot.calls() == ["restart flotilla-receive"]
    assert not robot.spool.exists()


@pytest.mark.parametrize("order", ["", "transfer 1\n", "key\n", "key 1 2\n"])
def test_no_key_is_refused(robot: Robot, order: str) -> None:
    robot.receive("begin", "10.0.0.254", "10.0.0.1", description=order, status=2 if order else 1)
    assert robot.calls() == []


def test_another_file_takes_the_place_of_one_that_was_not_ended(robot: Robot) -> None:
    """Seen to fail where what was received of it is kept, and counts as the other one's."""
    robot.begin(1)
    for name in ("file", "file.part", "file.repair"):
        (robot.spool / "in" / name).touch()
    robot.begin(2)
    assert sorted(file.name for file in robot.spool.iterdir()) == ["addresses", "description", "in", "key"]
    assert not any((robot.spool / "in").iterdir())
    assert "00000002" in (robot.spool / "description").read_text()


def test_a_file_that_leaves_too_little_room_is_refused(robot: Robot) -> None:
    """Twice its size and 64 MiB: seen to fail where the repair symbols beside it are forgotten."""
    needed = 2 * (SIZE >> 10) + (64 << 10)
    robot.free(needed - 4)
    said = f"receive: /data has {needed - 4} KiB free, a file of {SIZE} bytes needs {needed}\n"
    assert robot.begin(1, status=1) == said
    assert not robot.spool.exists()
    assert "restart flotilla-receive" not in robot.calls()
    robot.free(needed)
    robot.begin(1)


def test_the_end_names_a_file_that_is_whole(robot: Robot) -> None:
    """The service is asked to start in vain, so that its condition says that there is nothing to do. Seen to fail
    where it is only stopped."""
    assert robot.receive("end") == ""
    robot.begin(1)
    robot.calls()
    (robot.spool / "in/file.part").touch()
    assert robot.receive("end") == ""
    (robot.spool / "in/file.part").rename(robot.spool / "in/file")
    assert robot.receive("end") == f"{robot.spool}/in/file\n"
    assert robot.calls() == ["restart flotilla-receive"] * 2
    assert not (robot.spool / "addresses").exists()


def test_a_link_in_the_place_of_the_file_is_none(robot: Robot) -> None:
    """Whoever has taken over the receiver has root open no other file."""
    robot.begin(1)
    (robot.spool / "in/file").symlink_to("/etc/shadow")
    assert robot.receive("end") == ""


@pytest.mark.parametrize("arguments", [[], ["begin"], ["begin", "10.0.0.254"], ["start"]])
def test_a_wrong_command_is_refused(robot: Robot, arguments: list[str]) -> None:
    robot.receive(*arguments, status=2)
    assert robot.calls() == []
