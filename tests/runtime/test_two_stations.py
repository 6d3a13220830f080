"""Commands of two stations by real datagrams, to those blocks of the task `drive` that take and judge them."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from flotilla.fleet import identity
from flotilla.station.driving import COMMAND
from lab.wheeled import by_wires
from tests.running import Task, free_port, running, watching

FIRST, SECOND = "127.0.1.1", "127.0.1.2"
BLOCKS = ("command", "guard", "in")
WATCHED = ",".join(f"guard.{name}" for name in ("flag", "age", "operator", "other", "conflict"))


class Station:
    """Sends a command every 50 ms, until it is stopped."""

    def __init__(self, address: str, operator: int, port: int) -> None:
        self._operator, self._sequence, self._port = operator, 0, port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, 0))
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.05):
            self.send(1)

    def send(self, count: int) -> None:
        with self._lock:
            for _ in range(count):
                self._sequence += 1
                command = COMMAND.pack(self._operator, self._sequence, 0.3, 0, 0, True)
                self._socket.sendto(command, ("127.0.0.1", self._port))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def task(flotilla_run: Path, tmp_path: Path, port: int) -> Iterator[Task]:
    """As drive.yml has them, with addresses of loopback."""
    fleet = by_wires.fleet()
    drive = yaml.safe_load(identity.control_tasks(fleet, fleet.robot_with("drive"))["drive"])
    blocks = {name: drive["blocks"][name] for name in BLOCKS}
    blocks["command"]["parameters"] |= {"port": port, "from": [FIRST, SECOND]}
    text = yaml.safe_dump({"period": drive["period"], "priority": 0, "blocks": blocks})
    with running([flotilla_run, *watching(WATCHED)], tmp_path / "task.yml", text) as task:
        yield task


def test_each_station_is_heard(task: Task, port: int) -> None:
    """Seen to fail with a failover of 5 s, by which the second station is not noticed."""
    first = Station(FIRST, 1, port)
    try:
        task.until(lambda row: row["flag"] and row["operator"] == 1)
        second = Station(SECOND, 2, port)
        try:
            row = task.until(lambda row: row["conflict"])
            assert (row["flag"], row["operator"], row["other"]) == (0, 1, 2)
        finally:
            second.close()
        row = task.until(lambda row: row["flag"])
        assert (row["operator"], row["other"], row["conflict"]) == (1, 0, 0)
    finally:
        first.close()
    task.until(lambda row: not row["flag"])


def test_a_flood_ends_in_a_stop(task: Task, port: int) -> None:
    """2000 commands at once are more than the task takes in 0.3 s. What has waited for longer moves nothing, and it
    goes on when the queue is empty. Seen to fail with `take: newest`."""
    first = Station(FIRST, 1, port)
    try:
        task.until(lambda row: row["flag"])
        first.send(2000)
        row = task.until(lambda row: not row["flag"])
        assert (row["operator"], row["conflict"]) == (1, 0)
        task.until(lambda row: row["age"] > 0.5)
        task.until(lambda row: row["flag"])
    finally:
        first.close()
