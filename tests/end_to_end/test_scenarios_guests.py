"""The robot is flown by four guests of their card images in real time, and is safe when they lose each other.

In order, on guests that boot once for each link and transport; each test leaves the robot under control. Times are the
plant's, which are the robot's own, so a slow host flies more slowly; what it adds to the hops is in the error all the
same, so it should have nothing else to do. Exact figures are those of virtual time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import pytest

from flotilla.lab.qemu.radio_segment import RadioSegment
from flotilla.lab.scenarios import guests, virtual
from flotilla.lab.scenarios.guests import GuestFleet
from flotilla.lab.scenarios.plans import TESTED_SIDE_M

pytestmark = pytest.mark.nightly

# Bounds, stated before the flight and the same for both transports, by what a trial with the published laboratory's
# later robots gave: the same RMS, and three times its 0.65° of heading.
RMS_M = 0.019
HEADING_RAD = math.radians(2)
SPIN = (0.0, 0.0, 0.5)
"""Thrusters need two seconds to stop it."""
LIMIT_S = 300


# DDS over the emulated adapters of four guests is more than two processors can: half of the steps were lost, and four
# hops took 130 ms. test_scenarios.py flies that in virtual time.
FLOWN = [each for each in itertools.product(guests.HOW, guests.FLIGHTS) if each != ("ibss", "dds")]


@pytest.fixture(scope="module", params=FLOWN, ids="-".join)
def lab(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuestFleet]:
    link, transport = request.param
    plan = virtual.square(transport, "the square", TESTED_SIDE_M, transport=transport)
    with guests.guest_fleet(plan, tmp_path_factory.mktemp("flights"), link=link) as lab:
        yield lab


def connect(lab: GuestFleet, name: str, *, connected: bool) -> None:
    """Pull a robot's cable or put it back; on the air, take it out of the others' range."""
    if isinstance(lab.segment, RadioSegment):
        lab.segment.air.reach(name, reached=connected)
    else:
        lab.machines[name].cable(plugged=connected)


def stopped(lab: GuestFleet) -> bool:
    return abs(lab.robot.velocity[2]) < 0.05


def drifts(lab: GuestFleet) -> None:
    """Valves are closed, and nothing turns the robot faster or slower."""
    assert lab.robot.board.wait_relays(on=False, timeout=LIMIT_S)
    lab.pass_time(1, LIMIT_S)  # a command that was late had closed them for a moment
    rate = lab.robot.velocity[2]
    lab.pass_time(3, LIMIT_S)
    assert lab.robot.velocity[2] == rate
    assert not stopped(lab), "it was stopped before, and this shows nothing"


def test_the_square_is_flown(lab: GuestFleet) -> None:
    """Seen to fail with other work beside it: by UDP, RMS 22 mm, with a whole test run; by DDS with six busy programs,
    when a tenth of all commands was good."""
    lab.begin()
    lab.until(lambda: lab.done, LIMIT_S)
    flight = lab.flight()
    error, latency = flight.error(), flight.latency()
    print(f"RMS {error.rms_m * 1000:.1f} mm, heading within {math.degrees(error.max_heading_rad):.2f}°")
    print(f"lost {flight.lost()} of {len(flight.arrived)}; four hops: {latency.percentiles_us} µs")
    assert error.rms_m <= RMS_M
    assert error.max_heading_rad <= HEADING_RAD


def test_a_cut_link_closes_open_valves_until_it_is_back(lab: GuestFleet) -> None:
    """The published third test. Seen to fail, valves open, with a time-out of a minute."""
    lab.begin(SPIN)
    assert lab.robot.board.wait_relays(on=True, timeout=LIMIT_S)
    connect(lab, "robot1", connected=False)
    drifts(lab)
    connect(lab, "robot1", connected=True)
    lab.until(lambda: stopped(lab), LIMIT_S)


def test_a_computer_without_power_is_missed_until_it_has_booted(lab: GuestFleet) -> None:
    """Thruster mapping's. Nobody has to help when it is back."""
    lab.begin(SPIN)
    assert lab.robot.board.wait_relays(on=True, timeout=LIMIT_S)
    lab.machines["robot4"].cut()
    drifts(lab)
    lab.machines["robot4"].on()
    lab.until(lambda: stopped(lab), LIMIT_S)
