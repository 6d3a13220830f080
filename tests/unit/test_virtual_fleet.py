"""Ending the virtual fleet while its guests boot, and what killed ones leave. Its guests are nobody here."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Never

import pytest

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet, Robot
from flotilla.lab.qemu import virtual_fleet as virtual

SECONDS = 60
"""For what takes one or two: the machine may be busy."""
Start = Callable[..., "subprocess.Popen[str]"]


def boots_for_ever(
    fleet: Fleet, robots: Sequence[Robot], directory: Path, ports: object = None, images: object = None
) -> Never:
    """Guests, as `flotilla.lab.qemu.virtual_fleet.running`: says what lay there before them, and when they end."""
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


def test_ansible_has_patience_with_guests(tmp_path: Path) -> None:
    """Seen to fail on a busy host: `Timeout (62s) waiting for privilege escalation prompt`, and robot 1 unreachable."""
    guests, ssh, asked = tmp_path / "guests.yml", tmp_path / "ssh", tmp_path / "asked"
    guests.write_text(virtual.guests_inventory({"robot1": 1}))
    ssh.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" >{asked}\n')
    ssh.chmod(0o755)
    program = Path(sys.executable).with_name("ansible")
    argv: list[str | Path] = [
        program,
        "-i",
        guests,
        "guests",
        "-m",
        "raw",
        "-a",
        "true",
        "-e",
        f"ansible_ssh_executable={ssh}",
    ]
    subprocess.run(argv, cwd=paths.PROJECT / "ansible", check=True, capture_output=True)
    assert f"ConnectTimeout={virtual.LET_IN_SECONDS}" in asked.read_text().splitlines()


def test_a_fleet_whose_guests_boot_can_be_ended(start: Start, tmp_path: Path) -> None:
    """Seen to fail while SIGTERM was blocked, and with what a killed fleet left still there."""

    def run(command: str) -> str:
        return "".join(start("flotilla", "fleet", command).communicate(timeout=SECONDS))

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


def test_a_starting_fleet_says_whom_it_waits_for(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which guest, how many have booted, how long it took. Seen to fail with the step's calls of `at` removed."""
    pictures: list[str] = []
    image = tmp_path / "image"
    image.touch()
    holder = SimpleNamespace(stdout=io.StringIO("robot1\nrobot2\n"), poll=lambda: None)
    ports = iter([{}, {"robot1": 1, "robot2": 2}, {"robot1": 1, "robot2": 2}])
    for name, value in {"DIRECTORY": tmp_path, "_LOG": tmp_path / "log", "guest_ports": lambda: next(ports)}.items():
        monkeypatch.setattr(virtual, name, value)
    monkeypatch.setattr(inventory, "load_fleet", lambda: fleet)
    monkeypatch.setattr(virtual, "image_of", lambda _: image)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **_more: holder)
    monkeypatch.setattr(progress.Step, "show", lambda step: pictures.append(step._picture()))
    monkeypatch.setattr(progress, "_SHOWN_S", 0)
    monkeypatch.setattr(progress, "VERBOSE", False)
    monkeypatch.setattr(progress, "_TERMINAL", False)
    virtual.up(2)
    shown = [re.sub(r"^\S+ boot 2 guests: |\d+:\d\d.*", "", picture) for picture in pictures]
    assert list(dict.fromkeys(shown)) == [
        "", "robot1, 0 % of 2 guests, ", "robot2, 50 % of 2 guests, ", "100 % of 2 guests, "
    ]  # fmt: skip
    lines = [re.sub(r"[\d.]+ s", "… s", line) for line in capsys.readouterr().err.splitlines()]
    assert lines[:3] == ["boot 2 guests: robot1: … s", "boot 2 guests: robot2: … s", "boot 2 guests: … s"]


def test_a_fleet_may_have_another_link_than_the_inventorys(tmp_path: Path) -> None:
    """Its description passes check-fleet's rules, and differs in nothing else."""
    usual = inventory.load_fleet()
    on_the_air = inventory.load_fleet(virtual.with_link("ibss", tmp_path / "inventory"))
    assert (usual.network.link, on_the_air.network.link) == ("ethernet", "ibss")
    network = on_the_air.network.model_copy(update={"link": "ethernet"})
    assert on_the_air.model_copy(update={"network": network}) == usual


if __name__ == "__main__":
    virtual.running = boots_for_ever
    virtual.hold(1)
