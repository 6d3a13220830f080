"""What `make latency`, `make latency-accept` and `make boot-time` do."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import kernel
from flotilla.fleet import inventory
from flotilla.fleet.model import Board
from flotilla.lab.latency import boottime, controls, gate, limits, report, results, run, target, virtual_loop
from flotilla.lab.latency.results import Plan, Results

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


def plan(arguments: argparse.Namespace) -> Plan:
    """The one that is asked for; a robot, in real time, is as late as it is only now and then."""
    asked: Plan = arguments.plan or ("standard" if arguments.target else "quick")
    return asked


def systems(arguments: argparse.Namespace) -> list[System]:
    """The one that is asked for, or both kernels and the control."""
    board = _board(arguments)
    if arguments.kernel:
        return [_system(board, plan(arguments), arguments.kernel)]
    there = plan(arguments) != "disk" and f"{board.name}-{CONTROL}" in kernel.names()
    return [_system(board, plan(arguments), name) for name in (*KERNELS, *([CONTROL] if there else []))]


def _system(board: Board, plan: Plan, name: str) -> System:
    if name == CONTROL:  # five seconds show it, and there is an accepted run of the kernel that it deviates from
        return System(board.model_copy(update={"kernel": limits.OURS}), "quick", controls.NO_RT)
    return System(board.model_copy(update={"kernel": name}), plan, controls.NOTHING)


def _board(arguments: argparse.Namespace) -> Board:
    return inventory.load_fleet().board(arguments.board)


def measure(arguments: argparse.Namespace) -> None:
    if arguments.target:
        fleet = inventory.load_fleet()
        robot = target.named(fleet, arguments.target)
        with target.connect(robot) as shell:
            out = paths.BUILD / "latency" / f"{robot.name}-{arguments.plan}"
            target.measure(robot, fleet.boards[robot.board], shell, arguments.plan, out)
    else:
        asked = systems(arguments)
        progress.say(how_long(asked, kernel.unbuilt(kernels(asked))))
        for system in asked:
            run.measure(system.board, system.plan, system.directory, system.control)
    write_report()


def kernels(systems: Sequence[System]) -> list[str]:
    """Of kernel/, that these boot."""
    boards = [system.board for system in systems if system.board.kernel == limits.OURS]
    others = [f"{system.board.name}-{system.control.kernel}" for system in systems if system.control.kernel]
    return list(dict.fromkeys([*(board.name for board in boards), *others]))


def how_long(systems: Sequence[System], unbuilt: Sequence[str]) -> str:
    """What is said before systems are measured; `unbuilt`: kernels that have to be built."""
    names = [
        run.name(system.board.name, system.control.kernel or system.board.kernel, system.plan) for system in systems
    ]
    minutes = math.ceil(sum(run.host_s(system.plan) for system in systems) / 60)
    lines = [f"to measure: {', '.join(names)}; about {minutes} minutes on two cores"]
    return "\n".join(lines + [kernel.how_long(unbuilt)] * bool(unbuilt))


def write_report() -> None:
    found = [results.read(path) for path in sorted((paths.BUILD / "latency").glob("*/results.json"))]
    if not found:
        raise UserError(f"{paths.shown(paths.BUILD / 'latency')} has no results; measure first: make latency")
    print(paths.shown(report.write(found, REPORTS)))


def boot_time(arguments: argparse.Namespace) -> None:
    board = _board(arguments)
    if arguments.kernel:
        board = board.model_copy(update={"kernel": arguments.kernel})
    out = paths.BUILD / "latency" / f"{board.name}-{board.kernel}-boot"
    text = boottime.account(boottime.measure(board, out))
    REPORTS.mkdir(parents=True, exist_ok=True)
    (REPORTS / f"boot-time-{board.name}-{board.kernel}.txt").write_text(text + "\n")
    print(text)


def compare(arguments: argparse.Namespace) -> None:
    """Everything is judged, whatever is said of the first."""
    long = [system.results() for system in systems(arguments) if system.plan == "standard"]
    judged = [partial(_judge, system) for system in systems(arguments) if system.plan != "standard"]
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


def accept(arguments: argparse.Namespace) -> None:
    """Anew, not the last run: so it is of the system as it is now, and one command does for both kernels."""
    if arguments.plan != "quick":
        raise UserError(f"--plan {arguments.plan}: has limits, not a baseline; only quick has one")
    for name in [arguments.kernel] if arguments.kernel else KERNELS:
        system = _system(_board(arguments), arguments.plan, name)
        file = gate.baseline(system.board, system.plan)
        gate.accept(run.measure(system.board, system.plan, system.directory), file)
        print(f"{paths.shown(file)} is what was measured; commit it with the reason for the difference")
    virtual_loop.accept()


def latency(arguments: argparse.Namespace) -> None:
    """Measure, report, and judge: by limits, or exactly by the accepted run; the control has to be refused."""
    arguments.plan = plan(arguments)
    measure(arguments)
    if not arguments.target:
        compare(arguments)


def system_arguments(parser: argparse.ArgumentParser, *, control: bool = False) -> None:
    """Which system of which board is measured, and how long."""
    parser.add_argument("--board", help="name in the inventory (the first robot's)")
    parser.add_argument("--kernel", choices=(*KERNELS, CONTROL) if control else KERNELS, help="this one only")
    parser.add_argument(
        "--plan", choices=get_args(results.Plan), default="quick",
        help="quick, as accepted (a robot: standard); standard, an hour, within limits; disk, bounded",
    )  # fmt: skip


def latency_arguments(parser: argparse.ArgumentParser) -> None:
    system_arguments(parser, control=True)
    parser.set_defaults(plan=None)
    parser.add_argument("--target", metavar="ssh:ROBOT", help="a robot in real time, instead of virtual time")


def accept_arguments(parser: argparse.ArgumentParser) -> None:
    system_arguments(parser)
