"""What a person drives a robot with: keys of a terminal, or a gamepad. Both say what is wished for right now.

A gamepad's events are read here and not by the library evdev, which opens device nodes only: neither a pipe with
recorded events nor a computer without /dev/uinput could try the program. Facts: linux/input.h, input-event-codes.h and
Documentation/input/gamepad.rst of Linux.
"""

from __future__ import annotations

import codecs
import contextlib
import fcntl
import os
import re
import stat
import struct
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from flotilla.common.errors import UserError

KEYBOARD, GAMEPAD = "keyboard", "gamepad"
FIRST_S = 0.7
"""A key counts as held for so long when it is pressed: keyboards repeat it only after 0.25 s to 0.66 s."""
REPEATED_S = 0.25
"""And for so long after each repeat: they come every 30 ms to 100 ms, by ssh unevenly."""
PADS = Path("/dev/input/by-id")


@dataclass(frozen=True)
class Wish:
    """Each from −1 to 1, as parts of what the robot may do at most."""

    ahead: float = 0.0
    turn: float = 0.0
    """Anticlockwise."""
    boom: float = 0.0
    """Out."""


class Input(Protocol):
    """Something to drive with."""

    fd: int
    """Readable when there is something to `read`."""
    help: str

    def read(self) -> bool:
        """Take what has come; False: it is gone."""

    def wish(self) -> Wish: ...

    def toggled(self) -> bool:
        """Whether motors are to be switched, since the last call."""


_KEY = re.compile(r"\x1b(?:\[[0-9;]*[@-~]|O[A-Z])|.", re.DOTALL)
"""One key: what a terminal sends for an arrow or the like (ECMA-48), or a character."""
_HELD = {
    **dict.fromkeys(("w", "i", "\x1b[A", "\x1bOA"), Wish(ahead=1)),
    **dict.fromkeys(("a", "j", "\x1b[D", "\x1bOD"), Wish(turn=1)),
    **dict.fromkeys(("d", "l", "\x1b[C", "\x1bOC"), Wish(turn=-1)),
    **dict.fromkeys(("q", "u"), Wish(ahead=1, turn=0.5)),
    "o": Wish(ahead=1, turn=-0.5),
    **dict.fromkeys(("r", "\x1b[5~"), Wish(boom=1)),
    **dict.fromkeys(("f", "\x1b[6~"), Wish(boom=-1)),
}  # fmt: skip
_FASTER, _SLOWER = ("+", "="), ("-", "_")
_STEP, _SLOWEST = 0.1, 0.1


