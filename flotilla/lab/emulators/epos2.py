"""A Maxon EPOS2 drive with a motor, on CAN: CiA 301 below, CiA 402 above, as shipped (TPDO2 to 4 disabled).

Facts: Maxon, EPOS2 Firmware Specification, and the drive's EDS; CiA 301 4.2; CiA 402-2. The device is told the time, so
it can run in any: `Epos2.handle` and `Epos2.advance` return the frames it sends, and `Epos2Server` does both on a bus
in real time. It homes by an end stop, by a limit switch
or where it is. On demand it faults, refuses objects, falls silent, loses frames and its power, and talks nonsense.
"""

from __future__ import annotations

import random
import selectors
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum

from flotilla.lab.emulators.can_bus import EXTENDED, REMOTE, Bus, Frame


class Nmt(Enum):
    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class Axis(Enum):
    """States of CiA 402 with the status word by which an EPOS2 tells them."""

    SWITCH_ON_DISABLED = 0x0140
    READY_TO_SWITCH_ON = 0x0121
    SWITCHED_ON = 0x0123
    OPERATION_ENABLED = 0x0137
    QUICK_STOP_ACTIVE = 0x0117
    FAULT_REACTION_ACTIVE = 0x011F
    FAULT = 0x0108


POWERED = {Axis.OPERATION_ENABLED, Axis.QUICK_STOP_ACTIVE, Axis.FAULT_REACTION_ACTIVE}

REMOTE_BIT = 0x0200
TARGET_REACHED = 0x0400
SETPOINT_ACKNOWLEDGED = HOMING_ATTAINED = 0x1000
HOMING_ERROR = 0x2000
REFERENCED = 0x8000


class Abort(Exception):
    """An SDO transfer that is refused, by its abort code (CiA 301, 7.2.4.3.17)."""

    BAD_COMMAND = 0x05040001
    READ_ONLY = 0x06010002
    WRITE_ONLY = 0x06010001
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_TOO_LONG = 0x06040042
    WRONG_LENGTH = 0x06070010
    NO_SUB_INDEX = 0x06090011
    OUT_OF_RANGE = 0x06090030
    NOT_STORED = 0x08000020
    WRONG_STATE = 0x08000022

    def __init__(self, code: int) -> None:
        super().__init__(f"0x{code:08X}")
        self.code = code


@dataclass
class Entry:
    size: int
    value: int = 0
    signed: bool = False
    access: str = "rw"
    mapped: str = ""  # "r": into RPDOs, "t": into TPDOs
    low: int | None = None
    high: int | None = None


Name = tuple[int, int]
COMMUNICATION = range(0x1000, 0x2000)
PDO_OFF = 1 << 31
HISTORY = 5
"""Entries of object 1003."""
SAVE = int.from_bytes(b"save", "little")
"""What is written to 1010:1 to store all."""

MODE_POSITION, MODE_VELOCITY, MODE_CURRENT = -1, -2, -3
MODE_PROFILE_POSITION, MODE_PROFILE_VELOCITY, MODE_HOMING = 1, 3, 6
END_STOP = {-3: 1, -4: -1}
"""Direction in which a method of object 6098 searches an end stop, which the drive feels by its current."""
SWITCH = {17: -1, 18: 1}
"""Likewise of a limit switch."""
HERE = 35
"""The method that takes the actual position for the home."""
MODES = {MODE_POSITION, MODE_VELOCITY, MODE_CURRENT, MODE_PROFILE_POSITION, MODE_PROFILE_VELOCITY, 6, 7, -5, -6}


def _signed(size: int, access: str = "rw", mapped: str = "", value: int = 0) -> Entry:
    return Entry(size, value, signed=True, access=access, mapped=mapped)


