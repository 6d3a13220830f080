"""CAN frames, and the buses that carry them to an emulated device: SocketCAN, or UDP where there is no CAN.

On UDP a hub takes the bus's place: a datagram is the kernel's `struct can_frame`, and what one client sends reaches all
others. runtime/tests/can/udp_can.c turns a program's CAN sockets into such clients.
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from typing import Protocol, Self

EXTENDED = 1 << 31  # flags of an identifier, as in linux/can.h
REMOTE = 1 << 30

_LAYOUT = struct.Struct("=IB3x8s")


@dataclass(frozen=True)
class Frame:
    """A classical CAN frame; `id` carries the kernel's flags in bits 29 to 31."""

    id: int
    data: bytes = b""

    def pack(self) -> bytes:
        return _LAYOUT.pack(self.id, len(self.data), self.data)

    @classmethod
    def unpack(cls, raw: bytes) -> Self:
        identifier, length, data = _LAYOUT.unpack(raw)
        return cls(identifier, data[:length])


class Bus(Protocol):
    def fileno(self) -> int: ...
    def send(self, frame: Frame) -> None: ...
    def receive(self) -> Frame | None:
        """The next frame, None when none waits."""


class SocketCanBus:
    """An interface of the kernel: vcan, or a CAN board."""

    def __init__(self, interface: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.bind((interface,))
        self._socket.setblocking(False)

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, frame: Frame) -> None:
        self._socket.send(frame.pack())

    def receive(self) -> Frame | None:
        try:
            return Frame.unpack(self._socket.recv(_LAYOUT.size))
        except BlockingIOError:
            return None

    def close(self) -> None:
        self._socket.close()


class UdpHub:
    """A bus whose other nodes are UDP sockets on this computer."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._clients: set[tuple[str, int]] = set()
        self.port: int = self._socket.getsockname()[1]

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, frame: Frame) -> None:
        self._forward(frame.pack(), self._clients)

    def receive(self) -> Frame | None:
        while True:
            try:
                raw, sender = self._socket.recvfrom(64)
            except BlockingIOError:
                return None
            except ConnectionRefusedError:  # a client has ended since something was sent to it
                continue
            self._clients.add(sender)
            if len(raw) == _LAYOUT.size:  # a new client sends an empty one
                self._forward(raw, self._clients - {sender})
                return Frame.unpack(raw)

    def close(self) -> None:
        self._socket.close()

    def _forward(self, raw: bytes, clients: set[tuple[str, int]]) -> None:
        for client in clients:
            try:
                self._socket.sendto(raw, client)
            except (ConnectionRefusedError, BlockingIOError):
                continue  # as on a bus, nobody waits for a node that does not listen
