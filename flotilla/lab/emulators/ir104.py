"""The relay board IR-104-PBF: its eight registers, fed by whatever sees a robot's accesses to its I/O ports.

In QEMU an `isa-debugcon` at each of the first three ports hands every byte that is written there to a chardev:

    board = Ir104()
    board.feed(0, first_chardev.recv(4096))
    assert board.relays[2], "relay 3 is off"
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

RELAYS = 20
INPUTS = 20
REGISTERS = 8
PATIENCE_S = 600
"""Limit for what a guest does within one on an idle host."""

_RELAYS_AT = 0
_INPUTS_AT = 4
_NOBODY = 0xFF
"""What an ISA bus reads where no board answers."""


@dataclass(frozen=True)
class Switching:
    """A relay that went on or off."""

    seconds: float
    """Of the board's clock."""
    relay: int
    """From 1, as on the board."""
    on: bool


@dataclass
class Ir104:
    """A board as after power-on: all relays off, no input driven."""

    clock: Callable[[], float] = time.monotonic
    base: int = 0x300
    present: bool = True
    """False: the board is gone from the bus; reads find nobody, writes have no effect."""
    stuck: dict[int, bool] = field(default_factory=dict)
    """Relays, from 1, whose register bit stays so whatever is written."""
    log: list[Switching] = field(default_factory=list)
    after_write: Callable[[int], None] = lambda offset: None
    """Called with the register that was written, from 0."""
    lock: threading.Condition = field(default_factory=threading.Condition)
    """Held during a write."""
    _relays: int = 0
    _driven: int = 0

    @property
    def relays(self) -> tuple[bool, ...]:
        """Whether relay 1, 2, ... 20 is on."""
        return tuple(bool(self._relays >> bit & 1) for bit in range(RELAYS))

    def drive(self, number: int, driven: bool = True) -> None:
        """Put current on an opto input, from 1, or take it off."""
        if not 1 <= number <= INPUTS:
            raise ValueError(f"there is no input {number}")
        bit = 1 << number - 1
        self._driven = self._driven | bit if driven else self._driven & ~bit

    def write(self, port: int, value: int) -> None:
        """A byte that the processor writes to a port."""
        offset = self._offset(port)
        if not self.present or not _RELAYS_AT <= offset < _RELAYS_AT + 3:
            return
        shift = 8 * (offset - _RELAYS_AT)
        with self.lock:
            self._switch(self._relays & ~(0xFF << shift) | (value & 0xFF) << shift)
            self.after_write(offset)
            self.lock.notify_all()

    def wait(self, what: Callable[[], bool], timeout: float) -> bool:
        """Until what writes bring about is so, or for `timeout` seconds; whether it is."""
        with self.lock:
            return self.lock.wait_for(what, timeout)

    def wait_relays(self, *, on: bool, timeout: float = PATIENCE_S) -> bool:
        """Wait until some relay is on, or all are off."""
        return self.wait(lambda: any(self.relays) == on, timeout)

    def read(self, port: int) -> int:
        """The byte that the processor reads at a port."""
        offset = self._offset(port)
        if not self.present:
            return _NOBODY
        if _RELAYS_AT <= offset < _RELAYS_AT + 3:
            return self._relays >> 8 * (offset - _RELAYS_AT) & 0xFF
        if _INPUTS_AT <= offset < _INPUTS_AT + 3:
            return ~self._driven >> 8 * (offset - _INPUTS_AT) & 0xFF  # 0: driven
        return _NOBODY

    def feed(self, offset: int, data: bytes) -> None:
        """Bytes written one after the other to the register at `offset`."""
        for value in data:
            self.write(self.base + offset, value)

    def cut_power(self) -> None:
        """Power fails and comes back."""
        self._switch(0)

    def on_seconds(self, relay: int, until: float) -> float:
        """How long a relay, from 1, was on until then."""
        total, since = 0.0, None
        for switching in self.log:
            if switching.relay != relay or switching.seconds > until:
                continue
            if switching.on:
                since = switching.seconds
            elif since is not None:
                total += switching.seconds - since
                since = None
        return total if since is None else total + until - since

    def _offset(self, port: int) -> int:
        if not self.base <= port < self.base + REGISTERS:
            raise ValueError(f"port 0x{port:x} is not the board's")
        return port - self.base

    def _switch(self, relays: int) -> None:
        relays &= (1 << RELAYS) - 1
        for relay, on in self.stuck.items():
            bit = 1 << relay - 1
            relays = relays | bit if on else relays & ~bit
        now = self.clock()
        for bit in range(RELAYS):
            if (self._relays ^ relays) >> bit & 1:
                self.log.append(Switching(now, bit + 1, bool(relays >> bit & 1)))
        self._relays = relays
