"""Receives what robots tell the station, and hands it to all who want it: a UDP port can be received at only once.

A datagram of the wrong length, from somewhere else, or without proof of its sender, is counted and left out.
"""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

from flotilla.common.errors import UserError
from flotilla.station.authentication import TRAILER, Verdict, Verifier
from flotilla.station.recording import Value
from flotilla.station.telemetry import Stream

REFRESH_S = 1.0
_LONGEST = 65536
_AT_ONCE = 1000
"""Datagrams of a port before the other ones' turn."""
_IP_PKTINFO = 8
"""Linux's option of that name (ip(7)), which Python's `socket` lacks."""
_PACKET = struct.Struct("=I4s4s")
"""Linux's in_pktinfo (ip(7)): the interface's index, this computer's address, and where the datagram was sent to."""

KeyOf = Callable[[Stream, str], str | None]
"""The key of a stream's messages to an address of this computer, as `MessageKeys.between` has it. None: robots send
nothing there."""


class Sink(Protocol):
    """Wants what is received."""

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        """One message. `received_ns`: since 1970-01-01 UTC."""

    def refresh(self) -> None:
        """Called every REFRESH_S."""

    def end(self) -> str:
        """Complete what was begun; what came of it, to be printed."""


def _no_key(stream: Stream, address: str) -> None:
    """Of who receives nothing by a network."""


@dataclass
class Count:
    """Of a stream."""

    received: int = 0
    refused: int = 0
    """Of the wrong length."""
    forged: int = 0
    """No key proves its sender."""
    replayed: int = 0
    """It came again or late, or came before its sender proved that it is new: the first one after a start is such."""

    @property
    def bad(self) -> int:
        """What no robot would send."""
        return self.refused + self.forged

    @property
    def attempts(self) -> str:
        """`410 forged, 206 replayed`; empty: nothing but a first message was left out for its proof."""
        counts = {"forged": self.forged, "replayed": self.replayed if self.replayed > 1 else 0}
        return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)


class Receiver:
    """Tells the streams' datagrams from all others."""

    def __init__(self, known: Iterable[Stream], key_of: KeyOf = _no_key) -> None:
        self.known = {(stream.address, stream.port): stream for stream in known}
        self.counts = {stream.topic: Count() for stream in self.known.values()}
        self.strangers = 0
        """Datagrams from addresses that are no robot's of a stream, or to one that robots do not send to."""
        self.sinks: list[Sink] = []
        self._key_of = key_of
        self._verifiers: dict[tuple[str, str], Verifier] = {}
        """By stream and address of this computer."""

    def take(self, datagram: bytes, address: str, to: tuple[str, int], received_ns: int) -> bytes:
        """From an address, to address and port of this computer; `received_ns` as for sinks. What to send back, mostly
        nothing."""
        stream = self.known.get((address, to[1]))
        verifier = self._verifier(stream, to[0]) if stream else None
        if not stream or not verifier:
            self.strangers += 1
            return b""
        count = self.counts[stream.topic]
        if len(datagram) != stream.length + TRAILER:
            count.refused += 1
            return b""
        verdict, made = verifier.judge(datagram)
        if verdict is Verdict.GOOD:
            self.hand(stream, stream.unpack(made), received_ns)
            return b""
        if verdict is Verdict.FORGED:
            count.forged += 1
        else:
            count.replayed += 1
        return made

    def _verifier(self, stream: Stream, address: str) -> Verifier | None:
        found = self._verifiers.get((stream.topic, address))
        if not found and (key := self._key_of(stream, address)):
            found = self._verifiers[stream.topic, address] = Verifier(key, stream.port)
        return found

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
                f"{topic}: {count.received} received, {count.refused} of a wrong length, {count.forged} forged and "
                f"{count.replayed} replayed left out"
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
        one.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
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
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    refreshed = time.monotonic()
    with stopped() as wake:
        while (now := time.monotonic()) < end:
            ready, _, _ = select.select([wake, *by_fd, *readers], [], [], min(end - now, REFRESH_S))
            if wake in ready:
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


@contextlib.contextmanager
def stopped() -> Iterator[int]:
    """A file descriptor that is readable from SIGINT or SIGTERM on."""
    wake, waker = socket.socketpair()
    with wake, waker:
        waker.setblocking(False)
        signal.set_wakeup_fd(waker.fileno())
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        yield wake.fileno()
        signal.set_wakeup_fd(-1)


def drain(one: socket.socket, receiver: Receiver) -> None:
    """What has come to one of `listen`'s sockets."""
    port = one.getsockname()[1]
    for _ in range(_AT_ONCE):
        try:
            datagram, [(_, _, packet)], _, sender = one.recvmsg(_LONGEST, socket.CMSG_SPACE(_PACKET.size))
        except BlockingIOError:
            return
        _, _, to = _PACKET.unpack(packet)
        back = receiver.take(datagram, sender[0], (socket.inet_ntoa(to), port), time.time_ns())
        if back:
            # From the address that it came to: a computer may have several.
            here = [(socket.IPPROTO_IP, _IP_PKTINFO, _PACKET.pack(0, to, bytes(4)))]
            with contextlib.suppress(OSError):  # the robot is out of reach, or all is full: it is asked again
                one.sendmsg([back], here, 0, sender)
