"""Hokuyo's laser scanner URG-04LX. Facts: communication protocol specification for SCIP 2.0, C-42-03320B."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

from tests.emulators.serial_line import Device

FIRST, LAST, FRONT, PER_TURN = 44, 725, 384, 1024
BLOCK = 64
"""Characters of data in a line."""


def checksum(text: str) -> str:
    return chr((sum(text.encode()) & 0x3F) + 0x30)


def encode(number: int, characters: int) -> str:
    """Six bits a character."""
    return "".join(chr((number >> shift & 0x3F) + 0x30) for shift in range(6 * (characters - 1), -1, -6))


def reply(*lines: str) -> bytes:
    """An echo, and lines that get their checksums."""
    echo, *others = lines
    return "".join(f"{line}\n" for line in (echo, *(line + checksum(line) for line in others), "")).encode()


def scan(echo: str, status: str, milliseconds: int, points: list[int], characters: int) -> bytes:
    data = "".join(encode(point, characters) for point in points)
    blocks = [data[at : at + BLOCK] for at in range(0, len(data), BLOCK)]
    return reply(echo, status, encode(milliseconds & 0xFFFFFF, 4), *blocks)


class Urg(Device):
    """`distance` tells how far in mm the nearest thing is at a step, so many seconds after it was switched on."""

    baud = 115200
    jitter = 0.001

    def __init__(
        self,
        distance: Callable[[int, float], int] = lambda step, seconds: 1000 + step,
        *,
        old: bool = False,
        noise: float = 3,
        seed: int = 0,
    ) -> None:
        self.distance = distance
        self._old = old
        """Firmware that speaks SCIP 1.1 until it is told otherwise, each time it is switched on."""
        self._noise = noise
        """mm."""
        self._random = random.Random(seed)
        self.power_on()

    def power_on(self) -> None:
        self._scip2 = not self._old
        self.laser = False
        self._line = ""
        self._seconds = 0.0
        self._stream = ""
        self._left: int | None = None
        self._skipped = 0

    @property
    def period(self) -> float | None:
        return 0.1  # it turns, whether or not it is asked for scans

    def received(self, data: bytes) -> list[bytes]:
        answers = []
        for character in data.decode("latin-1"):
            if character not in "\r\n":
                self._line += character
            elif self._line:
                answers += self._obey(self._line)
                self._line = ""
        return answers

    def measure(self, seconds: float) -> list[bytes]:
        self._seconds = seconds
        if not self._stream:
            return []
        if self._skipped < int(self._stream[12]):
            self._skipped += 1
            return []
        self._skipped = 0
        echo = self._stream
        if self._left is not None:
            self._left -= 1
            echo = f"{echo[:13]}{self._left:02d}{echo[15:]}"
            if not self._left:
                self._stream = ""
        return [self._scan(echo, "99")]

    def _obey(self, command: str) -> list[bytes]:
        if command == "SCIP2.0":
            answer = b"SCIP2.0\n0\n\n" if not self._scip2 else reply(command, "0E")
            self._scip2 = True
            return [answer]
        if not self._scip2:
            return []
        match command[:2]:
            case "QT" | "RS":
                self.laser = False
                self._stream = ""
                return [reply(command, "00")]
            case "BM":
                status = "02" if self.laser else "00"
                self.laser = True
                return [reply(command, status)]
            case "VV":
                return [reply(command, "00", "VEND:Hokuyo Automatic Co., Ltd.;", "PROD:SOKUIKI Sensor URG-04LX;")]
            case "PP":
                facts = ("DMIN:20;", "DMAX:5600;", f"ARES:{PER_TURN};", f"AMIN:{FIRST};", f"AMAX:{LAST};", "SCAN:600;")
                return [reply(command, "00", *facts)]
            case "GD" | "GS":
                return [self._single(command)]
            case "MD" | "MS":
                return [self._begin(command)]
        return [reply(command, "0E")]

    def _wrong(self, command: str) -> str | None:
        """The status that refuses a command's steps."""
        for status, digits in ("01", command[2:6]), ("02", command[6:10]), ("03", command[10:12]):
            if not re.fullmatch("[0-9]+", digits):
                return status
        if int(command[6:10]) > LAST + FIRST - 1:
            return "04"
        return "05" if int(command[6:10]) < int(command[2:6]) else None

    def _single(self, command: str) -> bytes:
        if wrong := self._wrong(command):
            return reply(command, wrong)
        return self._scan(command, "00") if self.laser else reply(command, "10")

    def _begin(self, command: str) -> bytes:
        wrong = self._wrong(command)
        if not wrong and not command[12:13].isdigit():
            wrong = "06"
        if not wrong and not re.fullmatch("[0-9]{2}", command[13:15]):
            wrong = "07"
        if wrong:
            return reply(command, wrong)
        self.laser = True
        self._stream = command
        self._left = int(command[13:15]) or None
        self._skipped = 0
        return reply(command, "00")

    def _scan(self, echo: str, status: str) -> bytes:
        characters = 2 if echo[1] == "S" else 3
        first, last, cluster = int(echo[2:6]), int(echo[6:10]), int(echo[10:12]) or 1
        points = [
            min(self._range(step) for step in range(at, min(at + cluster, last + 1)))
            for at in range(first, last + 1, cluster)
        ]
        points = [min(point, 64**characters - 1) for point in points]
        return scan(echo, status, round(self._seconds * 1000), points, characters)

    def _range(self, step: int) -> int:
        if not FIRST <= step <= LAST:
            return 19  # a step that is not measured
        distance = self.distance(step, self._seconds)
        return distance if distance < 20 else max(20, round(self._random.gauss(distance, self._noise)))
