"""What a fleet sends over the air, read from its description: inventory, `messages.yml` and rendered control tasks.

| traffic | from where |
|---|---|
| messages between tasks, reports to stations | blocks that send, as robots get them: addresses, lengths, periods |
| hops | tasks with a trigger: they send once its message is there |
| positions from a station | tasks with a block `igps`, one for each of their steps |
| time | chrony: every member asks every other one each 64 s (`chrony.conf.j2`) |
| DDS discovery | `dds_peers`: every program announces itself to each peer, each 28 s (decision 37) |
| an update by multicast | `network.update_kbit_s`, where it is asked for |
| beacons | one in each 102.4 ms, of whichever member is first |

What an app sends, ROS's topics, SSH, and what DDS programs say to each other when they start are not in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from flotilla.common.errors import UserError
from flotilla.fleet import identity, transport
from flotilla.fleet.model import Fleet
from flotilla.updates import multicast

UDP_BYTES = 20 + 8
"""IPv4 and UDP."""
PROOF_BYTES = 40
"""Behind a message that proves its sender (runtime/core/authentication.h)."""
DDS_BYTES = 20 + 12 + 24 + 4 + 16 + 4
"""Before a message's bytes in a DDS topic: RTPS header, INFO_TS, DATA (DDSI-RTPS 2.1, 9.4), encapsulation, and what
`Bytes` of runtime/idl has before its data."""
SPDP_BYTES = 450
"""An announcement of a DDS program, about: parameters of the participant, with its host's and its process's name."""
SPDP_NS = 28_000_000_000
NTP_BYTES = 48 + 4 + 16
"""With number and code of the key, AES-CMAC (RFC 8573)."""
NTP_NS = 64_000_000_000
"""chrony's longest interval, `maxpoll 6`, which it reaches once clocks agree."""
IGPS_BYTES = 16
BEACON_NS = 102_400_000
"""100 time units of 1024 µs."""
_MULTICAST = ("224.", "225.", "226.", "227.", "228.", "229.", "23")


@dataclass(frozen=True)
class Flow:
    """What a task, or a station, sends again and again."""

    name: str
    """Of the message, where it is one."""
    sender: int
    """Member of the group: robots in the inventory's order, then stations."""
    receivers: tuple[int, ...]
    """Likewise. Each gets a frame of its own, unless it is to all."""
    packet: int
    """Bytes of the IP packet."""
    every: int = 1
    """It goes in every Nth step of the task."""
    to_all: bool = False
    deadline_ms: int | None = None
    triggers: Mapping[int, Sequence[int]] = field(default_factory=dict, hash=False)
    """By receiver: tasks, by index, that step when it arrives."""


@dataclass(frozen=True)
class Task:
    """A control task on one robot."""

    name: str
    robot: int
    period_ns: int
    triggered: bool
    flows: tuple[Flow, ...]


@dataclass(frozen=True)
class Chain:
    """Messages that one step sets off, hop by hop, to the task that acts."""

    flows: tuple[str, ...]
    period_ns: int
    """Of the first task: the last hop is on time when it arrives before the next step."""

    @property
    def name(self) -> str:
        return " → ".join(self.flows)


@dataclass(frozen=True)
class Description:
    """The traffic of one group: the fleet as it is described."""

    name: str
    robots: tuple[str, ...]
    stations: tuple[str, ...]
    tasks: tuple[Task, ...]
    chains: tuple[Chain, ...]
    positions: tuple[tuple[Flow, int], ...]
    """From a station to robots, each with its period in ns."""
    update: Flow | None
    """A frame of an update, and …"""
    update_ns: int
    """… the time to the next one."""
    dds_peers: Mapping[int, tuple[int, int]]
    """By robot: its DDS programs, and the ports of each other robot of the fleet at which they announce themselves."""
    ssid_bytes: int


def describe(fleet: Fleet) -> Description:
    """UserError where nothing goes over the air: then any number of robots could be carried."""
    robots = list(fleet.robots.values())
    members = {str(host.address): index for index, host in enumerate([*robots, *fleet.stations])}
    rendered = [
        (index, name, yaml.load(content, yaml.BaseLoader))
        for index, robot in enumerate(robots)
        for name, content in identity.control_tasks(fleet, robot).items()
    ]
    listening = [_listening(fleet, task) for _, _, task in rendered]
    heard_by = [members.get(address) if address else None for address in (each[1] for each in listening)]
    tasks = []
    for index, (robot, name, task) in enumerate(rendered):
        flows = tuple(_sent(fleet, members, rendered, listening, heard_by, robot, task))
        period_ns = round(transport.duration_s(task["period"]) * 1e9)
        tasks.append(Task(name, robot, period_ns, listening[index][0] is not None, flows))
    positions = tuple(_positions(fleet, rendered))
    if not any(set(flow.receivers) - {flow.sender} for task in tasks for flow in task.flows) and not positions:
        raise UserError(
            f"{fleet.name}: no control task of the inventory sends anything to another robot or to a station, so the "
            "channel stays empty; list control tasks in robots.yml, or take INVENTORY=flotilla/lab/scenarios/inventory"
        )
    stations = tuple(range(len(robots), len(robots) + len(fleet.stations)))
    everybody = tuple(range(len(robots)))
    packet = UDP_BYTES + multicast.OVERHEAD + multicast.SYMBOL
    update = Flow("update", stations[0], everybody, packet, to_all=True) if stations else None
    programs = {
        index: (sum(robot == index and _uses_dds(task) for robot, _, task in rendered), len(each.control_tasks) + 1)
        for index, each in enumerate(robots)
    }
    return Description(
        fleet.name, tuple(robot.name for robot in robots), tuple(host.name for host in fleet.stations), tuple(tasks),
        tuple(_chains(tasks)), positions, update,
        round((multicast.SYMBOL + multicast.OVERHEAD + multicast.HEADERS) * 8e6 / fleet.network.update_kbit_s),
        programs, len(fleet.network.ibss.ssid) if fleet.network.ibss else 8,
    )  # fmt: skip


