"""The indoor positioning system (iGPS): tells a robot by UDP where it is, and on demand does so badly.

with Igps(("127.0.0.1", 5000), lambda seconds: (0.01 * seconds, 0.5), rate=40) as igps:
    ...
    igps.faults = Faults(loss=1)  # silence
"""

from __future__ import annotations

import math
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

from flotilla.station.authentication import Signer

Position = tuple[float, float]
"""x and y in m."""

ByteOrder = Literal["little", "big"]


def pack(position: Position, byte_order: ByteOrder = "little") -> bytes:
    """A datagram: Y, then X, as IEEE 754 doubles."""
    x, y = position
    return struct.pack("<2d" if byte_order == "little" else ">2d", y, x)


@dataclass(frozen=True)
class Faults:
    """Shares of datagrams, from 0 to 1, that are treated so."""

    loss: float = 0
    """Never sent; 1 is silence."""
    garbage: float = 0
    """Random bytes, of any length but the right one."""
    blind: float = 0
    """NaN for a coordinate: the system does not see the robot."""
    wild: float = 0
    """A position far outside the room."""
    burst: int = 1
    """Datagrams that are held back until there are so many, and then leave at once."""


class Igps:
    """Sends to `destination` from its own thread while entered. `position` is asked with the seconds since then."""

    def __init__(
        self,
        destination: tuple[str, int],
        position: Callable[[float], Position],
        *,
        rate: float = 40,
        jitter: float = 0.002,
        byte_order: ByteOrder = "little",
        faults: Faults | None = None,
        seed: int = 0,
        signer: Signer | None = None,
    ) -> None:
        """`signer`: of positions to the destination; it proves bad ones, too."""
        self.faults = faults or Faults()
        """May be set at any time."""
        self.sent = 0
        """Good positions sent so far."""
        self._destination = destination
        self._position = position
        self._period = 1 / rate
        self._jitter = jitter
        self._byte_order: ByteOrder = byte_order
        self._random = random.Random(seed)
        self._signer = signer
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="igps")

    def datagrams(self) -> Iterator[tuple[float, list[bytes]]]:
        """When, in seconds since the begin, to send what; the same for the same seed, faults and position."""
        held: list[bytes] = []
        count = 0
        while True:
            due = count * self._period
            count += 1
            datagram = self._datagram(self._position(due))
            if datagram is not None:
                held.append(datagram)
            ready: list[bytes] = []
            if len(held) >= self.faults.burst:
                ready, held = held, []
            yield due + self._random.uniform(0, self._jitter), ready

    def _datagram(self, position: Position) -> bytes | None:
        chance = self._random.random
        if chance() < self.faults.loss:
            return None
        if chance() < self.faults.garbage:
            length = self._random.choice([*range(16), *range(17, 64)])
            return self._random.randbytes(length)
        if chance() < self.faults.blind:
            position = (position[0], math.nan)
        if chance() < self.faults.wild:
            position = (position[0] + 1e6, position[1])
        return pack(position, self._byte_order)

    def _is_good(self, datagram: bytes) -> bool:
        if len(datagram) != 16:
            return False
        values = struct.unpack("<2d" if self._byte_order == "little" else ">2d", datagram)
        return all(abs(value) < 1e5 for value in values)

    def _run(self) -> None:
        begin = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for due, datagrams in self.datagrams():
                if self._stop.wait(max(0.0, begin + due - time.monotonic())):
                    return
                for datagram in datagrams:
                    sender.sendto(self._signed(datagram, sender), self._destination)
                    self.sent += self._is_good(datagram)

    def _signed(self, datagram: bytes, sender: socket.socket) -> bytes:
        if not self._signer:
            return datagram
        self._signer.hear(sender)
        return self._signer.sign(datagram)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
