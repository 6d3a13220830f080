"""A bad release by `update.yml` on two guests: the first robot goes back, the second one never starts it.

tests/boot/test_bad_releases.py tries the robot each time, tests/boot/test_update_virtual.py the overruns, and
tests/unit/test_health.py the judgement.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.fleet.model import Fleet
from tests.provisioning.test_fleet import Guests
from tests.provisioning.test_update import (
    GOOD,
    NAME,
    ROBOT,
    SECONDS,
    STOP,
    Make,
    boot_of,
    make,
    runs,
    state,
    update,
    with_a_gyro,
)

__all__ = ["make"]

pytestmark = pytest.mark.nightly

OTHER = "robot4"
"""Of the same board; it has no control task."""


@pytest.fixture(scope="module")
def guests(fleet: Fleet, session_artefacts: Path) -> Iterator[Guests]:
    with with_a_gyro(fleet, [ROBOT, 4], session_artefacts / "bad-update") as guests:
        yield guests


def test_a_bad_release_touches_one_robot(guests: Guests, make: Make) -> None:
    """It lacks the driver of a required sensor's port, which is good before and after. Both robots have it on their
    cards then; the second one never starts it.

    Seen to fail where the roll-out's last message does not name the sensor."""
    guests.shells[NAME].script(GOOD, timeout=SECONDS)
    before, boot = runs(guests), boot_of(guests, OTHER)
    required = json.dumps({"health": {"overruns_percent": 100, "required_sensors": ["heading.gyro"]}})
    done = update(guests, make(3, "dead sensor"), *STOP, "-e", required)
    assert done.status != 0
    assert f"{NAME} goes back to its release: {NAME} does not do well" in done.said, done.said
    assert "heading.gyro: its flag is 0" in done.said, done.said
    now = state(guests)
    assert (runs(guests), now["trial"]) == (before, None)
    guests.shells[NAME].script(GOOD, timeout=SECONDS)
    other = state(guests, OTHER)
    assert (boot_of(guests, OTHER), runs(guests, OTHER), other["trial"]) == (boot, ("A", "1"), None)
    assert other["slots"]["B"]["release"] == "3", "it was not even brought there"
    assert f"changed: [{OTHER}]" not in done.said.partition("Robots start it")[2]


def test_a_release_whose_control_overruns_goes_back(guests: Guests, make: Make) -> None:
    """Every second step of its tasks takes longer than a period, which no unit notices. The limit lets pass what a busy
    host does to guests."""
    before, boot = runs(guests), boot_of(guests, OTHER)
    lenient = json.dumps({"health": {"overruns_percent": 25}})
    done = update(guests, make(6, "overruns"), *STOP, "-e", lenient)
    assert done.status != 0
    assert f"{NAME} goes back to its release: {NAME} does not do well" in done.said, done.said
    assert re.search(r"heading: \d+ of the last \d+ steps overran, more than 25 %", done.said), done.said
    now = state(guests)
    assert (runs(guests), now["trial"]) == (before, None)
    other = state(guests, OTHER)
    assert (boot_of(guests, OTHER), runs(guests, OTHER), other["trial"]) == (boot, ("A", "1"), None)
    assert other["slots"]["B"]["release"] == "6", "it was not even brought there"
