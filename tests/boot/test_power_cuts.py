"""Every power cut that can meet an update, by replay: no bricks, no wrong releases; and mistakes, which are found.

What writes the card is the robot's own: GRUB in QEMU, flotilla-slot and update.py on this computer.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest

from flotilla.debian.tools import Tools
from flotilla.fleet import inventory
from flotilla.fleet.model import Board, Fleet
from flotilla.lab.power_cuts import command, layout_1, scenario
from flotilla.lab.power_cuts.replay import Recording, Verdict, replay
from tests.figures import PROPERTY

ROBOT = 3
MIB = 8
NIGHTLY_MIB = 16


@pytest.fixture(scope="module")
def board(fleet: Fleet) -> Board:
    return fleet.boards[inventory.robot(fleet, ROBOT).board]


@pytest.fixture(scope="module")
def toolset() -> Tools:
    return command.builder_tools()


@pytest.fixture(scope="module")
def flotilla_slot(flotilla_run: Path) -> Path:
    return flotilla_run.with_name("flotilla-slot")


@pytest.fixture(scope="module")
def update(board: Board, toolset: Tools, flotilla_slot: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One update, interrupted, resumed, tried and confirmed."""
    directory = tmp_path_factory.mktemp("update")
    return scenario.update(board, toolset, directory, flotilla_slot, mib=MIB)


def first_alone(mistakes: tuple[str, ...]) -> list[Any]:
    """The first one each time, the others nightly."""
    return [mistakes[0], *(pytest.param(mistake, marks=pytest.mark.nightly) for mistake in mistakes[1:])]


def sound(verdict: Verdict) -> None:
    assert not verdict.bricks, command.describe("bricks", verdict)
    assert not verdict.wrong, command.describe("wrong releases", verdict)
    assert not verdict.ungrouped, command.describe("grouping", verdict)


def test_no_cut_of_an_update_bricks_or_starts_a_wrong_release(
    board: Board, update: Recording, session_artefacts: Path, record_property: Callable[[str, object], None]
) -> None:
    """Failed with each of the mistakes below."""
    verdict = replay(board, update, session_artefacts / "power-cuts", sample=command.SAMPLE)
    record_property(PROPERTY, f"power cuts of an update: {verdict.states} states, {verdict.groups} groups")
    sound(verdict)
    assert verdict.states >= 1500
    assert {"old in A", "new in B"} == set(verdict.started), "both releases are started, in some states each"


@pytest.mark.parametrize("mistake", first_alone(get_args(layout_1.Mistake)))
def test_mistakes_of_the_first_layout_are_found(
    board: Board, toolset: Tools, tmp_path: Path, session_artefacts: Path, mistake: layout_1.Mistake
) -> None:
    """What robots had before there were updates: the negative control of the test above."""
    recording = scenario.earlier(board, toolset, tmp_path, mistake)
    place = session_artefacts / f"power-cuts-{mistake.replace(' ', '-')}"
    assert not replay(board, recording, place, to_the_end=False).sound


@pytest.mark.parametrize("mistake", first_alone(tuple(scenario.MISTAKES)))
def test_mistakes_of_programs_are_found(board: Board, update: Recording, session_artefacts: Path, mistake: str) -> None:
    """The recording of an update that passes, but for one thing: the negative control of the test above."""
    recording = scenario.MISTAKES[mistake](update)
    place = session_artefacts / f"power-cuts-{mistake.replace(' ', '-')}"
    assert not replay(board, recording, place, to_the_end=False).sound


@pytest.mark.nightly
def test_no_cut_in_the_life_of_a_robot_bricks_or_starts_a_wrong_release(
    board: Board, toolset: Tools, flotilla_slot: Path, tmp_path: Path, session_artefacts: Path,
    record_property: Callable[[str, object], None],
) -> None:  # fmt: skip
    """Two updates, the second of which fails its first trial: 20,000 states. Seen to fail as the short one."""
    recording = scenario.life(board, toolset, tmp_path, flotilla_slot, mib=NIGHTLY_MIB)
    verdict = replay(board, recording, session_artefacts / "power-cuts-life", sample=command.SAMPLE)
    record_property(PROPERTY, f"power cuts in a life: {verdict.states} states, {verdict.groups} groups")
    sound(verdict)
    assert verdict.states >= 20_000
