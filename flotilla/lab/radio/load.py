"""A described fleet, once or several times over, on one simulated channel: what its messages and chains meet."""

from __future__ import annotations

import functools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields

from flotilla.lab.radio import dcf, phy
from flotilla.lab.radio.dcf import Cell, Counts, Frame, Links, Timing
from flotilla.lab.radio.phy import Air, Phy
from flotilla.lab.radio.traffic import (
    BEACON_NS,
    NTP_BYTES,
    NTP_NS,
    SPDP_BYTES,
    SPDP_NS,
    UDP_BYTES,
    Description,
    Flow,
    Task,
)

MS = 1_000_000
_WARM_NS = 50 * MS
"""Not judged: queues fill, phases settle."""
_REST_NS = 100 * MS
"""After the last step that is judged, so that its messages can arrive."""


@dataclass(frozen=True)
class Setting:
    """How the fleet is placed and clocked. What a report names as its assumptions."""

    standard: Phy
    rate_bit_s: int
    air: Air = field(default_factory=Air)
    area_m: float = 10.0
    """Side of the square on which members stand, each where chance puts it."""
    aligned: bool = True
    """Clocks agree within `clock_us`, so that all robots step at once; otherwise each steps at a phase of its own."""
    clock_us: float = 100.0
    """By how much two clocks may differ: chrony's over a radio."""
    compute_us: float = 400.0
    """From a step, or the arrival of its trigger, until its message is at the radio: what a hop takes in the flights of
    `make scenarios`, whose radio takes no time. Each step takes up to a tenth more or less."""
    update: bool = False
    """A station sends an update by multicast all the time."""
    seed: int = 1


@dataclass
class Met:
    """What steps of one chain, or frames of one message, met."""

    latencies_ns: list[int] = field(default_factory=list)
    """Of those that arrived."""
    sent: int = 0

    def lost(self) -> int:
        return self.sent - len(self.latencies_ns)

    def late(self, limit_ns: int) -> int:
        return sum(latency > limit_ns for latency in self.latencies_ns)

    def missed(self, limit_ns: int) -> float:
        """Share that is lost or late."""
        return (self.lost() + self.late(limit_ns)) / self.sent if self.sent else 0.0

    def percentile_ms(self, percent: float) -> float:
        """Of those that arrived, in ms; nan without any."""
        found = sorted(self.latencies_ns)
        return found[min(len(found) - 1, int(len(found) * percent / 100))] / MS if found else float("nan")


@dataclass
class Result:
    """A run with so many groups of robots."""

    groups: int
    robots: int
    seconds: float
    frames_s: float
    """Transmissions in a second, without ACKs."""
    busy: float
    """Share of time in which somebody sends."""
    counts: Counts
    messages: dict[str, Met]
    chains: dict[str, Met]
    silence_ms: dict[str, float]
    """Longest time without one of a message's frames, at any of its receivers."""


@dataclass(slots=True)
class _Tag:
    flow: Flow
    group: int
    origin_ns: int
    """When the step was due that began the chain."""
    given_ns: int
    judged: bool


