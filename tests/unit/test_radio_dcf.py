"""The simulated medium against published models of it, and rule by rule.

Seen to fail by planted mistakes: DIFS of one slot less, a window that does not grow, DIFS in place of EIFS, no NAV,
one attempt more, only the strongest interference, a seed that is not used, and slots that are not kept while another
sends.
"""

from __future__ import annotations

import dataclasses
import itertools

import pytest

from flotilla.lab.radio import dcf, phy
from flotilla.lab.radio.dcf import Cell, Frame, Links, Timing
from flotilla.lab.radio.phy import Air

US = 1000
M = 1_000_000
PATIENT = 10**9
"""Attempts of who never gives up, as models have it."""


def together(count: int) -> Links:
    return Links([(0, 0)] * count)


# Saturation: Bianchi's model, its equations solved here


def bianchi(stations: int, window: int, doublings: int, slot: float, success: float, collision: float) -> float:
    """Successful exchanges in a unit of time. Bianchi, IEEE JSAC 18(3), 2000: (7), (9), (10) to (13)."""

    def sends(collides: float) -> float:
        more = sum((2 * collides) ** stage for stage in range(doublings))
        return 2 / (1 + window + collides * window * more)

    low, high = 0.0, 1.0
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if 1 - (1 - sends(middle)) ** (stations - 1) > middle else (low, middle)
    tau = sends(low)
    nobody, one = (1 - tau) ** stations, stations * tau * (1 - tau) ** (stations - 1)
    return one / (nobody * slot + one * success + (1 - nobody - one) * collision)


BITS = 8184
HEADERS_US, ACK_US, DELAY_US = 272 + 128, 112 + 128, 1


@pytest.mark.parametrize("stations", [5, 20, 50])
@pytest.mark.parametrize(("window", "doublings"), [(32, 3), (32, 5), (128, 3)])
def test_saturation_throughput_is_bianchis(window: int, doublings: int, stations: int) -> None:
    """His table II: FHSS at 1 Mbit/s. The delay of propagation is part of each frame here."""
    timing = Timing(50 * US, 28 * US, 128 * US, 128 * US, 0, window - 1, (window << doublings) - 1, PATIENT)
    air_us = HEADERS_US + BITS + DELAY_US
    frames = [
        Frame(((station + 1) % stations,), air_us * US, (ACK_US + DELAY_US) * US, tag=station)
        for station in range(stations)
    ]
    seconds = 24 if stations > 20 else 12
    throughput = dcf.saturate(Cell(timing, together(stations), 1), frames, seconds) * BITS / (seconds * 1e6)
    exchange_us = air_us + 28 + ACK_US + DELAY_US + 128
    model = BITS * bianchi(stations, window, doublings, 50, exchange_us, air_us + 128)
    assert throughput == pytest.approx(model, rel=0.05 if stations > 20 else 0.03)


# ns-3's wifi-bianchi.cc publishes the throughput of 802.11b that it is held to within 1.5 %, in Mbit/s: packets of 1500
# bytes, long preamble, EIFS after collisions, no limit of retries.
NS_3 = {
    (1 * M, 5): 0.8418, (1 * M, 20): 0.7186,
    (11 * M, 5): 6.3821, (11 * M, 10): 6.0269, (11 * M, 20): 5.5765, (11 * M, 50): 4.9103,
}  # fmt: skip


@pytest.mark.parametrize(("rate", "stations"), NS_3)
def test_saturation_throughput_is_what_ns_3_publishes(rate: int, stations: int) -> None:
    timing = dataclasses.replace(Timing.of(phy.B), attempts=PATIENT)
    frames = [dcf.frame(phy.B, rate, 1500, ((station + 1) % stations,), tag=station) for station in range(stations)]
    seconds = (6 if stations > 10 else 12) if rate > M else 60
    arrived = dcf.saturate(Cell(timing, together(stations), 3), frames, seconds)
    assert 1500 * 8 * arrived / (seconds * 1e6) == pytest.approx(NS_3[rate, stations], rel=0.02)


# Rule by rule


def times(cell: Cell) -> list[int]:
    """When frames arrive, from now on."""
    found: list[int] = []
    cell.received = lambda now, _receiver, _frame: found.append(now)
    return found


