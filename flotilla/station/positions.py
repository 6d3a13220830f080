"""Positions of the indoor positioning system (iGPS), brought to a robot with proof: `make positions ROBOT=3`.

The positioning system's program sends them to a UDP port of this computer, as it would to the robot. This program
proves that they come from a station, and sends each on at once.
"""

from __future__ import annotations

import argparse
import contextlib
import select
import socket
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, inventory
from flotilla.fleet.model import Fleet, Robot
from flotilla.station import cell, sending
from flotilla.station.authentication import Signer
from flotilla.station.receiver import stopped

PORT = 5010
"""Where positions are taken, unless another is named."""
HERE = "127.0.0.1"
"""Where the positioning system's program sends if it runs on this computer: nobody else can send to this address."""
BYTES = 16
"""Of a position: y and x as doubles."""
_BLOCK = "igps"
_LONGEST = 2048


@dataclass(frozen=True)
class Receiver:
    """A robot's block."""

    port: int
    signed: bool
    """It takes only positions that prove their sender."""


@dataclass
class Forwarder:
    """Takes positions from one socket, and sends them to a robot from another."""

    taken: socket.socket
    sender: socket.socket
    to: tuple[str, int]
    signer: Signer | None
    sent: int = 0
    wrong: int = 0
    """Of another length than a position."""
    failed: dict[str, int] = field(default_factory=dict)
    """Positions that could not be sent, by the reason."""

    def run(self, until: int) -> None:
        """Until that file descriptor is readable."""
        while True:
            ready, _, _ = select.select([until, self.sender.fileno(), self.taken.fileno()], [], [])
            if until in ready:
                return
            with contextlib.suppress(BlockingIOError):  # the kernel threw away what it had announced
                if self.sender.fileno() in ready:  # first: the next position answers it
                    self._answer(self.sender.recv(_LONGEST))
                if self.taken.fileno() in ready:
                    self._send(self.taken.recv(_LONGEST))

    def _answer(self, challenge: bytes) -> None:
        if self.signer:
            self.signer.challenged(challenge)

    def _send(self, position: bytes) -> None:
        if len(position) != BYTES:
            self.wrong += 1
            return
        try:
            self.sender.sendto(self.signer.sign(position) if self.signer else position, self.to)
            self.sent += 1
        except OSError as error:  # it is lost, as by radio, and the next one follows
            reason = error.strerror or str(error)
            self.failed[reason] = self.failed.get(reason, 0) + 1


def receiver(fleet: Fleet, robot: Robot, directory: Path) -> Receiver:
    """Its block, as one of its control tasks has it; `directory`: of the fleet's inventory."""
    found = []
    for task, text in identity.control_tasks(fleet, robot).items():
        try:
            blocks = [block for block in yaml.safe_load(text)["blocks"].values() if block["type"] == _BLOCK]
            found += [Receiver(int(block["parameters"]["port"]), "keys" in block["parameters"]) for block in blocks]
        except (KeyError, TypeError, ValueError) as error:
            file = paths.shown(paths.TASKS / f"{task}.yml")
            raise UserError(
                f"{file}: {error}: is missing or wrong; a station reads port and keys of {_BLOCK}"
            ) from error
    if len(found) != 1:
        where = f"{paths.shown(directory / 'robots.yml')}: {robot.name}.control_tasks"
        tasks = ", ".join(robot.control_tasks) or "none"
        raise UserError(f"{where}: {tasks}: {len(found)} blocks {_BLOCK} take positions; list a task that has one")
    return found[0]


def run(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    robot = inventory.robot(fleet, arguments.robot)
    there = receiver(fleet, robot, arguments.inventory)
    station = inventory.station(fleet, arguments.station, arguments.inventory)
    signer = sending.signer(station, robot, there.port, "position") if there.signed else None
    from_ = sending.EVERYWHERE if arguments.interface else HERE
    remedy = "end the program that has it, or take another port: PORT="
    with (
        sending.bound(from_, arguments.port, remedy, arguments.interface) as taken,
        sending.bound(str(station.address), remedy=f"give this computer {station.name}'s address") as sender,
        stopped() as ended,
    ):
        forwarder = Forwarder(taken, sender, (str(robot.address), there.port), signer)
        where = f"{arguments.interface or HERE}:{arguments.port}"
        print(f"positions from {where} to {robot.name}, until Ctrl-C", flush=True)
        forwarder.run(ended)
    print("; ".join(
        [f"{forwarder.sent} positions sent to {robot.name}", f"{forwarder.wrong} of a wrong length left out"]
        + [f"{count} not sent: {reason}" for reason, count in forwarder.failed.items()]
    ))  # fmt: skip


def positions_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", type=int, help="number in the inventory")
    parser.add_argument(
        "--port", type=int, default=PORT, help=f"UDP port of {HERE} that positions are sent to (%(default)s)"
    )
    parser.add_argument(
        "--interface", default="", help="network interface that they come by (none: they come from this computer)"
    )
    cell.station_arguments(parser)