class _Run:
    def __init__(self, described: Description, setting: Setting, groups: int, seconds: float) -> None:
        self.described, self.setting, self.groups = described, setting, groups
        self.robots = len(described.robots)
        count = self.robots * groups + len(described.stations)
        self.chance = random.Random(f"{setting.seed} {groups}")
        side = setting.area_m
        places = [(self.chance.uniform(0, side), self.chance.uniform(0, side)) for _ in range(count)]
        self.cell = Cell(Timing.of(setting.standard), Links(places, setting.air), self.chance.randrange(1 << 30))
        self.cell.received = self.received
        self.until_ns = round(seconds * 1e9) + _WARM_NS
        self.messages: dict[str, Met] = {}
        self.chains = {chain.name: Met() for chain in described.chains}
        self.ends = {chain.flows[-1]: chain for chain in described.chains}
        self.firsts = {chain.flows[0]: chain for chain in described.chains}
        self.heard_ns: dict[tuple[str, int], int] = {}
        self.silence_ns: dict[str, int] = {}
        self.steps: dict[tuple[int, int], int] = {}
        self.count = count

    def member(self, group: int, index: int) -> int:
        """A robot of a group, or a station, of which there are no more than described."""
        return group * self.robots + index if index < self.robots else (self.groups - 1) * self.robots + index

    # What sends

    def begin(self) -> None:
        for group in range(self.groups):
            clocks_ns = [self.phase_ns(task_period) for task_period in self.periods()]
            for index, task in enumerate(self.described.tasks):
                if not task.triggered:
                    self.clock(group, index, task, clocks_ns[task.robot] % task.period_ns)
            for flow, period_ns in self.described.positions:
                self.repeat(flow, group, period_ns, self.chance.randrange(period_ns))
        if self.setting.update and self.described.update:
            everybody = tuple(range(self.robots * self.groups))
            flow = self.described.update
            for_all = Flow(flow.name, flow.sender, everybody, flow.packet, to_all=True)
            self.repeat(for_all, self.groups - 1, self.described.update_ns, 0)
        self.background()
        self.cell.at(0, self.beacon)

    def periods(self) -> list[int]:
        """Of each robot, the period within which its phase is."""
        return [
            max((task.period_ns for task in self.described.tasks if task.robot == robot), default=MS)
            for robot in range(self.robots)
        ]

    def phase_ns(self, period_ns: int) -> int:
        if self.setting.aligned:
            return round(self.chance.uniform(0, self.setting.clock_us) * 1000)
        return self.chance.randrange(period_ns)

    def clock(self, group: int, index: int, task: Task, phase_ns: int) -> None:
        def due(now: int) -> None:
            self.step(now, group, index, now, _WARM_NS <= now < self.until_ns)
            self.cell.at(now + task.period_ns, due)

        self.cell.at(phase_ns, due)

    def repeat(self, flow: Flow, group: int, period_ns: int, phase_ns: int) -> None:
        def due(now: int) -> None:
            self.send(now, flow, group, now, _WARM_NS <= now < self.until_ns)
            self.cell.at(now + period_ns, due)

        self.cell.at(phase_ns, due)

    def step(self, now: int, group: int, index: int, origin_ns: int, judged: bool) -> None:
        """A task steps: its messages are at the radio once they are computed."""
        task = self.described.tasks[index]
        number = self.steps[group, index] = self.steps.get((group, index), -1) + 1
        flows = [flow for flow in task.flows if number % flow.every == 0]
        if judged and not task.triggered:
            for flow in flows:
                if flow.name in self.firsts:
                    self.chains[self.firsts[flow.name].name].sent += 1
        takes_ns = round(self.setting.compute_us * 1000 * self.chance.uniform(0.9, 1.1))

        def ready(then: int) -> None:
            for flow in flows:
                self.send(then, flow, group, origin_ns, judged)

        self.cell.at(now + takes_ns, ready)

    def send(self, now: int, flow: Flow, group: int, origin_ns: int, judged: bool) -> None:
        sender, setting = self.member(group, flow.sender), self.setting
        met = self.messages.setdefault(flow.name, Met())
        if flow.to_all:
            receivers = (
                flow.receivers if flow.name == "update" else tuple(self.member(group, r) for r in flow.receivers)
            )
            met.sent += judged * len(receivers)
            tag = _Tag(flow, group, origin_ns, now, judged)
            self.cell.send(sender, dcf.frame(setting.standard, 0, flow.packet, receivers, to_all=True, tag=tag))
            return
        for index in flow.receivers:
            receiver = self.member(group, index)
            met.sent += judged
            tag = _Tag(flow, group, origin_ns, now, judged)
            made = dcf.frame(setting.standard, setting.rate_bit_s, flow.packet, (receiver,), tag=tag)
            if receiver == sender:  # by the loopback
                self.received(now, receiver, made)
            else:
                self.cell.send(sender, made)

    def background(self) -> None:
        """chrony and DDS, each at a time of its own."""
        until_ns = self.until_ns + _REST_NS
        for here in range(self.count):
            for there in range(self.count):
                if here != there and (at := self.chance.randrange(NTP_NS)) < until_ns:
                    self.cell.at(at, self.one(here, there, NTP_BYTES, "time", answered=True))
        for group in range(self.groups):
            for robot, (programs, _) in self.described.dds_peers.items():
                for _ in range(programs):
                    if (at := self.chance.randrange(SPDP_NS)) < until_ns:
                        self.cell.at(at, self.announce(self.member(group, robot)))

    def one(self, here: int, there: int, size: int, name: str, *, answered: bool = False) -> Callable[[int], None]:
        def due(now: int) -> None:
            if answered:
                self.cell.at(now + NTP_NS, due)
            flow = Flow(name, here, (there,), UDP_BYTES + size)
            judged = _WARM_NS <= now < self.until_ns
            self.messages.setdefault(name, Met()).sent += judged
            tag = _Tag(flow, -1 if answered else -2, now, now, judged)
            self.cell.send(
                here, dcf.frame(self.setting.standard, self.setting.rate_bit_s, flow.packet, (there,), tag=tag)
            )

        return due

    def announce(self, here: int) -> Callable[[int], None]:
        """A DDS program announces itself to all ports of all other robots, one after the other, as fast as it can."""

        def due(now: int) -> None:
            self.cell.at(now + SPDP_NS, due)
            for other in range(self.robots * self.groups):
                if other != here:
                    for _ in range(self.described.dds_peers[other % self.robots][1]):
                        self.one(here, other, SPDP_BYTES, "DDS discovery")(now)

        return due

    def beacon(self, now: int) -> None:
        """802.11-2007, 11.1.2.2: each member waits a random number of slots; whoever hears another's leaves its own."""
        standard = self.setting.standard
        size = beacon_bytes(self.described, standard)
        rate = standard.basic_bit_s[0]
        made = Frame((), standard.frame_ns(size, rate), 0, rate, size)
        draws = sorted((self.chance.randrange(2 * standard.cw_min + 1), member) for member in range(self.count))
        links = self.cell.links
        sending: list[tuple[int, int]] = []
        for slots, member in draws:
            if not any(slots > before and links.hears[other][member] for before, other in sending):
                sending.append((slots, member))
        for slots, member in sending:
            self.cell.at(now + slots * standard.slot_ns, functools.partial(self.send_first, member, made))
        self.cell.at(now + BEACON_NS, self.beacon)

    def send_first(self, member: int, made: Frame, _now: int) -> None:
        self.cell.send(member, made, first=True)

    # What arrives

    def received(self, now: int, receiver: int, frame: Frame) -> None:
        tag = frame.tag
        if not isinstance(tag, _Tag):
            return
        flow = tag.flow
        if tag.judged:
            self.messages[flow.name].latencies_ns.append(now - tag.given_ns)
        if tag.group < 0:
            if tag.group == -1:
                self.one(receiver, flow.sender, NTP_BYTES, flow.name)(now)
            return
        before = self.heard_ns.get((flow.name, receiver))
        if before is not None and before >= _WARM_NS and now < self.until_ns:
            self.silence_ns[flow.name] = max(self.silence_ns.get(flow.name, 0), now - before)
        self.heard_ns[flow.name, receiver] = now
        if tag.judged and flow.name in self.ends:
            self.chains[self.ends[flow.name].name].latencies_ns.append(now - tag.origin_ns)
        index = receiver - tag.group * self.robots
        for task in flow.triggers.get(index, ()):
            self.step(now, tag.group, task, tag.origin_ns, tag.judged)

    def result(self) -> Result:
        self.begin()
        self.cell.run(self.until_ns + _REST_NS)
        counts = self.cell.counts
        passed_s = self.cell.now_ns / 1e9
        silences = {name: silence / MS for name, silence in self.silence_ns.items()}
        return Result(
            self.groups, self.groups * self.robots, (self.until_ns - _WARM_NS) / 1e9, counts.frames / passed_s,
            counts.busy_ns / self.cell.now_ns, counts, self.messages, self.chains, silences,
        )  # fmt: skip


