"""What tests of the station need: the real program, robots that tell it something, and what a viewer does."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, SeekingReader

from flotilla.common import paths
from flotilla.fleet import inventory
from flotilla.fleet.message_keys import MessageKeys
from flotilla.fleet.model import Fleet
from flotilla.station import telemetry
from flotilla.station.authentication import Signer
from tests.running import PATIENCE

FLEET = paths.PROJECT / "flotilla/lab" / "scenarios" / "inventory"
LOOPBACK = "127.{}.{}.".format(*divmod(256 + os.getpid() % 65024, 256))
"""The fleet's addresses begin so: tests that run beside these have other ones, with the same ports."""

NEIGHBOUR = "127.255.{}.".format(LOOPBACK.split(".")[2])
"""Of a further fleet of the same test; nobody else's begin so."""

ADDRESS = LOOPBACK + "254"
"""The station's in the fleet on loopback."""

STRANGER = LOOPBACK + "9"
"""No robot of that fleet."""

SECRET = bytes([0x42] * 32)
"""Of fleets in tests."""

Messages = list[tuple[str, Any]]
"""Topic and decoded message."""


def on_loopback(directory: Path, begin: str = LOOPBACK, fleet: Path = FLEET) -> Path:
    """The scenarios' fleet, or another one, on this computer's loopback, in an inventory that is made; its addresses
    `begin` so."""
    shutil.copytree(fleet, directory)
    for file in (directory / "robots.yml", directory / "group_vars" / "all.yml"):
        file.write_text(re.sub(r"170\.160\.1\.|10\.43\.0\.", begin, file.read_text()))
    return directory


def secret_in(directory: Path) -> dict[str, str]:
    """The environment of programs that have a fleet's secret: in this folder, which is made."""
    directory.mkdir(exist_ok=True)
    (directory / "fleet_secret").write_text(SECRET.hex() + "\n")
    return {"KEYS": str(directory)}


@contextmanager
def station(
    fleet: Path,
    command: str,
    *options: str | Path,
    under: tuple[str, ...] = (),
    environment: Mapping[str, str] | None = None,
    address: str = ADDRESS,
) -> Iterator[subprocess.Popen[str]]:
    """`flotilla COMMAND` with `options`, run by the command line `under`, with the secret of fleets in tests.
    `environment`: besides this one's."""
    argv = [*under, sys.executable, "-m", "flotilla", command, *options, "--inventory", fleet, "--address", address]
    with (
        tempfile.TemporaryDirectory() as keys,
        subprocess.Popen(
            argv, cwd=paths.PROJECT, env=os.environ | secret_in(Path(keys)) | dict(environment or {}),
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        ) as process,
    ):  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def message_class(name: str, descriptors: bytes) -> type[Any]:
    """Of a protobuf schema, as a viewer makes it: `descriptors` is a FileDescriptorSet."""
    pool = descriptor_pool.DescriptorPool()
    for each in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(each)
    found: type[Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return found


class ProvenWay:
    """A stream's datagrams to its station, each with a proof."""

    def __init__(self, stream: telemetry.Stream, fleet: Fleet, secret: bytes = SECRET) -> None:
        robot = next(robot for robot in fleet.robots.values() if robot.name == stream.robot)
        station = fleet.stations[0]
        keys = MessageKeys(secret, {})
        self.signer = Signer(keys.between(robot, station), stream.port)
        self._to = (str(station.address), stream.port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((stream.address, 0))

    def send(self, payload: bytes) -> bytes:
        """The message that was sent."""
        self.signer.hear(self._socket)
        message = self.signer.sign(payload)
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.sendto(message, self._to)
        return message

    def close(self) -> None:
        self._socket.close()


class Robots:
    """Send what the tasks `valves` and `control` would; numbers go up by one."""

    def __init__(self, fleet: Path, secret: bytes = SECRET) -> None:
        described = inventory.load_fleet(fleet)
        self.streams = {stream.task: stream for stream in telemetry.streams(described)}
        self.sent = dict.fromkeys(self.streams, 0)
        self._ways = {task: ProvenWay(stream, described, secret) for task, stream in self.streams.items()}
        self._last: dict[str, bytes] = {}

    def __enter__(self) -> Robots:
        return self

    def __exit__(self, *_: object) -> None:
        for way in self._ways.values():
            way.close()

    def send(self, task: str, payload: bytes | None = None) -> None:
        """With the proof of the robot's task."""
        stream = self.streams[task]
        if payload is None:
            payload = struct.pack("<Q", self.sent[task]) + bytes(stream.length - 8)
            self.sent[task] += 1
        self._last[task] = self._ways[task].send(payload)

    def repeat(self, task: str) -> None:
        """The last message."""
        self.send_raw(task, self._last[task])

    def send_raw(self, task: str, datagram: bytes, address: str = "") -> None:
        """From the robot's address, or another one."""
        stream = self.streams[task]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.bind((address or stream.address, 0))
            one.sendto(datagram, (ADDRESS, stream.port))

    def until(self, what: Callable[[], bool]) -> None:
        """Send from both, a hundred times a second, until something has come of it."""
        end = time.monotonic() + PATIENCE
        while not what():
            assert time.monotonic() < end
            for task in self.streams:
                self.send(task)
            time.sleep(0.01)  # the rate of the robots


def steps(messages: Messages, topic: str) -> list[int]:
    return [message.step for name, message in messages if name == topic]


def contiguous(numbers: list[int]) -> bool:
    return all(after == before + 1 for before, after in itertools.pairwise(numbers))


def decoded(file: Path, *, whole: bool = True) -> Messages:
    """All messages, decoded by the file's own schemas alone. A file that is not `whole` has no index and no end."""
    data = io.BytesIO(file.read_bytes())
    reader = SeekingReader(data, validate_crcs=True) if whole else NonSeekingReader(data, validate_crcs=True)
    kinds: dict[int, type[Any]] = {}
    found: Messages = []
    try:
        for schema, channel, message in reader.iter_messages(log_time_order=whole):  # which would wait for the end
            assert schema is not None
            if schema.id not in kinds:
                kinds[schema.id] = message_class(schema.name, schema.data)
            assert message.sequence == sum(topic == channel.topic for topic, _ in found)
            found.append((channel.topic, kinds[schema.id].FromString(message.data)))
    except EndOfFile:
        assert not whole
    return found


def pymcap(command: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """By a reader that shares nothing with the writer."""
    argv = [str(Path(sys.executable).with_name("pymcap-cli")), command, *map(str, arguments)]
    return subprocess.run(argv, capture_output=True, text=True, check=False, timeout=PATIENCE)
