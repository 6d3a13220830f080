"""A floating robot whose control is spread over four computers flies in virtual time, and what happens when it cannot.

The published experiment: navigation, control and thruster mapping on three computers, sensors and valves on a fourth,
100 Hz, everything across the ad hoc network four times within a period; then the link is cut with valves closed (it
drifts) and open (it spun). Most flights are of one guest; `make scenarios` flies the square in its full size.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flotilla.fleet.model import Board
from flotilla.lab.scenarios import gate, report, virtual
from flotilla.lab.scenarios.flight import HOPS, Flight
from flotilla.lab.scenarios.plans import SIDE_M, TESTED_SIDE_M, disturbed, over_the_air, plans, standby
from tests.perturb import perturbed_host

# Bounds, stated before the flight, by what a trial with the published laboratory's later robots gave: RMS 19 mm,
# heading within 0.65°, thrusters 33 s of 400 s.
RMS_M = 0.012
HEADING_RAD = math.radians(1)
VALVES_OPEN_S = 2 * 8 * 10.5 * 0.01 / 0.16
"""Of all valves: twice what starting, turning at corners and stopping take, eight changes of a velocity by 1 cm/s."""
PUBLISHED_VALVES_OPEN_S = 33
"""Over the published square, which is for the most part keeping to its sides: the trial's."""
FIRINGS_PER_S = 5
"""Between chance and a fault: two images of the same parts differ in where these lie in memory, and so by a factor of
two in firings, up to 49 in 12 s; arms of 10 cm lead to 103 and more."""
DIVIDED = {"disorder": 2}
"""By flight, into how many firings a pulse may fall: a command that is late leaves the valve closed in between."""

TIMEOUT_S = 0.15
"""Until valves without good commands are closed: 0.05 s until a message is old, 0.1 s of the relay board's block."""
RECORD_S = 0.05
"""Between two records of the plant."""
TIMEOUT_NS = round((TIMEOUT_S + RECORD_S) * 1e9)

TURN = 0.05
"""At least so often in a period a receiver's messages are forged, for which its nine take turns."""

CONTROL_TASKS = ("sensors", "navigation", "control", "thruster-mapping", "valves")
LATE = 0.15
"""Of steps over the air whose four hops may take longer than the limit."""
HOP_US = 500
"""At least, of a frame of 802.11b at 11 Mbit/s with its ACK: preambles of 192 µs, 10 µs between, 112 µs of ACK."""

HANDOVER_S = 0.0575
"""Between two commands at the valves when another computer takes over: 0.03 s until it is listened to, a period until
it says something then, a period for the four hops, and three quarters because steps without a message are that late."""
RESTART_S = 1.5
"""Until a task that was started is listened to."""

REPEATED = (
    virtual.square("udp", "by UDP", 0.01),
    virtual.square("air", "over the air", 0.01, air_loss=0.05),
    virtual.square("dds", "by DDS", 0.01, transport="dds"),
)


@pytest.fixture(scope="module")
def board() -> Board:
    return virtual.fleet("udp").board().model_copy(update={"kernel": "lean"})


@pytest.fixture(scope="module")
def flown(board: Board, session_artefacts: Path) -> dict[str, Flight]:
    directories = virtual.fly(plans(TESTED_SIDE_M), board, session_artefacts / "scenarios")
    return {name: Flight.read(directory) for name, directory in directories.items()}


@pytest.fixture(scope="module")
def published(board: Board, session_artefacts: Path) -> dict[str, Flight]:
    squares = [plan for plan in plans(SIDE_M) if plan.name in ("udp", "dds")]
    directories = virtual.fly(squares, board, session_artefacts / "published")
    return {name: Flight.read(directory) for name, directory in directories.items()}


@pytest.fixture(scope="module")
def stood_by(board: Board, session_artefacts: Path) -> dict[str, Flight]:
    directories = virtual.fly(standby(TESTED_SIDE_M), board, session_artefacts / "standby")
    return {name: Flight.read(directory) for name, directory in directories.items()}


@pytest.fixture(scope="module")
def rough(board: Board, session_artefacts: Path) -> dict[str, Flight]:
    directories = virtual.fly(disturbed(TESTED_SIDE_M), board, session_artefacts / "disturbed")
    return {name: Flight.read(directory) for name, directory in directories.items()}


@pytest.fixture(scope="module")
def lossy(board: Board, session_artefacts: Path) -> dict[str, Flight]:
    directories = virtual.fly(over_the_air(TESTED_SIDE_M), board, session_artefacts / "over-the-air")
    return {name: Flight.read(directory) for name, directory in directories.items()}