def test_a_station_alone_sends_at_once_and_then_after_difs_and_slots() -> None:
    """Exactly: each cycle is frame, SIFS, ACK, DIFS and 0 to 31 slots, 15.5 in the mean."""
    cell, sent = Cell(Timing.of(phy.B), together(2), 1), dcf.frame(phy.B, 11 * M, 100, (1,))
    found = times(cell)
    for _ in range(2000):
        cell.at(cell.now_ns, lambda _now: cell.send(0, sent))
        cell.run(cell.now_ns + 100 * 1_000_000)
        assert len(found) == 1
        assert found.pop() == cell.now_ns - 100 * 1_000_000 + sent.air_ns, "waited for nothing"
    cell = Cell(Timing.of(phy.B), together(2), 1, queue=2001)
    found = times(cell)
    for _ in range(2001):
        cell.send(0, sent)
    cell.run(10**11)
    cycle = sent.air_ns + 10 * US + 248 * US + 50 * US
    slots = [(after - before - cycle) / (20 * US) for before, after in itertools.pairwise(found)]
    assert sorted(set(slots)) == list(range(32))
    assert sum(slots) / len(slots) == pytest.approx(15.5, rel=0.05)


def test_who_waits_stops_counting_while_another_sends() -> None:
    """Two frames come while a third is sent: both count from its end, and the later one goes on where it stopped, after
    DIFS more."""
    sent = [dcf.frame(phy.B, 11 * M, 100, (3,), tag=station) for station in range(3)]
    seen = 0
    for seed in range(50):
        cell = Cell(Timing.of(phy.B), together(4), seed)
        found = times(cell)
        cell.send(0, sent[0])
        cell.at(100 * US, lambda _now, cell=cell: cell.send(1, sent[1]))  # type: ignore[misc]
        cell.at(100 * US, lambda _now, cell=cell: cell.send(2, sent[2]))  # type: ignore[misc]
        cell.run(10**9)
        exchange = sent[0].air_ns + 258 * US
        starts = [time - sent[0].air_ns for time in found]
        first = (starts[1] - exchange - 50 * US) / (20 * US)
        second = (starts[2] - 2 * exchange - 100 * US) / (20 * US)
        if cell.counts.collided == 0:
            assert 0 <= first < second <= 31, "slots in all, from the first one's end"
            assert (first, second) == (int(first), int(second))
            seen += 1
    assert seen > 40


def test_frames_that_come_before_another_is_sensed_collide_and_are_repeated() -> None:
    """Sensing takes a slot without the time to turn: 15 µs."""
    sent = [dcf.frame(phy.B, 11 * M, 100, (2,), tag=station) for station in range(2)]
    for later_us, collided in ((0, 2), (14, 2), (15, 0)):
        cell = Cell(Timing.of(phy.B), together(3), 1)
        found = times(cell)
        cell.send(0, sent[0])
        cell.at(later_us * US, lambda _now, cell=cell: cell.send(1, sent[1]))  # type: ignore[misc]
        cell.run(10**9)
        assert cell.counts.collided == collided
        assert len(found) == 2


def test_a_frame_is_given_up_after_seven_attempts_each_with_twice_the_window() -> None:
    """To a station that is too far away: of 400 frames, the last wait has a mean near 1023/2 slots."""
    links = Links([(0, 0), (100_000, 0)], Air())
    cell = Cell(Timing.of(phy.B), links, 1, queue=500)
    lost: list[int] = []
    cell.lost = lambda now, _station, _frame: lost.append(now)
    sent = dcf.frame(phy.B, 11 * M, 100, (1,))
    for _ in range(400):
        cell.send(0, sent)
    cell.run(10**12)
    assert (cell.counts.frames, cell.counts.given_up, len(lost)) == (2800, 400, 400)
    attempt = sent.air_ns + 222 * US  # no ACK; DIFS has passed by then
    slots = (lost[-1] - 400 * 7 * attempt) / (20 * US) / 400
    # six waits of 63, 127, …, 1023, 1023 and one of 31, each halved: the window ends at 1023
    assert slots == pytest.approx((31 + 63 + 127 + 255 + 511 + 1023 + 1023) / 2, rel=0.05)


def test_a_frame_to_all_is_neither_acknowledged_nor_repeated() -> None:
    """Nearer stations get it, further ones do not; it takes its air time once, at 1 Mbit/s."""
    links = Links([(0, 0), (5, 0), (100_000, 0), (10, 0)], Air())
    cell = Cell(Timing.of(phy.B), links, 1)
    got: list[int] = []
    cell.received = lambda _now, receiver, _frame: got.append(receiver)
    cell.send(0, dcf.frame(phy.B, 11 * M, 500, (1, 2, 3), to_all=True))
    cell.run(10**9)
    assert got == [1, 3]
    assert (cell.counts.frames, cell.counts.busy_ns) == (1, (192 + 8 * 536) * US)


