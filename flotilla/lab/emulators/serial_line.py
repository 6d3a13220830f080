"""A serial line with an emulated device at its end, over a pseudo terminal or a Unix socket (QEMU's chardevs).

    with SerialLine(Dsp3000(lambda seconds: 10.0), Pty()) as line:
        print(line.path)            # open this as a serial port
        line.faults = Faults(corrupt=0.1)
        line.unplug()
        line.replug()               # behind the same path, switched on anew

A device knows its protocol and no time but what it is told; the line has the clock, the jitter and the faults.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pty
import random
import select
import socket
import struct
import tempfile
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self


class Device(ABC):
    """What hangs on a serial line. Its messages are the units that faults apply to."""

    baud: int
    """Rate that it is set to. What `received` answers still leaves at the one before."""
    jitter: float = 0.0002
    """How much later than due a message leaves it at most, in s."""

    @abstractmethod
    def power_on(self) -> None:
        """Forget everything but what survives a power cut."""

    @abstractmethod
    def received(self, data: bytes) -> list[bytes]:
        """Take bytes from the robot, and answer."""

    @property
    @abstractmethod
    def period(self) -> float | None:
        """Seconds between two of `measure`; None while it sends nothing by itself."""

    @abstractmethod
    def measure(self, seconds: float) -> list[bytes]:
        """What it sends by itself, `seconds` after it was switched on."""


@dataclass(frozen=True)
class Faults:
    """Shares are of messages, from 0 to 1."""

    garbage: float = 0
    """Random bytes in place of a message."""
    half: float = 0
    """A message that breaks off."""
    corrupt: float = 0
    """A message with one bit flipped: its checksum, if it has one, is wrong."""
    silence: bool = False
    """Nothing is sent; commands are still heard."""
    burst: int = 1
    """Messages that are held back until there are so many, and then leave at once."""
    baud: int | None = None
    """The rate that the device really has, other than it should."""


class Endpoint(Protocol):
    """Where the bytes go."""

    path: str
    """What the robot opens, for people to read."""

    def plug(self) -> int:
        """Connect, and give the descriptor to read and write."""

    def unplug(self) -> None:
        """Disconnect; the robot sees a hang-up."""

    def robot_baud(self) -> int | None:
        """The rate at which the robot listens, where that can be known."""


class Pty:
    """A pseudo terminal, behind a link that stays the same when it is unplugged and plugged in again."""

    def __init__(self, link: Path | None = None) -> None:
        self._link = link or Path(tempfile.mkdtemp(prefix="serial-")) / "port"
        self.path = str(self._link)
        self._master = self._slave = -1

    def plug(self) -> int:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._link.symlink_to(os.ttyname(self._slave))
        return self._master

    def unplug(self) -> None:
        self._link.unlink()
        os.close(self._slave)
        os.close(self._master)

    def robot_baud(self) -> int | None:
        # struct termios2 of asm/termbits.h, which Python's termios does not know: rates beside POSIX's list.
        tcgets2 = 0x802C542A
        settings = fcntl.ioctl(self._slave, tcgets2, bytes(44))
        return int(struct.unpack_from("=I", settings, 40)[0])


class UnixSocket:
    """A Unix socket that somebody listens on, by its path.

    Like a wire it keeps next to nothing for who does not listen: its sender sees what the other end has yet to read,
    and here that is a handful of messages. TCP takes up kilobytes: ten seconds of a gyro have been seen.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._socket: socket.socket | None = None

    def plug(self) -> int:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 0)  # the least there is, socket(7)
        self._socket.connect(self.path)
        self._socket.setblocking(False)
        return self._socket.fileno()

    def unplug(self) -> None:
        if self._socket:
            self._socket.close()
        self._socket = None

    def robot_baud(self) -> int | None:
        return None


def at_wrong_baud(data: bytes, sent: int, heard: int) -> bytes:
    """What a UART at `heard` Bd makes of bytes, 8N1 and back to back, at `sent` Bd.

    It samples each bit in the middle of where that would be. A character without its stop bit is taken all the same: a
    raw terminal does not tell frame errors.
    """
    bits = [bit for byte in data for bit in (0, *((byte >> shift) & 1 for shift in range(8)), 1)]

    def level(seconds: float) -> int:
        index = int(seconds * sent)
        return bits[index] if index < len(bits) else 1

    out = bytearray()
    end = len(bits) / sent
    at = 0.0
    step = 1 / (16 * heard)  # a UART looks for the start bit sixteen times a bit
    while at < end:
        if level(at):
            at += step
            continue
        out.append(sum(level(at + (index + 1.5) / heard) << index for index in range(8)))
        at += 9.5 / heard
        while at < end and not level(at):  # wait for the line to be idle
            at += step
    return bytes(out)


