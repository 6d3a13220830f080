"""A USB device of the lab in a guest's socket: the device's side of USB redirection, version 0.7, which QEMU speaks.

The protocol is that of the usbredir project (docs/usb-redirection-protocol.md there). Of its capabilities these are
offered: the device's version, and packet sizes of endpoints. So identifiers have 32 bits, lengths of bulk packets 16.
QEMU answers what it can by itself: addresses, and waiting for a device that has nothing to say.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

_HEADER = struct.Struct("<III")
_HELLO, _CONNECT, _DISCONNECT, _RESET, _INTERFACES, _ENDPOINTS, _CONFIGURE = range(7)
_CONFIGURATION, _CONFIGURED, _SET_SETTING, _SETTING, _SETTING_IS = range(7, 12)
_CANCEL = 21
_CONTROL, _BULK = 100, 101
_CONTROL_HEADER = struct.Struct("<BBBBHHH")
_BULK_HEADER = struct.Struct("<BBHI")
_CAPABILITIES = 1 << 1 | 1 << 4
_SUCCESS, _CANCELLED, _STALL = 0, 1, 4
_TYPE_CONTROL, _TYPE_BULK, _TYPE_NONE = 0, 2, 255
_HIGH_SPEED = 2
_PLACES = 32
"""Of endpoints in tables: 0 to 15 outward, 16 to 31 inward."""
_IN = 0x80
WAITING = 64
"""Messages that wait for the guest to ask for them; a device drops what comes then."""


@dataclass(frozen=True)
class Setup:
    """A control request (USB 2.0, table 9-2)."""

    request_type: int
    request: int
    value: int
    index: int
    length: int


class Device(Protocol):
    """What the guest sees: high speed, one interface of the vendor's own class, one bulk endpoint each way."""

    vendor: int
    product: int
    version_bcd: int
    endpoint_in: int
    """With the bit of the direction: 0x81."""
    endpoint_out: int
    packet_bytes: int
    """Of both endpoints."""

    def control(self, setup: Setup, data: bytes) -> bytes | None:
        """A request that is not of the standard. What it answers; None refuses it."""

    def written(self, data: bytes) -> None:
        """A bulk transfer to the device."""


