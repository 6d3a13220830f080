"""What `make top` says of streams, by a clock of the tests'."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import pytest

from flotilla.fleet.inventory import load_fleet
from flotilla.fleet.model import Fleet, Message, Signal
from flotilla.station.authentication import TRAILER, Signer
from flotilla.station.receiver import Receiver
from flotilla.station.recording import Field
from flotilla.station.services import State, TaskStatus
from flotilla.station.telemetry import Stream, streams
from flotilla.station.top import Row, StreamStats, Top

SECOND_NS = 1_000_000_000
STATION, LOOPBACK = "10.42.0.254", "127.0.0.1"
KEY = "42" * 32
STREAM = Stream(
    robot="robot1",
    task="valves",
    name="report",
    address="10.42.0.1",
    port=5020,
    fields=(
        Field("step", "uint16", 1, 0),
        Field("good", "boolean", 1, 2),
        Field("valves", "boolean", 8, 3),
        Field("flying", "boolean", 1, 11),
    ),
    step_s=0.01,
    every=2,
)


def heard(steps: Iterable[int], bad: Iterable[int] = ()) -> Row:
    """A row right after datagrams with these steps, one each 20 ms; those in `bad` have good = 0."""
    found = StreamStats(STREAM, 0)
    now_ns = 0
    for step in steps:
        now_ns += 20_000_000
        found.take({"step": step, "good": step not in bad, "valves": (True,) * 8, "flying": True}, now_ns)
    return found.row(now_ns)


def row(rate_hz: float, flags: dict[str, float], link: float = 1, age_s: float | None = 0) -> Row:
    """Where nothing was lost, and there is no battery."""
    return Row(rate_hz=rate_hz, lost=0, link=link, age_s=age_s, charge=None, attempts={}, flags=flags)


def test_all_came() -> None:
    """In less than the window too. Seen to fail without regard to that."""
    assert heard(range(2, 52, 2)) == row(rate_hz=50, flags={"good": 1, "flying": 1})
    assert heard(range(2, 402, 2)) == row(rate_hz=50, flags={"good": 1, "flying": 1})


@pytest.mark.parametrize(
    ("steps", "lost"),
    [
        ([100, 102, 104], 0),
        ([100, 106, 108], 2),
        ([100, 104, 102, 106], 0),  # overtaken
        ([100, 100, 102], 0),  # twice: the task stepped by itself
        ([65532, 65534, 0, 2], 0),  # after the largest
        ([65532, 4], 3),
        ([5000, 2, 8], 2),  # the robot starts anew
        ([0, 0, 700, 702], 0),  # nothing had reached the task
    ],
)
def test_lost_are_steps_that_did_not_come(steps: list[int], lost: int) -> None:
    """Each was seen to fail: with `every`, overtaking, the largest number, a start anew or 0 left out."""
    assert heard(steps).lost == lost


def test_a_silent_stream_has_age_and_no_rate() -> None:
    """Its flags are the last ones. Seen to fail where the window ends with the last datagram."""
    found = StreamStats(STREAM, 0)
    found.take({"step": 1, "good": False, "valves": (True,) * 8, "flying": True}, SECOND_NS)
    assert found.row(2 * SECOND_NS) == row(0.5, {"good": 0, "flying": 1}, age_s=1)
    assert found.row(9 * SECOND_NS) == row(0, {"good": 0, "flying": 1}, link=0, age_s=8)
    assert StreamStats(STREAM, 0).row(SECOND_NS) == row(0, {}, link=0, age_s=None)


@pytest.mark.parametrize(
    ("every", "age_s", "silent"), [(2, 0.49, False), (2, 0.51, True), (100, 2.4, False), (100, 2.6, True)]
)
def test_nothing_older_than_half_a_second_is_current(every: int, age_s: float, silent: bool) -> None:
    """But for streams that come less often. Seen to fail: ten datagrams' time, of 1 Hz ten seconds."""
    stream = dataclasses.replace(STREAM, every=every)
    found = StreamStats(stream, 0)
    found.take({"step": 1, "good": True, "valves": (True,) * 8, "flying": True}, SECOND_NS)
    assert found.row(SECOND_NS + round(age_s * SECOND_NS)).silent(stream) is silent


def test_the_rate_after_a_jump_of_a_replay_is_that_of_the_messages_before_it() -> None:
    """Seen to fail with 20000000000.0 of 10 Hz: the window began at the jump."""
    step_ns = round(SECOND_NS / STREAM.rate_hz)
    jumped_ns = 1000 * SECOND_NS
    found = StreamStats(STREAM, jumped_ns)
    for step in range(20):
        found.take(
            {"good": True, "valves": (True,) * 8, "flying": True, "step": 500 + step}, jumped_ns - (19 - step) * step_ns
        )
    assert found.row(jumped_ns + 1).rate_hz == pytest.approx(STREAM.rate_hz, rel=0.1)
    single = StreamStats(STREAM, jumped_ns)
    single.take({"good": True, "valves": (True,) * 8, "flying": True, "step": 500}, jumped_ns)
    assert single.row(jumped_ns + 1).rate_hz <= 1.01 * STREAM.rate_hz


