"""An 802.11 adapter on USB as the published robots have it: Ralink RT2571W with the radio chip RF2528.

What it does is known from the driver that Linux has for it, `rt73usb`: registers, descriptors of frames and the
firmware's place are those of drivers/net/wireless/ralink/rt2x00/rt73usb.h. It runs no firmware, but without one it
does nothing, as the real one. It has no power saving, no encryption and no 5 GHz; frames have no check sequence here.
"""

from __future__ import annotations

import enum
import random
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

from flotilla.lab.emulators.usb_redirection import Setup

FIRMWARE_BYTES = 2048
_FIRMWARE, _BEACON = 0x0800, 0x2400
_CHIP, _MAC, _BSSID, _STATE = 0x3000, 0x3008, 0x3010, 0x3030
_FILTER, _RETRIES, _SYNCHRONISATION, _TIME_LOW, _TIME_HIGH = 0x3040, 0x3050, 0x3064, 0x3070, 0x3074
_BASEBAND, _RADIO = 0x308C, 0x3090
_BUSY_BASEBAND, _BUSY_RADIO = 1 << 16, 1 << 31
_IS_READ = 1 << 15
_AWAKE, _FORCE_AWAKE = 1 << 3, 1 << 2
_DEAF, _NOT_TO_ME = 1 << 16, 1 << 20
_BEACONS = 1 << 20
_START_FIRMWARE = 8
_DESCRIPTOR = struct.Struct("<6I")
_VALID, _ACKNOWLEDGED, _TIMESTAMP, _OFDM, _SEQUENCE = 1 << 1, 1 << 3, 1 << 4, 1 << 5, 1 << 28
_HEADER_BYTES = 24
_CCK_100KBIT_S = {0: 10, 1: 20, 2: 55, 3: 110}
"""Rates by their code in a descriptor, without the bit of the short preamble."""
_OFDM_100KBIT_S = {0xB: 60, 0xF: 90, 0xA: 120, 0xE: 180, 0x9: 240, 0xD: 360, 0x8: 480, 0xC: 540}
_OFDM_CODES = {rate: code for code, rate in _OFDM_100KBIT_S.items()}
_TU_US = 1024
_GROUP = 1
"""Bit of a hardware address."""


class Request(enum.IntEnum):
    """Of the vendor's own."""

    MODE = 1
    WRITE = 6
    READ = 7
    READ_EEPROM = 9
    LEDS = 10
    RECEIVE = 12


@dataclass(frozen=True)
class Frame:
    """An 802.11 frame without its check sequence, and how it goes through the air."""

    content: bytes
    rate_100kbit_s: int
    frequency_mhz: int
    attempts: int = 1
    """Until its receiver has acknowledged it; 1 where nobody has to."""

    @property
    def receiver(self) -> bytes:
        return self.content[4:10]

    @property
    def is_beacon(self) -> bool:
        return self.content[0] == 0x80


def _eeprom(mac: bytes) -> bytes:
    words = bytearray(b"\xff" * 256)
    words[4:10] = mac
    struct.pack_into("<H", words, 2 * 0x10, 2 << 11 | 2 << 4 | 2 << 2 | 2)  # RF2528, antenna B, two of them
    return bytes(words)