@pytest.fixture(scope="module")
def flights(flown: dict[str, Flight]) -> Callable[[str], Flight]:
    return lambda name: flown[name]


@pytest.mark.parametrize("name", ["udp", "air", "dds", "loss", "strangers"])
def test_the_square_is_flown(flights: Callable[[str], Flight], name: str) -> None:
    """Seen to fail, by the thrusters, with arms of 10 cm: a pulse was more than the controller's dead band."""
    square_is_flown(name, flights(name))


@pytest.mark.nightly  # each time, a tenth is lost and a stranger disturbs
@pytest.mark.parametrize("name", ["disorder", "gaps"])
def test_the_square_is_flown_through_disturbances(rough: dict[str, Flight], name: str) -> None:
    square_is_flown(name, rough[name])
    assert rough[name].faults(disturbed=True) == []


def square_is_flown(name: str, flight: Flight, side_m: float = TESTED_SIDE_M, on_time_s: float = VALVES_OPEN_S) -> None:
    seconds = 4 * side_m / 0.01
    error, thrusters = flight.error(), flight.thrusters()
    print(f"{name}: RMS {error.rms_m * 1000:.1f} mm, at most {error.max_m * 1000:.1f} mm")
    print(f"{name}: heading within {math.degrees(error.max_heading_rad):.2f}°")
    print(f"{name}: thrusters {thrusters.on_time_s:.2f} s, {thrusters.firings} firings")
    assert flight.completed
    assert error.rms_m <= RMS_M
    assert error.max_heading_rad <= HEADING_RAD
    assert thrusters.on_time_s <= on_time_s
    assert thrusters.firings <= FIRINGS_PER_S * seconds * DIVIDED.get(name, 1)


@pytest.mark.parametrize("name", ["udp", "dds"])
def test_four_hops_take_less_than_a_period(flights: Callable[[str], Flight], name: str) -> None:
    """Seen to fail, by DDS, with an announcement to five ports of each computer: 9 steps lost, and as many late; and
    with announcements sent and received by threads of the data's priority: 6 of 3270 late.
    """
    hops_are_in_time(name, flights(name))


def hops_are_in_time(name: str, flight: Flight) -> None:
    for index, hop in enumerate(HOPS):
        latency = flight.hop(index)
        print(f"{name}: {hop}: {latency.min_us} to {latency.max_us} µs, mean {latency.mean_us:.0f}")
    latency = flight.latency()
    print(f"{name}: four hops: {latency.min_us} to {latency.max_us} µs, mean {latency.mean_us:.0f}")
    print(f"{name}: percentiles {latency.percentiles_us}")
    print(f"{name}: {flight.late()} of {latency.samples} late; lost {flight.lost()}")
    assert flight.faults(disturbed=False) == []
    assert flight.lost() == 0


def test_over_the_air_every_step_is_flown(flights: Callable[[str], Flight], session_artefacts: Path) -> None:
    """Four hops take longer by what four frames and their neighbours take on a channel of 802.11b. All eight computers
    are one processor here, so some of them take longer than a period; none is lost, and no task's step is late.

    Seen to fail with frames at 1 Mbit/s, which need more than the whole channel.
    """
    steps_are_flown("air", flights("air"))
    carried = json.loads((session_artefacts / "scenarios/flights/air/air.json").read_text())
    print(f"on the air: {carried}")
    assert carried["frames"] > 4 * len(flights("air").arrived)
    assert carried["lost"] == carried["given_up"] == carried["dropped"] == 0
    assert flights("udp").latency().mean_us + 4 * HOP_US < flights("air").latency().mean_us


def steps_are_flown(name: str, flight: Flight, overruns: int = 0, lost: float = 0) -> None:
    print(f"{name}: percentiles of four hops {flight.latency().percentiles_us} µs")
    print(f"{name}: {flight.late()} of {flight.latency().samples} above the limit; lost {flight.lost()}")
    overran = {task: flight.overruns(task) for task in CONTROL_TASKS}
    print(f"{name}: overruns {overran}")
    assert flight.lost() <= lost * flight.latency().samples
    assert sum(overran.values()) <= overruns
    assert flight.late() < LATE * flight.latency().samples


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["air-1", "air-5", "air-10", "air-dds"])
def test_over_the_air_that_loses_frames(lossy: dict[str, Flight], name: str) -> None:
    """802.11 sends again what was not acknowledged: frames get late, and hardly a step is left out for it."""
    square_is_flown(name, lossy[name])
    steps_are_flown(name, lossy[name], overruns=1, lost=0.002)


