"""Hokuyo's laser scanner URG-04LX.

Facts: communication protocol specification for SCIP 2.0, C-42-03320B. What that leaves open is as in recordings of
scanners, which come with hokuyo_aist (examples/*.logr), and as urg_library and Player (urg_laser.cc, for SCIP 1.1)
expect it: names and texts of VV, PP and II, their checksums, the answers of the old protocol, those in the time
adjustment mode.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable

from flotilla.lab.emulators.serial_line import Device

FIRST, LAST, FRONT, PER_TURN = 44, 725, 384, 1024
MOTOR_RPM = 600
BLOCK = 64
"""Characters of data in a line."""
BAUDS = (19200, 57600, 115200, 250000, 500000, 750000)
"""Rates of its RS-232 interface. A scanner leaves the works with the first."""

_PARAMETERS = {
    name: characters
    for characters, names in {0: "BM QT RS VV PP II", 1: "TM HS", 2: "CR", 6: "SS", 10: "GD GS", 13: "MD MS"}.items()
    for name in names.split()
}
"""Characters that follow a command's name."""


def checksum(text: str) -> str:
    return chr((sum(text.encode()) & 0x3F) + 0x30)


def encode(number: int, characters: int) -> str:
    """Six bits a character."""
    return "".join(chr((number >> shift & 0x3F) + 0x30) for shift in range(6 * (characters - 1), -1, -6))


def reply(*lines: str) -> bytes:
    """An echo, and lines that get their checksums."""
    echo, *others = lines
    return "".join(f"{line}\n" for line in (echo, *(line + checksum(line) for line in others), "")).encode()


def facts(echo: str, **values: str) -> bytes:
    """What VV, PP and II tell. The semicolon is not in the checksum."""
    lines = (f"{name}:{value}" for name, value in values.items())
    return "\n".join((echo, "00P", *(f"{line};{checksum(line)}" for line in lines), "", "")).encode()


def blocks(points: list[int], characters: int) -> list[str]:
    data = "".join(encode(point, characters) for point in points)
    return [data[at : at + BLOCK] for at in range(0, len(data), BLOCK)]


def scan(echo: str, status: str, milliseconds: int, points: list[int], characters: int) -> bytes:
    return reply(echo, status, encode(milliseconds & 0xFFFFFF, 4), *blocks(points, characters))