class Plug:
    """One connection of a device with QEMU. Bytes go in by `feed` and out by `send`, which may block."""

    def __init__(self, device: Device, send: Callable[[bytes], object]) -> None:
        self.device = device
        self._send = send
        self._input = bytearray()
        self._asked: deque[tuple[int, int]] = deque()
        """Identifier and length of the guest's transfers that wait for data."""
        self._waiting: deque[bytes] = deque()
        self.dropped = 0
        """Messages of the device that found no room."""
        self._plugged = False
        self._handlers: dict[int, Callable[[int, bytes], None]] = {
            _HELLO: self._hello,
            _RESET: lambda identifier, body: self._forget(),
            _CONFIGURE: lambda identifier, body: self._put(_CONFIGURED, identifier, bytes([_SUCCESS, body[0]])),
            _CONFIGURATION: lambda identifier, body: self._put(_CONFIGURED, identifier, bytes([_SUCCESS, 1])),
            _SET_SETTING: lambda identifier, body: self._put(_SETTING_IS, identifier, bytes([_SUCCESS, *body[:2]])),
            _SETTING: lambda identifier, body: self._put(_SETTING_IS, identifier, bytes([_SUCCESS, body[0], 0])),
            _CANCEL: self._cancel,
            _CONTROL: self._control,
            _BULK: self._bulk,
        }
        hello = b"flotilla".ljust(64, b"\0") + struct.pack("<I", _CAPABILITIES)
        self._put(_HELLO, 0, hello)

    def feed(self, data: bytes) -> None:
        """What QEMU said."""
        self._input += data
        while len(self._input) >= _HEADER.size:
            kind, length, identifier = _HEADER.unpack_from(self._input)
            end = _HEADER.size + length
            if len(self._input) < end:
                return
            body = bytes(self._input[_HEADER.size : end])
            del self._input[:end]
            if handler := self._handlers.get(kind):
                handler(identifier, body)

    def say(self, data: bytes) -> None:
        """The device has a bulk transfer for the guest."""
        if not self._plugged or len(self._waiting) >= WAITING:
            self.dropped += 1
            return
        self._waiting.append(data)
        self._deliver()

    def plug(self) -> None:
        """Into the guest's socket."""
        device = self.device
        interfaces = struct.pack("<I", 1) + bytes(_PLACES) + b"\xff" * _PLACES + bytes(2 * _PLACES)
        self._put(_INTERFACES, 0, interfaces)
        kinds, sizes = [_TYPE_NONE] * _PLACES, [0] * _PLACES
        for place in (0, 16):
            kinds[place], sizes[place] = _TYPE_CONTROL, 64
        for endpoint in (device.endpoint_in, device.endpoint_out):
            place = (endpoint & _IN) >> 3 | endpoint & 0xF
            kinds[place], sizes[place] = _TYPE_BULK, device.packet_bytes
        self._put(_ENDPOINTS, 0, bytes(kinds) + bytes(2 * _PLACES) + struct.pack(f"<{_PLACES}H", *sizes))
        identity = struct.pack(
            "<BBBBHHH", _HIGH_SPEED, 0xFF, 0xFF, 0xFF, device.vendor, device.product, device.version_bcd
        )
        self._put(_CONNECT, 0, identity)
        self._plugged = True

    def unplug(self) -> None:
        """Out of it."""
        self._put(_DISCONNECT, 0, b"")
        self._plugged = False
        self._forget()

    def _forget(self) -> None:
        self._asked.clear()
        self._waiting.clear()

    def _put(self, kind: int, identifier: int, body: bytes) -> None:
        self._send(_HEADER.pack(kind, len(body), identifier) + body)

    def _hello(self, _: int, body: bytes) -> None:
        self.plug()

    def _cancel(self, identifier: int, _: bytes) -> None:
        for asked in self._asked:
            if asked[0] == identifier:
                self._asked.remove(asked)
                header = _BULK_HEADER.pack(self.device.endpoint_in, _CANCELLED, 0, 0)
                self._put(_BULK, identifier, header)
                return

    def _control(self, identifier: int, body: bytes) -> None:
        endpoint, request, request_type, _, value, index, length = _CONTROL_HEADER.unpack_from(body)
        setup = Setup(request_type, request, value, index, length)
        data = body[_CONTROL_HEADER.size :]
        inward = bool(request_type & _IN)
        is_standard = not request_type & 0x60
        answer = self._standard(setup) if is_standard else self.device.control(setup, data)
        status = _SUCCESS if answer is not None else _STALL
        answer = (answer or b"")[:length] if inward else b""
        count = len(answer) if inward or status else length
        header = _CONTROL_HEADER.pack(endpoint, request, request_type, status, value, index, count)
        self._put(_CONTROL, identifier, header + answer)

    def _standard(self, setup: Setup) -> bytes | None:
        if setup.request == 6:  # GET_DESCRIPTOR
            return self._descriptors().get(setup.value >> 8)
        if setup.request == 0:  # GET_STATUS
            return bytes(2)
        return b"" if setup.request in (1, 3) else None  # CLEAR_FEATURE, SET_FEATURE

    def _descriptors(self) -> dict[int, bytes]:
        """Device and configuration; there are no strings."""
        device = self.device
        own = struct.pack("<BBHBBBB", 18, 1, 0x200, 0xFF, 0xFF, 0xFF, 64)
        own += struct.pack("<HHHBBBB", device.vendor, device.product, device.version_bcd, 0, 0, 0, 1)
        interface = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 2, 0xFF, 0xFF, 0xFF, 0)
        for endpoint in (device.endpoint_in, device.endpoint_out):
            interface += struct.pack("<BBBBHB", 7, 5, endpoint, _TYPE_BULK, device.packet_bytes, 0)
        configuration = struct.pack("<BBHBBBBB", 9, 2, 9 + len(interface), 1, 1, 0, 0x80, 150)
        return {1: own, 2: configuration + interface}

    def _bulk(self, identifier: int, body: bytes) -> None:
        endpoint, _, length, stream = _BULK_HEADER.unpack_from(body)
        if endpoint & _IN:
            self._asked.append((identifier, length))
            self._deliver()
            return
        self._put(_BULK, identifier, _BULK_HEADER.pack(endpoint, _SUCCESS, length, stream))
        self.device.written(body[_BULK_HEADER.size :])

    def _deliver(self) -> None:
        while self._asked and self._waiting:
            identifier, length = self._asked.popleft()
            data = self._waiting.popleft()[:length]
            header = _BULK_HEADER.pack(self.device.endpoint_in, _SUCCESS, len(data), 0)
            self._put(_BULK, identifier, header + data)
