"""What keys do on the screen of `make top`: typed at a pseudo terminal, acted upon by an `ssh` that runs it here."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import sys
import termios
import time
from collections.abc import Callable, Iterator
from ipaddress import IPv4Address
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet.model import Robot
from flotilla.robot import ssh
from flotilla.station.dialog import HELP, Dialog, keyboard
from flotilla.station.receiver import Receiver
from flotilla.station.services import State
from flotilla.station.top import Top

SECONDS = 30
"""For what takes none: the machine may be busy."""
NAMES = ("robot1", "robot2")
ROBOTS = {
    name: Robot(name=name, number=number, board="smartcoret3", address=IPv4Address(f"10.0.0.{number}"))
    for number, name in enumerate(NAMES, 1)
}
STATES = {(name, task): State("running 5 s", True) for name in NAMES for task in ("heading", "valves")}
SAYS = """#!/bin/sh
echo "$0 $*" | sed "s|.*/||" >>{directory}/done
case "$*" in
*" a.b"*x*) echo "flotilla-param: task heading: block a: x is not a number" >&2; exit 1;;
*valves*) seq 100;;
*) echo "a.b: 1 [s] → 2 from step 5 on";;
esac
"""
DOWN, UP = "\x1b[B", "\x1b[A"


class Screen:
    """A terminal with the dialog."""

    def __init__(self, directory: Path, top: Top, dialog: Dialog, terminal: int, read: Callable[[], bool]) -> None:
        self.top, self.dialog, self.terminal, self.read = top, dialog, terminal, read
        self._done = directory / "done"

    def type(self, typed: str) -> None:
        os.write(self.terminal, typed.encode())
        ready, _, _ = select.select([sys.stdin], [], [], SECONDS)
        assert ready
        assert self.read()

    def until(self, words: str) -> list[str]:
        """The dialog's lines, once one has these words."""
        end = time.monotonic() + SECONDS
        while not any(words in line for line in self.dialog.lines):
            assert time.monotonic() < end, self.dialog.lines
            time.sleep(0.01)
        return self.dialog.lines

    def done(self) -> list[str]:
        """What was asked of robots."""
        return self._done.read_text().splitlines() if self._done.exists() else []


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Screen]:
    for name in ("flotilla-param", "sudo"):
        (tmp_path / name).write_text(SAYS.format(directory=tmp_path))
        (tmp_path / name).chmod(0o755)
    there = ["sh", "-c", 'PATH="$0:$PATH" exec sh -c "$1"', str(tmp_path)]
    monkeypatch.setattr(ssh, "command", lambda _: there)
    terminal, stdin = pty.openpty()
    dialog = Dialog(ROBOTS)
    top = Top(Receiver([]), STATES, dialog)
    with os.fdopen(stdin, "r") as file, os.fdopen(terminal, "wb") as kept:
        monkeypatch.setattr(sys, "stdin", file)
        with keyboard(top.press) as readers:
            ((_, read),) = readers.items()
            yield Screen(tmp_path, top, dialog, kept.fileno(), read)


def test_a_task_is_chosen_and_stopped(screen: Screen) -> None:
    """By arrows and letters, around the end. Seen to fail where another line than the marked one is acted upon."""
    screen.type(DOWN + "jj" + DOWN + DOWN + "k" + UP + "x")
    assert screen.dialog.lines == ["stop robot2 valves? y: yes, any other key: no"]
    assert screen.done() == []
    screen.type("y")
    assert screen.until("stop robot2 valves:")[0] == HELP
    assert screen.done() == ["sudo systemctl stop flotilla-task@valves.service"]


def test_it_is_started_and_what_was_not_meant_is_left(screen: Screen) -> None:
    screen.type("sn")
    assert screen.until("left as it is") == [HELP, "start robot1 heading: left as it is"]
    screen.type("sy")
    screen.until("start robot1 heading:")
    assert screen.done() == ["sudo systemctl start flotilla-task@heading.service"]


def test_a_parameter_is_set(screen: Screen) -> None:
    """The value goes as it was typed, corrected. Seen to fail without the key that erases."""
    screen.type("pa.c\x7fb  -1.5 [2]")
    (line,) = screen.dialog.lines
    assert line.startswith("robot1 heading: BLOCK.PARAMETER [VALUE]")
    assert line.endswith("> a.b  -1.5 [2]▏")
    screen.type("\n")
    assert screen.until("from step")[2] == "a.b: 1 [s] → 2 from step 5 on"
    assert screen.done() == ["flotilla-param heading a.b -1.5 [2]"]


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("z", "z does nothing"),
        ("\x1b[15~", "that key does nothing"),
        ("é\x01", "that key does nothing"),
        ("pa.b x\n", "robot1 heading a.b x: robot1: task heading: block a: x is not a number"),
        ("x\x1b", "left as it is"),
        ("p\x1b[A\x01" + "y" * 1000 + "\n", "from step 5"),
    ],
)
def test_what_cannot_be_is_answered(screen: Screen, typed: str, said: str) -> None:
    """Seen to fail where keys that make no character are typed."""
    screen.type(typed)
    screen.until(said)
    assert all("\x1b" not in line and "\x01" not in line for line in screen.done())


def test_leaving_asks_nobody(screen: Screen) -> None:
    screen.type("pa.b 1\x1b")
    assert (screen.dialog.lines, screen.done()) == ([HELP], [])


def test_without_keys_to_a_robot_it_says_so(screen: Screen, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(paths, "KEYS", tmp_path)
    dialog = Dialog(ROBOTS)
    dialog.press("p\n", list(STATES))
    end = time.monotonic() + SECONDS
    while not any("operator_ed25519 is missing" in line for line in dialog.lines):
        assert time.monotonic() < end, dialog.lines


def test_where_there_is_no_task(screen: Screen) -> None:
    dialog = Dialog(ROBOTS)
    dialog.press("x", [])
    assert dialog.lines == [HELP, "there is no task to choose"]
    assert dialog.chosen([]) is None


def test_the_screen_has_the_question_above_the_table(screen: Screen) -> None:
    """A long answer leaves room for it. Seen to fail with markup in answers, and with all of their lines."""
    console = screen.top.console
    console.height, console.width = 20, 150
    screen.type("jp\n")
    screen.until("100")
    with console.capture() as shown:
        console.print(screen.top._screen())
    lines = [line.rstrip() for line in shown.get().splitlines()]
    assert lines[0] == HELP
    assert lines[10] == "… 92 more lines"
    assert lines[11].split()[:3] == ["robot", "task", "ms"]
    screen.type("kpa.b\n")
    screen.until("[s]")
    with console.capture() as shown:
        console.print(screen.top._screen())
    assert "a.b: 1 [s] → 2" in shown.get()


def test_the_terminal_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a terminal that is gone ends nothing else. Seen to fail without `finally`."""
    terminal, stdin = pty.openpty()
    with os.fdopen(stdin, "r") as file:
        monkeypatch.setattr(sys, "stdin", file)
        before = termios.tcgetattr(stdin)
        with contextlib.suppress(KeyError), keyboard(lambda _: None):
            assert termios.tcgetattr(stdin) != before
            raise KeyError
        assert termios.tcgetattr(stdin) == before
        with keyboard(lambda _: None) as readers:
            os.close(terminal)
            assert readers[stdin]() is False


def test_what_is_no_terminal_has_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path("/dev/null").open() as file:
        monkeypatch.setattr(sys, "stdin", file)
        with keyboard(lambda _: None) as readers:
            assert readers == {}