def test_who_hears_only_the_sender_leaves_time_for_the_acknowledgement() -> None:
    """Three in a row, the outer ones out of range of each other: the third hears the frame, not its ACK, and what it
    sent then would hit the ACK. With NAV nothing is lost."""
    air = Air(exponent=4, sense_dbm=-80)
    links = Links([(0, 0), (15, 0), (-15, 0), (-16, 0)], air)  # 0 sends to 1; 2 hears 0 and not 1
    assert links.hears[2][0]
    assert not links.hears[2][1]
    sent = dcf.frame(phy.B, 2 * M, 50, (1,))
    other = dcf.frame(phy.B, 2 * M, 50, (3,))
    lost = 0
    for seed in range(200):
        cell = Cell(Timing.of(phy.B), links, seed)
        cell.send(0, sent)
        cell.at(100 * US, lambda _now, cell=cell: cell.send(2, other))  # type: ignore[misc]
        cell.run(10**8)
        lost += cell.counts.frames - 2
    assert lost == 0


def rate_of_collisions(distance_m: float) -> float:
    """Two stations send to one between them; they are that far from it."""
    air = Air(exponent=4, sense_dbm=-80)
    cell = Cell(Timing.of(phy.B), Links([(-distance_m, 0), (distance_m, 0), (0, 0)], air), 1)
    frames = [dcf.frame(phy.B, 2 * M, 500, (2,), tag=station) for station in range(2)]
    dcf.saturate(cell, frames, 5)
    return cell.counts.collided / cell.counts.frames


def test_hidden_nodes_collide() -> None:
    """At 8 m they hear each other, at 13 m they do not, and both are heard in the middle."""
    assert rate_of_collisions(8) < 0.1
    assert rate_of_collisions(13) > 0.4


def test_the_stronger_of_two_frames_survives_and_many_weak_ones_together_destroy_it() -> None:
    """From 1 m against 3 m there are 14 dB between them, more than capture needs. Four are 6 dB stronger."""
    for others, survives in ((1, True), (4, False)):
        links = Links([(0, 0), (1, 0), *[(0, 3.0)] * others], Air())
        cell = Cell(Timing.of(phy.B), links, 1)
        got: list[tuple[int, object]] = []
        cell.received = lambda now, _receiver, frame, got=got: got.append((now, frame.tag))  # type: ignore[misc]
        sent = dcf.frame(phy.B, 2 * M, 100, (0,), tag="near")
        cell.send(1, sent)
        for other in range(others):
            cell.send(2 + other, dcf.frame(phy.B, 2 * M, 100, (0,), tag=other))
        cell.run(10**9)
        assert ((sent.air_ns, "near") in got) == survives
        assert len(got) == 1 + others, "all arrive, in the end"


def log_of(seed: int) -> list[tuple[int, int, object]]:
    links = Links([(n * 9.0, 0) for n in range(6)], Air(exponent=3.5))
    cell = Cell(Timing.of(phy.G), links, seed)
    found: list[tuple[int, int, object]] = []
    cell.received = lambda now, receiver, frame: found.append((now, receiver, frame.tag))
    for step in range(200):
        for station in range(6):
            sent = dcf.frame(phy.G, 24 * M, 200, ((station + 1) % 6,), tag=step)
            cell.at(step * 2_000_000, lambda _now, station=station, sent=sent: cell.send(station, sent))  # type: ignore[misc]
    cell.run(10**9)
    return found


def test_a_run_repeats_and_another_seed_is_another_run() -> None:
    first, again, other = log_of(7), log_of(7), log_of(8)
    assert len(first) > 800
    assert first == again
    assert first != other


def test_a_full_queue_takes_no_more() -> None:
    cell = Cell(Timing.of(phy.B), together(2), 1, queue=3)
    lost: list[object] = []
    found = times(cell)
    cell.lost = lambda _now, _station, frame: lost.append(frame.tag)
    for tag in range(5):
        cell.send(0, dcf.frame(phy.B, 11 * M, 100, (1,), tag=tag))
    cell.run(10**9)
    assert (lost, len(found), cell.counts.overflowed) == ([3, 4], 3, 2)
