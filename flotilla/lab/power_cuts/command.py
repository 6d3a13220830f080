"""What `make power-cuts` does: life of a robot recorded and replayed, and mistakes that have to be found."""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import pool, tools
from flotilla.debian.lock import read_lock
from flotilla.debian.tools import Tools
from flotilla.fleet import inventory
from flotilla.fleet.model import Board
from flotilla.lab.power_cuts import layout_1, scenario
from flotilla.lab.power_cuts.replay import Recording, Verdict, replay

DIRECTORY = paths.BUILD / "power-cuts"
REPORT = paths.BUILD / "reports" / "power-cuts.txt"
MIB = 16
"""Size of the releases: some 20,000 states."""
SAMPLE = 0.01
"""Share of the states that are also started by themselves."""
GUEST_PER_CUT = 20
GUEST_SAMPLE = 0.002
"""The same for recordings of a whole system, of which a start takes several times as long."""
_MOST = 20
"""Faults that the report names."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--board", help="of the inventory; by default the first robot's")
    parser.add_argument(
        "--mib", type=int, default=MIB, help=f"size of the releases in MiB: more of it, more states (default: {MIB})"
    )


def run(given: argparse.Namespace) -> None:
    if given.mib < 1:
        raise UserError(f"--mib {given.mib}: a release has at least 1 MiB; more make more states, 16 some 20,000")
    board = inventory.load_fleet().board(given.board)
    toolset = builder_tools()
    recording = scenario.life(board, toolset, DIRECTORY / "life", flotilla_slot(), mib=given.mib)
    verdict = replay(board, recording, DIRECTORY / "replay", sample=SAMPLE)
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    missed = []
    lines = [describe("life of a robot", verdict)]
    for name, mistaken in mistakes(board, toolset, DIRECTORY, recording):
        found = replay(board, mistaken, DIRECTORY / "mistakes" / name.replace(" ", "-"), to_the_end=False)
        lines.append(describe(f"mistake: {name}", found))
        missed += [name] if found.sound else []
    REPORT.write_text("\n".join(lines))
    print(REPORT.read_text() + paths.shown(REPORT))
    if not verdict.sound:
        raise UserError(
            f"power cuts leave {len(verdict.bricks)} bricks and start {len(verdict.wrong)} wrong releases, "
            f"{len(verdict.ungrouped)} faults of the grouping; see {paths.shown(REPORT)}"
        )
    if missed:
        raise UserError(f"the replay did not find the mistakes that it must find: {', '.join(missed)}")


def mistakes(board: Board, tools: Tools, directory: Path, life: Recording) -> Iterator[tuple[str, Recording]]:
    """All that the replay has to find out, by name."""
    for mistake in get_args(layout_1.Mistake):
        yield mistake, scenario.earlier(board, tools, directory / mistake.replace(" ", "-"), mistake)
    for name, change in scenario.MISTAKES.items():
        yield name, change(life)


def describe(name: str, verdict: Verdict) -> str:
    """A verdict in words."""
    started = ", ".join(f"{release}: {states}" for release, states in sorted(verdict.started.items()))
    faults = [*verdict.bricks[:_MOST], *verdict.wrong[:_MOST], *verdict.ungrouped[:_MOST]]
    lines = [
        f"{name}: {verdict.states} states in {verdict.groups} groups, {verdict.power_ons} power-ons, "
        f"{verdict.sampled} states by themselves: "
        f"{len(verdict.bricks)} bricks, {len(verdict.wrong)} wrong releases",
        f"    states by the slot that started: {started}",
        *(f"    {fault}" for fault in faults),
    ]
    return "".join(f"{line}\n" for line in lines)


def builder_tools() -> Tools:
    """The build tools, which the cards of this replay are made with."""
    lock = read_lock("tools")
    pool.fill([lock])
    return Tools(tools.tree(lock), lock.epoch)


def flotilla_slot() -> Path:
    """The robot's program, built for this computer."""
    with progress.step("runtime for this computer"):
        done = subprocess.run(
            ["make", "-C", str(paths.PROJECT), "runtime"], capture_output=True, text=True, check=False
        )
    if done.returncode:
        raise UserError(f"make runtime failed: {done.stderr.strip()}")
    return paths.BUILD / "runtime" / "flotilla-slot"