@pytest.mark.nightly
def test_a_link_that_is_cut_on_the_air_ends_in_a_drift(lossy: dict[str, Flight]) -> None:
    ends_in_a_drift("air-cut-open", lossy["air-cut-open"])
    valves_were_open(lossy["air-cut-open"])


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["udp", "dds"])
def test_the_published_square(published: dict[str, Flight], name: str) -> None:
    """A side of 1 m, 400 s: DDS programs announce themselves fourteen times meanwhile."""
    square_is_flown(name, published[name], SIDE_M, PUBLISHED_VALVES_OPEN_S)
    hops_are_in_time(name, published[name])


def test_no_message_arrives_before_it_is_sent(flown: dict[str, Flight]) -> None:
    """Late and lost ones included. Seen to fail where an interrupt between two readings made an arrival older: a
    hop of -22 µs in the flight with a stranger."""
    faults = {name: flight.faults(disturbed=True) for name, flight in flown.items()}
    assert not any(faults.values()), faults


def test_hops_are_the_accepted_ones(flown: dict[str, Flight]) -> None:
    """Seen to fail whenever the root or a task changes: then `make scenarios-accept`."""
    gate.check(gate.latencies(flown))


def test_what_the_network_loses_is_lost_and_no_more(flights: Callable[[str], Flight]) -> None:
    """Four hops, each with nine of ten: about two thirds arrive. By the tasks' own account: reports get lost, too."""
    tasks = flights("loss").statistics
    came = tasks["valves"]["steps"] - tasks["valves"]["timeouts"]
    share = 1 - came / tasks["sensors"]["steps"]
    print(f"lost {share:.1%}")
    assert abs(share - (1 - 0.9**4)) < 0.04


@pytest.mark.nightly
def test_a_computer_without_power_closes_the_valves_until_it_is_back(rough: dict[str, Flight]) -> None:
    """Thruster mapping is gone for a second: nothing fires, and nobody has to help when it returns."""
    flight = rough["gaps"]
    off_ns, on_ns, *_ = flight.events_ns
    opened = {record["time_ns"]: sum(record["on_time"]) for record in flight.since(off_ns + TIMEOUT_NS)}
    gone = {opened[time_ns] for time_ns in opened if time_ns < on_ns}
    assert len(gone) == 1
    back_ns = next(time_ns for time_ns in opened if opened[time_ns] not in gone)
    print(f"control resumes {(back_ns - on_ns) / 1e9:.2f} s after the tasks start")


def controllers(flight: Flight) -> list[tuple[int, int]]:
    """Who controls while the path is flown, 0 or the one that stands by, and from when on."""
    found: list[tuple[int, int]] = []
    for record in commands(flight):
        if not found or record["controller"] != found[-1][0]:
            found.append((record["controller"], record["now_ns"]))
    return found


def commands(flight: Flight) -> list[dict[str, Any]]:
    """Those that reached the valves while the path is flown."""
    return [record for record in flight.arrived if record["now_ns"] >= flight.commanded[0]["time_ns"]]


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["standby", "standby-dds"])
def test_another_computer_takes_over_control(stood_by: dict[str, Flight], name: str) -> None:
    """And hands back when the first one is there again, which then goes on alone. Seen to fail by DDS when it returned:
    1.2 s without commands."""
    flight = stood_by[name]
    off_ns, *later_ns = flight.events_ns
    who = controllers(flight)
    assert [number for number, _ in who] == ([0, 1, 0] if later_ns else [0, 1])
    assert who[1][1] <= off_ns + HANDOVER_S * 1e9
    for (_, back_ns), on_ns in zip(who[2:], later_ns, strict=False):
        print(f"{name}: back {(back_ns - on_ns) / 1e9:.2f} s after power on")
        assert 0 < back_ns - on_ns <= RESTART_S * 1e9
    begin_ns = flight.commanded[0]["time_ns"]
    assert all(record["good"] for record in flight.steps if record["now_ns"] >= begin_ns), "valves were to be closed"
    arrived = [record["now_ns"] for record in commands(flight)]
    longest_ns = max(after - before for before, after in itertools.pairwise(arrived))
    print(f"{name}: at most {longest_ns / 1e6:.1f} ms between commands; {flight.lost()} steps lost")
    assert longest_ns <= HANDOVER_S * 1e9
    assert arrived[-1] > flight.events_ns[-1] + 1e9, "the flight ends too early"
    square_is_flown(name, flight)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["standby", "standby-dds"])
