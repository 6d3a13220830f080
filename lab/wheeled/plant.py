"""The plant as a task of its own: the robot's other end of bus and serial line, in a room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from lab.plants import wheeled

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
PERIOD_MS = 2
RECORD_STEPS = 5
"""Between two records."""
BITRATE = 1_000_000
NO_HOME = 1
"""In place of an error code: no fault, but a drive that is to search its home says that it cannot find it."""
_AT_ONCE_S = 1e-6


@dataclass(frozen=True)
class Trouble:
    """What is wrong with the devices from one time to another, in seconds after the plant's start."""

    begin_s: float
    end_s: float
    what: str
    """`scanner`: it is unplugged; `left`, `right` or `boom`: the drive finds a fault at the beginning, or no home."""
    code: int = 0x2310
    """EMCY error code: overcurrent."""


@dataclass(frozen=True)
class Plant:
    """Where and how the robot is."""

    room: str = "corner"
    troubles: Sequence[Trouble] = ()
    figures: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    """Parameters that are not those of wheeled_robot.yml."""


AXES = ("left", "right", "boom")


def task(plant: Plant, interface: str, laser: str, priority: int = 40) -> dict[str, Any]:
    """Drives on a CAN interface, the scanner at the link `laser`.

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
        "driven": {
            "type": "recorder",
            "every": RECORD_STEPS,
            "in": {name: signal for name, (signal, _, _) in RECORDED.items()},
            "parameters": {
                "directory": ".",
                "names": list(RECORDED),
                "types": [kind for _, kind, _ in RECORDED.values()],
                "widths": [width for _, _, width in RECORDED.values()],
                "sync": 0,
            },
        },
    }
    for name in AXES:
        blocks[name] = _pulses([(trouble, trouble.code) for trouble in plant.troubles if trouble.what == name])
    return {"period": f"{PERIOD_MS} ms", "phase": "1.5 ms", "priority": priority, "overruns": 0, "blocks": blocks}


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
