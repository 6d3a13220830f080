"""Command line: `python -m tests.latency`, called by `make latency`, `make latency-accept` and CI."""

from __future__ import annotations

import argparse
import sys
from typing import get_args

from images.builder import inventory, paths
from images.builder.errors import UserError, exit_status
from images.builder.fleet import Board
from tests.latency import boottime, gate, report, results, run, target

REPORTS = paths.BUILD / "reports"
KERNELS = ("lean", "debian")


def _board(arguments: argparse.Namespace) -> Board:
    boards = inventory.load_fleet().boards
    name = arguments.board
    if name not in boards:
        raise UserError(f"--board {name}: there is no such board; the inventory has {', '.join(sorted(boards))}")
    return boards[name].model_copy(update={"kernel": arguments.kernel} if arguments.kernel else {})


def _measure(arguments: argparse.Namespace) -> None:
    if arguments.target:
        fleet = inventory.load_fleet()
        robot = target.named(fleet, arguments.target)
        with target.connect(robot) as shell:
            out = paths.BUILD / "latency" / f"{robot.name}-{arguments.plan}"
            target.measure(robot, fleet.boards[robot.board], shell, arguments.plan, out)
    else:
        board = _board(arguments)
        run.measure(board, arguments.plan, run.directory(board, arguments.plan))
    _report(arguments)


def _report(_: argparse.Namespace) -> None:
    found = [results.read(path) for path in sorted((paths.BUILD / "latency").glob("*/results.json"))]
    if not found:
        raise UserError(f"{paths.shown(paths.BUILD / 'latency')} has no results; measure first: make latency")
    print(paths.shown(report.write(found, REPORTS)))


def _boot_time(arguments: argparse.Namespace) -> None:
    board = _board(arguments)
    text = boottime.account(boottime.measure(board, paths.BUILD / "latency" / f"{run.name(board, 'standard')}-boot"))
    REPORTS.mkdir(parents=True, exist_ok=True)
    (REPORTS / f"boot-time-{run.name(board, 'standard')}.txt").write_text(text + "\n")
    print(text)


def _compare(arguments: argparse.Namespace) -> None:
    board = _board(arguments)
    path = run.directory(board, arguments.plan) / "results.json"
    if not path.exists():
        raise UserError(f"{paths.shown(path)} is missing; measure first: make latency")
    print(gate.check(results.read(path), gate.baseline(board, arguments.plan)))


def _accept(arguments: argparse.Namespace) -> None:
    """Anew, not the last run: so it is of the system as it is now, and one command does for both kernels."""
    if arguments.plan == "disk":
        raise UserError("--plan disk: has bounds, not a baseline: tests/latency/scenarios.py")
    for kernel in [arguments.kernel] if arguments.kernel else KERNELS:
        board = _board(argparse.Namespace(board=arguments.board, kernel=kernel))
        file = gate.baseline(board, arguments.plan)
        gate.accept(run.measure(board, arguments.plan, run.directory(board, arguments.plan)), file)
        print(f"{paths.shown(file)} is what was measured; commit it with the reason for the difference")


_COMMANDS = {
    "measure": (_measure, "measure a board's system in virtual time, and write the report"),
    "compare": (_compare, "compare the last run with the accepted one: exactly"),
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
        command.add_argument("--kernel", choices=KERNELS, help="instead of the one the inventory names")
        if name == "measure":
            command.add_argument("--target", metavar="ssh:ROBOT", help="a robot in real time, instead of virtual time")
        default = "quick" if name == "accept" else "standard"
        command.add_argument(
            "--plan", choices=get_args(results.Plan), default=default,
            help="standard, a minute each; quick, what every test run measures; disk, bounded only (%(default)s)",
        )  # fmt: skip
    arguments = parser.parse_args()
    return exit_status(lambda: _COMMANDS[arguments.command][0](arguments))


if __name__ == "__main__":
    sys.exit(main())