def test_flags_are_those_of_the_window() -> None:
    assert heard(range(2, 402, 2), bad=range(2, 200, 2)).flags == {"good": 1, "flying": 1}
    assert heard(range(2, 402, 2), bad=range(302, 402, 2)).flags == {"good": 0.5, "flying": 1}


def test_the_table_says_it() -> None:
    """Seen to fail with columns exchanged."""
    now_ns = 0
    other = Stream("robot2", "control", "report", "10.42.0.2", 5021, STREAM.fields[1:], 0.01, 10)
    receiver = Receiver([STREAM, other], lambda _, address: KEY if address == STATION else None)
    signer = Signer(KEY, STREAM.port)
    top = Top(receiver, clock=lambda: now_ns)
    receiver.sinks.append(top)
    for step in range(2, 402, 2):
        now_ns += 20_000_000
        if step % 8:
            message = signer.sign(step.to_bytes(2, "little") + b"\x01" + bytes(9))
            if challenge := receiver.take(message, STREAM.address, (STATION, STREAM.port), now_ns):
                assert signer.challenged(challenge)
                message = signer.sign(message[:-TRAILER])
                receiver.take(message, STREAM.address, (STATION, STREAM.port), now_ns)
    receiver.take(b"short", other.address, (STATION, other.port), now_ns)
    receiver.take(message, STREAM.address, (STATION, STREAM.port), now_ns)
    receiver.take(message[:-1] + bytes([message[-1] ^ 1]), STREAM.address, (STATION, STREAM.port), now_ns)
    receiver.take(message, STREAM.address, (LOOPBACK, STREAM.port), now_ns)
    receiver.take(message, "10.42.0.9", (STATION, STREAM.port), now_ns)
    assert [" ".join(line.split()) for line in top.end().splitlines()] == [
        "robot task ms stream Hz of came refused lost % link% age s charge% flags",
        "robot1 valves 10 report 37.5 50 150 1 49 24.6 76 0.02 good, not flying",
        "robot2 control 10 report 0.0 10 0 1 never",
        "left out as robot1's valves report: 1 forged, 2 replayed",
        "2 datagrams of strangers left out",
    ]


def test_tasks_are_shown_with_streams_or_without() -> None:
    """Seen to fail where tasks without streams are left out."""
    states = {
        ("robot1", "valves"): State("running 5 s", True, TaskStatus(0.01, 7, 2, {"gyro": True, "laser": False})),
        ("robot1", "heading"): State("no answer", False),
        ("robot1", "slow"): State("running 5 s", True, TaskStatus(0.25, 0, 0, {})),
    }
    top = Top(Receiver([STREAM]), states, clock=lambda: 0)
    assert [" ".join(line.split()) for line in top.end().splitlines()] == [
        "robot task ms stream Hz of came refused lost % link% age s charge% flags runs overruns sensors",
        "robot1 valves 10 report 0.0 50 0 0 0 0 never running 5 s 7 (+2) gyro, not laser",
        "robot1 heading no answer",
        "robot1 slow 250 running 5 s 0",
    ]


def reporting(rate_hz: float, every: int, charge: str | None = None, **signals: Signal) -> Fleet:
    """The fleet, with this message from robot 1 to the stations."""
    fleet = load_fleet()
    message = Message(
        sender="heading", receiver="stations", port=5030, rate_hz=rate_hz, every=every, charge=charge, signals=signals
    )
    return fleet.model_copy(update={"messages": {"heading-power": message}})


def test_what_a_robot_refused_is_named() -> None:
    """By kind, as the message says. Seen to fail where a count of 0 is named, too."""
    count = Signal(type="uint32")
    message = reporting(100, 1, forged=count, replayed=count, other=count).messages["heading-power"]
    fleet = reporting(100, 1).model_copy(
        update={"messages": {"heading-power": message.model_copy(update={"attempts": ["forged", "replayed"]})}}
    )
    (stream,) = streams(fleet)
    top = Top(Receiver([stream]), clock=lambda: 0)
    top.take(stream, {"forged": 0, "replayed": 0, "other": 3}, 0)
    assert "refused messages" not in top.end()
    top.take(stream, {"forged": 410, "replayed": 0, "other": 3}, 0)
    assert top.end().splitlines()[-1].strip() == "robot1: heading refused messages: 410 forged"


def test_what_else_a_robot_says_is_below_the_table() -> None:
    """Seen to fail without the robot's name."""
    notes = {"robot3": ("radio off", "firewall dropped 7 packets of a flood"), "robot1": ()}
    said = Top(Receiver(streams(load_fleet())), clock=lambda: 0, notes=notes).end().splitlines()
    assert said[-2].strip() == "robot3: radio off"
    assert said[-1].strip() == "robot3: firewall dropped 7 packets of a flood"