def test_who_takes_over_is_at_the_same_point_of_the_path(stood_by: dict[str, Flight], name: str) -> None:
    """Seen to fail with controllers that begin the path by their own clock: the one that came back began anew."""
    commanded = stood_by[name].commanded
    farthest_m = 0.0
    for before, after in itertools.pairwise(commanded):  # by their time and by the robot's, either of which may be old
        seconds = max((after["time_ns"] - before["time_ns"]) / 1e9, 0.01 * (after["number"] - before["number"]))
        farthest_m = max(farthest_m, math.dist(before["wanted"], after["wanted"]) - 0.01 * seconds)
    print(f"{name}: the wanted position is at most {farthest_m * 1000:.2f} mm farther than the speed takes it")
    assert farthest_m < 0.001


@pytest.mark.nightly
def test_without_another_the_robot_coasts(stood_by: dict[str, Flight]) -> None:
    """The negative control: valves are closed all the time, and it leaves the path."""
    flight = stood_by["no-standby"]
    off_ns, on_ns = flight.events_ns
    gone = [record for record in flight.since(off_ns + TIMEOUT_NS) if record["time_ns"] < on_ns]
    assert len(gone) > 50
    assert len({sum(record["on_time"]) for record in gone}) == 1
    there, wanted = flight.pose_at(on_ns), stood_by["standby"].pose_at(stood_by["standby"].events_ns[1])
    distance = math.dist(there[:2], wanted[:2])
    print(f"{distance * 1000:.1f} mm from where it is with another")
    assert distance > 2 * RMS_M
    assert {who for who, _ in controllers(flight)} == {0}


def test_strangers_are_refused_and_counted(flights: Callable[[str], Flight]) -> None:
    """Noise of a command's length among them. Seen to fail with receivers that take from anybody."""
    flight = flights("strangers")
    last = flight.steps[-1]
    steps = flight.statistics["valves"]["steps"]
    print(f"refused {last['refused']} until the station was gone, in {steps} steps; lost {flight.lost()}")
    assert last["refused"] > 0.3 * len(flight.steps)
    assert {record["refused"] for record in flights("udp").steps} == {0}


def test_forged_and_replayed_commands_are_refused_and_counted(flights: Callable[[str], Flight]) -> None:
    """With the right robot's address, port and length: a command as recorded, with a bit altered, and noise."""
    flight = flights("strangers")
    last = flight.steps[-1]
    print(f"forged {last['forged']}, replayed {last['replayed']}; lost {flight.lost()}")
    assert last["forged"] > 1.8 * last["replayed"] > TURN * len(flight.steps)
    assert {record["forged"] for record in flights("udp").steps} == {0}
    replayed = {record["replayed"] for record in flights("udp").in_flight}
    assert len(replayed) == 1, "more than the first messages of all, before the robots knew each other"


def test_reflected_messages_are_refused_and_counted(flights: Callable[[str], Flight]) -> None:
    """Each sender's messages come back to it as if from who got them."""

    def came_back(flight: Flight) -> dict[str, int]:
        blocks = {task: flight.refused[task] for task in ("sensors", "navigation", "control", "thruster-mapping")}
        return {
            task: sum(kinds.get("forged", 0) for name, kinds in refused.items() if name.startswith("to_"))
            for task, refused in blocks.items()
        }

    flight = flights("strangers")
    print(f"came back {came_back(flight)} in {len(flight.steps)} steps")
    assert all(count > TURN * len(flight.steps) for count in came_back(flight).values())
    assert set(came_back(flights("udp")).values()) == {0}


def test_false_telemetry_and_positions_are_refused_and_counted(flights: Callable[[str], Flight]) -> None:
    """By a station, what is sent in a robot's name; by a robot, what is in a station's. Seen to fail with a station
    and sensors that ask for no proof."""
    flight, quiet = flights("strangers"), flights("udp")
    for task, block in (("second", "report"), ("second", "flight"), ("sensors", "igps")):
        kinds = flight.refused[task][block]
        print(f"{task}, {block}: {kinds}")
        assert all(kinds[kind] > TURN / 2 * len(flight.steps) for kind in ("refused", "forged", "replayed"))
    for task, block in (("station", "report"), ("station", "flight"), ("sensors", "igps")):
        assert quiet.refused[task][block].keys() <= {"replayed"}
    numbers = [record["number"] for record in flight.second_station]
    assert numbers == sorted(numbers), "an altered or recorded report was taken"


def test_a_second_station_hears_the_same_and_disturbs_nobody(flights: Callable[[str], Flight]) -> None:
    """Its positions are a metre off, and the square is flown all the same; it goes on when the first one is gone."""
    flight = flights("strangers")
    first, second = ([record["number"] for record in heard] for heard in (flight.steps, flight.second_station))
    gone = [record for record in flight.second_station if record["time_ns"] > flight.events_ns[-1]]
    print(f"the first heard of {len(set(first))} steps, the second of {len(set(second))}, {len(gone)} of them alone")
    both = {number for number in first if number >= min(filter(None, second))}
    assert len(both - set(second)) <= 0.001 * len(first)
    assert len(gone) > 300


