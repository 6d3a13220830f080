"""Who sends when: the distributed coordination function of IEEE 802.11 (2007, clause 9.2), event by event.

A station that wants to send waits until the channel was idle for DIFS, sends at once if it was idle all the time, and
otherwise counts down a random number of slots, which it stops while the channel is busy. A frame to one station is
acknowledged, or repeated with twice the contention window; a frame to all is sent once. After each frame comes a
backoff, whether something waits or not.

What a station hears is its own: who is too far away is not sensed (hidden node), and the stronger of two frames may
survive at one receiver and not at the other. What a frame says about its ACK (NAV) holds for whoever could read it.
Who heard a frame and could not read it waits EIFS.

Simplified: a signal takes no time to travel, and interference counts with its sum, as if all of it lasted throughout.
There are neither RTS nor fragments nor QoS classes, and a beacon that another station is late with is not called off.

Time is in whole nanoseconds. All chance comes from one seed, so that a run repeats exactly.
"""

from __future__ import annotations

import heapq
import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from flotilla.lab.radio import phy
from flotilla.lab.radio.phy import Air, Phy

_NEVER = -1
_ACK_BYTES = phy.ACK_BYTES


@dataclass(frozen=True)
class Timing:
    """What stations wait for. `of` a standard, or a model's own numbers."""

    slot_ns: int
    sifs_ns: int
    difs_ns: int
    eifs_ns: int
    ack_timeout_ns: int
    """After the end of a frame whose ACK does not come."""
    cw_min: int
    cw_max: int
    attempts: int = 7
    """Transmissions of a frame until it is given up: dot11ShortRetryLimit."""
    turn_ns: int = 5_000
    """Of a slot, what turning from reception to transmission takes (aRxTxTurnaroundTime). The rest is for sensing."""

    @classmethod
    def of(cls, standard: Phy) -> Timing:
        return cls(
            standard.slot_ns, standard.sifs_ns, standard.difs_ns, standard.eifs_ns, standard.ack_timeout_ns,
            standard.cw_min, standard.cw_max,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Frame:
    """What a station sends."""

    receivers: tuple[int, ...]
    """Stations. With an ACK, one."""
    air_ns: int
    ack_ns: int
    """Air time of the ACK; 0: a frame to all, which nobody acknowledges."""
    rate_bit_s: int = 0
    size: int = 0
    """Bytes, MAC header included: errors depend on rate and size."""
    ack_rate_bit_s: int = 0
    tag: object = None
    """The sender's own."""


def frame(
    standard: Phy, rate_bit_s: int, packet: int, receivers: tuple[int, ...], *, to_all: bool = False, tag: object = None
) -> Frame:
    """An IP packet of `packet` bytes, as a standard sends it: to all at its lowest basic rate, without an ACK."""
    size = packet + phy.LLC_BYTES + phy.MAC_BYTES
    if to_all:
        rate_bit_s = standard.basic_bit_s[0]
        return Frame(receivers, standard.frame_ns(size, rate_bit_s), 0, rate_bit_s, size, 0, tag)
    air_ns = standard.protection_ns(rate_bit_s) + standard.frame_ns(size, rate_bit_s)
    ack_rate = standard.ack_rate_bit_s(rate_bit_s)
    return Frame(receivers, air_ns, standard.ack_ns(rate_bit_s), rate_bit_s, size, ack_rate, tag)


class Links:
    """How strongly stations receive each other, and what that means."""

    def __init__(self, places_m: Sequence[tuple[float, float]], air: Air | None = None) -> None:
        """`places_m`: of each station, in a plane. `air`: None for a room in which everybody receives everything and
        two frames at once are lost."""
        self.count = len(places_m)
        self._air = air
        everybody = range(self.count)
        self.dbm = [
            [air.received_dbm(math.dist(here, there)) if air else 0.0 for there in places_m] for here in places_m
        ]
        """By sender and receiver."""
        sense = air.sense_dbm if air else -1.0
        self.hears = [[i == j or self.dbm[i][j] >= sense for j in everybody] for i in everybody]
        """Whether what one sends makes the channel busy for the other, likewise."""
        self._errors: dict[tuple[int, int, int, int], float] = {}

    def error(self, sender: int, receiver: int, rate_bit_s: int, size: int) -> float:
        """Share of frames that noise alone destroys."""
        if self._air is None:
            return 0.0
        key = (sender, receiver, rate_bit_s, size)
        if key not in self._errors:
            snr_db = self.dbm[sender][receiver] - self._air.noise_dbm(rate_bit_s)
            self._errors[key] = phy.frame_error(rate_bit_s, size, snr_db)
        return self._errors[key]

    def error_beside(
        self, sender: int, receiver: int, rate_bit_s: int, size: int, others: Sequence[int]
    ) -> float:  # fmt: skip
        """The same while others sent, too."""
        if self._air is None or receiver in others:
            return 1.0
        sent = sum(10 ** (self.dbm[other][receiver] / 10) for other in others)
        signal_dbm = self.dbm[sender][receiver]
        if signal_dbm - 10 * math.log10(sent) < self._air.capture_db:
            return 1.0
        noise = sent + 10 ** (self._air.noise_dbm(rate_bit_s) / 10)
        return phy.frame_error(rate_bit_s, size, signal_dbm - 10 * math.log10(noise))


@dataclass
class Counts:
    """What happened on the channel."""

    busy_ns: int = 0
    """Somebody sent."""
    frames: int = 0
    """Transmissions of frames, repetitions included."""
    delivered: int = 0
    """Frames that their receiver, or one of them, got."""
    collided: int = 0
    """Transmissions to one station that were lost while others sent."""
    corrupted: int = 0
    """Transmissions to one station that noise destroyed."""
    given_up: int = 0
    overflowed: int = 0
    """Frames that a full queue did not take."""


@dataclass(slots=True)
class _Queued:
    frame: Frame
    attempts: int = 0
    delivered: bool = False


@dataclass(slots=True)
class _Sent:
    """A transmission that is on the air: of a frame, or of its ACK."""

    sender: int
    queued: _Queued
    acknowledges: int = _NEVER
    """The station to which it is an ACK."""
    beside: list[int] = field(default_factory=list)
    """Senders of what overlaps."""


Call = Callable[[int], None]
"""Something due; it is given the time in ns."""


class Cell:
    """Stations on one channel. `run` lets time pass; callbacks `received` and `lost` say what became of frames."""

    def __init__(self, timing: Timing, links: Links, seed: int, queue: int = 64) -> None:
        """`queue`: frames that a station's queue takes."""
        self.now_ns = 0
        self.counts = Counts()
        self.received: Callable[[int, int, Frame], None] = lambda _time, _receiver, _frame: None
        """Time, receiver, frame: once for each receiver, however often it is repeated."""
        self.lost: Callable[[int, int, Frame], None] = lambda _time, _sender, _frame: None
        """Time, sender, frame: given up, or not taken by a full queue. A frame to all is never given up."""
        self._timing = timing
        self.links = links
        self._random = random.Random(seed)
        self._events: list[tuple[int, int, Call | None, int, int]] = []
        self._number = 0
        self._room = queue
        count = links.count
        self._stations = range(count)
        self._near = [[j for j in self._stations if links.hears[i][j]] for i in self._stations]
        self._queues: list[deque[_Queued]] = [deque() for _ in self._stations]
        self._window = [timing.cw_min] * count
        self._slots = [0] * count
        """Still to count down."""
        self._waits = [False] * count
        """Wants the channel: for a frame, or to end the backoff after one."""
        self._fresh = [False] * count
        """Waits without a backoff, since the channel was idle when the frame came."""
        self._sending = [False] * count
        """From the start of a frame until its fate is known."""
        self._counts_from = [_NEVER] * count
        self._due = [0] * count
        self._turn = [0] * count
        """Marks which `due` event counts."""
        self._busy = [0] * count
        self._busy_from = [0] * count
        self._idle_since = [-(10**9)] * count
        self._reserved_until = [-(10**9)] * count
        self._confused = [False] * count
        """What was heard last could not be read."""
        self._on_air: list[_Sent] = []
        self._busy_since = 0

    def at(self, time_ns: int, call: Call) -> None:
        """Call something at a time from now on."""
        self._number += 1
        heapq.heappush(self._events, (time_ns, self._number, call, 0, 0))

    def run(self, until_ns: int) -> None:
        """Let time pass."""
        events = self._events
        while events and events[0][0] <= until_ns:
            now, _, call, station, turn = heapq.heappop(events)
            if call is not None:
                self.now_ns = now
                call(now)
            elif self._turn[station] == turn:
                self.now_ns = now
                self._take_turn(now, station)
        self.now_ns = until_ns

    def send(self, station: int, frame: Frame, *, first: bool = False) -> None:
        """Queue a frame now. `first`: before what waits, as beacons are."""
        queue = self._queues[station]
        if len(queue) >= self._room and not first:
            self.counts.overflowed += 1
            self.lost(self.now_ns, station, frame)
            return
        if first and queue:
            queue.insert(1, _Queued(frame))  # the one before it may be on the air
        else:
            queue.append(_Queued(frame))
        if self._waits[station] or self._sending[station]:
            return
        self._waits[station] = True
        if self._unaware(station):
            self._slots[station] = 0
            self._await_turn(self.now_ns, station)
        elif self._busy[station] or self._reserved_until[station] > self.now_ns:
            self._slots[station] = self._draw(station)
        else:
            self._slots[station] = 0
            self._fresh[station] = True
        if not self._busy[station]:
            self._count(self.now_ns, station)

    def _unaware(self, station: int) -> bool:
        """The channel was idle for DIFS until just now, and what began since is not sensed yet."""
        began = self._busy_from[station]
        return (
            self._busy[station] > 0
            and self.now_ns - began < self._timing.slot_ns - self._timing.turn_ns
            and began - max(self._idle_since[station], self._reserved_until[station]) >= self._timing.difs_ns
        )

    def _draw(self, station: int) -> int:
        return self._random.randrange(self._window[station] + 1)

    # Waiting

    def _count(self, now: int, station: int) -> None:
        """The channel is idle for this station: slots count after the interframe space."""
        timing = self._timing
        idle = max(self._idle_since[station], self._reserved_until[station])
        start = max(now, idle + (timing.eifs_ns if self._confused[station] else timing.difs_ns))
        self._await_turn(start, station)

    def _await_turn(self, start: int, station: int) -> None:
        self._counts_from[station] = start
        self._due[station] = due = start + self._slots[station] * self._timing.slot_ns
        self._turn[station] = turn = self._turn[station] + 1
        self._number += 1
        heapq.heappush(self._events, (due, self._number, None, station, turn))

    def _stop(self, now: int, station: int) -> None:
        """It is busy again."""
        counted = now - self._counts_from[station]
        if counted > 0:
            self._slots[station] -= counted // self._timing.slot_ns
        self._counts_from[station] = _NEVER
        self._turn[station] += 1
        if self._fresh[station]:
            self._fresh[station] = False
            self._slots[station] = self._draw(station)

    def _take_turn(self, now: int, station: int) -> None:
        self._counts_from[station] = _NEVER
        self._turn[station] += 1
        self._waits[station] = self._fresh[station] = False
        if self._queues[station]:
            queued = self._queues[station][0]
            queued.attempts += 1
            self._sending[station] = True
            self.counts.frames += 1
            self._start(now, _Sent(station, queued), queued.frame.air_ns)

    # On the air

    def _start(self, now: int, sent: _Sent, air_ns: int) -> None:
        sender, busy, counts_from, due = sent.sender, self._busy, self._counts_from, self._due
        for other in self._on_air:
            other.beside.append(sender)
            sent.beside.append(other.sender)
        if not self._on_air:
            self._busy_since = now
        self._on_air.append(sent)
        # Who begins within a slot has not sensed it yet: finding a channel busy and turning to send take a slot.
        unaware = now + self._timing.slot_ns
        for station in self._near[sender]:
            if not busy[station]:
                self._busy_from[station] = now
            busy[station] += 1
            if counts_from[station] != _NEVER and (due[station] >= unaware or station == sender):
                self._stop(now, station)
        self.at(now + air_ns, lambda time: self._end(time, sent))

    def _end(self, now: int, sent: _Sent) -> None:
        self._on_air.remove(sent)
        if not self._on_air:
            self.counts.busy_ns += now - self._busy_since
        frame, sender = sent.queued.frame, sent.sender
        if sent.acknowledges != _NEVER:
            read = self._readable(sent, frame.ack_rate_bit_s, _ACK_BYTES)
            self._free(now, sent, frame.ack_rate_bit_s, _ACK_BYTES, now, sent.acknowledges, _NEVER)
            self._fate(now, sent.acknowledges, read(sent.acknowledges))
        elif frame.ack_ns:
            (receiver,) = frame.receivers
            arrived = self._readable(sent, frame.rate_bit_s, frame.size)(receiver)
            reserved = now + self._timing.sifs_ns + frame.ack_ns
            self._free(now, sent, frame.rate_bit_s, frame.size, reserved, receiver, receiver if arrived else _NEVER)
            if arrived:
                self._deliver(now, receiver, sent.queued)
                ack = _Sent(receiver, sent.queued, acknowledges=sender)
                self.at(now + self._timing.sifs_ns, lambda time: self._start(time, ack, frame.ack_ns))
                return
            if sent.beside:
                self.counts.collided += 1
            else:
                self.counts.corrupted += 1
            if self._timing.ack_timeout_ns:
                self.at(now + self._timing.ack_timeout_ns, lambda time: self._fate(time, sender, False))
            else:
                self._fate(now, sender, False)
        else:
            read = self._readable(sent, frame.rate_bit_s, frame.size)
            self._free(now, sent, frame.rate_bit_s, frame.size, now, _NEVER, _NEVER)
            for receiver in frame.receivers:
                if read(receiver):
                    self._deliver(now, receiver, sent.queued)
            self._fate(now, sender, True)

    def _readable(self, sent: _Sent, rate_bit_s: int, size: int) -> Callable[[int], bool]:
        """Whether a station read it, by chance."""

        def read(receiver: int) -> bool:
            if sent.beside:
                error = self.links.error_beside(sent.sender, receiver, rate_bit_s, size, sent.beside)
            else:
                error = self.links.error(sent.sender, receiver, rate_bit_s, size)
            return error <= 0 or (error < 1 and self._random.random() >= error)

        return read

    def _free(
        self, now: int, sent: _Sent, rate_bit_s: int, size: int, reserved: int, receiver: int, answers: int
    ) -> None:
        """The channel is idle again, for whoever hears nothing else. `answers`: who sends an ACK after SIFS; whoever
        hears that counts only after it."""
        links, sender, beside = self.links, sent.sender, sent.beside
        busy, waits = self._busy, self._waits
        answered = links.hears[answers] if answers != _NEVER else ()
        for station in self._near[sender]:
            busy[station] -= 1
            if station == sender:
                self._confused[station] = False
            else:
                if beside:
                    unread = links.error_beside(sender, station, rate_bit_s, size, beside) > 0.5
                else:
                    unread = links.error(sender, station, rate_bit_s, size) > 0.5
                self._confused[station] = unread
                if not unread and station != receiver and reserved > self._reserved_until[station]:
                    self._reserved_until[station] = reserved
            if not busy[station]:
                self._idle_since[station] = now
                if waits[station] and not (answered and answered[station]):
                    self._count(now, station)

    def _deliver(self, now: int, receiver: int, queued: _Queued) -> None:
        frame = queued.frame
        if frame.ack_ns and queued.delivered:  # repeated, since its ACK was lost
            return
        if not queued.delivered:
            self.counts.delivered += 1
        queued.delivered = True
        self.received(now, receiver, frame)

    def _fate(self, now: int, station: int, succeeded: bool) -> None:
        """A frame has succeeded, or failed once more: the next backoff begins."""
        queue = self._queues[station]
        queued = queue[0]
        if succeeded:
            self._window[station] = self._timing.cw_min
            queue.popleft()
        elif queued.attempts >= self._timing.attempts:
            self._window[station] = self._timing.cw_min
            queue.popleft()
            self.counts.given_up += 1
            if not queued.delivered:
                self.lost(now, station, queued.frame)
        else:
            self._window[station] = min(2 * self._window[station] + 1, self._timing.cw_max)
        self._sending[station] = False
        self._slots[station] = self._draw(station)
        self._waits[station] = True
        if not self._busy[station]:
            self._count(now, station)


def saturate(cell: Cell, frames: Sequence[Frame], seconds: float, warm_s: float = 0.5) -> int:
    """Let each station always have a frame to send, its own of `frames`; how many arrived, after `warm_s`."""
    arrived = 0
    station_of = {frame: station for station, frame in enumerate(frames)}
    if len(station_of) != len(frames):
        raise ValueError("frames of two stations are the same; tags tell them apart")

    def received(_now: int, _receiver: int, frame: Frame) -> None:
        nonlocal arrived
        arrived += 1
        cell.send(station_of[frame], frame)

    cell.received = received
    cell.lost = lambda _now, station, frame: cell.send(station, frame)
    for station, frame in enumerate(frames):
        cell.send(station, frame)
    cell.run(cell.now_ns + round(warm_s * 1e9))
    before = arrived
    cell.run(cell.now_ns + round(seconds * 1e9))
    return arrived - before