def _blocks(task: Any, *kinds: str) -> Iterator[tuple[str, dict[str, Any], int]]:
    """Name, parameters, and every how many steps."""
    for name, block in task["blocks"].items():
        if block["type"] in kinds:
            yield name, block.get("parameters") or {}, int(block.get("every", 1))


def _uses_dds(task: Any) -> bool:
    return any(_blocks(task, "dds-publish", "dds-subscribe"))


def _listed(value: Any) -> list[str]:
    return [str(each) for each in value] if isinstance(value, list) else [str(value)]


def _listening(fleet: Fleet, task: Any) -> tuple[str | None, str | None]:
    """What makes a task step: a port or topic, and the address that it is first listened to from; None: the clock."""
    for name, parameters, _ in _blocks(task, "udp-receive", "dds-subscribe"):
        if name == task.get("trigger"):
            if "topic" in parameters:
                first = int(_listed(parameters.get("robot", 0))[0])
                robot = fleet.robots.get(first)
                return str(parameters["topic"]), str(robot.address) if robot else None
            come = _listed(parameters["from"])[0] if "from" in parameters else None
            return str(parameters["port"]), come
    return None, None


def _sent(
    fleet: Fleet, members: Mapping[str, int], rendered: Sequence[tuple[int, str, Any]],
    listening: Sequence[tuple[str | None, str | None]], heard_by: Sequence[int | None], robot: int, task: Any,
) -> Iterator[Flow]:  # fmt: skip
    names = {str(message.port): name for name, message in fleet.messages.items()}

    def woken(where: str, receivers: Sequence[int]) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for other, (there, _, _) in enumerate(rendered):
            if there in receivers and listening[other][0] == where and heard_by[other] in (None, robot):
                found.setdefault(there, []).append(other)
        return found

    for _, parameters, every in _blocks(task, "udp-send"):
        port, to = str(parameters["port"]), _listed(parameters["address"])
        name = names.get(port, f"port {port}")
        message = fleet.messages.get(name)
        to_all = any(each.startswith(_MULTICAST) or each.endswith(".255") for each in to)
        receivers = (
            tuple(each for each in members.values() if each != robot)
            if to_all
            else tuple(members[each] for each in to if each in members)
        )
        packet = UDP_BYTES + int(parameters.get("length", message.bytes if message else 0))
        packet += PROOF_BYTES if parameters.get("keys") else 0
        deadline = message.deadline_ms if message else None
        yield Flow(name, robot, receivers, packet, every, to_all, deadline, woken(port, receivers))
    for _, parameters, every in _blocks(task, "dds-publish"):
        topic = str(parameters["topic"])
        receivers = tuple(
            dict.fromkeys(
                there
                for there, _, other in rendered
                for _, others, _ in _blocks(other, "dds-subscribe")
                if str(others["topic"]) == topic
            )
        )
        message = fleet.messages.get(topic)
        size = int(parameters.get("bytes", message.bytes if message else 64))
        deadline = message.deadline_ms if message else None
        yield Flow(
            topic, robot, receivers, UDP_BYTES + DDS_BYTES + size, every, False, deadline, woken(topic, receivers)
        )


def _positions(fleet: Fleet, rendered: Sequence[tuple[int, str, Any]]) -> Iterator[tuple[Flow, int]]:
    for robot, _, task in rendered:
        for _, parameters, _ in _blocks(task, "igps"):
            if fleet.stations:
                packet = UDP_BYTES + IGPS_BYTES + (PROOF_BYTES if parameters.get("keys") else 0)
                flow = Flow("positions", len(fleet.robots), (robot,), packet)
                yield flow, round(transport.duration_s(task["period"]) * 1e9)


def _chains(tasks: Sequence[Task]) -> list[Chain]:
    """From each task that steps by the clock, along triggers, to each message that triggers no further one to a task.
    Where tasks send to stations only, each of those messages by itself."""
    if chains := list(_between_tasks(tasks)):
        return chains
    return [Chain((flow.name,), task.period_ns * flow.every) for task in tasks for flow in task.flows]


def _between_tasks(tasks: Sequence[Task]) -> Iterator[Chain]:
    robots = {task.robot for task in tasks}

    def onward(task: Task, passed: tuple[str, ...], seen: frozenset[str]) -> Iterator[tuple[str, ...]]:
        ends = True
        for flow in task.flows:
            if not set(flow.receivers) & robots:
                continue
            ends = False
            woken = [tasks[index] for there in flow.triggers.values() for index in there]
            woken = [each for each in woken if each.name not in seen]
            if not woken:
                yield (*passed, flow.name)
            for each in woken:
                yield from onward(each, (*passed, flow.name), seen | {each.name})
        if ends and passed:
            yield passed

    for task in tasks:
        if not task.triggered:
            for flows in dict.fromkeys(onward(task, (), frozenset({task.name}))):
                yield Chain(flows, task.period_ns)