class SerialLine:
    """Runs a device in a thread of its own, in real time, while entered."""

    def __init__(
        self, device: Device, endpoint: Endpoint | None = None, *, faults: Faults | None = None, seed: int = 0
    ) -> None:
        self.device = device
        self.faults = faults or Faults()
        self._endpoint: Endpoint = endpoint or Pty()
        self.path = self._endpoint.path
        self.sent = 0
        """Messages that the device has sent, faulty or not."""
        self._random = random.Random(seed)
        self._held: list[bytes] = []
        self._descriptor = -1
        self._wake, self._waker = os.pipe()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        self.replug()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._thread:
            self.unplug()
        os.close(self._wake)
        os.close(self._waker)

    def unplug(self) -> None:
        """Pull the plug, and the device's power with it."""
        assert self._thread
        self._stopping.set()
        os.write(self._waker, b"x")
        self._thread.join()
        os.read(self._wake, 1)
        self._thread = None
        self._endpoint.unplug()

    def replug(self) -> None:
        self._stopping.clear()
        self._held = []
        self._descriptor = self._endpoint.plug()
        self.device.power_on()
        self._thread = threading.Thread(target=self._run, name=type(self.device).__name__, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        begun = time.monotonic()
        due: float | None = None
        leaves = 0.0
        while not self._stopping.is_set():
            period = self.device.period
            if period is None:
                due = None
            elif due is None:
                due = time.monotonic() + period
                leaves = due + self._random.uniform(0, self.device.jitter)
            wait = None if due is None else max(0.0, leaves - time.monotonic())
            readable, _, _ = select.select([self._descriptor, self._wake], [], [], wait)
            if self._stopping.is_set():
                return
            if self._descriptor in readable and not self._receive():
                return
            if due is not None and self.device.period and time.monotonic() >= leaves:
                self._send(self.device.measure(due - begun))
                due += self.device.period
                # A host that stopped us for long hears no burst of what was missed.
                due = max(due, time.monotonic() - 1)
                leaves = due + self._random.uniform(0, self.device.jitter)

    def _receive(self) -> bool:
        try:
            data = os.read(self._descriptor, 4096)
        except OSError as error:
            return error.errno in (errno.EAGAIN, errno.EINTR)
        baud = self.device.baud
        self._send(self.device.received(self._over_the_wire(data, baud, inwards=True)), baud)
        return bool(data)

    def _send(self, messages: Iterable[bytes], baud: int | None = None) -> None:
        for message in messages:
            self._held.append(self._spoil(message))
            self.sent += 1
        if self.faults.silence:
            self._held = []
        if len(self._held) < self.faults.burst:
            return
        data, self._held = b"".join(self._held), []
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionError):
            # Nobody listens: a wire does not wait.
            os.write(self._descriptor, self._over_the_wire(data, baud or self.device.baud))

    def _spoil(self, message: bytes) -> bytes:
        faults = self.faults
        if self._random.random() < faults.garbage:
            return self._random.randbytes(self._random.randint(1, 2 * len(message)))
        if self._random.random() < faults.half:
            return message[: self._random.randrange(len(message))]
        if self._random.random() < faults.corrupt:
            damaged = bytearray(message)
            damaged[self._random.randrange(len(message))] ^= 1 << self._random.randrange(8)
            return bytes(damaged)
        return message

    def _over_the_wire(self, data: bytes, baud: int, *, inwards: bool = False) -> bytes:
        """What the other end makes of bytes, while the device is set to a rate."""
        device = self.faults.baud or baud
        robot = self._endpoint.robot_baud()
        if robot is None:
            robot = baud
        # UARTs agree on a character while they are less than some 4 % apart.
        if abs(robot - device) <= 0.04 * device:
            return data
        return at_wrong_baud(data, robot, device) if inwards else at_wrong_baud(data, device, robot)
