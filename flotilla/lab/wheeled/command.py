"""`make wheeled`: wheeled robots in a room, to be driven from this computer; `make wheeled-down` ends them."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from contextlib import ExitStack

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.lab.qemu import holder
from flotilla.lab.qemu.timing import LabError
from flotilla.lab.wheeled import live
from flotilla.lab.wheeled.live import Live
from flotilla.robot import ssh

_LOCK = live.DIRECTORY / "lock"
"""Locked by the process that holds the robots."""
_LOOK_S = 1.0
"""Between two looks whether the guests still run."""


def arguments(parser: argparse.ArgumentParser) -> None:
    count = parser.add_argument("count", type=int, nargs="?", default=1, help="of robots, up to 3 (%(default)s)")
    variable(count, "N")
    parser.add_argument("--room", default="corner", help="a file in flotilla/lab/plants/rooms (%(default)s)")


def run(arguments: argparse.Namespace) -> None:
    """Until SIGINT or SIGTERM."""
    lock = holder.free(_LOCK)
    if lock is None:
        raise UserError("wheeled robots run already; end them: make wheeled-down")
    ended = threading.Event()
    with lock, ExitStack() as stack:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # while they start, as Ctrl-C
        holder.sign(lock)
        try:
            there = stack.enter_context(live.robots(arguments.count, arguments.room))
            for one in there.robots:
                stack.enter_context(ssh.announced(one.robot, one.ssh_port))
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: ended.set())
            print(said(there, arguments.room), flush=True)
            while not ended.wait(_LOOK_S):
                if gone := [one.robot.name for one in there.robots if not one.machine.running]:
                    raise LabError(f"the guest of {gone[0]} ended; its logs are in {paths.shown(live.DIRECTORY)}")
        except KeyboardInterrupt:
            sys.stderr.write("ended before they had started\n")
        except LabError as error:
            raise UserError(str(error)) from error


def down() -> None:
    lock, ran = holder.end(_LOCK)
    if lock is None:
        raise UserError(f"the wheeled robots did not end; process {_LOCK.read_text()} holds them")
    lock.close()
    print("wheeled robots ended" if ran else "no wheeled robots run")


def said(there: Live, room: str) -> str:
    """How they are reached."""
    where = f"INVENTORY={paths.shown(there.inventory)}"
    keys = f"KEYS={paths.shown(paths.KEYS)}"
    robots = ", ".join(f"{one.robot.name} at {one.address}" for one in there.robots)
    return (
        f"in room {room}: {robots}\n"
        f"commands go to UDP port {there.robots[0].command_address[1]} there; reports come to port {there.report_port} "
        f"of {there.station_address}, or of any address\n"
        f"drive in a browser: make station {where} {keys}\n"
        f"by keys or gamepad: make drive ROBOT=1 {where} {keys}\n"
        f"watch: make top {where} {keys}    record: make record {where} {keys}\n"
        f"a shell, parameters, signals: make ssh|param|scope ROBOT=1 {where} {keys}    end: Ctrl-C or make wheeled-down"
    )
