"""The same by computation: how many frames a saturated cell carries, and what waiting for less than that costs.

Saturation is Bianchi's model (IEEE Journal on Selected Areas in Communications 18(3), 2000), EIFS after collisions.
A cell that is not saturated is taken for a queue with a fixed service time at that rate (M/D/1, Pollaczek and
Khinchine). Both assume that frames come independently of each other: robots that step at once do not, and the hops of a
chain never meet each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from flotilla.lab.radio import phy
from flotilla.lab.radio.load import Setting, beacon_bytes
from flotilla.lab.radio.phy import Phy
from flotilla.lab.radio.traffic import BEACON_NS, NTP_BYTES, NTP_NS, SPDP_BYTES, SPDP_NS, UDP_BYTES, Description


@dataclass(frozen=True)
class Computed:
    """For so many groups of robots."""

    frames_s: float
    """Offered in a second, without ACKs and repetitions."""
    air: float
    """Share of time that they, their ACKs and SIFS take when none collides; may be above 1."""
    utilisation: float
    """Offered frames by what the saturated cell carries. From 1 on, queues grow without end."""
    chain_ms: dict[str, float]
    """Mean latency of chains; infinite from a utilisation of 1 on."""


def transmits(stations: int, cw_min: int, doublings: int) -> float:
    """Probability that a saturated station sends in a slot: Bianchi's (7) and (9)."""
    window = cw_min + 1

    def sends(collides: float) -> float:
        return 2 / (1 + window + collides * window * sum((2 * collides) ** stage for stage in range(doublings)))

    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if 1 - (1 - sends(middle)) ** (stations - 1) > middle:
            low = middle
        else:
            high = middle
    return sends(low)


def saturation_s(standard: Phy, stations: int, data_ns: float, ack_ns: float) -> float:
    """Frames a second that a cell delivers when each station always has one."""
    doublings = round(math.log2((standard.cw_max + 1) / (standard.cw_min + 1)))
    tau = transmits(stations, standard.cw_min, doublings)
    nobody, one = (1 - tau) ** stations, stations * tau * (1 - tau) ** (stations - 1)
    success_ns = data_ns + standard.sifs_ns + ack_ns + standard.difs_ns
    collision_ns = data_ns + standard.eifs_ns
    return 1e9 * one / (nobody * standard.slot_ns + one * success_ns + (1 - nobody - one) * collision_ns)


def compute(described: Description, setting: Setting, groups: int) -> Computed:
    """Of a room in which everybody hears everybody, and noise destroys nothing."""
    standard, rate = setting.standard, setting.rate_bit_s
    robots = len(described.robots) * groups
    members = robots + len(described.stations)
    sent: list[tuple[float, int, bool]] = []  # a second, bytes of the packet, to all
    senders = set()
    for task in described.tasks:
        for flow in task.flows:
            copies = 1 if flow.to_all else sum(receiver != flow.sender for receiver in flow.receivers)
            if copies:
                senders.add(flow.sender)
            sent.append((1e9 / task.period_ns / flow.every * copies * groups, flow.packet, flow.to_all))
    for flow, period_ns in described.positions:
        sent.append((1e9 / period_ns * groups, flow.packet, False))
    sent.append((2e9 / NTP_NS * members * (members - 1), UDP_BYTES + NTP_BYTES, False))
    programs = sum(count for count, _ in described.dds_peers.values())
    if programs:
        ports = sum(ports for _, ports in described.dds_peers.values()) * groups
        sent.append((1e9 / SPDP_NS * programs * groups * ports, UDP_BYTES + SPDP_BYTES, False))
    if setting.update and described.update:
        sent.append((1e9 / described.update_ns, described.update.packet, True))
    beacon = beacon_bytes(described, standard) - phy.LLC_BYTES - phy.MAC_BYTES
    sent.append((1e9 / BEACON_NS, beacon, True))

    frames_s = sum(each for each, _, _ in sent)
    ack_ns = standard.ack_ns(rate)

    def data_ns(packet: int, to_all: bool) -> float:
        size = packet + phy.LLC_BYTES + phy.MAC_BYTES
        if to_all:
            return standard.frame_ns(size, standard.basic_bit_s[0])
        return standard.protection_ns(rate) + standard.frame_ns(size, rate)

    mean_data_ns = sum(each * data_ns(packet, to_all) for each, packet, to_all in sent) / frames_s
    acked = sum(each for each, _, to_all in sent if not to_all) / frames_s
    mean_ack_ns = acked * (standard.sifs_ns + ack_ns) - standard.sifs_ns
    air = frames_s * (mean_data_ns + standard.sifs_ns + mean_ack_ns) / 1e9
    stations = max(2, len(senders) * groups + len(described.stations) * bool(described.positions))
    utilisation = frames_s / saturation_s(standard, stations, mean_data_ns, mean_ack_ns)
    service_ms = 1e3 * utilisation / frames_s
    wait_ms = utilisation * service_ms / (2 * (1 - utilisation)) if utilisation < 1 else math.inf
    packets = {flow.name: flow.packet for task in described.tasks for flow in task.flows}
    return Computed(
        frames_s, air, utilisation,
        {
            chain.name: sum(
                setting.compute_us / 1e3 + wait_ms + data_ns(packets[name], False) / 1e6 for name in chain.flows
            )
            for chain in described.chains
        },
    )  # fmt: skip
