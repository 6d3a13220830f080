"""Ending the virtual fleet while its guests boot, and what killed ones leave. Its guests are nobody here."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Never

import pytest

from images.builder import paths
from images.builder.errors import UserError
from images.builder.fleet import Fleet, Robot
from tests.lab import fleet as virtual

SECONDS = 60
"""For what takes one or two: the machine may be busy."""
Start = Callable[..., "subprocess.Popen[str]"]


def boots_for_ever(fleet: Fleet, robots: Sequence[Robot], directory: Path) -> Never:
    """Guests, as `tests.lab.fleet.running`: says what lay there before them, and when they end."""
    print(*sorted(path.name for path in directory.iterdir()), flush=True)
    try:
        while True:
            signal.pause()
    finally:
        print("guests ended", flush=True)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a module with arguments and outputs of the test's own; it ends with the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*argv: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", *argv], cwd=paths.PROJECT, env=os.environ | {"BUILD": str(tmp_path)},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_a_fleet_whose_guests_boot_can_be_ended(start: Start, tmp_path: Path) -> None:
    """Seen to fail while SIGTERM was blocked, and with what a killed fleet left still there."""

    def run(command: str) -> str:
        return "".join(start("tests.lab.fleet", command).communicate(timeout=SECONDS))

    overlay = tmp_path / "fleet" / "robot1" / "card.qcow2"
    overlay.parent.mkdir(parents=True)
    overlay.write_text("of another image")
    (tmp_path / "fleet" / "guests.yml").write_text(virtual.guests_inventory({"robot1": 4711}))
    holder = start("tests.unit.test_virtual_fleet")
    assert holder.stdout
    assert holder.stdout.readline() == "lock\n"
    assert "is starting or ending" in run("status")
    assert "ended before it had started" in run("down")
    assert holder.communicate(timeout=SECONDS) == ("guests ended\n", "it was ended before it had started\n")
    assert "no virtual fleet runs" in run("down")


def test_a_killed_fleets_number_is_nobodys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While someone else has the lock for a moment. Seen to fail where its file still had the number."""
    killed: list[int] = []
    monkeypatch.setattr(os, "kill", lambda process, _: killed.append(process))
    for name, value in {"DIRECTORY": tmp_path, "GUESTS": tmp_path / "guests.yml", "_LOCK": tmp_path / "lock"}.items():
        monkeypatch.setattr(virtual, name, value)
    monkeypatch.setattr(virtual, "DOWN_SECONDS", 0)
    (tmp_path / "lock").write_text("4711")
    someone = virtual._free_lock()
    assert someone
    with someone, pytest.raises(UserError, match="did not end within 0 s"):
        virtual.down()
    assert killed == []


if __name__ == "__main__":
    virtual.running = boots_for_ever
    virtual.hold(1)