def shipped(node: int) -> dict[Name, Entry]:
    """The object dictionary as it leaves the factory, as far as a driver touches it."""
    objects: dict[Name, Entry] = {
        (0x1000, 0): Entry(4, 0x00020192, access="ro"),
        (0x1001, 0): Entry(1, access="ro"),
        (0x1003, 0): Entry(1, high=0),
        **{(0x1003, sub): Entry(4, access="ro") for sub in range(1, HISTORY + 1)},
        (0x1005, 0): Entry(4, 0x80),
        (0x1008, 0): Entry(4, int.from_bytes(b"EPOS", "little"), access="ro"),
        (0x100C, 0): Entry(2),
        (0x100D, 0): Entry(1),
        (0x1010, 0): Entry(1, 1, access="ro"),
        (0x1010, 1): Entry(4, 1),
        (0x1014, 0): Entry(4, 0x80 + node),
        (0x1016, 0): Entry(1, 2, access="ro"),
        (0x1016, 1): Entry(4),
        (0x1016, 2): Entry(4),
        (0x1017, 0): Entry(2),
        (0x1018, 0): Entry(1, 4, access="ro"),
        (0x1018, 1): Entry(4, 0x000000FB, access="ro"),
        (0x1018, 2): Entry(4, access="ro"),
        (0x1018, 3): Entry(4, access="ro"),
        (0x1018, 4): Entry(4, access="ro"),
        (0x1200, 0): Entry(1, 2, access="ro"),
        (0x1200, 1): Entry(4, 0x600 + node, access="ro"),
        (0x1200, 2): Entry(4, 0x580 + node, access="ro"),
        (0x6007, 0): _signed(2, value=1),
        (0x6040, 0): Entry(2, mapped="r"),
        (0x6041, 0): Entry(2, access="ro", mapped="t"),
        (0x6060, 0): _signed(1, mapped="r", value=MODE_PROFILE_POSITION),
        (0x6061, 0): _signed(1, access="ro", mapped="t", value=MODE_PROFILE_POSITION),
        (0x6064, 0): _signed(4, access="ro", mapped="t"),
        (0x606C, 0): _signed(4, access="ro", mapped="t"),
        (0x6078, 0): _signed(2, access="ro", mapped="t"),
        (0x607A, 0): _signed(4, mapped="rt"),
        (0x607F, 0): Entry(4, 25000, low=0, high=25000),
        (0x6081, 0): Entry(4, 1000, mapped="r"),
        (0x6083, 0): Entry(4, 10000, mapped="r"),
        (0x6084, 0): Entry(4, 10000, mapped="r"),
        (0x6085, 0): Entry(4, 10000, mapped="r"),
        (0x6098, 0): _signed(1, value=7),
        (0x6099, 0): Entry(1, 2, access="ro"),
        (0x6099, 1): Entry(4, 100),
        (0x6099, 2): Entry(4, 10),
        (0x609A, 0): Entry(4, 1000),
        (0x607C, 0): _signed(4),
        (0x2080, 0): Entry(2, 500),
        (0x2081, 0): _signed(4),
        (0x60FF, 0): _signed(4, mapped="rt"),
        (0x6502, 0): Entry(4, 0x65, access="ro"),  # profile position and velocity, homing, interpolated position
        (0x6410, 0): Entry(1, 5, access="ro"),
        (0x6410, 1): Entry(2, 2000),
        (0x6410, 2): Entry(2, 4000),
        (0x6410, 3): Entry(1, 1),
        (0x6410, 4): Entry(4, 25000),
        (0x6410, 5): Entry(2, 40),
        (0x2030, 0): _signed(2, mapped="rt"),
        (0x2062, 0): _signed(4, mapped="rt"),
        (0x206B, 0): _signed(4, mapped="rt"),
    }
    second = [None, 0x60600008, 0x607A0020, 0x60FF0020], [None, 0x60610008, 0x60640020, 0x606C0020]
    for number in range(4):
        enabled = number == 0
        objects[0x1400 + number, 0] = Entry(1, 2, access="ro")
        objects[0x1800 + number, 0] = Entry(1, 3, access="ro")
        objects[0x1400 + number, 1] = Entry(4, 0x200 + 0x100 * number + node)
        objects[0x1400 + number, 2] = Entry(1, 255)
        objects[0x1800 + number, 1] = Entry(4, (0x40000180 if enabled else 0xC0000180) + 0x100 * number + node)
        objects[0x1800 + number, 2] = Entry(1, 255)
        objects[0x1800 + number, 3] = Entry(2, 10)
        for mapping, first, more in ((0x1600, 0x60400010, second[0]), (0x1A00, 0x60410010, second[1])):
            extra = more[number]
            objects[mapping + number, 0] = Entry(1, 1 if extra is None else 2, high=8)
            for sub in range(1, 9):
                objects[mapping + number, sub] = Entry(4)
            objects[mapping + number, 1].value = first
            objects[mapping + number, 2].value = extra or 0
    return objects