class Rt73Usb:
    """The adapter. `transmit` gets its frames, `say` its USB transfers; `tick` lets it send beacons."""

    vendor, product, version_bcd = 0x148F, 0x2573, 0x0001
    endpoint_in, endpoint_out, packet_bytes = 0x81, 0x01, 512

    def __init__(self, mac: bytes, transmit: Callable[[Frame], None], seed: int = 1) -> None:
        self.mac = mac
        self.say: Callable[[bytes], None] = lambda data: None
        self._transmit = transmit
        self._chance = random.Random(f"{seed} {mac.hex()}")
        self.power_on()

    def power_on(self) -> None:
        """As plugged in: everything is forgotten."""
        self._memory = bytearray(0x4000)
        self._baseband = bytearray(128)
        self._baseband[0] = 0x25
        self._pll: dict[int, int] = {}
        self._runs_firmware = False
        self._sequence = 0
        self._began_ns = time.monotonic_ns()
        self._next_beacon_ns: int | None = None
        self._set(_CHIP, 0x2573 << 4 | 0xA)

    # As USB sees it

    def control(self, setup: Setup, data: bytes) -> bytes | None:
        match setup.request:
            case Request.READ:
                return self._read(setup.index, setup.length)
            case Request.READ_EEPROM:
                return _eeprom(self.mac)[setup.index : setup.index + setup.length]
            case Request.WRITE:
                self._write(setup.index, data)
            case Request.MODE:
                if setup.value == _START_FIRMWARE:
                    self._runs_firmware = any(self._memory[_FIRMWARE : _FIRMWARE + FIRMWARE_BYTES])
            case Request.LEDS | Request.RECEIVE:
                pass  # registers say whether it receives
            case _:
                return None
        return b""

    def written(self, data: bytes) -> None:
        """A descriptor and a frame, with bytes behind it that fill up a word."""
        if len(data) > _DESCRIPTOR.size and self._is_awake:
            self._send(data[: _DESCRIPTOR.size], data[_DESCRIPTOR.size :])

    # As the air sees it

    @property
    def frequency_mhz(self) -> int:
        """0 while it is not tuned. Two channels share a divider and differ in the fraction (RF2528's table)."""
        divider, fraction = self._pll.get(2), self._pll.get(3, 0) & 0xFFF
        if divider is None:
            return 0
        if divider == 0x7A2:
            return 2484
        return 2412 + 5 * ((divider - 0x786) // 2 + (fraction == 0xA1F))

    def hear(self, frame: Frame, dbm: float) -> None:
        """A frame that came well through the air. What is not for this adapter, it does not hand on."""
        filter_ = self._get(_FILTER)
        if not self._is_awake or filter_ & _DEAF or frame.frequency_mhz != self.frequency_mhz:
            return
        receiver, own_cell = frame.receiver, self._memory[_BSSID : _BSSID + 6]
        to_group, to_me = bool(receiver[0] & _GROUP), receiver == bytes(self._memory[_MAC : _MAC + 6])
        if filter_ & _NOT_TO_ME and not (to_me or to_group):
            return
        is_own_cell = frame.content[16:22] == own_cell
        if frame.is_beacon and is_own_cell and self._next_beacon_ns is not None:
            self._wait_for_beacon()  # one member of the cell sends it (9.1.4, 11.1.2.2)
        ofdm = _OFDM_CODES.get(frame.rate_100kbit_s)
        signal = frame.rate_100kbit_s if ofdm is None else ofdm
        word0 = to_me << 2 | to_group << 3 | is_own_cell << 5 | (ofdm is not None) << 7 | len(frame.content) << 16
        gain = min(max(round((dbm + 90) / 2), 0), 31)
        self.say(_DESCRIPTOR.pack(word0, signal | gain << 8 | 3 << 13, 0, 0, 0, 0) + frame.content)

    def next_tick_ns(self) -> int | None:
        """When the next beacon is due, by the host's monotonic clock."""
        return self._next_beacon_ns

    def tick(self, now_ns: int) -> None:
        """Send what is due."""
        if self._next_beacon_ns is None or now_ns < self._next_beacon_ns:
            return
        self._wait_for_beacon()
        descriptor = self._memory[_BEACON : _BEACON + _DESCRIPTOR.size]
        if self._is_awake and descriptor[0] & _VALID:
            at = _BEACON + _DESCRIPTOR.size
            self._send(bytes(descriptor), bytes(self._memory[at : at + 0x100 - _DESCRIPTOR.size]))

    # Inside

    @property
    def _is_awake(self) -> bool:
        return self._runs_firmware and bool(self._get(_STATE) & _AWAKE)

    def _send(self, descriptor: bytes, content: bytes) -> None:
        word0, word1, word2, *_ = _DESCRIPTOR.unpack(descriptor)
        frame = bytearray(content[: word0 >> 16 & 0xFFF])
        if len(frame) < _HEADER_BYTES + 8 * bool(word0 & _TIMESTAMP):
            return
        if word0 & _TIMESTAMP:
            struct.pack_into("<Q", frame, _HEADER_BYTES, self._time_us)
        if word1 & _SEQUENCE:
            self._sequence = (self._sequence + 0x10) & 0xFFFF
            struct.pack_into("<H", frame, 22, self._sequence | frame[22] & 0xF)
        code = word2 & 0xFF
        rate = _OFDM_100KBIT_S[code & 0xF] if word0 & _OFDM else _CCK_100KBIT_S[code & 0x3]
        attempts = max(self._get(_RETRIES) >> 28, 1) if word0 & _ACKNOWLEDGED else 1
        self._transmit(Frame(bytes(frame), rate, self.frequency_mhz, attempts))

    @property
    def _time_us(self) -> int:
        """The cell's time is this adapter's own: nobody sets it by others' beacons."""
        return (time.monotonic_ns() - self._began_ns) // 1000

    def _wait_for_beacon(self) -> None:
        """For an interval, and a random share of it, so that members take turns."""
        interval_us = (self._get(_SYNCHRONISATION) & 0xFFFF) * _TU_US // 16
        spread_us = self._chance.randrange(interval_us // 4 + 1)
        self._next_beacon_ns = time.monotonic_ns() + (interval_us + spread_us) * 1000

    def _get(self, at: int) -> int:
        return int(struct.unpack_from("<I", self._memory, at)[0])

    def _set(self, at: int, value: int) -> None:
        struct.pack_into("<I", self._memory, at, value)

    def _read(self, at: int, length: int) -> bytes:
        self._set(_TIME_LOW, self._time_us & 0xFFFFFFFF)
        self._set(_TIME_HIGH, self._time_us >> 32)
        return bytes(self._memory[at : at + length])

    def _write(self, at: int, data: bytes) -> None:
        if at == _CHIP:
            return
        self._memory[at : at + len(data)] = data
        if len(data) != 4:
            return
        value = self._get(at)
        if at == _STATE:
            self._set(at, value | _AWAKE if value & _FORCE_AWAKE else value & ~_AWAKE)
        elif at == _BASEBAND:
            register = value >> 8 & 0x7F
            if not value & _IS_READ:
                self._baseband[register] = value & 0xFF
            self._set(at, value & ~_BUSY_BASEBAND & ~0xFF | self._baseband[register])
        elif at == _RADIO:
            self._pll[value & 3] = value & 0xFFFFFF
            self._set(at, value & ~_BUSY_RADIO)
        elif at == _SYNCHRONISATION:
            if value & _BEACONS and value & 0xFFFF:
                if self._next_beacon_ns is None:
                    self._wait_for_beacon()
            else:
                self._next_beacon_ns = None
