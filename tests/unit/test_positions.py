"""`make positions`: what it refuses, and what it says to do. tests/runtime/test_positions.py sends some."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.cli import main as command_line
from flotilla.common import paths
from flotilla.fleet import identity, inventory, message_keys
from flotilla.lab.scenarios import virtual
from flotilla.station import positions
from tests.station import FLEET

Said = Callable[..., str]


@pytest.fixture
def said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Said:
    """What the command complains about."""
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")

    def run(robot: int, *options: str, fleet: Path = FLEET) -> str:
        argv = ["flotilla", "positions", str(robot), "--inventory", str(fleet), *options]
        monkeypatch.setattr(sys, "argv", argv)
        assert command_line.main() == 1
        return capsys.readouterr().err

    return run


def test_the_robots_port_and_proof_are_its_control_tasks() -> None:
    """Seen to fail with `signed` that is always false."""
    fleet = virtual.fleet("udp")
    assert positions.receiver(fleet, fleet.robot_with("sensors"), FLEET) == positions.Receiver(5010, True)
    alone = fleet.model_copy(update={"stations": []})
    assert positions.receiver(alone, alone.robot_with("sensors"), FLEET) == positions.Receiver(5010, False)


def test_a_robot_without_the_block_is_named(said: Said) -> None:
    message_keys.write_secret(bytes(32))
    assert "robots.yml: robot2.control_tasks: navigation: 0 blocks igps take positions; list a task that" in said(2)
    assert "robots.yml: robot3.control_tasks: none: 0 blocks igps" in said(3, fleet=paths.INVENTORY)
    assert "robot 9: no such robot" in said(9)


def test_a_task_that_says_no_port_is_named(said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    message_keys.write_secret(bytes(32))
    monkeypatch.setattr(identity, "control_tasks", lambda *_: {"sensors": b"blocks: { a: { type: igps } }"})
    assert "sensors.yml: 'parameters': is missing or wrong; a station reads port and keys of igps" in said(1)


def test_who_is_no_station_is_told(said: Said) -> None:
    assert "stations: desk is none; there are station" in said(1, "--station", "desk")


def test_without_the_secret_no_robot_would_take_one(said: Said) -> None:
    assert "fleet_secret: is missing, so robot1 would take no position; bring it from where" in said(1)
    assert not message_keys.secret_file().exists()


def test_an_address_that_others_have_is_named(said: Said) -> None:
    """The port on this computer, and the station's address, which this computer has not."""
    message_keys.write_secret(bytes(32))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((positions.HERE, 0))
        port = other.getsockname()[1]
        complaint = said(1, "--port", str(port))
    assert f"127.0.0.1:{port}: Address already in use; end the program that has it, or take another" in complaint
    assert "eth99: No such device; give a network interface of this computer" in said(1, "--interface", "eth99")
    (station,) = inventory.load_fleet(FLEET).stations
    assert f"{station.address}: Cannot assign requested address; give this computer station's" in said(1, "--port", "0")
