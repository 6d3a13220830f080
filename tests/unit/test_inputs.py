"""Keys and gamepads, by events as they come and a clock that the tests turn."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.station import inputs
from flotilla.station.inputs import BTN_START, BTN_TL, EVENT, Gamepad, Keyboard, Wish

SYN, KEY, ABS = 0, 1, 3


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def keyboard(clock: Clock) -> Keyboard:
    return Keyboard(0, clock)


def test_a_key_counts_while_its_repeats_come(keyboard: Keyboard, clock: Clock) -> None:
    """Pressed at 0, repeated from 0.5 s to 1 s every 33 ms, then released: it moved all the time, and rests
    0.25 s after the last repeat. Seen to fail with 0.4 s for the first, and with 0.7 s for each."""
    keyboard.press("w")
    for index in range(50):
        clock.now_s = index / 100
        assert keyboard.wish() == Wish(ahead=0.5), clock.now_s
    for index in range(16):
        clock.now_s = 0.5 + index / 30
        keyboard.press("w")
        assert keyboard.wish() == Wish(ahead=0.5)
    clock.now_s = 1.24
    assert keyboard.wish() == Wish(ahead=0.5)
    clock.now_s = 1.26
    assert keyboard.wish() == Wish()
    keyboard.press("w")  # a new press, not a repeat
    clock.now_s = 1.9
    assert keyboard.wish() == Wish(ahead=0.5)
    clock.now_s = 1.97
    assert keyboard.wish() == Wish()


@pytest.mark.parametrize("key", [" ", "x", "e", "\x1b", "+", "\x1bOP"])
def test_any_key_that_moves_nothing_stops(keyboard: Keyboard, key: str) -> None:
    keyboard.press("w")
    keyboard.press(key)
    assert keyboard.wish() == Wish()


def test_keys(keyboard: Keyboard) -> None:
    for keys, wish in (
        (("w", "i", "\x1b[A", "\x1bOA"), Wish(0.5)),
        (("a", "j", "\x1b[D", "\x1bOD"), Wish(0, 0.5)),
        (("d", "l", "\x1b[C", "\x1bOC"), Wish(0, -0.5)),
        (("q", "u"), Wish(0.5, 0.25)),
        (("o",), Wish(0.5, -0.25)),
        (("r", "\x1b[5~"), Wish(boom=1)),
        (("f", "\x1b[6~"), Wish(boom=-1)),
    ):
        for key in keys:
            keyboard.press(key)
            assert keyboard.wish() == wish, key
    keyboard.press("wd")
    assert keyboard.wish() == Wish(0, -0.5), "the last one counts"


def test_speed_and_motors(keyboard: Keyboard) -> None:
    keyboard.press("+" * 20 + "w")
    assert keyboard.wish() == Wish(ahead=1)
    keyboard.press("-" * 20 + "w")
    assert keyboard.wish() == Wish(ahead=0.1)
    assert not keyboard.toggled()
    keyboard.press("e")
    assert keyboard.toggled()
    assert not keyboard.toggled()
    keyboard.press("ee")
    assert not keyboard.toggled()


def test_a_terminal_that_is_gone_holds_no_key(clock: Clock) -> None:
    read, write = os.pipe()
    keyboard = Keyboard(read, clock)
    os.write(write, b"w")
    assert keyboard.read()
    assert keyboard.wish() == Wish(ahead=0.5)
    os.close(write)
    assert not keyboard.read()
    assert keyboard.wish() == Wish()
    os.close(read)


class Pad:
    """The other end of a gamepad: a pipe with a name."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self._fd = os.open(path, os.O_RDWR)
        self.pad = Gamepad(path)
        self._open = True

    def send(self, *events: tuple[int, int, int]) -> bool:
        os.write(self._fd, b"".join(EVENT.pack(1, 2, *event) for event in events))
        return self.pad.read()

    def unplug(self) -> bool:
        if self._open:
            os.close(self._fd)
            self._open = False
        return self.pad.read()


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[Pad]:
    pad = Pad(tmp_path / "event7")
    yield pad
    pad.unplug()
    os.close(pad.pad.fd)


AHEAD = (ABS, inputs.ABS_Y, -32768)
HELD, RELEASED = (KEY, BTN_TL, 1), (KEY, BTN_TL, 0)


def test_a_gamepad_moves_nothing_unless_its_button_is_held(pad: Pad) -> None:
    """Seen to fail with a `wish` that knows no button."""
    assert pad.send(AHEAD)
    assert pad.pad.wish() == Wish()
    pad.send(HELD)
    assert pad.pad.wish() == Wish(ahead=1)
    pad.send(RELEASED)
    assert pad.pad.wish() == Wish()


def test_its_sticks(pad: Pad) -> None:
    pad.send(HELD, (ABS, inputs.ABS_X, 32767))
    assert pad.pad.wish() == Wish(turn=-1)
    pad.send((ABS, inputs.ABS_X, 2000), (ABS, inputs.ABS_RX, -32768), (ABS, inputs.ABS_HAT0Y, -1))
    assert pad.pad.wish() == Wish(turn=1, boom=1)
    pad.send((ABS, inputs.ABS_RX, -2000), (ABS, inputs.ABS_HAT0Y, 0), (ABS, 0x28, 9), (KEY, 0x130, 1))
    assert pad.pad.wish() == Wish(), "the dead zone"
    pad.send((KEY, BTN_START, 1), (KEY, BTN_START, 2), (KEY, BTN_START, 0))
    assert pad.pad.toggled()
    assert not pad.pad.toggled()


def test_events_that_come_in_parts(pad: Pad) -> None:
    whole = b"".join(EVENT.pack(1, 2, *event) for event in (HELD, AHEAD))
    for index in range(len(whole)):
        os.write(pad._fd, whole[index : index + 1])
        assert pad.pad.read()
    assert pad.pad.wish() == Wish(ahead=1)
    assert pad.pad.read(), "nothing waits, and it is there"


def test_events_that_the_kernel_lost_may_have_been_the_release(pad: Pad) -> None:
    """SYN_DROPPED. Seen to fail where it is passed over."""
    pad.send(HELD, AHEAD, (SYN, 3, 0))
    assert pad.pad.wish() == Wish()
    pad.send(HELD, AHEAD, (SYN, 0, 0))
    assert pad.pad.wish() == Wish(ahead=1)


def test_an_unplugged_gamepad_holds_no_button(pad: Pad) -> None:
    pad.send(HELD, AHEAD)
    assert not pad.unplug()
    assert pad.pad.wish() == Wish()


def test_a_gamepad_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="event9: No such file or directory; plug the gamepad in"):
        Gamepad(tmp_path / "event9")
    monkeypatch.setattr(inputs, "PADS", tmp_path)
    with pytest.raises(UserError, match="has no gamepad"), inputs.opened(inputs.GAMEPAD):
        pass
    Pad(tmp_path / "usb-maker-event-joystick")
    with inputs.opened(inputs.GAMEPAD) as found:
        assert found.wish() == Wish()
