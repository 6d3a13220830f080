"""Command line: `python -m tests.latency`, called by `make latency`, `make latency-accept` and CI."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from images.builder import inventory, kernel, paths
from images.builder.errors import UserError, exit_status
from images.builder.fleet import Board
from tests.latency import boottime, controls, gate, limits, report, results, run, target
from tests.latency.results import Plan, Results

REPORTS = paths.BUILD / "reports"
KERNELS = ("lean", "debian")
CONTROL = "no-rt"
"""The kernel `lean` without real time: what the gate has to refuse."""


@dataclass(frozen=True)
class System:
    """What is measured, and by what plan."""

    board: Board
    plan: Plan
    control: controls.Control

    @property
    def directory(self) -> Path:
        return run.directory(self.board, self.plan, self.control)

    def results(self) -> Results:
        path = self.directory / "results.json"
        if not path.exists():
            raise UserError(f"{paths.shown(path)} is missing; measure first: make latency")
        return results.read(path)


def _systems(arguments: argparse.Namespace) -> list[System]:
    """The one that is asked for, or both kernels and the control."""
    board = _board(arguments)
    if arguments.kernel:
        return [_system(board, arguments.plan, arguments.kernel)]
    there = arguments.plan != "disk" and f"{board.name}-{CONTROL}" in kernel.recipes()
    return [_system(board, arguments.plan, name) for name in (*KERNELS, *([CONTROL] if there else []))]


def _system(board: Board, plan: Plan, name: str) -> System:
    if name == CONTROL:  # five seconds show it, and there is an accepted run of the kernel that it deviates from
        return System(board.model_copy(update={"kernel": limits.OURS}), "quick", controls.NO_RT)
    return System(board.model_copy(update={"kernel": name}), plan, controls.NOTHING)


def _board(arguments: argparse.Namespace) -> Board:
    boards = inventory.load_fleet().boards
    name = arguments.board
    if name not in boards:
        raise UserError(f"--board {name}: there is no such board; the inventory has {', '.join(sorted(boards))}")
    return boards[name]


def _measure(arguments: argparse.Namespace) -> None:
    if arguments.target:
        fleet = inventory.load_fleet()
        robot = target.named(fleet, arguments.target)
        with target.connect(robot) as shell:
            out = paths.BUILD / "latency" / f"{robot.name}-{arguments.plan}"
            target.measure(robot, fleet.boards[robot.board], shell, arguments.plan, out)
    else:
        for system in _systems(arguments):
            run.measure(system.board, system.plan, system.directory, system.control)
    _report(arguments)


def _report(_: argparse.Namespace) -> None:
    found = [results.read(path) for path in sorted((paths.BUILD / "latency").glob("*/results.json"))]
    if not found:
        raise UserError(f"{paths.shown(paths.BUILD / 'latency')} has no results; measure first: make latency")
    print(paths.shown(report.write(found, REPORTS)))


def _boot_time(arguments: argparse.Namespace) -> None:
    board = _board(arguments)
    if arguments.kernel:
        board = board.model_copy(update={"kernel": arguments.kernel})
    out = paths.BUILD / "latency" / f"{board.name}-{board.kernel}-boot"
    text = boottime.account(boottime.measure(board, out))
    REPORTS.mkdir(parents=True, exist_ok=True)
    (REPORTS / f"boot-time-{board.name}-{board.kernel}.txt").write_text(text + "\n")
    print(text)


def _compare(arguments: argparse.Namespace) -> None:
    """Everything is judged, whatever is said of the first."""
    long = [system.results() for system in _systems(arguments) if system.plan == "standard"]
    judged = [partial(_judge, system) for system in _systems(arguments) if system.plan != "standard"]
    refused = []
    for judge in [*judged, partial(limits.check, long)] if long else judged:
        try:
            print(judge())
        except UserError as error:
            refused.append(str(error))
    if refused:
        raise UserError("\n".join(refused))


def _judge(system: System) -> str:
    found = system.results()
    if system.control == controls.NOTHING:
        return gate.check(found, gate.baseline(system.board, system.plan))
    return gate.check_control(found)


def _accept(arguments: argparse.Namespace) -> None:
    """Anew, not the last run: so it is of the system as it is now, and one command does for both kernels."""
    if arguments.plan != "quick":
        raise UserError(f"--plan {arguments.plan}: has limits, not an accepted run; only quick has one")
    for name in [arguments.kernel] if arguments.kernel else KERNELS:
        system = _system(_board(arguments), arguments.plan, name)
        file = gate.baseline(system.board, system.plan)
        gate.accept(run.measure(system.board, system.plan, system.directory), file)
        print(f"{paths.shown(file)} is what was measured; commit it with the reason for the difference")


_COMMANDS = {
    "measure": (_measure, "measure a board's system in virtual time, and write the report"),
    "compare": (
        _compare,
        "judge the last runs: by limits, or exactly by the accepted run; the control has to be refused",
    ),
    "accept": (_accept, "measure, and make that the accepted run; both kernels, unless one is named"),
    "report": (_report, "write the report of all runs there are"),
    "boot-time": (_boot_time, "boot once in virtual time, and say where it goes"),
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.latency", description="Latency in virtual time.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, (_, text) in _COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("--board", default="smartcoret3", help="name in the inventory (%(default)s)")
        known = (*KERNELS, CONTROL) if name in ("measure", "compare") else KERNELS
        command.add_argument("--kernel", choices=known, help="this one only")
        if name == "measure":
            command.add_argument("--target", metavar="ssh:ROBOT", help="a robot in real time, instead of virtual time")
        default = "quick" if name == "accept" else "standard"
        command.add_argument(
            "--plan", choices=get_args(results.Plan), default=default,
            help="standard, a minute each, with limits; quick, what tests measure; disk, bounded (%(default)s)",
        )  # fmt: skip
    arguments = parser.parse_args()
    return exit_status(lambda: _COMMANDS[arguments.command][0](arguments))


if __name__ == "__main__":
    sys.exit(main())
