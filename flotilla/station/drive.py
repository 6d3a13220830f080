"""Drive a robot from this terminal: `make drive ROBOT=5`, by keys or a gamepad; who commands, what is sent, and what
the robot reports are on the screen."""

from __future__ import annotations

import argparse
import contextlib
import getpass
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.fleet import inventory
from flotilla.station import inputs, station_keys
from flotilla.station.driving import TASK, Driving, Motion, Operator, Refused, State
from flotilla.station.inputs import Input
from flotilla.station.receiver import Receiver, drain, listen
from flotilla.station.recording import Value
from flotilla.station.telemetry import Stream, streams

INTERVAL_S = 0.05
"""Between two inputs: a key's end shows within one of the sender's intervals."""
SHOW_S = 0.2
STALE_S = 1.0
"""Nobody drives a robot that reports nothing for so long."""
BOOM_M_S = 0.05
"""As fast as the robot moves it: `boom_limit` of drive.yml."""


class Session:
    """An input, the robot's reports, and what comes of both; a sink of the receiver. `clock` in s."""

    def __init__(
        self,
        driving: Driving,
        robot: str,
        operator: Operator,
        source: Input,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._driving, self._robot, self._operator, self._source = driving, robot, operator, source
        (vehicle,) = (each for each in driving.vehicles if each.robot == robot)
        self._limits = vehicle.limits
        self._clock = clock
        self._report: Mapping[str, Value] = {}
        self._reported_s = self._moved_s = clock()
        self._boom = 0.0
        self._enable = False
        self.refused = ""
        """Why the last input was not taken."""

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        """A report. The first one says where the boom is and whether the motors are on: both stay so."""
        if not self._report:
            self._boom, self._enable = _number(values["boom"]), bool(values["left"] and values["right"])
        self._report, self._reported_s = values, self._clock()

    def refresh(self) -> None:
        """Give the input of this moment. Without reports there is none at first, and later one that moves nothing."""
        now_s = self._clock()
        wish, past_s = self._source.wish(), min(now_s - self._moved_s, 2 * INTERVAL_S)
        toggled, self._moved_s = self._source.toggled(), now_s
        if not self._report:
            return
        if now_s - self._reported_s > STALE_S:
            wish = inputs.Wish()
        low, high = self._limits["boom"]
        self._boom = min(max(self._boom + wish.boom * BOOM_M_S * past_s, low), high)
        self._enable ^= toggled
        v, omega = max(wish.ahead, 0.0) * self._limits["v"][1], wish.turn * self._limits["omega"][1]
        try:
            self._driving.drive(self._robot, self._operator.id, v, omega, self._boom, self._enable)
            self.refused = ""
        except Refused as error:
            self.refused = f"{error}; end this and begin anew"

    def end(self) -> str:
        return self._answer(self._driving.state(self._robot))

    @property
    def lines(self) -> list[str]:
        """For the screen."""
        state = self._driving.state(self._robot)
        holder = f"{state.holder.name}, operator {state.number}" if state.holder else "nobody"
        sent = _motion(state.sending) if state.sending else "nothing"
        why = "; ".join(filter(None, (state.note, state.error, self.refused)))
        return [
            f"{self._robot}: commanded by {holder}",
            f"sent:  {sent}{f' ({why})' if why else ''}",
            f"robot: {self._answer(state)}",
        ]

    def _answer(self, state: State) -> str:
        """What the robot reports."""
        if not self._report:
            return "no report yet, so nothing is sent: is it on, and is this computer a station?"
        age_s = self._clock() - self._reported_s
        if age_s > STALE_S:
            return f"no report for {age_s:.1f} s: nothing moves until it is back"
        report = self._report
        v, omega = _pair(report["motion"])
        motion = Motion(v, omega, _number(report["boom"]), bool(report["left"] and report["right"]))
        return ", ".join([_motion(motion), *_remarks(report, state)])


def _remarks(report: Mapping[str, Value], state: State) -> Iterator[str]:
    if report["conflict"]:
        yield f"STOPS: operators {report['operator']} and {report['other']} command at once"
    elif state.number and report["operator"] != state.number:
        yield f"obeys operator {report['operator']}" if report["operator"] else "obeys nobody yet"
    elif not report["alive"]:
        yield "takes no commands"
    if not report["seeing"]:
        yield "sees nothing"
    elif report["limited"]:
        yield "slowed by an obstacle"
    for name in ("left", "right", "boom"):
        if code := report[f"{name}_error"]:
            yield f"drive {name}: error {code:#06x}"


def _motion(motion: Motion) -> str:
    motors = "on" if motion.enable else "off"
    return f"{motion.v:.2f} m/s, turn {motion.omega:.2f} rad/s, boom {motion.boom:.2f} m, motors {motors}"


def _number(value: Value) -> float:
    assert isinstance(value, (int, float))
    return float(value)


def _pair(value: Value) -> tuple[float, float]:
    assert isinstance(value, (list, tuple))
    first, second = value
    return float(first), float(second)


def run(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    robot = inventory.robot(fleet, arguments.robot)
    known = [stream for stream in streams(fleet) if (stream.robot, stream.task) == (robot.name, TASK)]
    name = f"{arguments.input} of {getpass.getuser()} at {socket.gethostname()}"
    operator = Operator(f"drive-{os.getpid()}", name)
    with _ended_by_signals(), Driving(fleet, arguments.address) as driving:
        driving.take(robot.name, operator)
        if not known:
            raise UserError(f"{robot.name}: its task {TASK} reports to no station; describe one in the inventory")
        receiver = Receiver(known, station_keys.of_telemetry(fleet))
        sockets = listen((stream.port for stream in known), arguments.address)
        with inputs.opened(arguments.input) as source:
            session = Session(driving, robot.name, operator, source)
            receiver.sinks.append(session)
            with _screen(session, source) as show:
                _loop(session, source, sockets, receiver, show)


def _loop(
    session: Session, source: Input, sockets: list[socket.socket], receiver: Receiver, show: Callable[[], None]
) -> None:
    """Until Ctrl-C or a signal ends it, or the input is gone."""
    by_fd = {one.fileno(): one for one in sockets}
    next_s = shown_s = time.monotonic()
    while True:
        wait_s = max(0.0, next_s - time.monotonic())
        ready, _, _ = select.select([source.fd, *by_fd], [], [], wait_s)
        for fd in ready:
            if fd in by_fd:
                drain(by_fd[fd], receiver)
            elif not source.read():
                raise UserError("the keyboard or gamepad is gone, and the robot stops; plug it in and begin anew")
        now_s = time.monotonic()
        if now_s >= next_s:
            session.refresh()
            next_s = now_s + INTERVAL_S
        if now_s - shown_s >= SHOW_S:
            show()
            shown_s = now_s


class _Ended(BaseException):
    """By a signal."""


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Whatever ends the program, the robot is told to stop; where even that is impossible, it misses commands."""

    def end(*_: object) -> None:
        raise _Ended

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    with contextlib.suppress(_Ended):
        yield


@contextlib.contextmanager
def _screen(session: Session, source: Input) -> Iterator[Callable[[], None]]:
    """On a terminal lines that change in place; else a line whenever what is sent or reported is another one."""
    console = Console()
    before: list[str] = []

    def text() -> Group:
        return Group(*map(Text, [source.help, *session.lines]))

    def show() -> None:
        nonlocal before
        if console.is_terminal:
            live.update(text(), refresh=True)
        elif (lines := session.lines) != before:
            sys.stdout.write("\n".join(lines) + "\n")
            sys.stdout.flush()
            before = lines

    if not console.is_terminal:
        yield show
        return
    with Live(text(), console=console, auto_refresh=False) as live:
        yield show


def drive_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", type=int, help="number in the inventory")
    parser.add_argument(
        "--input", default=inputs.KEYBOARD, help=f"{inputs.KEYBOARD}, {inputs.GAMEPAD}, or its node (%(default)s)"
    )
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")
    address = parser.add_argument(
        "--address", default="0.0.0.0", help="this computer's, to send from and receive at (%(default)s)"
    )
    variable(address, "RECEIVE_ADDRESS")