@dataclass
class Motor:
    """A motor with its load, and the drive's inner loops reduced to a lag: enough for a controller around it."""

    counts_per_turn: int = 2000
    torque_constant: float = 0.025  # N·m/A
    inertia: float = 1e-5  # kg·m²
    friction: float = 2e-6  # N·m·s
    lag: float = 0.005  # s, of the velocity loop
    position_gain: float = 30  # 1/s
    turns: float = 0
    rpm: float = 0
    current: float = 0  # A
    load: float = 0  # N·m, against the motion's positive direction
    stops: tuple[float, float] | None = None  # turns between which the load can move
    switches: tuple[float, float] | None = None  # turns below and above which a limit switch is closed

    def drive_current(self, amperes: float, seconds: float) -> None:
        radians = self.rpm * 0.10471975511965977
        torque = self.torque_constant * amperes - self.friction * radians - self.load
        self._move(radians + torque / self.inertia * seconds, seconds)
        self.current = amperes

    def drive_rpm(self, target: float, limit_amperes: float, seconds: float) -> None:
        wanted = (target - self.rpm) * 0.10471975511965977 / self.lag
        held = self.inertia * wanted + self.friction * self.rpm * 0.10471975511965977 + self.load
        amperes = held / self.torque_constant
        self.drive_current(max(-limit_amperes, min(limit_amperes, amperes)), seconds)

    def _move(self, radians_per_s: float, seconds: float) -> None:
        rpm = radians_per_s / 0.10471975511965977
        self.turns += (self.rpm + rpm) / 2 / 60 * seconds
        self.rpm = rpm
        if self.stops and not self.stops[0] <= self.turns <= self.stops[1]:
            self.turns, self.rpm = max(self.stops[0], min(self.stops[1], self.turns)), 0

    def on_switch(self, direction: int) -> bool:
        """The limit switch in a direction, 1 or -1, is closed."""
        if self.switches is None:
            return False
        return self.turns <= self.switches[0] if direction < 0 else self.turns >= self.switches[1]

    @property
    def counts(self) -> int:
        return round(self.turns * self.counts_per_turn)


@dataclass
class Misbehaviour:
    """What the drive does wrong, changed while it runs."""

    silent: bool = False  # it hears, moves, and says nothing
    refuse: dict[Name, int] = field(default_factory=dict)  # abort codes by object
    loss: float = 0  # share of its frames that never arrive
    nonsense: float = 0  # frames of random content for each of its own
    stuck_axis: bool = False  # the axis ignores the control word
    nmt_keeps_axis: bool = False  # the axis goes on whatever NMT commands
    homing_error: bool = False  # each search for the home fails


