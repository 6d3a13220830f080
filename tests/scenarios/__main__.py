"""Command line: `python -m tests.scenarios`, called by `make scenarios`."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence

from images.builder import inventory, paths, progress
from images.builder.errors import UserError, exit_status
from images.builder.fleet import Board
from tests.scenarios import crowd, gate, guests, report, virtual
from tests.scenarios.flight import Flight
from tests.scenarios.plans import SIDE_M, TESTED_SIDE_M, plans, standby
from tests.scenarios.virtual import Plan

OUT = paths.BUILD / "scenarios"
GUESTS = paths.BUILD / "flights"
CROWD = paths.BUILD / "crowd"


def _board() -> Board:
    return inventory.load_fleet().boards["smartcoret3"].model_copy(update={"kernel": "lean"})


def _flown(chosen: Sequence[Plan]) -> dict[str, Flight]:
    shutil.rmtree(OUT, ignore_errors=True)
    board = _board()
    with progress.step(f"{len(chosen)} flights, {sum(plan.seconds for plan in chosen):g} virtual seconds"):
        return {name: Flight.read(directory) for name, directory in virtual.fly(chosen, board, OUT).items()}


def _fly(names: list[str], side_m: float) -> None:
    there = {plan.name: plan for plan in (*plans(side_m), *standby(side_m))}
    for name in names:
        if name not in there:
            raise UserError(f"{name}: there is no such flight; there are {', '.join(there)}")
    chosen = [there[name] for name in names or there]
    flown = _flown(chosen)
    page = report.write({there[name].title: flight for name, flight in flown.items()}, paths.BUILD / "reports")
    print(f"{paths.shown(page)}; what each task said and recorded: {paths.shown(OUT)}/flights")
    faults = [
        f"{there[name].title}: {fault}"
        for name, flight in flown.items()
        for fault in flight.faults(disturbed=there[name].disturbed)
    ]
    if faults:
        raise UserError("\n".join(faults))


def _fly_guests(names: list[str], side_m: float) -> None:
    there = {plan.name: plan for plan in plans(side_m) if plan.name in guests.FLIGHTS}
    if others := [name for name in names if name not in there]:
        raise UserError(f"{', '.join(others)}: guests fly {', '.join(there)}; all else is for virtual time")
    shutil.rmtree(GUESTS, ignore_errors=True)
    chosen = [there[name] for name in names or there]
    flown = {plan.title: guests.fly(plan, GUESTS / plan.name) for plan in chosen}
    page = report.write(flown, paths.BUILD / "reports", "flights", guests.HOW)
    print(f"{paths.shown(page)}; consoles of the guests: {paths.shown(GUESTS)}")


def crowds(most: int) -> None:
    """Measure these many robots and fewer."""
    sizes = [size for size in crowd.SIZES if size <= most]
    if not sizes:
        raise UserError(f"{most} robots: give {', '.join(map(str, crowd.SIZES))}, and all up to that are measured")
    shutil.rmtree(CROWD, ignore_errors=True)
    measured = []
    for size in sizes:
        with progress.step(f"{size} robots, {crowd.SECONDS:g} virtual seconds"):
            measured.append(crowd.measure(size, _board(), CROWD / str(size)))
    for found in measured:
        percentiles = found.latency.percentiles_us
        print(
            f"{found.robots:3} robots, {found.loops} loops: {found.lost} of {found.steps} steps lost; four hops: "
            f"median {percentiles['50']} µs, 99.9 % {percentiles['99.9']}, max {found.latency.max_us}"
        )
    print(paths.shown(report.write_crowds(measured, paths.BUILD / "reports")))


def _accept() -> None:
    gate.accept(gate.latencies(_flown(plans(TESTED_SIDE_M))))
    print(f"{paths.shown(gate.BASELINE)} has the hops of these flights; commit it")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.scenarios", description="A robot flown by four computers.")
    parser.add_argument("flights", nargs="*", help="names; without, all")
    parser.add_argument("--side", type=float, default=SIDE_M, metavar="M", help="of the square (%(default)s m)")
    parser.add_argument("--guests", action="store_true", help="in real time, by guests of the card images")
    parser.add_argument("--robots", type=int, metavar="N", help="instead, latency and loss with up to so many robots")
    parser.add_argument("--accept", action="store_true", help="fly as the tests do, and accept the hops' latencies")
    arguments = parser.parse_args()

    def work() -> None:
        if not 0.01 <= arguments.side <= 10:
            raise UserError(f"--side {arguments.side:g}: is not from 0.01 to 10 m")
        if arguments.accept:
            _accept()
        elif arguments.robots is not None:
            crowds(arguments.robots)
        else:
            (_fly_guests if arguments.guests else _fly)(arguments.flights, arguments.side)

    return exit_status(work)


if __name__ == "__main__":
    sys.exit(main())
