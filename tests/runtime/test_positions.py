"""`make positions` by the real program, to a task with a block `igps` that the real runtime runs.

Robot 1 of the scenarios' fleet is an address of loopback, and so is its station.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from flotilla.common import paths
from flotilla.fleet import identity, inventory, message_keys
from tests.running import PATIENCE, Row, Task, free_port, running, watching
from tests.station import ADDRESS, on_loopback, secret_in

pytestmark = pytest.mark.clock

WATCHED = ",".join(f"igps.{name}" for name in ("position", "flag", "sequence", "refused", "forged", "replayed"))


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return on_loopback(tmp_path / "inventory")


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    environment = secret_in(tmp_path / "keys")
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    return environment


@pytest.fixture
def robot(fleet: Path, keys: dict[str, str], flotilla_run: Path, tmp_path: Path) -> Iterator[Task]:
    """The block as sensors.yml has it, with the keys of the robot's own card. The flag outlasts the program."""
    described = inventory.load_fleet(fleet)
    flying = described.robot_with("sensors")
    block = yaml.safe_load(identity.control_tasks(described, flying)["sensors"])["blocks"]["igps"]
    own, _ = identity.render(described, flying)[identity.TASKS.parent / message_keys.CREDENTIAL]
    (tmp_path / message_keys.CREDENTIAL).write_bytes(own)
    block["parameters"] |= {"local_address": str(flying.address), "timeout": 60}
    text = yaml.safe_dump({"period": "10 ms", "priority": 0, "blocks": {"igps": block}})
    environment = {"CREDENTIALS_DIRECTORY": str(tmp_path)}
    with running([flotilla_run, *watching(WATCHED)], tmp_path / "task.yml", text, environment) as task:
        next(task.rows())  # the port is open
        yield task


class Forwarding:
    """The program, and the positioning system's before it."""

    def __init__(self, process: subprocess.Popen[str], port: int, where: str) -> None:
        self.process = process
        self._to = ("127.0.0.1", port)
        assert process.stdout
        assert process.stdout.readline() == f"positions from {where}:{port} to robot1, until Ctrl-C\n"

    def send(self, datagram: bytes) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as system:
            system.sendto(datagram, self._to)

    def until(self, robot: Task, x: float, y: float) -> Row:
        """Send that position in each of the robot's steps until the robot is there."""
        for row in robot.rows():
            if row["flag"] and row["position"] == [x, y]:
                return row
            self.send(struct.pack("<2d", y, x))
        raise AssertionError

    def end(self, number: signal.Signals) -> str:
        """What it says."""
        self.process.send_signal(number)
        said, _ = self.process.communicate(timeout=PATIENCE)
        assert self.process.returncode == 0
        return said


@contextmanager
def forwarding(fleet: Path, keys: dict[str, str], interface: str = "") -> Iterator[Forwarding]:
    port = free_port()
    options = ["1", "--port", str(port), "--inventory", str(fleet)]
    options += ["--interface", interface] if interface else []
    argv = [sys.executable, "-m", "flotilla", "positions", *options]
    with subprocess.Popen(argv, cwd=paths.PROJECT, env=os.environ | keys, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Forwarding(process, port, interface or "127.0.0.1")
        finally:
            process.kill()


def test_positions_reach_the_robot_also_after_a_restart(robot: Task, fleet: Path, keys: dict[str, str]) -> None:
    """Seen to fail with a program that takes no challenges."""
    with forwarding(fleet, keys) as program:
        program.send(b"not a position")
        row = program.until(robot, 1.5, -2.25)
        said = program.end(signal.SIGINT)
    assert re.fullmatch(r"[1-9]\d* positions sent to robot1; 1 of a wrong length left out\n", said), said
    assert (row["refused"], row["forged"]) == (0, 0)
    with forwarding(fleet, keys) as program:
        again = program.until(robot, 3, 4)
        program.end(signal.SIGTERM)
    assert again["sequence"] > row["sequence"]
    assert again["forged"] == 0


def test_positions_come_by_one_interface(robot: Task, fleet: Path, keys: dict[str, str]) -> None:
    """That of the loopback here. Seen to fail with a socket that is bound to another."""
    with forwarding(fleet, keys, "lo") as program:
        row = program.until(robot, 5, 6)
        program.end(signal.SIGTERM)
    assert row["position"] == [5, 6]


def test_who_has_the_stations_address_alone_moves_no_robot(robot: Task, fleet: Path, keys: dict[str, str]) -> None:
    """A position without a proof, and one with a wrong one. Seen to fail with a block without keys."""
    with forwarding(fleet, keys) as program:
        program.until(robot, 1, 2)
        program.end(signal.SIGTERM)
    described = inventory.load_fleet(fleet)
    to = (str(described.robot_with("sensors").address), 5010)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind((ADDRESS, 0))
        stranger.sendto(struct.pack("<2d", 7, 7), to)
        stranger.sendto(struct.pack("<2d", 7, 7) + bytes(40), to)
        row = robot.until(lambda row: row["forged"] and row["refused"])
    assert (row["forged"], row["refused"]) == (1, 1)
    assert (row["position"], row["flag"]) == ([1, 2], True)
