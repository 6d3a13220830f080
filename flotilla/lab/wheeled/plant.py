"""The plant as a task of its own: the robot's other end of bus and serial line, in a room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from flotilla.lab.plants import wheeled
from flotilla.station.recording import Field, Value

RECORDED = {
    "pose": ("robot.pose", "double", 3),
    "motion": ("robot.motion", "double", 2),
    "least": ("robot.least", "double", 1),
    "contacts": ("robot.contacts", "uint32", 1),
    "position": ("robot.position", "double", 3),
    "powered": ("drives.enable", "boolean", 3),
    "frames": ("drives.frames", "uint32", 1),
    "bits": ("drives.bits", "uint64", 1),
    "unsent": ("drives.lost", "uint32", 1),
    "scans": ("scanner.sent", "uint32", 1),
}
"""What it records: signal, type and width by name."""
TRUTH = {name: RECORDED[name] for name in ("pose", "motion", "least", "contacts", "position", "powered", "scans")}
"""What it tells a station, in this order and without gaps."""
TRUTH_PORT = 5099
"""UDP port of that."""
TRUTH_STEPS = 25
"""Between two of these."""
PERIOD_MS = 2
RECORD_STEPS = 5
"""Between two records."""
BITRATE = 1_000_000
NO_HOME = 1
"""In place of an error code: no fault, but a drive that is to search its home says that it cannot find it."""
NO_POWER = 2
"""In place of an error code: the drive is without power, and begins anew at the end."""
_AT_ONCE_S = 1e-6


@dataclass(frozen=True)
class Trouble:
    """What is wrong with the devices from one time to another, in seconds after the plant's start."""

    begin_s: float
    end_s: float
    what: str
    """`scanner`: it is unplugged; `left`, `right` or `boom`: its drive has this trouble."""
    code: int = 0x2310
    """EMCY error code of the fault that it finds at the beginning, such as overcurrent; or NO_HOME or NO_POWER."""


POSE_PORT = 5080
"""Others' poses come to this UDP port and the other's number."""
POSE_STEPS = 10
"""Between two of them."""
AWAY_S = 10.0
"""A robot whose plant is silent for so long is not in the room any more."""


@dataclass(frozen=True)
class Room:
    """Who else is in the room, by plants of their own."""

    number: int
    """This robot's."""
    others: Mapping[int, str]
    """Addresses by number."""


@dataclass(frozen=True)
class Plant:
    """Where and how the robot is."""

    room: str = "corner"
    troubles: Sequence[Trouble] = ()
    figures: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    """Parameters that are not those of wheeled_robot.yml."""


AXES = ("left", "right", "boom")


def task(
    plant: Plant, interface: str, laser: str, priority: int = 40, station: str = "", room: Room | None = None
) -> dict[str, Any]:
    """Drives on a CAN interface, the scanner at the link `laser`. It records, or tells the address `station`.

    Of less priority than the robot's tasks and not released with them: devices have processors of their own.
    """
    blocks: dict[str, Any] = {
        "drives": {
            "type": "epos2-drives",
            "in": {name: f"robot.{name}" for name in ("position", "speed", "torque")} | {"error": "error.out"},
            "parameters": {"interface": interface, "nodes": [1, 2, 3], "gear": 43},
        },
        "robot": {
            "type": "wheeled-robot",
            "in": {name: f"drives.{name}" for name in ("target", "enable", "mode")},
            "parameters": {
                "figures": wheeled.figures(**plant.figures),
                "walls": wheeled.walls(wheeled.ROOMS / f"{plant.room}.yml"),
            },
        },
        "scanner": {
            "type": "urg-scanner",
            "in": {"millimetres": "robot.millimetres", "scans": "robot.scans", "unplugged": "unplugged.on"},
            "parameters": {"link": laser},
        },
        "error": {
            "type": "join",
            "in": {f"in{i}": f"{name}.position[0]" for i, name in enumerate(AXES)},
            "parameters": {"inputs": len(AXES)},
        },
        "unplugged": {
            "type": "schmitt-trigger",
            "in": {"in": "unplug.position[0]"},
            "parameters": {"on": 0.5, "off": 0.5},
        },
        "unplug": _pulses([(trouble, 1) for trouble in plant.troubles if trouble.what == "scanner"]),
    }
    blocks |= _told(station) if station else _recorded()
    if room and room.others:
        blocks["robot"]["in"] |= {"others": "others.out", "there": "there.out"}
        blocks["robot"]["parameters"]["others"] = len(room.others)
        blocks |= _together(room)
    for name in AXES:
        blocks[name] = _pulses([(trouble, trouble.code) for trouble in plant.troubles if trouble.what == name])
    return {"period": f"{PERIOD_MS} ms", "phase": "1.5 ms", "priority": priority, "overruns": 0, "blocks": blocks}