def merged(results: Sequence[Result]) -> Result:
    """Of runs of one size: all that they met together."""
    first = results[0]
    counts = Counts(
        **{each.name: sum(getattr(result.counts, each.name) for result in results) for each in fields(Counts)}
    )

    def together(of: Callable[[Result], dict[str, Met]]) -> dict[str, Met]:
        found: dict[str, Met] = {}
        for result in results:
            for name, met in of(result).items():
                all_of_them = found.setdefault(name, Met())
                all_of_them.latencies_ns.extend(met.latencies_ns)
                all_of_them.sent += met.sent
        return found

    silences: dict[str, float] = {}
    for result in results:
        for name, silence in result.silence_ms.items():
            silences[name] = max(silence, silences.get(name, 0.0))
    return Result(
        first.groups, first.robots, sum(result.seconds for result in results),
        sum(result.frames_s for result in results) / len(results),
        sum(result.busy for result in results) / len(results), counts,
        together(lambda result: result.messages), together(lambda result: result.chains), silences,
    )  # fmt: skip


def beacon_bytes(described: Description, standard: Phy) -> int:
    """Of a beacon in an ad hoc cell (802.11-2007, 7.2.3.1): fixed fields, SSID, rates, channel, ATIM window; of 802.11g
    also ERP information and further rates."""
    return phy.MAC_BYTES + 12 + 2 + described.ssid_bytes + 10 + 3 + 4 + 9 * (standard.rates_bit_s[-1] > 11_000_000)


def run(described: Description, setting: Setting, groups: int, seconds: float) -> Result:
    """Simulate `groups` times the described fleet for so long, and a little before and after."""
    return _Run(described, setting, groups, seconds).result()
