"""Command line: `python -m tests.scenarios`, called by `make scenarios`."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence

from images.builder import inventory, paths, progress
from images.builder.errors import UserError, exit_status
from tests.scenarios import gate, report, virtual
from tests.scenarios.flight import Flight
from tests.scenarios.plans import SIDE_M, TESTED_SIDE_M, plans
from tests.scenarios.virtual import Plan

OUT = paths.BUILD / "scenarios"


def _flown(chosen: Sequence[Plan]) -> dict[str, Flight]:
    shutil.rmtree(OUT, ignore_errors=True)
    board = inventory.load_fleet().boards["smartcoret3"].model_copy(update={"kernel": "lean"})
    with progress.step(f"{len(chosen)} flights, {sum(plan.seconds for plan in chosen):g} virtual seconds"):
        return {name: Flight(directory) for name, directory in virtual.fly(chosen, board, OUT).items()}


def _fly(names: list[str], side_m: float) -> None:
    if not 0.01 <= side_m <= 10:
        raise UserError(f"--side {side_m:g}: is not from 0.01 to 10 m")
    there = {plan.name: plan for plan in plans(side_m)}
    for name in names:
        if name not in there:
            raise UserError(f"{name}: there is no such flight; there are {', '.join(there)}")
    chosen = [there[name] for name in names or there]
    flown = _flown(chosen)
    page = report.write({there[name].title: flight for name, flight in flown.items()}, paths.BUILD / "reports")
    print(f"{paths.shown(page)}; what each task said and recorded: {paths.shown(OUT)}/flights")


def _accept() -> None:
    gate.accept(gate.latencies(_flown(plans(TESTED_SIDE_M))))
    print(f"{paths.shown(gate.BASELINE)} has the hops of these flights; commit it")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.scenarios", description="Flights in virtual time.")
    parser.add_argument("flights", nargs="*", help="names; without, all")
    parser.add_argument("--side", type=float, default=SIDE_M, metavar="M", help="of the square (%(default)s m)")
    parser.add_argument("--accept", action="store_true", help="fly as the tests do, and accept the hops' latencies")
    arguments = parser.parse_args()
    return exit_status(_accept if arguments.accept else lambda: _fly(arguments.flights, arguments.side))


if __name__ == "__main__":
    sys.exit(main())
