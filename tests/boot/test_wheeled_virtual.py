"""The wheeled robot in virtual time: the shipped system with the tasks, drivers, CAN bus and scanner of its inventory.

Every figure repeats to the byte, so it is judged: distances that are left, times to rest, jitter, load of the bus.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from flotilla.lab.scenarios.flight import Record
from flotilla.lab.wheeled import guest, virtual
from flotilla.lab.wheeled.by_wires import fleet
from flotilla.lab.wheeled.plant import BITRATE
from flotilla.lab.wheeled.virtual import BOOM_RAD, COURSE, OPERATORS, SILENT_S, TOWARDS_S, TROUBLES, Driven

JITTER_NS = 60_000
"""Of either task. Seen to fail with 8 ns an instruction, where plant and robot want more than the whole processor."""
LEFT_M = (0.105, 0.2)
"""Before a wall that it runs at from 0.5 m/s: 5 cm around it and the margin of 6 cm, less the noise of a scan."""
DEAD_MAN_S = 1.0
"""From the last command to rest: 0.3 s until it is missed, 0.5 s to brake from 0.5 m/s."""
STOPS_S = 0.8
"""From a trouble to rest at 0.3 m/s: 0.25 s to 0.3 s until it is noticed."""

ROLLS_S = 2.2
"""The same where a wheel's motor is without power."""


@pytest.fixture(scope="module")
def driven(session_artefacts: Path) -> dict[str, Driven]:
    return virtual.drive([COURSE, TROUBLES, OPERATORS], fleet().board(), session_artefacts / "wheeled")


@pytest.fixture
def course(driven: dict[str, Driven]) -> Driven:
    return driven[COURSE.name]


@pytest.fixture
def troubles(driven: dict[str, Driven]) -> Driven:
    return driven[TROUBLES.name]


@pytest.fixture
def operators(driven: dict[str, Driven]) -> Driven:
    return driven[OPERATORS.name]


def at_rest(record: Record) -> bool:
    speed, rate = record["motion"]
    return math.fabs(speed) < 0.01 and math.fabs(rate) < 0.02


def rests(driven: Driven, begin_s: float, within_s: float, until_s: float) -> None:
    """It moved at `begin_s`, and from so long after on it rests."""
    assert not at_rest(driven.between(begin_s - 0.1, begin_s)[-1]), "it did not move before"
    moving = [record for record in driven.between(begin_s, until_s) if not at_rest(record)]
    needed_s = driven.at_s(moving[-1]) - begin_s
    print(f"at rest {needed_s:.2f} s after {begin_s:g} s")
    assert needed_s < within_s


def said(log: str, *parts: str) -> bool:
    """A line of the journal has all of these."""
    return any(all(part in line for part in parts) for line in log.splitlines())


def test_it_is_driven_by_a_station(course: Driven) -> None:
    """A report in each tenth of a second; wheels on the floor and odometry agree; the boom is out."""
    assert set(course.statuses.values()) == {0}
    reports = course.told(1, COURSE.seconds - 0.5)
    assert len(reports) >= 10 * (COURSE.seconds - 1.5) - 2
    last, there = reports[-1], course.plant[-1]
    error = max(abs(last["pose"][axis] - there["pose"][axis]) for axis in (0, 1))
    print(f"odometry off by {1e3 * error:.0f} mm at {there['pose'][0]:.2f}, {there['pose'][1]:.2f} m")
    assert error < 0.05
    assert last["boom"] == pytest.approx(0.1, abs=0.001)
    curve = course.told(7, 8)
    turned = curve[-1]["pose"][2] - curve[0]["pose"][2]
    assert turned / (course.at_s(curve[-1]) - course.at_s(curve[0])) == pytest.approx(0.3, abs=0.02)
    assert all(report["lost"] == 0 for report in reports)


def test_it_reports_the_motion_that_it_has(course: Driven) -> None:
    """In a curve, from the positions of two drives whose answers come apart; `obstacle-stop` goes by it."""
    reported = [report["motion"] for report in course.told(7, 7.9)]
    print(f"reported in the curve: {reported}")
    assert len(reported) == 9
    for motion in reported:
        assert motion == pytest.approx((0.3, 0.3), rel=0.1)