class Epos2:
    CYCLE = 0.001  # s, of its control loops

    def __init__(self, node: int = 1, motor: Motor | None = None, seed: int = 1) -> None:
        self.node = node
        self.motor = motor or Motor()
        self.wrong = Misbehaviour()
        self._random = random.Random(seed)
        self._now = 0.0
        self._heard: float | None = None  # the master's last heartbeat
        self._out: list[Frame] = []
        self.stored: dict[Name, int] = {}
        self.on = False
        self.power_on()

    # --- what a test does to it ---

    def power_on(self) -> None:
        self.on = True
        self._reset_node()

    def store(self, **values: int) -> None:
        """Write objects and store all, as a tool does: `store(x1400_1=0x201)`."""
        for name, value in values.items():
            index, sub = name.removeprefix("x").split("_")
            self.objects[int(index, 16), int(sub)].value = value
        self._store()

    def _reset_node(self) -> None:
        self.axis = Axis.SWITCH_ON_DISABLED
        self.objects = self._restored()
        self._zero = self.motor.counts  # the encoder counts from 0
        self.referenced = self.homing_error = False
        self._homing: Iterator[None] | None = None
        self._control = 0
        self._demand_rpm = 0.0
        self._demand_turns: float | None = None
        self._acknowledged = False
        self.errors: list[int] = []
        self._reset_communication()

    def power_off(self) -> None:
        self.on = False
        self.motor.current = 0

    def fault(self, code: int, register: int = 0x01) -> None:
        """The drive finds an error: it tells, stops the motor and stays in Fault."""
        self.errors.append(code)
        for sub, error in enumerate(self.errors[: -HISTORY - 1 : -1], 1):  # the newest first
            self.objects[0x1003, sub].value = error
        self.objects[0x1003, 0].value = min(len(self.errors), HISTORY)
        self.objects[0x1001, 0].value |= register
        self._emit(
            Frame(0x80 + self.node, code.to_bytes(2, "little") + bytes([self.objects[0x1001, 0].value, 0, 0, 0, 0, 0]))
        )
        self.axis = Axis.FAULT_REACTION_ACTIVE if self.axis in POWERED else Axis.FAULT

    # --- frames ---

    def handle(self, frame: Frame) -> list[Frame]:
        """Take a frame from the bus; what the drive sends at once."""
        if self.on and not frame.id & EXTENDED:
            self._take(frame)
        return self._flush()

    def advance(self, now: float) -> list[Frame]:
        """Let time pass until `now` (s, of any origin); what the drive sends meanwhile."""
        if now - self._now > 1:  # the first call, or a pause of the test's
            self._now = now
            self._heard = now
        while self._now + self.CYCLE <= now:
            self._now += self.CYCLE
            if self.on:
                self._cycle()
        return self._flush()

    def _emit(self, frame: Frame) -> None:
        self._out.append(frame)

    def _flush(self) -> list[Frame]:
        out, self._out = self._out, []
        if not self.on or self.wrong.silent:
            return []
        sent: list[Frame] = []
        for frame in out:
            if self._random.random() >= self.wrong.loss:
                sent.append(frame)
            if self._random.random() < self.wrong.nonsense:
                base = self._random.choice([0x80, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700])
                sent.append(Frame(base + self.node, self._random.randbytes(self._random.randrange(9))))
        return sent

    def _take(self, frame: Frame) -> None:
        identifier = frame.id & 0x7FF
        if frame.id & REMOTE:
            self._answer_request(identifier)
        elif identifier == 0 and len(frame.data) == 2 and frame.data[1] in (0, self.node):
            self._command_nmt(frame.data[0])
        elif identifier == self.objects[0x1005, 0].value & 0x7FF:
            self._synchronise()
        elif identifier == 0x600 + self.node and len(frame.data) == 8 and self.nmt is not Nmt.STOPPED:
            if frame.data[0] == 0x80:
                return  # the client gives up
            self._emit(Frame(0x580 + self.node, self._serve(frame.data)))
        elif identifier & 0x780 == 0x700:
            self._hear_heartbeat(identifier & 0x7F)
        elif self.nmt is Nmt.OPERATIONAL:
            self._take_pdo(identifier, frame.data)

    # --- CiA 301: NMT, heartbeat ---

    def _reset_communication(self) -> None:
        fresh = self._restored()
        for name in fresh:
            if name[0] in COMMUNICATION:
                self.objects[name] = fresh[name]
        self.nmt = Nmt.PRE_OPERATIONAL
        self._heard = None
        self._beat = self._now
        self._sent: dict[int, tuple[bytes, float]] = {}
        self._emit(Frame(0x700 + self.node, bytes([Nmt.INITIALISING.value])))

    def _restored(self) -> dict[Name, Entry]:
        objects = shipped(self.node)
        for name, value in self.stored.items():
            objects[name].value = value
        return objects

    def _store(self) -> None:
        self.stored = {name: entry.value for name, entry in self.objects.items() if entry.access == "rw"}

    def _command_nmt(self, command: int) -> None:
        if command == 0x01:
            self.nmt = Nmt.OPERATIONAL
        elif command in (0x02, 0x80, 0x81, 0x82):
            if self.nmt is Nmt.OPERATIONAL:
                self._lose_connection()
            self.nmt = Nmt.STOPPED if command == 0x02 else Nmt.PRE_OPERATIONAL
            if command == 0x81:
                self._reset_node()
            elif command == 0x82:
                self._reset_communication()

    def _lose_connection(self) -> None:
        """Abort connection option code 6007: what the axis does when nobody leads it any more."""
        if self.axis in POWERED and not self.wrong.nmt_keeps_axis:
            self.axis = Axis.SWITCH_ON_DISABLED

    def _hear_heartbeat(self, node: int) -> None:
        if self.objects[0x1016, 1].value >> 16 & 0x7F == node:
            self._heard = self._now

    def _watch_heartbeat(self) -> None:
        allowed = (self.objects[0x1016, 1].value & 0xFFFF) / 1000
        if not allowed or self._heard is None or self._now - self._heard <= allowed:
            return
        self._heard = None  # watched again from its next heartbeat on
        if self.objects[0x6007, 0].value == 1:
            self.fault(0x8130, 0x11)
        elif self.objects[0x6007, 0].value in (2, 3):
            self._lose_connection()

    # --- CiA 301: SDO server, expedited ---

    def _serve(self, request: bytes) -> bytes:
        index, sub = int.from_bytes(request[1:3], "little"), request[3]
        try:
            if (index, sub) in self.wrong.refuse:
                raise Abort(self.wrong.refuse[index, sub])
            if request[0] >> 5 == 1:
                if request[0] & 0x02 == 0:
                    raise Abort(Abort.BAD_COMMAND)  # segmented: no object here is longer than four bytes
                # Without a size in the request, the object's own.
                size = 4 - (request[0] >> 2 & 3) if request[0] & 1 else self._entry(index, sub).size
                self._write(index, sub, request[4 : 4 + size])
                return bytes([0x60]) + request[1:4] + bytes(4)
            if request[0] >> 5 == 2:
                value = self._read(index, sub)
                return bytes([0x43 | (4 - len(value)) << 2]) + request[1:4] + value.ljust(4, b"\0")
            raise Abort(Abort.BAD_COMMAND)
        except Abort as abort:
            return bytes([0x80]) + request[1:4] + abort.code.to_bytes(4, "little")

    def _entry(self, index: int, sub: int) -> Entry:
        if (index, sub) in self.objects:
            return self.objects[index, sub]
        raise Abort(Abort.NO_SUB_INDEX if any(name[0] == index for name in self.objects) else Abort.NO_OBJECT)

    def _read(self, index: int, sub: int) -> bytes:
        self._show()
        entry = self._entry(index, sub)
        return (entry.value % (1 << 8 * entry.size)).to_bytes(entry.size, "little")

    def _write(self, index: int, sub: int, raw: bytes) -> None:
        entry = self._entry(index, sub)
        value = int.from_bytes(raw, "little", signed=entry.signed)
        if entry.access == "ro":
            raise Abort(Abort.READ_ONLY)
        if len(raw) != entry.size:
            raise Abort(Abort.WRONG_LENGTH)
        if (entry.low is not None and value < entry.low) or (entry.high is not None and value > entry.high):
            raise Abort(Abort.OUT_OF_RANGE)
        if index & 0xFFFC in (0x1600, 0x1A00):
            self._check_mapping(index, sub, value)
        if (index, sub) == (0x6060, 0) and value not in MODES:
            raise Abort(Abort.OUT_OF_RANGE)
        if (index, sub) == (0x6098, 0) and value not in {*END_STOP, *SWITCH, HERE, 7}:
            raise Abort(Abort.OUT_OF_RANGE)
        if (index, sub) == (0x1010, 1):
            if value != SAVE:
                raise Abort(Abort.NOT_STORED)
            self._store()
            return
        if (index, sub) == (0x1003, 0):
            self.errors.clear()
        entry.value = value
        self._written(index)

    def _check_mapping(self, index: int, sub: int, value: int) -> None:
        if not self.objects[index - 0x200, 1].value & PDO_OFF:
            raise Abort(Abort.WRONG_STATE)
        if sub == 0:
            if sum(self.objects[index, i].value & 0xFF for i in range(1, value + 1)) > 64:
                raise Abort(Abort.PDO_TOO_LONG)
            return
        if self.objects[index, 0].value:
            raise Abort(Abort.WRONG_STATE)
        if value:
            entry = self.objects.get((value >> 16, value >> 8 & 0xFF))
            direction = "r" if index < 0x1A00 else "t"
            if entry is None or direction not in entry.mapped or value & 0xFF != 8 * entry.size:
                raise Abort(Abort.NOT_MAPPABLE)

    def _written(self, index: int) -> None:
        if index == 0x6040:
            self._obey(self.objects[0x6040, 0].value)
        elif index == 0x6060 and self.objects[0x6061, 0].value != self.objects[0x6060, 0].value:
            self.objects[0x6061, 0].value = self.objects[0x6060, 0].value
            self._demand_rpm, self._demand_turns = self.motor.rpm, None

    # --- CiA 301: PDOs ---

    def _mapping(self, index: int) -> list[Entry]:
        mapped = (self.objects[index, sub].value for sub in range(1, self.objects[index, 0].value + 1))
        return [self.objects[name >> 16, name >> 8 & 0xFF] for name in mapped]

    def _take_pdo(self, identifier: int, data: bytes) -> None:
        for number in range(4):
            cob = self.objects[0x1400 + number, 1].value
            if cob & PDO_OFF or cob & 0x7FF != identifier:
                continue
            names = [
                self.objects[0x1600 + number, sub].value for sub in range(1, self.objects[0x1600 + number, 0].value + 1)
            ]
            if len(data) < sum(name & 0xFF for name in names) // 8:
                self.fault(0x8210, 0x10)
                return
            at, written = 0, []
            for name in names:
                entry = self.objects[name >> 16, name >> 8 & 0xFF]
                entry.value = int.from_bytes(data[at : at + entry.size], "little", signed=entry.signed)
                at += entry.size
                written.append(name >> 16)
            for index in sorted(written, reverse=True):  # the set points first, then the word that starts them
                self._written(index)

    def _tpdo(self, number: int) -> bytes:
        entries = self._mapping(0x1A00 + number)
        return b"".join((e.value % (1 << 8 * e.size)).to_bytes(e.size, "little") for e in entries)

    def _send_tpdo(self, number: int) -> None:
        data = self._tpdo(number)
        self._sent[number] = (data, self._now)
        self._emit(Frame(self.objects[0x1800 + number, 1].value & 0x7FF, data))

    def _enabled_tpdos(self) -> Iterator[tuple[int, int]]:
        if self.nmt is Nmt.OPERATIONAL:
            for number in range(4):
                if not self.objects[0x1800 + number, 1].value & PDO_OFF:
                    yield number, self.objects[0x1800 + number, 2].value

    def _synchronise(self) -> None:
        self._show()
        for number, transmission in self._enabled_tpdos():
            if transmission == 1:
                self._send_tpdo(number)

    def _answer_request(self, identifier: int) -> None:
        for number, _ in self._enabled_tpdos():
            if self.objects[0x1800 + number, 1].value & 0x7FF == identifier:
                self._send_tpdo(number)

    def _send_changes(self) -> None:
        for number, transmission in self._enabled_tpdos():
            data, at = self._sent.get(number, (None, -1.0))
            inhibit = self.objects[0x1800 + number, 3].value * 1e-4
            if transmission == 255 and data != self._tpdo(number) and self._now - at >= inhibit:
                self._send_tpdo(number)

    # --- CiA 402 ---

    def _obey(self, word: int) -> None:
        rising = word & ~self._control
        self._control = word
        if self.wrong.stuck_axis:
            return
        if self.axis is Axis.FAULT:
            if rising & 0x80:
                self.axis = Axis.SWITCH_ON_DISABLED
                self.objects[0x1001, 0].value = 0
                self._emit(Frame(0x80 + self.node, bytes(8)))
        elif self.axis is not Axis.FAULT_REACTION_ACTIVE:
            self._transit(word)
        if not word & 0x10:
            self._homing = None
        if rising & 0x10 and self.axis is Axis.OPERATION_ENABLED and self.objects[0x6061, 0].value == MODE_HOMING:
            self.referenced, self.homing_error = False, self.wrong.homing_error
            self._homing = None if self.homing_error else self._search()
        elif rising & 0x10 and self.axis is Axis.OPERATION_ENABLED:
            self._demand_turns = self._turns(self.objects[0x607A, 0].value)
            if word & 0x40:
                self._demand_turns += self.motor.turns
            self._acknowledged = True
        if not word & 0x10:
            self._acknowledged = False

    def _transit(self, word: int) -> None:
        was = self.axis
        if not word & 0x02:  # disable voltage
            self.axis = Axis.SWITCH_ON_DISABLED
        elif not word & 0x04:  # quick stop
            powered = was in (Axis.OPERATION_ENABLED, Axis.QUICK_STOP_ACTIVE)
            self.axis = Axis.QUICK_STOP_ACTIVE if powered else Axis.SWITCH_ON_DISABLED
        elif was is Axis.QUICK_STOP_ACTIVE:
            pass  # left by disable voltage only
        elif not word & 0x01:  # shutdown
            self.axis = Axis.READY_TO_SWITCH_ON
        elif was in (Axis.READY_TO_SWITCH_ON, Axis.OPERATION_ENABLED) and not word & 0x08:
            self.axis = Axis.SWITCHED_ON
        elif was in (Axis.READY_TO_SWITCH_ON, Axis.SWITCHED_ON) and word & 0x08:  # from the former by both transitions
            self.axis = Axis.OPERATION_ENABLED
            self._demand_rpm, self._demand_turns = 0.0, None

    def _status(self) -> int:
        word = self.axis.value
        if self.nmt is Nmt.OPERATIONAL:
            word |= REMOTE_BIT
        if self._acknowledged and self.objects[0x6061, 0].value == MODE_PROFILE_POSITION:
            word |= SETPOINT_ACKNOWLEDGED
        if self.referenced:
            word |= REFERENCED
        if self.objects[0x6061, 0].value == MODE_HOMING:
            word |= HOMING_ATTAINED | TARGET_REACHED if self.referenced else 0
            word |= HOMING_ERROR if self.homing_error else 0
        elif self.axis is Axis.OPERATION_ENABLED and self._demand_turns is not None:
            word |= TARGET_REACHED if abs(self._demand_turns - self.motor.turns) < 0.002 else 0
        return word

    def _show(self) -> None:
        for index, value in (
            (0x6041, self._status()),
            (0x6064, self.motor.counts - self._zero),
            (0x606C, round(self.motor.rpm)),
            (0x6078, round(self.motor.current * 1000)),
        ):
            self.objects[index, 0].value = value

    def _cycle(self) -> None:
        self._watch_heartbeat()
        beat = self.objects[0x1017, 0].value / 1000
        if beat and self._now - self._beat >= beat:
            self._beat = self._now
            self._emit(Frame(0x700 + self.node, bytes([self.nmt.value])))
        self._move()
        self._show()
        self._send_changes()

    def _move(self) -> None:
        limit = self.objects[0x6410, 2].value / 1000
        if self.axis not in POWERED:
            self.motor.drive_current(0, self.CYCLE)
        elif self.axis is not Axis.OPERATION_ENABLED:
            self._ramp(0, self.objects[0x6085, 0].value)
            self.motor.drive_rpm(self._demand_rpm, limit, self.CYCLE)
            if self.axis is Axis.FAULT_REACTION_ACTIVE and abs(self.motor.rpm) < 1:
                self.axis = Axis.FAULT
        elif self.objects[0x6061, 0].value == MODE_CURRENT:
            amperes = self.objects[0x2030, 0].value / 1000
            self.motor.drive_current(max(-limit, min(limit, amperes)), self.CYCLE)
        else:
            self._demand()
            self.motor.drive_rpm(self._demand_rpm, limit, self.CYCLE)

    def _demand(self) -> None:
        mode = self.objects[0x6061, 0].value
        fastest = self.objects[0x607F, 0].value
        if mode == MODE_VELOCITY:
            self._demand_rpm = max(-fastest, min(fastest, self.objects[0x206B, 0].value))
        elif mode == MODE_PROFILE_VELOCITY:
            halted = self._control & 0x100
            target = 0 if halted else max(-fastest, min(fastest, self.objects[0x60FF, 0].value))
            self._ramp(target, self.objects[0x6083, 0].value)
        elif mode == MODE_POSITION:
            self._approach(self._turns(self.objects[0x2062, 0].value), fastest)
        elif mode == MODE_HOMING:
            if self._homing is None:
                self._ramp(0, self.objects[0x609A, 0].value)
            elif next(self._homing, self) is self:
                self._homing = None
        elif mode == MODE_PROFILE_POSITION and self._demand_turns is not None:
            self._approach(self._demand_turns, min(fastest, self.objects[0x6081, 0].value))

    def _turns(self, position: int) -> float:
        """Of the motor, at a position as objects have it."""
        return (position + self._zero) / self.motor.counts_per_turn

    def _search(self) -> Iterator[None]:
        """Homing, by the method of object 6098, a cycle at a time."""
        method, speed = self.objects[0x6098, 0].value, self.objects[0x6099, 1].value
        offset = self.objects[0x607C, 0].value
        direction = END_STOP.get(method) or SWITCH.get(method, 0)
        self._demand_rpm = self.motor.rpm
        while direction and not self._found(method, direction):
            self._ramp(direction * speed, self.objects[0x609A, 0].value)
            yield
        home = self.motor.counts + offset
        while abs(self.motor.counts - home) > 2:
            self._approach(home / self.motor.counts_per_turn, speed)
            yield
        self._demand_rpm = 0
        self._zero = home - self.objects[0x2081, 0].value
        self.referenced = True

    def _found(self, method: int, direction: int) -> bool:
        if method in SWITCH:
            return self.motor.on_switch(direction)
        return abs(self.motor.current) * 1000 >= self.objects[0x2080, 0].value

    def _approach(self, turns: float, fastest: float) -> None:
        rpm = (turns - self.motor.turns) * self.motor.position_gain * 60
        self._demand_rpm = max(-fastest, min(fastest, rpm))

    def _ramp(self, target: float, rpm_per_s: float) -> None:
        step = rpm_per_s * self.CYCLE
        self._demand_rpm += max(-step, min(step, target - self._demand_rpm))


class Epos2Server:
    """Drives on a bus, in real time, in a thread of their own."""

    def __init__(self, bus: Bus, *drives: Epos2) -> None:
        self._bus = bus
        self._drives = drives
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @contextmanager
    def running(self) -> Iterator[None]:
        self._thread.start()
        try:
            yield
        finally:
            self._stop.set()
            self._thread.join()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Change or read the drives while no frame is being handled."""
        with self._lock:
            yield

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._bus.fileno(), selectors.EVENT_READ)
            while not self._stop.is_set():
                selector.select(timeout=Epos2.CYCLE)
                with self._lock:
                    self._turn()

    def _turn(self) -> None:
        now = time.monotonic()
        for drive in self._drives:
            self._send(drive.advance(now))
        while (frame := self._bus.receive()) is not None:
            for drive in self._drives:
                self._send(drive.handle(frame))

    def _send(self, frames: list[Frame]) -> None:
        for frame in frames:
            self._bus.send(frame)
