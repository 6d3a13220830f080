"""`make drive` by the real program: keys on a terminal, a gamepad at a pipe, and a robot that keeps what it is sent.

The robot is a socket at an address of loopback. It reports ten times a second what it was commanded.
"""

from __future__ import annotations

import os
import pty
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flotilla.common import paths, signals
from flotilla.fleet import inventory
from flotilla.lab.wheeled import by_wires
from flotilla.station import inputs, telemetry
from flotilla.station.driving import COMMAND, Motion
from tests.running import PATIENCE
from tests.station import LOOPBACK, ProvenWay, secret_in

ROBOT, STATION = LOOPBACK + "1", LOOPBACK + "254"
KEYS = "keys"
"""The fleet's, beside its inventory."""
INTERVAL_S = 0.1
Sent = tuple[int, int, Motion]
"""Number of the operator, sequence, motion."""


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """The wheeled robot's, on this computer's loopback."""
    made = tmp_path / "inventory"
    shutil.copytree(by_wires.INVENTORY, made)
    for file in (made / "robots.yml", made / "group_vars" / "all.yml"):
        file.write_text(file.read_text().replace("10.43.0.", LOOPBACK))
    secret_in(tmp_path / KEYS)
    return made


class Robot:
    """By a thread of its own: takes commands, and reports unless it is to be silent."""

    def __init__(self, fleet: Path) -> None:
        described = inventory.load_fleet(fleet)
        (self._stream,) = (stream for stream in telemetry.streams(described) if stream.task == "drive")
        self._way = ProvenWay(self._stream, described)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((ROBOT, 5030))
        self.commands: list[Sent] = []
        self._seen = 0
        self.silent = False
        self.operator = 0
        """Whom it says it obeys; 0: who commands."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        next_s, step = time.monotonic(), 0
        while not self._ended.is_set():
            if select.select([self._socket], [], [], max(0.0, next_s - time.monotonic()))[0]:
                number, sequence, v, omega, boom, enable = COMMAND.unpack(self._socket.recv(100)[: COMMAND.size])
                self.commands.append((number, sequence, Motion(v, omega, boom, enable)))
            if time.monotonic() >= next_s:
                step, next_s = step + 10, time.monotonic() + INTERVAL_S
                if not self.silent:
                    self._way.send(self._report(step))

    def _report(self, step: int) -> bytes:
        number, sequence, motion = self.commands[-1] if self.commands else (0, 0, Motion(0, 0, 0.2, False))
        values = {
            "step": step, "command": sequence, "operator": self.operator or number, "alive": motion.enable,
            "motion": (motion.v, motion.omega), "boom": motion.boom, "seeing": True, "left": motion.enable,
            "right": motion.enable, "boom_enabled": motion.enable,
        }  # fmt: skip
        report = b""
        for field in self._stream.fields:
            value = values.get(field.name, 0)
            elements = value if isinstance(value, tuple) else (value,) * field.width
            report += struct.pack(f"<{field.width}{signals.CODES[field.type]}", *elements)
        return report

    def until(self, what: Callable[[], bool], hold: Callable[[], None] = lambda: None) -> None:
        """`hold`: called twenty times a second meanwhile, as a keyboard repeats a key."""
        end_s = time.monotonic() + PATIENCE
        while not what():
            assert time.monotonic() < end_s, self.commands[-3:]
            hold()
            time.sleep(0.05)

    def does(
        self,
        v: float,
        omega: float = 0,
        *,
        boom: float = 0.2,
        enable: bool = True,
        hold: Callable[[], None] = lambda: None,
    ) -> None:
        """Wait until a command after the last one that was waited for is this."""
        wanted = Motion(v, omega, boom, enable)

        def found() -> bool:
            for index in range(self._seen, len(self.commands)):
                if self.commands[index][2] == wanted:
                    self._seen = index
                    return True
            return False

        self.until(found, hold)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()
        self._way.close()


@pytest.fixture
def robot(fleet: Path) -> Iterator[Robot]:
    robot = Robot(fleet)
    yield robot
    robot.close()


class Terminal:
    """The program on a terminal of its own."""

    def __init__(self, fleet: Path, build: Path, *options: str) -> None:
        self._fd, theirs = pty.openpty()
        argv = [sys.executable, "-m", "flotilla", "drive", "1", "--inventory", str(fleet), "--address", STATION]
        self.process = subprocess.Popen(
            [*argv, *options], cwd=paths.PROJECT, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
            preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),
            env=os.environ | {"TERM": "xterm", "BUILD": str(build), "COLUMNS": "200", "KEYS": str(fleet.parent / KEYS)},
        )  # fmt: skip
        os.close(theirs)
        self.said = ""

    def press(self, keys: str) -> None:
        os.write(self._fd, keys.encode())

    def hold(self, key: str) -> Callable[[], None]:
        return lambda: self.press(key)

    def until(self, answer: str) -> None:
        """Read until it stands on the screen."""
        end_s = time.monotonic() + PATIENCE
        self.said = ""
        while answer not in self.said:
            assert select.select([self._fd], [], [], end_s - time.monotonic())[0], self.said
            self.said += os.read(self._fd, 65536).decode(errors="replace")

    def wait(self) -> int:
        """Its exit status; the screen is read meanwhile, so that it can write."""
        while True:
            try:
                self.said += os.read(self._fd, 65536).decode(errors="replace")
            except OSError:
                return self.process.wait(PATIENCE)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._fd)


@contextmanager
def driving(fleet: Path, build: Path, *options: str) -> Iterator[Terminal]:
    terminal = Terminal(fleet, build, *options)
    try:
        yield terminal
    finally:
        terminal.close()


def test_keys_drive_it(fleet: Path, robot: Robot, tmp_path: Path) -> None:
    """Motors and boom are as the robot has them. A key moves it and its end stops it, as do space and Ctrl-C. Who
    commands, what is sent and what is reported are on the screen. Seen to fail with keys that never end."""
    with driving(fleet, tmp_path) as terminal:
        robot.does(0, enable=False)
        terminal.until("commanded by keyboard of")
        terminal.press("e")
        robot.does(0)
        terminal.until("motors on")
        robot.does(0.25, hold=terminal.hold("w"))
        robot.does(0)
        terminal.press("+++++")
        robot.does(0.5, hold=terminal.hold("\x1b[A"))
        terminal.press(" ")
        robot.does(0)
        robot.does(0, 1.5, hold=terminal.hold("a"))
        robot.until(lambda: robot.commands[-1][2].boom > 0.21, terminal.hold("r"))
        robot.until(lambda: robot.commands[-1][2].v > 0, terminal.hold("w"))
        terminal.press("\x03")
        assert terminal.wait() == 0
    assert robot.commands[-1][2].resting == robot.commands[-1][2]
    assert len({number for number, _, _ in robot.commands}) == 1
    assert [sequence for _, sequence, _ in robot.commands] == list(range(1, len(robot.commands) + 1))
    assert "Traceback" not in terminal.said


def test_without_reports_it_rests(fleet: Path, robot: Robot, tmp_path: Path) -> None:
    """Before the first one nothing is sent; when they cease, a held key moves nothing. Seen to fail with an input that
    asks for no report."""
    robot.silent = True
    with driving(fleet, tmp_path) as terminal:
        terminal.until("no report yet, so nothing is sent")
        assert robot.commands == []
        robot.silent = False
        robot.does(0, enable=False)
        terminal.press("e")
        robot.does(0)
        robot.does(0.25, hold=terminal.hold("w"))
        robot.silent = True
        terminal.until("nothing moves until it is back")
        rests_from = len(robot.commands)
        robot.until(lambda: len(robot.commands) > rests_from + 10, terminal.hold("w"))
        assert all(motion.v == 0 for _, _, motion in robot.commands[rests_from:])


def test_a_second_program_is_refused(fleet: Path, robot: Robot, tmp_path: Path) -> None:
    """By the name of the first one; after its end, however it ended, the robot is free. Seen to fail without a lock."""
    with driving(fleet, tmp_path) as first:
        first.until("commanded by keyboard of")
        with driving(fleet, tmp_path) as second:
            assert second.wait() == 1
            assert "rover: keyboard of " in second.said
            assert f"(process {first.process.pid}) commands it" in second.said.replace("\r\n", " ")
        first.process.send_signal(signal.SIGKILL)
        first.process.wait(PATIENCE)
        with driving(fleet, tmp_path) as second:
            second.until("commanded by keyboard of")


def test_it_says_whom_the_robot_obeys(fleet: Path, robot: Robot, tmp_path: Path) -> None:
    robot.operator = 77
    with driving(fleet, tmp_path) as terminal:
        terminal.until("obeys operator 77")


def test_a_closed_terminal_stops_it(fleet: Path, robot: Robot, tmp_path: Path) -> None:
    """SIGHUP, as of a closed window or a lost ssh."""
    with driving(fleet, tmp_path) as terminal:
        robot.does(0, enable=False)
        terminal.press("e")
        robot.does(0)
        robot.does(0.25, hold=terminal.hold("w"))
        terminal.process.send_signal(signal.SIGHUP)
        assert terminal.wait() == 0
    robot.does(0)


def test_a_gamepad_drives_it(fleet: Path, robot: Robot, tmp_path: Path) -> None:
    """Held button and stick move it; the button's release, and an unplugged gamepad, stop it."""
    path = tmp_path / "event5"
    os.mkfifo(path)
    pad = os.open(path, os.O_RDWR)

    def send(*events: tuple[int, int, int]) -> None:
        os.write(pad, b"".join(inputs.EVENT.pack(1, 2, *event) for event in events))

    with driving(fleet, tmp_path, "--input", str(path)) as terminal:
        robot.does(0, enable=False)
        send((1, inputs.BTN_START, 1), (1, inputs.BTN_START, 0))
        robot.does(0)
        send((3, inputs.ABS_Y, -32768))
        terminal.until("sent:  0.00 m/s")
        send((1, inputs.BTN_TL, 1))
        robot.does(0.5)
        send((1, inputs.BTN_TL, 0))
        robot.does(0)
        send((1, inputs.BTN_TL, 1))
        robot.does(0.5)
        os.close(pad)
        assert terminal.wait() == 1
        assert "gamepad is gone, and the robot stops" in terminal.said
    robot.does(0)


def test_a_keyboard_needs_a_terminal(fleet: Path, tmp_path: Path) -> None:
    argv = [sys.executable, "-m", "flotilla", "drive", "1", "--inventory", str(fleet), "--address", STATION]
    done = subprocess.run(
        argv,
        cwd=paths.PROJECT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
        env=os.environ | {"BUILD": str(tmp_path), "KEYS": str(fleet.parent / KEYS)},
    )
    assert done.returncode == 1
    assert "keyboard: standard input is no terminal; run it in one, or give INPUT=gamepad" in done.stderr
