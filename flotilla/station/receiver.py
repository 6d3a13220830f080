"""Receives what robots tell the station, and hands it to all who want it: a UDP port can be received at only once.

A datagram of the wrong length, or from somewhere else, is counted and left out.
"""

from __future__ import annotations

import select
import signal
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

from flotilla.common.errors import UserError
from flotilla.station.recording import Value
from flotilla.station.telemetry import Stream

REFRESH_S = 1.0
_LONGEST = 65536
_AT_ONCE = 1000
"""Datagrams of a port before the other ones' turn."""


class Sink(Protocol):
    """Wants what is received."""

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        """One message. `received_ns`: since 1970-01-01 UTC."""

    def refresh(self) -> None:
        """Called every REFRESH_S."""

    def end(self) -> str:
        """Complete what was begun; what came of it, to be printed."""


@dataclass
class Count:
    """Of a stream."""

    received: int = 0
    refused: int = 0
    """Of the wrong length."""


class Receiver:
    """Tells the streams' datagrams from all others."""

    def __init__(self, known: Iterable[Stream]) -> None:
        self.known = {(stream.address, stream.port): stream for stream in known}
        self.counts = {stream.topic: Count() for stream in self.known.values()}
        self.strangers = 0
        """Datagrams from addresses that are no robot's of a stream."""
        self.sinks: list[Sink] = []

    def take(self, datagram: bytes, address: str, port: int, received_ns: int) -> None:
        """From an address, to a port of this computer; `received_ns` as for sinks."""
        stream = self.known.get((address, port))
        if not stream:
            self.strangers += 1
            return
        count = self.counts[stream.topic]
        if len(datagram) != stream.length:
            count.refused += 1
            return
        self.hand(stream, stream.unpack(datagram), received_ns)

    def hand(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        """A message to all sinks."""
        self.counts[stream.topic].received += 1
        for sink in self.sinks:
            sink.take(stream, values, received_ns)

    def refresh(self) -> None:
        for sink in self.sinks:
            sink.refresh()

    @property
    def summary(self) -> list[str]:
        """Lines."""
        return [
            *(
                f"{topic}: {count.received} received, {count.refused} of a wrong length left out"
                for topic, count in self.counts.items()
            ),
            f"{self.strangers} datagrams of strangers left out",
        ]


def listen(ports: Iterable[int], address: str) -> list[socket.socket]:
    """A socket for each port."""
    opened = []
    for port in sorted(set(ports)):
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        one.setblocking(False)
        try:
            one.bind((address, port))
        except OSError as error:
            remedy = "end what receives there, or give this computer the address"
            raise UserError(f"UDP port {port} of {address}: {error.strerror}; {remedy}") from error
        opened.append(one)
    return opened


def receive(
    receiver: Receiver,
    sockets: list[socket.socket],
    seconds: float | None,
    note: Callable[[str], None] | None,
    others: Mapping[int, Callable[[], bool]] = MappingProxyType({}),
) -> None:
    """Until SIGINT or SIGTERM, or for so many seconds; `note` is called with how far it is.

    `others`: what to call when a file descriptor is readable, until it returns False.
    """
    readers = dict(others)
    by_fd = {one.fileno(): one for one in sockets}
    wake, waker = socket.socketpair()
    waker.setblocking(False)
    signal.set_wakeup_fd(waker.fileno())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    refreshed = time.monotonic()
    while (now := time.monotonic()) < end:
        ready, _, _ = select.select([wake.fileno(), *by_fd, *readers], [], [], min(end - now, REFRESH_S))
        if wake.fileno() in ready:
            break
        for fd in ready:
            if fd in by_fd:
                drain(by_fd[fd], receiver)
            elif not readers[fd]():
                del readers[fd]
        if time.monotonic() - refreshed >= REFRESH_S:
            receiver.refresh()
            refreshed = time.monotonic()
            if note:
                note(f"{sum(count.received for count in receiver.counts.values())} messages")
    for one in sockets:  # what came before the end
        drain(one, receiver)


def drain(one: socket.socket, receiver: Receiver) -> None:
    """What has come to one of `listen`'s sockets."""
    port = one.getsockname()[1]
    for _ in range(_AT_ONCE):
        try:
            datagram, (address, _) = one.recvfrom(_LONGEST)
        except BlockingIOError:
            return
        receiver.take(datagram, address, port, time.time_ns())
