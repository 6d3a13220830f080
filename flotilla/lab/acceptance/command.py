"""`make accept ROBOT=3`: one command that says whether a robot is what its board's file asks."""

from __future__ import annotations

import argparse
import sys
from typing import get_args

from flotilla.cli.command import robot_argument
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.lab.acceptance import checks, facts, outcome, report
from flotilla.lab.latency import target
from flotilla.lab.qemu.timing import LabError


def run(arguments: argparse.Namespace) -> None:
    if arguments.relays and not sys.stdin.isatty():
        raise UserError("RELAYS=1 asks whoever watches the relays: run it on a terminal")
    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    others = list(outcome.of_board(robot.board))  # one that is not as it was signed is said before the hour, not after
    out = paths.BUILD / "latency" / f"{robot.name}-accept"
    try:
        with target.connect(robot) as shell:
            plan = None if arguments.plan == "none" else arguments.plan
            found = facts.ask(
                fleet, robot, shell, out, plan=plan, seconds=arguments.seconds, bite=arguments.watchdog,
                person=_person if arguments.relays else None,
            )  # fmt: skip
    except LabError as error:
        raise UserError(f"{robot.name}: {error}; is it on and reachable? `make ssh ROBOT={robot.number}`") from error
    made = checks.judge(fleet, robot, found, arguments.plan)
    file = outcome.write(made)
    page = report.write(made, others)
    print(said(made))
    print(f"{paths.shown(page)}: the report; {paths.shown(file)}: its figures, signed by the operator's key")
    if made.failures:
        raise UserError(f"{robot.name} is not accepted: {len(made.failures)} of {len(made.outcomes)} checks fail")


def _person(question: str) -> bool:
    """Whoever sits at the terminal."""
    while (answer := input(f"{question} [y/n] ").strip().lower()) not in ("y", "n"):
        pass
    return answer == "y"


def said(made: outcome.Acceptance) -> str:
    """What fails, a line each, and how many of the others hold or were not judged."""
    counts = {state: sum(each.state == state for each in made.outcomes) for state in get_args(outcome.State)}
    lines = [f"fails: {each}" for each in made.failures]
    return "\n".join(
        [*lines, f"{counts['holds']} checks hold, {counts['fails']} fail, {counts['not judged']} not judged"]
    )


def arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    parser.add_argument(
        "--plan", choices=("standard", "quick", "none"), default="standard",
        help="of latency: standard, a minute for each scenario; quick, five seconds for some; none",
    )  # fmt: skip
    parser.add_argument("--seconds", type=int, default=60, help="of each other meter (%(default)s)")
    parser.add_argument("--relays", action="store_true", help="switch each relay, and ask whether it does")
    parser.add_argument("--watchdog", action="store_true", help="hang the computer, for its watchdog to restart it")