def truth(datagram: bytes) -> dict[str, Value]:
    """What the plant told."""
    return {field.name: field.of(datagram) for field in _fields()}


def _fields() -> list[Field]:
    fields: list[Field] = []
    for name, (_, kind, width) in TRUTH.items():
        fields.append(Field(name, kind, width, fields[-1].end if fields else 0))
    return fields


def _recorded() -> dict[str, Any]:
    return {"driven": _all("recorder", RECORDED, RECORD_STEPS, directory=".", sync=0)}


def _told(station: str) -> dict[str, Any]:
    return {
        "truth": _all("pack", TRUTH, TRUTH_STEPS),
        "to_station": {
            "type": "udp-send",
            "every": TRUTH_STEPS,
            "in": {"data": "truth.out"},
            "parameters": {"address": station, "port": TRUTH_PORT, "length": _fields()[-1].end},
        },
    }


def _together(room: Room) -> dict[str, Any]:
    """Where the robot is, to the others; where they are."""
    poses = [f"pose{number}.pose[{axis}]" for number in room.others for axis in range(3)]
    blocks: dict[str, Any] = {
        "own": {"type": "pack", "every": POSE_STEPS, "in": {"pose": "robot.pose"}, "parameters": _pose()},
        "to_others": {
            "type": "udp-send",
            "every": POSE_STEPS,
            "in": {"data": "own.out"},
            "parameters": {"address": list(room.others.values()), "port": POSE_PORT + room.number, "length": 24},
        },
    }
    for number, address in room.others.items():
        blocks[f"other{number}"] = {
            "type": "udp-receive",
            "parameters": {"port": POSE_PORT + number, "from": address, "length": 24, "timeout": AWAY_S},
        }
        blocks[f"pose{number}"] = {"type": "unpack", "in": {"in": f"other{number}.data"}, "parameters": _pose()}
    there = [f"other{number}.flag" for number in room.others]
    for name, kind, wires in (("others", "double", poses), ("there", "boolean", there)):
        ends = {f"in{i}": wire for i, wire in enumerate(wires)}
        blocks[name] = {"type": "join", "in": ends, "parameters": {"inputs": len(wires), "type": kind}}
    return blocks


def _pose() -> dict[str, Any]:
    return {"names": ["pose"], "types": ["double"], "widths": [3]}


def _all(kind: str, signals: Mapping[str, tuple[str, str, int]], every: int, **parameters: object) -> dict[str, Any]:
    """A block that takes them all."""
    return {
        "type": kind,
        "every": every,
        "in": {name: signal for name, (signal, _, _) in signals.items()},
        "parameters": {
            "names": list(signals),
            "types": [kind for _, kind, _ in signals.values()],
            "widths": [width for _, _, width in signals.values()],
            **parameters,
        },
    }


def steps(rows: Sequence[tuple[float, Sequence[float]]]) -> dict[str, Any]:
    """A block whose signal jumps to these values at these times, the first at 0."""
    times, points = [0.0], list(rows[0][1])
    for (_, before), (at_s, after) in pairwise(rows):
        times += [at_s, at_s + _AT_ONCE_S]
        points += [*before, *after]
    times.append(times[-1] + 1)
    points += rows[-1][1]
    return {"type": "trajectory", "parameters": {"waypoints": points, "times": times, "dimensions": len(rows[0][1])}}


def _pulses(troubles: Sequence[tuple[Trouble, float]]) -> dict[str, Any]:
    rows: list[tuple[float, Sequence[float]]] = [(0.0, [0.0])]
    for trouble, value in troubles:
        rows += [(trouble.begin_s, [value]), (trouble.end_s, [0.0])]
    return steps(rows)
