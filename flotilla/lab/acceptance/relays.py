"""Relays, one after the other, while a person watches: whether what hangs on them switches, no register tells.

The robot's control tasks are stopped meanwhile. Each relay is switched by a task of the runtime, so that relays go to
their reset state however it ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.lab.acceptance import answers
from flotilla.lab.qemu.ssh import Ssh
from flotilla.robot.answers import judged

_TYPE = "ir104-pbf"
_FILE = "/run/accept-relay.yml"
_LIMIT_S = 600
"""For a person who went away."""


@dataclass(frozen=True)
class Board:
    """A relay board, as a control task describes it."""

    task: str
    block: str
    base: int
    """First of its I/O ports."""
    channels: tuple[int, ...]


@dataclass(frozen=True)
class Relay:
    """What became of one."""

    board: Board
    number: int
    """As on the board."""
    seen: bool
    """By the person."""
    mismatch: bool
    """Its register read back other than written."""


def boards(robot: Robot) -> list[Board]:
    """Those that the robot's control tasks drive."""
    found = []
    for name in robot.control_tasks:
        blocks: dict[str, Any] = yaml.safe_load((paths.TASKS / f"{name}.yml").read_text())["blocks"]
        for block, said in blocks.items():
            if said["type"] == _TYPE:
                given = said["parameters"]
                found.append(Board(name, block, int(given["base"]), tuple(given["channels"])))
    return found


def watch(robot: Robot, shell: Ssh, person: Callable[[str], bool]) -> list[Relay]:
    """Switch each relay on, and ask. `person`: says yes or no to a question."""
    described = boards(robot)
    if not described:
        raise UserError(f"{robot.name} has no control task with a block {_TYPE}: leave out RELAYS=1")
    with _stopped(shell, robot.control_tasks):
        return [
            Relay(board, number, *_switched(robot.name, shell, board, number, person))
            for board in described
            for number in board.channels
        ]


@contextmanager
def _stopped(shell: Ssh, tasks: Sequence[str]) -> Iterator[None]:
    units = [f"flotilla-task@{task}.service" for task in tasks]
    shell.run(["sudo", "systemctl", "stop", *units])
    try:
        yield
    finally:
        shell.run(["sudo", "systemctl", "start", *units])


def _switched(robot: str, shell: Ssh, board: Board, number: int, person: Callable[[str], bool]) -> tuple[bool, bool]:
    """Whether the person saw it, and whether it read back as another."""
    block = {
        "type": _TYPE,
        "in": {"command": 1, "flag": 1},
        "parameters": {"base": hex(board.base), "channels": [number], "timeout": 1.0},
    }
    task = yaml.safe_dump({"period": "100 ms", "priority": 80, "blocks": {"relay": block}})
    shell.run(["sudo", "tee", _FILE], stdin=task)
    argv = ["sudo", "timeout", str(_LIMIT_S), "flotilla-run", "--watch", "relay.mismatch", _FILE]
    try:
        with shell.start(argv) as program:
            assert program.stdout
            lines = answers.lines(robot, program.stdout)
            if (first := next(lines, None)) is None:
                raise UserError(f"{board.task}: relay {number} cannot be switched; `make hwcheck` shows its I/O ports")
            try:
                seen = person(f"{board.task}: is relay {number} on, and no other?")
            finally:
                shell.run(["sudo", "pkill", "-TERM", "-f", f"^flotilla-run.*{_FILE}"], check=False)
            said = [judged(robot, line, answers.Watched) for line in (first, *lines)]
    finally:
        shell.run(["sudo", "rm", "-f", _FILE])
    return seen, any(line["relay.mismatch"] for line in said)