class Urg(Device):
    """`distance` tells how far in mm the nearest thing is at a step, so many seconds after it was switched on."""

    jitter = 0.001

    def __init__(
        self,
        distance: Callable[[int, float], int] = lambda step, seconds: 1000 + step,
        *,
        old: bool = False,
        baud: int = BAUDS[0],
        noise: float = 3,
        seed: int = 0,
    ) -> None:
        self.distance = distance
        self.trouble = ""
        """Status, 50 to 97, by which it refuses to measure: the laser, the motor."""
        self._old = old
        """Firmware that speaks SCIP 1.1 until it is told otherwise, each time it is switched on."""
        self._usual_baud = baud
        self._noise = noise
        """mm."""
        self._random = random.Random(seed)
        self.power_on()

    def power_on(self) -> None:
        self._scip2 = not self._old
        self._line = ""
        self._seconds = 0.0
        self._reset()
        self.laser = self._old  # only SCIP 2.0 begins with the laser off

    def _reset(self) -> None:
        """What RS does."""
        self.baud = self._usual_baud
        self.laser = False
        self.adjusting = False
        """The time, by TM0: until TM2 it obeys nothing else."""
        self._slowness = 0
        """Level of the motor's speed: each is 1 % less."""
        self._sensitive = "0"
        self._began = self._seconds
        self._stop()

    def _stop(self) -> None:
        self.stream = ""
        """The command by which it sends scans."""
        self._left: int | None = None
        self._skipped = 0

    @property
    def period(self) -> float | None:
        return 60 / self._rpm  # it turns, whether or not it is asked for scans

    @property
    def _rpm(self) -> int:
        return MOTOR_RPM * (100 - self._slowness) // 100

    @property
    def _milliseconds(self) -> int:
        return round((self._seconds - self._began) * 1000) & 0xFFFFFF

    def received(self, data: bytes) -> list[bytes]:
        answers = []
        for character in data.decode("latin-1"):
            if character not in "\r\n":
                self._line += character
            elif self._line:
                answers.append(self._obey(self._line) if self._scip2 else self._obey_old(self._line))
                self._line = ""
        return answers

    def measure(self, seconds: float) -> list[bytes]:
        self._seconds = seconds
        if not self.stream:
            return []
        if self._skipped < int(self.stream[12]):
            self._skipped += 1
            return []
        self._skipped = 0
        command = self.stream
        echo = command
        if self._left is not None:
            self._left -= 1
            echo = f"{command[:13]}{self._left:02d}{command[15:]}"
        if self.trouble:
            self._stop()
            return [reply(echo, self.trouble)]
        if self._left == 0:
            self._stop()
            self.laser = False
        return [self._scan(echo, "99")]

    def _obey_old(self, command: str) -> bytes:
        """SCIP 1.1: names of one character, a status of one, no checksums, points of two characters."""
        lines: list[str] = []
        status = "0"
        if command == "SCIP2.0":
            self._scip2 = True
            self.laser = False
        elif command == "V":
            lines = [
                "VEND:Hokuyo Automatic Co.,Ltd.", "PROD:SOKUIKI Sensor URG-04LX",
                f"FIRM:3.1.04(02/Aug./2007)(20-5600[mm],240[deg],{FIRST}-{LAST}[step],{MOTOR_RPM}[rpm])",
                "PROT:00003,(SCIP 1.1)", "SERI:H0706400",
            ]  # fmt: skip
        elif command in ("L0", "L1"):
            self.laser = command == "L1"
        elif re.fullmatch(r"S\d{13}", command) and int(command[1:7]) in BAUDS:
            self.baud = int(command[1:7])
        elif re.fullmatch(r"G\d{8}", command) and self.laser and int(command[1:4]) <= int(command[4:7]):
            lines = blocks(self._points(int(command[1:4]), int(command[4:7]), int(command[7:]), 2), 2)
        else:
            status = "E"
        return "".join(f"{line}\n" for line in (command, status, *lines, "")).encode()

    def _obey(self, command: str) -> bytes:
        if wrong := self._malformed(command):
            return reply(command, wrong)
        parameter = command.partition(";")[0][2:]
        match command[:2]:
            case "TM":
                return self._adjust(command, parameter)
            case _ if self.adjusting:
                return reply(command, "0E")
            case "QT":
                self._stop()
                self.laser = False
                return reply(command, "00")
            case "RS":
                self._reset()
                return reply(command, "00")
            case "BM":
                status = "01" if self.trouble else "02" if self.laser else "00"
                self.laser = not self.trouble
                return reply(command, status)
            case "SS":
                return reply(command, self._change_baud(parameter))
            case "CR":
                return reply(command, self._change_speed(parameter))
            case "HS":
                status = "01" if parameter not in ("0", "1") else "02" if parameter == self._sensitive else "00"
                self._sensitive = parameter if status == "00" else self._sensitive
                return reply(command, status)
            case "GD" | "GS":
                return self._single(command)
            case "MD" | "MS":
                return self._begin(command)
        return self._tell(command)

    def _malformed(self, command: str) -> str | None:
        """The status that refuses a command before it is looked at. After a semicolon, anything for the echo."""
        begin, semicolon, text = command.partition(";")
        characters = _PARAMETERS.get(command[:2])
        if characters is None:
            return "0E"
        if len(begin) != 2 + characters:
            return "0C" if len(begin) < 2 + characters else "0D"
        if semicolon and not re.fullmatch(r"[A-Za-z0-9 ._+@]*", text):
            return "0H"
        return "0G" if len(text) > 16 else None

    def _tell(self, command: str) -> bytes:
        match command[:2]:
            case "VV":
                return facts(
                    command, VEND="Hokuyo Automatic Co.,Ltd.", PROD="SOKUIKI Sensor URG-04LX",
                    FIRM="3.1.04(02/Aug./2007)", PROT="SCIP 2.0", SERI="H0706400",
                )  # fmt: skip
            case "PP":
                return facts(
                    command, MODL="URG-04LX(Hokuyo Automatic Co.,Ltd.)", DMIN="20", DMAX="5600", ARES=str(PER_TURN),
                    AMIN=str(FIRST), AMAX=str(LAST), AFRT=str(FRONT), SCAN=str(MOTOR_RPM),
                )  # fmt: skip
        usual = "<-Default setting by user"
        return facts(
            command, MODL="URG-04LX(Hokuyo Automatic Co.,Ltd.)", LASR="ON" if self.laser else "OFF",
            SCSP=f"{self._rpm}[rpm]" if self._slowness else f"Initial({MOTOR_RPM}[rpm]){usual}", MESM="CLASSIC",
            SBPS=f"{self.baud}[bps]{usual if self.baud == self._usual_baud else ''}",
            TIME=f"{self._milliseconds:06X}", STAT=f"Error {self.trouble}" if self.trouble else "Sensor works well.",
        )  # fmt: skip

    def _adjust(self, command: str, code: str) -> bytes:
        if self.stream:
            return reply(command, "10")  # as urg_stamped's simulator has it; the specification says nothing of it
        match code:
            case "0":
                status = "02" if self.adjusting else "00"
                self.adjusting, self.laser = True, False
            case "1" if self.adjusting:
                return reply(command, "00", encode(self._milliseconds, 4))
            case "1":
                status = "04"
            case "2":
                status = "00" if self.adjusting else "03"
                self.adjusting = False
            case _:
                status = "01"
        return reply(command, status)

    def _change_baud(self, digits: str) -> str:
        if not re.fullmatch("[0-9]+", digits):
            return "01"
        if int(digits) not in BAUDS:
            return "04" if int(digits) == 38400 else "02"  # some models have that
        if int(digits) == self.baud:
            return "03"
        self.baud = int(digits)
        return "00"

    def _change_speed(self, digits: str) -> str:
        if not re.fullmatch("[0-9]+", digits):
            return "01"
        level = 0 if digits == "99" else int(digits)
        if level > 10:
            return "02"
        if level == self._slowness:
            return "03"
        self._slowness = level
        return "00"

    def _wrong(self, command: str) -> str | None:
        """The status that refuses a command's steps."""
        for status, digits in ("01", command[2:6]), ("02", command[6:10]), ("03", command[10:12]):
            if not re.fullmatch("[0-9]+", digits):
                return status
        if int(command[6:10]) > LAST + FIRST - 1:
            return "04"
        return "05" if int(command[6:10]) < int(command[2:6]) else None

    def _single(self, command: str) -> bytes:
        if wrong := self._wrong(command) or self.trouble:
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
        self.stream = command
        self._left = int(command[13:15]) or None
        self._skipped = 0
        return reply(command, "00")

    def _scan(self, echo: str, status: str) -> bytes:
        characters = 2 if echo[1] == "S" else 3
        points = self._points(int(echo[2:6]), int(echo[6:10]), int(echo[10:12]), characters)
        return scan(echo, status, self._milliseconds, points, characters)

    def _points(self, first: int, last: int, cluster: int, characters: int) -> list[int]:
        cluster = cluster or 1
        points = []
        for at in range(first, last + 1, cluster):
            ranges = [self._range(step) for step in range(at, min(at + cluster, last + 1))]
            shortest = min((distance for distance in ranges if distance >= 20), default=ranges[0])  # no error code
            points.append(min(shortest, 64**characters - 1))
        return points

    def _range(self, step: int) -> int:
        if not FIRST <= step <= LAST:
            return 19  # a step that is not measured
        distance = self.distance(step, self._seconds)
        return distance if distance < 20 else max(20, round(self._random.gauss(distance, self._noise)))