def test_the_boom_finds_its_home_while_the_robot_drives(course: Driven) -> None:
    """It is out at first, goes to its end stop, 1 mm away from it, and then as it is told."""
    assert course.plant[0]["position"][2] == pytest.approx(BOOM_RAD, abs=0.01)
    (searching,) = course.told(4.5, 4.59)
    assert not searching["boom_enabled"]
    assert searching["left"]
    assert searching["right"]
    assert searching["motion"][0] > 0.3
    assert min(record["position"][2] for record in course.between(3, 8)) < 0.05
    assert course.told(8, 8.2)[0]["boom_enabled"]
    assert course.plant[-1]["position"][2] == pytest.approx(2 * math.pi * (0.1 + 0.001) / 0.01, abs=0.2)
    begin = next(record for record in course.plant if record["powered"][2])
    end = next(report for report in course.reports if report["boom_enabled"])
    print(f"home {course.at_s(end) - course.at_s(begin):.1f} s after its power, from {BOOM_RAD:g} rad")


def test_a_boom_without_its_home_stays_off(troubles: Driven) -> None:
    """And the robot drives. It is tried again when the motors are switched on again."""
    assert said(troubles.logs["drive"], "drive 3", "home failed")
    (report,) = troubles.told(5, 5.09)
    assert not report["boom_enabled"]
    assert not at_rest(troubles.between(5, 6)[-1])
    assert not any(record["powered"][2] for record in troubles.between(4, 16))
    assert troubles.told(19, 19.2)[0]["boom_enabled"]


def test_it_stops_before_a_wall(course: Driven) -> None:
    """Whatever the station commands."""
    begin_s, end_s = TOWARDS_S
    towards = course.between(begin_s, end_s)
    assert max(record["motion"][0] for record in towards) > 0.49
    assert at_rest(towards[-1])
    left = towards[-1]["least"]
    print(f"{1e3 * left:.1f} mm left")
    assert LEFT_M[0] < left < LEFT_M[1]
    assert course.told(end_s - 0.2, end_s)[0]["limited"]
    assert course.plant[-1]["contacts"] == 0


def test_it_stops_when_commands_cease(course: Driven) -> None:
    rests(course, SILENT_S, DEAD_MAN_S, COURSE.seconds)
    assert not course.reports[-1]["alive"]
    assert course.reports[-1]["command_age"] > 1


@pytest.mark.parametrize("task", virtual.TASKS)
def test_steps_are_on_time(driven: dict[str, Driven], task: str) -> None:
    """With all devices, and while they fail."""
    for name, each in driven.items():
        found = each.statistics[task]
        print(f"{name}: {task}: jitter {found['jitter']['max_ns'] / 1e3} µs, step {found['step']['max_ns'] / 1e3} µs")
        assert found["overruns"] == 0
        assert found["jitter"]["max_ns"] < JITTER_NS


def busiest(records: Sequence[Record]) -> float:
    """The greatest share of the bus in a tenth of a second."""
    shares: list[float] = [
        (after["bits"] - before["bits"]) / BITRATE / ((after["time_ns"] - before["time_ns"]) / 1e9)
        for before, after in zip(records, records[10:], strict=False)
    ]
    return max(shares)


def test_three_drives_need_less_than_half_of_the_bus(course: Driven) -> None:
    """At 100 Hz, with all stuff bits that there may be."""
    running = course.between(4, COURSE.seconds)
    share = busiest(running)
    frames = (running[-1]["frames"] - running[0]["frames"]) / (course.at_s(running[-1]) - course.at_s(running[0]))
    print(f"{100 * share:.1f} % of the bus, {frames:.0f} frames a second")
    assert frames > 3 * 4 * 100, "a command and three answers of each drive"
    assert share < 0.5
    assert running[-1]["unsent"] == 0


def test_without_its_scanner_it_stops_and_goes_on_with_it(troubles: Driven) -> None:
    rests(troubles, 7, STOPS_S, 10)
    assert not any(report["seeing"] for report in troubles.told(8, 10))
    assert said(troubles.logs["perceive"], "laser", "is gone")
    assert not at_rest(troubles.between(12, 13)[-1]), "it does not go on"