class Keyboard:
    """Keys of a terminal, which says when one is pressed and repeated, and never when it is released. The last one
    counts: a keyboard repeats only that. `clock` in s."""

    help = "↑/w ahead   ←/a →/d turn   u o curve   r f boom   + - speed   e motors   space stop   Ctrl-C end"

    def __init__(self, fd: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.fd = fd
        self.speed = 0.5
        """Part of the greatest."""
        self._clock = clock
        self._decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
        self._key = ""
        self._until_s = 0.0
        self._toggled = False

    def read(self) -> bool:
        try:
            typed = os.read(self.fd, 1024)
        except OSError:  # nobody is at the other end any more
            typed = b""
        self.press(self._decoder.decode(typed))
        if not typed:
            self._key = ""
        return bool(typed)

    def press(self, typed: str) -> None:
        """Keys as the terminal sends them. Any that moves nothing stops."""
        for key in _KEY.findall(typed):
            now_s = self._clock()
            if key in _HELD:
                repeated = key == self._key and now_s < self._until_s
                self._until_s = now_s + (REPEATED_S if repeated else FIRST_S)
                self._key = key
                continue
            self._key = ""
            if key == "e":
                self._toggled = not self._toggled
            elif key in (*_FASTER, *_SLOWER):
                self.speed = min(max(round(self.speed + (_STEP if key in _FASTER else -_STEP), 1), _SLOWEST), 1.0)

    def wish(self) -> Wish:
        if self._clock() >= self._until_s or not self._key:
            self._key = ""
            return Wish()
        held = _HELD[self._key]
        return Wish(held.ahead * self.speed, held.turn * self.speed, held.boom)

    def toggled(self) -> bool:
        toggled, self._toggled = self._toggled, False
        return toggled


EVENT = struct.Struct("llHHi")
"""struct input_event: seconds, microseconds, type, code, value."""
_SYN, _KEYS, _ABS = 0, 1, 3
_DROPPED = 3
"""Code of a _SYN: the kernel lost events."""
BTN_TL, BTN_START = 0x136, 0x13B
ABS_X, ABS_Y, ABS_RX, ABS_HAT0Y = 0x00, 0x01, 0x03, 0x11
_ABSINFO = struct.Struct("6i")
_EVIOCGABS = 0x80004540 | _ABSINFO.size << 16
_STICK, _HAT = (-32768, 32767), (-1, 1)
_DEAD_ZONE = 0.12
"""Of a stick: its centre is never quite 0."""


class Gamepad:
    """A gamepad, as Linux maps all of them. Nothing moves unless the upper left shoulder button is held, which is its
    dead man's switch. `path`: its node in /dev/input, or a pipe with the same events."""

    help = "hold left shoulder button: left stick up ahead, sticks sideways turn, cross up down boom; start: motors"

    def __init__(self, path: Path) -> None:
        try:
            self.fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise UserError(
                f"{path}: {error.strerror}; plug the gamepad in, and have an administrator put you into the group "
                "`input`; or give INPUT=/dev/input/eventN"
            ) from error
        self.path = path
        self._axes = dict.fromkeys((ABS_X, ABS_Y, ABS_RX, ABS_HAT0Y), 0.0)
        self._ranges = {axis: self._range(axis) for axis in self._axes}
        self._held = self._toggled = False
        self._rest = b""

    def _range(self, axis: int) -> tuple[int, int]:
        if stat.S_ISCHR(os.fstat(self.fd).st_mode):
            with contextlib.suppress(OSError):  # it has no such axis
                answer = fcntl.ioctl(self.fd, _EVIOCGABS + axis, bytes(_ABSINFO.size))
                _, low, high, *_ = _ABSINFO.unpack(answer)
                if low < high:
                    return low, high
        return _HAT if axis == ABS_HAT0Y else _STICK

    def read(self) -> bool:
        try:
            read = os.read(self.fd, 64 * EVENT.size)
        except BlockingIOError:
            return True
        except OSError:  # unplugged
            read = b""
        if not read:
            self._forget()
            return False
        whole = self._rest + read
        end = len(whole) - len(whole) % EVENT.size
        self._rest = whole[end:]
        for _, _, kind, code, value in EVENT.iter_unpack(whole[:end]):
            self._take(kind, code, value)
        return True

    def _take(self, kind: int, code: int, value: int) -> None:
        if (kind, code) == (_SYN, _DROPPED):  # whether the button was released meanwhile is not known
            self._forget()
        elif (kind, code) == (_KEYS, BTN_TL):
            self._held = value != 0
        elif (kind, code, value) == (_KEYS, BTN_START, 1):
            self._toggled = not self._toggled
        elif kind == _ABS and code in self._axes:
            low, high = self._ranges[code]
            self._axes[code] = min(max((2 * value - low - high) / (high - low), -1.0), 1.0)

    def _forget(self) -> None:
        self._held = False
        self._axes = dict.fromkeys(self._axes, 0.0)

    def wish(self) -> Wish:
        if not self._held:
            return Wish()
        axes = {axis: value if abs(value) > _DEAD_ZONE else 0.0 for axis, value in self._axes.items()}
        turn = axes[ABS_X] if abs(axes[ABS_X]) > abs(axes[ABS_RX]) else axes[ABS_RX]
        return Wish(0.0 - axes[ABS_Y], 0.0 - turn, 0.0 - axes[ABS_HAT0Y])

    def toggled(self) -> bool:
        toggled, self._toggled = self._toggled, False
        return toggled


@contextlib.contextmanager
def opened(which: str) -> Iterator[Input]:
    """`keyboard`: of this terminal; `gamepad`: the first one; else the path of one."""
    if which == KEYBOARD:
        with _terminal() as fd:
            yield Keyboard(fd)
        return
    pad = Gamepad(_first_pad() if which == GAMEPAD else Path(which))
    try:
        yield pad
    finally:
        os.close(pad.fd)


def _first_pad() -> Path:
    found = sorted(PADS.glob("*-event-joystick"))
    if not found:
        raise UserError(f"{PADS}: has no gamepad; plug one in, or give its node: INPUT=/dev/input/eventN")
    return found[0]


@contextlib.contextmanager
def _terminal() -> Iterator[int]:
    """Standard input without echo or end of line."""
    if not sys.stdin.isatty():
        raise UserError("keyboard: standard input is no terminal; run it in one, or give INPUT=gamepad")
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)
    try:
        yield fd
    finally:
        with contextlib.suppress(termios.error):
            termios.tcsetattr(fd, termios.TCSADRAIN, before)
