"""The floating robot flies with the default kernel of its board. `test_scenarios.py` has all flights, with our own
kernel."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.fleet.model import Fleet
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.flight import Flight
from flotilla.lab.scenarios.plans import plans
from tests.end_to_end.test_scenarios import ends_in_a_drift, hops_are_in_time, spins, square_is_flown, valves_were_open

SIDE_M = 0.02
NAMES = ("udp", "cut-open", "cut-open-no-timeout")


@pytest.fixture(scope="module")
def flown(fleet: Fleet, session_artefacts: Path) -> dict[str, Flight]:
    chosen = [plan for plan in plans(SIDE_M) if plan.name in NAMES]
    directories = virtual.fly(chosen, fleet.board(), session_artefacts / "flight")
    return {name: Flight.read(directory) for name, directory in directories.items()}


def test_the_square_is_flown_and_no_message_is_late(flown: dict[str, Flight]) -> None:
    square_is_flown("udp", flown["udp"], SIDE_M)
    hops_are_in_time("udp", flown["udp"])


def test_a_cut_link_closes_the_valves(flown: dict[str, Flight]) -> None:
    """By the time-out: without it, the robot spins."""
    valves_were_open(flown["cut-open"])
    ends_in_a_drift("cut-open", flown["cut-open"])
    spins(flown["cut-open-no-timeout"])