def test_a_drive_that_faults_stops_both_wheels(troubles: Driven) -> None:
    """Until the station has switched the motors off and on."""
    rests(troubles, 13, STOPS_S, 17.5)
    (report,) = troubles.told(14, 14.1)
    assert (report["left"], report["left_error"]) == (False, 0x2310)
    assert said(troubles.logs["drive"], "drive 1 has a fault", "2310")
    assert not at_rest(troubles.between(19, 20)[-1]), "it does not go on"
    assert troubles.told(19, 19.2)[0]["left_error"] == 0


def test_without_its_bus_it_stops(troubles: Driven) -> None:
    """Drives that hear nothing stop by themselves. It goes on after the motors were switched off and on."""
    rests(troubles, 20, STOPS_S, 25.5)
    assert said(troubles.logs["drive"], "can0", "down")
    assert not at_rest(troubles.between(28, 29)[-1]), "it does not go on"
    assert troubles.plant[-1]["contacts"] == 0


def test_with_its_controller_bus_off_it_stops(troubles: Driven) -> None:
    """By what its driver reports, and drives that hear nothing; with a restart it goes on, as after any loss.

    The reports are made by us: QEMU's controllers have no error counters.
    """
    rests(troubles, 29, STOPS_S, 33)
    assert said(troubles.logs["drive"], "can0", "bus-off")
    assert not any(report["left"] or report["right"] for report in troubles.told(29.5, 31))
    assert not at_rest(troubles.between(35, 36)[-1]), "it does not go on"


def test_a_drive_that_loses_its_power_stops_both_wheels(troubles: Driven) -> None:
    """The other one brakes; its own brakes nothing, and rolls out. It is configured again by itself; its motor is on
    after the motors were switched off and on."""
    rests(troubles, 36, ROLLS_S, 40.9)
    assert said(troubles.logs["drive"], "drive 2", "no heartbeat")
    assert not any(report["right"] for report in troubles.told(36.5, 39.5))
    assert not at_rest(troubles.between(42, 43)[-1]), "it does not go on"
    assert troubles.told(42, 42.2)[0]["right"]


def test_it_stops_while_a_second_operator_commands(operators: Driven) -> None:
    """And names both, until 1 s after the second one's last command; its boom does not move. Then it goes on."""
    rests(operators, 5, STOPS_S, 6.8)
    for report in operators.told(5.2, 6.8):
        told = {name: report[name] for name in ("alive", "conflict", "operator", "other")}
        assert told == {"alive": False, "conflict": True, "operator": guest.OPERATOR, "other": guest.SECOND}
    assert not at_rest(operators.between(7.8, 8)[-1]), "it does not go on"
    assert not operators.told(7.5, 8)[-1]["conflict"]
    assert max(report["boom"] for report in operators.reports) == pytest.approx(0, abs=0.001)


def test_rubbish_stops_it_and_moves_nothing(operators: Driven) -> None:
    """Of the right length it may be a second operator's."""
    rests(operators, 8, STOPS_S, 9.3)
    assert all(report["operator"] in (0, guest.OPERATOR) for report in operators.reports)
    assert not at_rest(operators.between(10, 10.2)[-1]), "it does not go on"


def test_a_flood_of_commands_stops_it(operators: Driven) -> None:
    """500 a second are more than it reads: what has waited for longer than the dead man's switch allows moves nothing.
    It goes on when the queue is empty."""
    rests(operators, 10.4, DEAD_MAN_S, 12)
    assert max(report["command_age"] for report in operators.told(10.8, 13)) > 0.5
    last = operators.reports[-1]
    assert (last["alive"], last["conflict"], last["refused"]) == (True, False, 0)
    assert not at_rest(operators.plant[-1]), "it does not go on"
    assert operators.plant[-1]["contacts"] == 0


@pytest.mark.nightly  # each time, latencies repeat
def test_a_drive_repeats_to_the_byte(driven: dict[str, Driven], artefacts: Path) -> None:
    again = virtual.drive([COURSE, TROUBLES, OPERATORS], fleet().board(), artefacts / "wheeled")
    assert again == driven
