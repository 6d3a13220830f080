"""OceanServer's battery controller. Registers: Smart Battery Data Specification 1.1, section 5.1."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce
from operator import xor

from flotilla.lab.emulators.serial_line import Device

MENU = b"\r\nOceanServer Battery Controller\r\n\r\n  X - hexadecimal output\r\n  any other key - this menu\r\n\r\n"
NO_ESTIMATE = 9999
"""Minutes left where the controller cannot tell."""


def record(name: str, *values: tuple[int, int | str]) -> bytes:
    """A record of numbers and values, those written with as many digits as they come with (text), or two."""
    text = name + "".join(
        f",{number:02X},{value if isinstance(value, str) else f'{value:02X}'}" for number, value in values
    )
    return b"$%s%%%02X\r\n" % (text.encode(), reduce(xor, text.encode(), 0))


@dataclass
class Battery:
    """In SI units."""

    voltage: float = 16.661
    current: float = -0.02
    temperature: float = 296.4
    charge: float = 0.96


@dataclass
class OceanServer(Device):
    batteries: dict[int, Battery] = field(default_factory=lambda: {1: Battery(), 2: Battery()})
    minutes_left: int = NO_ESTIMATE
    charging: int = 0
    external_power: int = 0
    message: str = ""
    """What the controller has to say to people; it may have commas."""
    baud: int = 19200
    jitter: float = 0.05

    def __post_init__(self) -> None:
        self.power_on()

    def power_on(self) -> None:
        self._awake = False
        self._streaming = False

    @property
    def period(self) -> float | None:
        return 1.0 if self._streaming else None

    def received(self, data: bytes) -> list[bytes]:
        answers = []
        for key in data.decode("latin-1"):
            if key in "xX" and self._awake:
                self._streaming = True
            elif key == " " or self._awake:
                if self._streaming:  # the record that is on the wire is finished
                    answers.append(self._records()[-1])
                self._awake = True
                self._streaming = False
                answers.append(MENU)
        return answers

    def measure(self, seconds: float) -> list[bytes]:
        return self._records()

    def _records(self) -> list[bytes]:
        present = sum(1 << (number - 1) for number in self.batteries)
        charge = sum(battery.charge for battery in self.batteries.values()) / max(1, len(self.batteries))
        discharging = present & ~self.charging
        masks = (present, self.charging, discharging, 0, self.external_power, 0, 0)
        records = [
            record(
                "S",
                (1, f"{self.minutes_left:04X}"),
                (2, 0),
                *([(3, self.message)] if self.message else []),
                (4, round(charge * 100)),
            ),
            record("C1", *((number, mask) for number, mask in enumerate(masks, 1))),
        ]
        for number, battery in self.batteries.items():
            records.append(
                record(
                    f"B1{number}",
                    (0x08, f"{round(battery.temperature * 10):04X}"),
                    (0x09, f"{round(battery.voltage * 1000):04X}"),
                    (0x0A, f"{round(battery.current * 1000) & 0xFFFF:04X}"),
                )
            )
            records.append(record(f"B1{number}", (0x0D, f"{round(battery.charge * 100):04X}")))
        return records
