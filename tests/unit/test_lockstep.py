"""What a flight of guests in lock-step counts, and which flights these fly."""

from __future__ import annotations

import argparse
from typing import Any

import pytest

from flotilla.common.errors import UserError
from flotilla.lab.scenarios import command
from flotilla.lab.scenarios.member import since

BEFORE = {"steps": 100, "overruns": 3, "skipped": 9, "timeouts": 100, "last_overrun": {"ago_s": 0.5}}


def after(ago_s: float | None) -> dict[str, Any]:
    last = None if ago_s is None else {"ago_s": ago_s}
    return {"steps": 1400, "overruns": 4, "skipped": 11, "timeouts": 105, "last_overrun": last}


@pytest.mark.parametrize(("ago_s", "overruns", "skipped"), [(9.9, 1, 2), (10.1, 0, 0), (None, 0, 0)])
def test_overruns_before_the_flight_are_not_its(ago_s: float | None, overruns: int, skipped: int) -> None:
    counted = since(BEFORE, after(ago_s), seconds=10)
    assert counted == {"steps": 1300, "timeouts": 5, "overruns": overruns, "skipped": skipped}


def test_flights_of_one_guest_are_refused() -> None:
    parser = argparse.ArgumentParser()
    command.arguments(parser)
    with pytest.raises(UserError, match=r"strangers: guests in lock-step run air, air-1, .* over the air"):
        command.run(parser.parse_args(["--lockstep", "strangers"]))