def test_what_any_task_refused_is_named() -> None:
    """By block, without a stream too. Seen to fail without tasks that have no stream, and without the blocks."""
    by_block = {"wrench": {"forged": 410, "replayed": 206}, "state": {"forged": 3}}
    states = {
        ("robot1", "valves"): State("running 5 s", True, TaskStatus(0.01, 0, 0, {}, {"wrench": {"refused": 5}})),
        ("robot4", "thruster-mapping"): State("running 5 s", True, TaskStatus(0.01, 0, 0, {}, by_block)),
        ("robot4", "heading"): State("running 5 s", True, TaskStatus(0.01, 0, 0, {})),
        ("robot5", "drive"): State("no answer", False),
    }
    top = Top(Receiver([STREAM]), states, clock=lambda: 0)
    assert [line.strip() for line in top.end().splitlines() if "refused:" in line] == [
        "robot1: valves refused: 5 refused by wrench",
        "robot4: thruster-mapping refused: 410 forged, 206 replayed by wrench; 3 forged by state",
    ]


def test_an_actuator_that_waits_is_named() -> None:
    """Each start of a task stops its actuators until somebody switches them off and on."""
    status = TaskStatus(0.01, 0, 0, {}, waiting=["left", "right"])
    still = State("running 5 s", True, TaskStatus(0.01, 0, 0, {}))
    states = {("robot5", "drive"): State("running 5 s", True, status), ("robot5", "perceive"): still}
    top = Top(Receiver([STREAM]), states, clock=lambda: 0)
    assert [line.strip() for line in top.end().splitlines() if "stopped" in line] == [
        "robot5: drive is stopped since its start, switch off and on: left, right"
    ]


def test_serial_overruns_are_named() -> None:
    """Bytes that a port loses are the robot's fault, and no device's."""
    status = TaskStatus(0.01, 0, 0, {}, serial_overruns={"gyro": 12, "compass": 1})
    still = State("running 5 s", True, TaskStatus(0.01, 0, 0, {}))
    states = {("robot3", "heading"): State("running 5 s", True, status), ("robot3", "sensors"): still}
    top = Top(Receiver([STREAM]), states, clock=lambda: 0)
    assert [line.strip() for line in top.end().splitlines() if "were lost" in line] == [
        "robot3: heading has serial overruns, bytes were lost: 12 at gyro, 1 at compass"
    ]


@pytest.mark.parametrize(
    ("refused", "said"),
    [
        ({"wrench": {"forged": 409}}, ["robot1: heading refused: 409 forged by wrench"]),
        ({}, ["robot1: heading refused messages: 410 forged"]),
        (
            {"wrench": {"replayed": 1}},
            ["robot1: heading refused: 1 replayed by wrench", "robot1: heading refused messages: 410 forged"],
        ),
        (None, ["robot1: heading refused messages: 410 forged"]),
    ],
)
def test_what_a_task_and_its_stream_say_is_said_once(
    refused: dict[str, dict[str, int]] | None, said: list[str]
) -> None:
    """The task's own words come first, unless they lack a kind. Seen to fail with both, and with one alone."""
    message = reporting(100, 1, forged=Signal(type="uint32")).messages["heading-power"]
    fleet = reporting(100, 1).model_copy(
        update={"messages": {"heading-power": message.model_copy(update={"attempts": ["forged"]})}}
    )
    (stream,) = streams(fleet)
    status = None if refused is None else TaskStatus(0.01, 0, 0, {}, refused)
    top = Top(Receiver([stream]), {("robot1", "heading"): State("running 5 s", True, status)}, clock=lambda: 0)
    top.take(stream, {"forged": 410}, 0)
    assert [line.strip() for line in top.end().splitlines() if "heading refused" in line] == said


def test_the_rate_is_the_message_s() -> None:
    one = Signal(type="double", unit=["1"])
    (stream,) = streams(reporting(100, 4, left=one))
    assert (stream.topic, stream.length) == ("/robot1/heading/power", 8)
    assert (stream.step_s, stream.every, stream.rate_hz) == pytest.approx((0.0025, 4, 100))
    assert not streams(reporting(100, 4, left=one).model_copy(update={"stations": []}))


def test_the_link_is_that_of_the_last_steps() -> None:
    """Half of the steps were lost, long ago or now. Seen to fail with all steps since the start."""
    assert heard([*range(2, 200, 4), *range(200, 600, 2)]).link == 1
    assert heard([*range(2, 600, 2), *range(602, 1200, 4)]).link == pytest.approx(0.5, abs=0.01)


def test_a_batterys_charge_is_the_signal_that_the_message_names() -> None:
    """Whatever that is called. Seen to fail where any field of a battery's is its charge."""
    one = Signal(type="double", unit=["1"])
    (stream,) = streams(reporting(100, 1, charge="soc", left=one, soc=one, one=one))
    found = StreamStats(stream, 0)
    assert (stream.charge, found.row(1).charge) == ("soc", None)
    found.take({"left": 60.0, "soc": 0.15, "one": 1.0}, 1)
    assert found.row(1).charge == 0.15
    receiver = Receiver([stream])
    top = Top(receiver, clock=lambda: 0)
    top.take(stream, {"left": 60.0, "soc": 0.15, "one": 1.0}, 0)
    assert top.end().split()[-1] == "15"