def test_robots_do_not_care_for_station_or_clock(flights: Callable[[str], Flight]) -> None:
    """The clock is set by an hour in the midst of the flight, the station gone at its end."""
    flight = flights("strangers")
    for name in CONTROL_TASKS:
        found = flight.statistics[name]
        print(name, {key: found[key] for key in ("steps", "overruns", "timeouts") if key in found})
        assert found["overruns"] == 0
    gone = flight.since(flight.events_ns[-1])
    assert len(gone) > 50, "the flight ends too early"
    distance = max(math.hypot(*record["pose"][:2]) for record in gone)
    print(f"within {distance * 1000:.1f} mm without a station")
    assert distance <= 2 * RMS_M


def velocities(flight: Flight) -> list[tuple[float, float, float]]:
    """From when the valves have to be closed."""
    return [record["velocity"] for record in flight.since(flight.events_ns[0] + TIMEOUT_NS)]


def on_times(flight: Flight) -> list[float]:
    return [sum(record["on_time"]) for record in flight.since(flight.events_ns[0] + TIMEOUT_NS)]


def test_a_cut_link_ends_in_a_drift(flights: Callable[[str], Flight]) -> None:
    ends_in_a_drift("cut-open", flights("cut-open"))


@pytest.mark.nightly
def test_a_cut_link_with_valves_closed_ends_in_a_drift(rough: dict[str, Flight]) -> None:
    ends_in_a_drift("cut-closed", rough["cut-closed"])


def ends_in_a_drift(name: str, flight: Flight) -> None:
    (before,) = flight.since(flight.events_ns[0])[:1]
    after = on_times(flight)
    assert len(after) > 50, "the flight ends too early"
    assert min(after) == max(after), "a valve is open after the time-out"
    rates = {velocity[2] for velocity in velocities(flight)}
    print(f"{name}: {before['velocity'][2]:.4f} rad/s when the link was cut, {sorted(rates)} afterwards")
    assert len(rates) == 1
    assert abs(rates.pop()) <= abs(before["velocity"][2]) + 0.001


def test_valves_are_open_when_the_link_is_cut(flights: Callable[[str], Flight]) -> None:
    """Otherwise the test above would show nothing."""
    valves_were_open(flights("cut-open"))


def valves_were_open(flight: Flight) -> None:
    just_before = [record for record in flight.flown if record["time_ns"] < flight.events_ns[0]][-3:]
    times = [sum(record["on_time"]) for record in just_before]
    assert times[0] < times[1] < times[2]


def test_without_the_time_out_it_spins(flights: Callable[[str], Flight]) -> None:
    """The published third test, and the negative control of the two above."""
    spins(flights("cut-open-no-timeout"))


def spins(flight: Flight) -> None:
    rates = [velocity[2] for velocity in velocities(flight)]
    print(f"from {rates[0]:.2f} to {rates[-1]:.2f} rad/s")
    assert rates[-1] < rates[0] - 1, "it was to be stopped, and is driven on"


def test_the_report_shows_every_flight(flown: dict[str, Flight], session_artefacts: Path) -> None:
    """Its pages are among the artefacts, to be looked at."""
    titles = {plan.name: plan.title for plan in plans(TESTED_SIDE_M)}
    page = report.write({titles[name]: flight for name, flight in flown.items()}, session_artefacts)
    text = page.read_text()
    assert all(f"<h2>{title}</h2>" in text for title in titles.values())
    assert text.count("<svg") == text.count("</svg>") >= 2 * len(flown)
    assert not re.search(r"(src|href)=.(?!#)", text), "the page needs something from elsewhere"
    figures = json.loads((session_artefacts / "scenarios.json").read_text())
    assert figures[titles["udp"]]["lost"] == 0
    assert figures[titles["udp"]]["rms_m"] == flown["udp"].error().rms_m


@pytest.mark.nightly  # each time, latencies repeat
def test_flights_repeat_to_the_byte(board: Board, artefacts: Path) -> None:
    """Once on a host that schedules at random. Seen to fail with another seed of the plant's noise."""

    def left(name: str) -> dict[str, bytes]:
        flights = virtual.fly(REPEATED, board, artefacts / name)
        return {
            f"{flight}/{path.relative_to(directory)}": path.read_bytes()
            for flight, directory in flights.items()
            for path in sorted(directory.rglob("*"))
            if path.is_file()
        }

    first = left("first")
    with perturbed_host():
        second = left("second")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
