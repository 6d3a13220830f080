"""PNI's CommBoard with a MicroMag3 magnetometer. Facts: PNI Legacy CommBoard user manual, pages 8 to 22."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import Literal

from flotilla.lab.emulators.serial_line import Device

Field = tuple[float, float, float]

_VALUES = {"uc": "dm", "sn": "mt", "sdo": "tnr", "ec": "ed", "ex": "ed", "ey": "ed", "ez": "ed"}
"""What each setting can be: one letter."""


def checksum(text: bytes) -> int:
    """The exclusive or of all bytes."""
    return reduce(xor, text, 0)


def record(text: str) -> bytes:
    """What the board says, between $ and its checksum."""
    return b"$%s*%02X\r\n" % (text.encode(), checksum(text.encode()))


class MicroMag3(Device):
    """`heading` in degrees and `field` in the board's units, so many seconds after it was switched on."""

    baud = 9600
    jitter = 0.004

    def __init__(
        self,
        heading: Callable[[float], float] = lambda seconds: 194.74,
        field: Callable[[float], Field] = lambda seconds: (-106.0, -403.0, 98.0),
        *,
        sums: Literal["xor", "unknown"] = "xor",
        noise: float = 0.1,
        seed: int = 0,
    ) -> None:
        self.heading = heading
        self.field = field
        self.error = 0
        """The board's error code; 0: none."""
        self.sums = sums
        """Whether its checksums are the documented ones; "unknown": as in the manual's example, where they are not."""
        # Those survive power cuts.
        self.pollfreq = 8
        self.settings = {"uc": "d", "sn": "m", "sdo": "t", "ec": "e", "ex": "e", "ey": "e", "ez": "d"}
        """As the board is shipped: pages 18 to 28."""
        self._noise = noise
        self._random = random.Random(seed)
        self.power_on()

    def power_on(self) -> None:
        self._streaming = False
        self._line = b""
        self._seconds = 0.0

    @property
    def period(self) -> float | None:
        if not self._streaming:
            return None
        return 1 / self.pollfreq if self.pollfreq else 2.0

    def received(self, data: bytes) -> list[bytes]:
        answers = []
        for byte in data:
            if byte not in b"\r\n":
                self._line += bytes([byte])
            elif self._line:
                answers += self._obey(self._line.decode("latin-1"))
                self._line = b""
        return answers

    def measure(self, seconds: float) -> list[bytes]:
        self._seconds = seconds
        return [self._sample()]

    def _obey(self, command: str) -> list[bytes]:
        name, _, value = command.partition("=")
        match name:
            case "go":
                self._streaming = True
                return []
            case "h":
                self._streaming = False
                return [record("h")]
            case "s?":
                return [self._sample()]
            case "sr?":
                return [self._raw()]
            case "pollfreq" if value.isdigit() and int(value) <= 16:
                self.pollfreq = int(value)
                return [record(f"pollfreq={self.pollfreq:02d}")]
            case "pollfreq?":
                return [record(f"pollfreq={self.pollfreq:02d}")]
            case "pollfreq":
                return [record("pollfreq:E040")]
        if name in self.settings:
            if len(value) != 1 or value not in _VALUES[name]:
                return [record(f"{name}:E040")]
            self.settings[name] = value
            return [record(command)]
        return [record(f"{name}:E010")]

    def _sample(self) -> bytes:
        heading = (self.heading(self._seconds) + self._random.gauss(0, self._noise)) % 360
        heading = heading if round(heading, 2) < 360 else 0.0
        if self.settings["sdo"] == "n":
            return record(f"HCHDM,{heading:.2f},M")
        if self.settings["sdo"] == "r":
            return self._raw()
        told = f"{heading:.2f}" if self.settings["uc"] == "d" else f"{int(heading * 6400 / 360)}"
        text = f"C{told}" if self.settings["ec"] == "e" else ""
        text += self._axes(2) + (f":E{self.error:X}" if self.error else "")
        said = record(text)
        return said if self.sums == "xor" else said[:-4] + b"%02X\r\n" % (checksum(text.encode()) ^ 0x75)

    def _raw(self) -> bytes:
        return record(f"raw,{self._axes(0)}")

    def _axes(self, decimals: int) -> str:
        values = zip("XYZ", self._noisy(self.field(self._seconds)), strict=True)
        return "".join(
            f"{axis}{value:.{decimals}f}" for axis, value in values if self.settings[f"e{axis.lower()}"] == "e"
        )

    def _noisy(self, field: Field) -> Field:
        x, y, z = (value + self._random.gauss(0, self._noise) for value in field)
        return x, y, z
