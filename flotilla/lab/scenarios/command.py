"""What `make scenarios` and `make scenarios-accept` do."""

from __future__ import annotations

import argparse
import math
import shutil
from collections.abc import Iterable, Sequence

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.debian import kernel
from flotilla.fleet import inventory
from flotilla.fleet.model import Board
from flotilla.lab.scenarios import crowd, gate, guests, lockstep, report, virtual
from flotilla.lab.scenarios.flight import Flight
from flotilla.lab.scenarios.plans import TESTED_SIDE_M, disturbed, over_the_air, plans, secured, standby
from flotilla.lab.scenarios.virtual import Plan

OUT = paths.BUILD / "scenarios"
GUESTS = paths.BUILD / "flights"
LOCKSTEP = paths.BUILD / "lockstep"
ALL = "all"
DEFAULT = "udp"
"""The flight of who names none: a few minutes."""
CROWD = paths.BUILD / "crowd"


def _board(name: str | None) -> Board:
    """That of the scenario's own description, or another one of the inventory; with our kernel."""
    board = inventory.load_fleet().board(name) if name else virtual.fleet("udp").board()
    return board.model_copy(update={"kernel": "lean"})


def _flown(flights: Sequence[Plan], board: Board) -> dict[str, Flight]:
    shutil.rmtree(OUT, ignore_errors=True)
    progress.say(how_long(flights, kernel.unbuilt([board.name])))
    return {name: Flight.read(directory) for name, directory in virtual.fly(flights, board, OUT).items()}


def how_long(flights: Sequence[Plan], kernels: Sequence[str]) -> str:
    """What is said before flights; `kernels`: those that have to be built."""
    seconds = sum(plan.seconds for plan in flights)
    minutes = math.ceil((virtual.BOOT_HOST_S + virtual.HOST_S * seconds) / 60)
    names = ", ".join(plan.name for plan in flights)
    lines = [f"scenarios: {names}; {seconds:g} virtual seconds, about {minutes} minutes on two cores"]
    return "\n".join(lines + [kernel.how_long(kernels)] * bool(kernels))


def chosen(given: Sequence[str], there: Iterable[str]) -> Iterable[str]:
    """Names of the flights that are asked for."""
    return there if given == [ALL] else given or [DEFAULT]


def _fly(names: list[str], side_m: float, board: Board) -> None:
    every = (plans, disturbed, over_the_air, standby)
    there = {plan.name: plan for group in every for plan in group(side_m)}
    for name in chosen(names, there):
        if name not in there:
            raise UserError(f"{name}: there is no such scenario; there are {', '.join(there)}, and {ALL} for all")
    flown = _flown([there[name] for name in chosen(names, there)], board)
    page = report.write({there[name].title: flight for name, flight in flown.items()}, paths.BUILD / "reports")
    print(f"{paths.shown(page)}; logs and recordings of each task: {paths.shown(OUT)}/flights")
    faults = [
        f"{there[name].title}: {fault}"
        for name, flight in flown.items()
        for fault in flight.faults(disturbed=there[name].disturbed)
    ]
    if faults:
        raise UserError("\n".join(faults))


def _fly_guests(names: list[str], side_m: float, board: Board, link: str) -> None:
    there = {plan.name: plan for plan in plans(side_m) if plan.name in guests.FLIGHTS}
    if others := [name for name in chosen(names, there) if name not in there]:
        raise UserError(f"{', '.join(others)}: guests run {', '.join(there)}; all else is for virtual time")
    shutil.rmtree(GUESTS, ignore_errors=True)
    to_fly = [there[name] for name in chosen(names, there)]
    flown = {plan.title: guests.fly(plan, GUESTS / plan.name, board, link) for plan in to_fly}
    page = report.write(flown, paths.BUILD / "reports", "flights", guests.HOW[link])
    print(f"{paths.shown(page)}; consoles of the guests: {paths.shown(GUESTS)}")


def _fly_lockstep(names: list[str], side_m: float, board: Board) -> None:
    every = (*plans(side_m), *over_the_air(side_m), *secured(side_m))
    there = {plan.name: plan for plan in every if plan.air_loss is not None}
    names = names or [lockstep.DEFAULT]
    if others := [name for name in chosen(names, there) if name not in there]:
        raise UserError(f"{', '.join(others)}: guests in lock-step run {', '.join(there)}, over the air")
    to_fly = [there[name] for name in chosen(names, there)]
    shutil.rmtree(LOCKSTEP, ignore_errors=True)
    flown = {plan.title: lockstep.fly(plan, board, LOCKSTEP / plan.name) for plan in to_fly}
    page = report.write(flown, paths.BUILD / "reports", "lockstep", lockstep.HOW)
    print(f"{paths.shown(page)}; consoles of the guests: {paths.shown(LOCKSTEP)}")


def crowds(most: int, board: Board) -> None:
    """Measure these many robots and fewer."""
    sizes = [size for size in crowd.SIZES if size <= most]
    if not sizes:
        raise UserError(f"{most} robots: give {', '.join(map(str, crowd.SIZES))}, and all up to that are measured")
    shutil.rmtree(CROWD, ignore_errors=True)
    measured = []
    for size in sizes:
        with progress.step(f"{size} robots, {crowd.SECONDS:g} virtual seconds"):
            measured.append(crowd.measure(size, board, CROWD / str(size)))
    for found in measured:
        percentiles = found.latency.percentiles_us
        print(
            f"{found.robots:3} robots, {found.loops} loops: {found.lost} of {found.steps} steps lost; four hops: "
            f"median {percentiles['50']} µs, 99.9 % {percentiles['99.9']}, max {found.latency.max_us}"
        )
    print(paths.shown(report.write_crowds(measured, paths.BUILD / "reports")))


def accept(_: argparse.Namespace) -> None:
    gate.accept(gate.latencies(_flown(plans(TESTED_SIDE_M), _board(None))))
    print(f"{paths.shown(gate.BASELINE)} has the latencies of these scenarios; commit it")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flights", nargs="*", help=f"names ({DEFAULT}), or {ALL}")
    parser.add_argument(
        "--side",
        type=float,
        default=TESTED_SIDE_M,
        metavar="M",
        help="side of the square (%(default)s m)",
    )
    real = parser.add_argument("--guests", action="store_true", help="in real time, by guests of the card images")
    virtual_time = parser.add_argument(
        "--lockstep", action="store_true", help="in virtual time, a guest for each computer"
    )
    variable(real, "ON", value="guests")
    variable(virtual_time, "ON", value="lockstep")
    parser.add_argument(
        "--link",
        choices=tuple(guests.HOW),
        default="ethernet",
        help="of guests (%(default)s); in virtual time it is ibss",
    )
    parser.add_argument("--robots", type=int, metavar="N", help="instead, latency and loss with up to so many robots")
    parser.add_argument("--board", help="of the computers, a name in the inventory (the scenario's own)")


def run(arguments: argparse.Namespace) -> None:
    if not 0.01 <= arguments.side <= 10:
        raise UserError(f"--side {arguments.side:g}: is not from 0.01 to 10 m")
    if arguments.robots is not None:
        crowds(arguments.robots, _board(arguments.board))
    else:
        board = _board(arguments.board)
        if arguments.lockstep:
            _fly_lockstep(arguments.flights, arguments.side, board)
        elif arguments.guests:
            _fly_guests(arguments.flights, arguments.side, board, arguments.link)
        else:
            _fly(arguments.flights, arguments.side, board)
