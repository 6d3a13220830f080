"""The fibre-optic gyro KVH DSP-3000, both variants. Facts: KVH technical manual 54-0215 Rev. C, sections 2 and 3."""

from __future__ import annotations

import random
from collections.abc import Callable
from enum import Enum
from typing import Literal

from flotilla.lab.emulators.serial_line import Device

Format = Literal["text", "words"]

FULL_SCALE = 375.0
"""°/s."""


class Mode(Enum):
    """By its command; the order is that of a word's type bits."""

    RATE = "R"
    INCREMENTAL = "A"
    INTEGRATED = "P"


def text(value: float, valid: bool = True) -> bytes:
    """A frame of the 100 Hz gyro: 21 bytes, 5.5 ms at 38400 Bd."""
    return f"{value:>15.6f}   {valid:d}\r\n".encode()


def word(value: float, mode: Mode, valid: bool = True) -> bytes:
    """A word of the 1000 Hz gyro. The synchronisation bits are left 0."""
    unit = 60e-6 if mode is Mode.RATE else 6e-6
    bits = valid << 31 | list(Mode).index(mode) << 27 | (round(value / unit) & 0x3FFFFFF)
    if bits.bit_count() % 2 == 0:
        bits |= 1 << 26
    return bits.to_bytes(4, "big")


class Dsp3000(Device):
    """`rate` tells how it turns, in °/s clockwise, so many seconds after it was switched on."""

    def __init__(
        self,
        rate: Callable[[float], float] = lambda seconds: 0.0,
        format: Format = "text",
        *,
        rate_error: float = 0.02,
        deaf: float = 0.2,
        noise: float = 0.003,
        seed: int = 0,
    ) -> None:
        self.rate = rate
        self.format = format
        self.baud = 38400 if format == "text" else 115200
        self.valid = True
        self._period = (1 + rate_error) / (100 if format == "text" else 1000)
        """Each unit's own: up to 3 % off the nominal one."""
        self._deaf = deaf
        """Share of commands that it misses."""
        self._noise = noise
        """°/s."""
        self._random = random.Random(seed)
        self.power_on()

    def power_on(self) -> None:
        self.mode = Mode.RATE
        self._angle = 0.0
        self._last = 0.0

    @property
    def period(self) -> float | None:
        return self._period

    def received(self, data: bytes) -> list[bytes]:
        if self.format == "words":
            return []  # that variant's connector has no line to hear by
        for command in data.decode("latin-1"):
            if self._random.random() < self._deaf:
                continue
            if command == "Z":
                self._angle = 0.0
            elif command in {mode.value for mode in Mode}:
                self.mode = Mode(command)
        return []

    def measure(self, seconds: float) -> list[bytes]:
        rate = self.rate(seconds) + self._random.gauss(0, self._noise)
        increment = rate * (seconds - self._last)
        self._last = seconds
        self._angle = (self._angle + increment) % 360
        value = {Mode.RATE: rate, Mode.INCREMENTAL: increment, Mode.INTEGRATED: self._angle}[self.mode]
        valid = self.valid and abs(rate) <= FULL_SCALE
        return [text(value, valid) if self.format == "text" else word(value, self.mode, valid)]
