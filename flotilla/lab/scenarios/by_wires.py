"""The floating robot's five tasks and its plant as one task, on this computer, by a clock that counts.

The tasks are those that images bring. In place of messages, devices and queues there are wires, so a flight takes
seconds, and it shows what control does. What the network adds, `virtual.py` shows.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import paths
from flotilla.fleet import identity
from flotilla.lab.plants import plant
from flotilla.lab.scenarios import virtual

PERIOD_S = 0.01
FIVE = ("sensors", "navigation", "control", "thruster-mapping", "valves")
_REMOVED = ("udp-receive", "udp-send", "unpack", "pack", "igps", "dsp3000", "ir104-pbf", "queue-receive", "queue-send")
_SWITCHED = {True: "on", False: "off"}
_WIRE = re.compile(r"(?P<block>[\w-]+)\.(?P<port>\w+)(?P<element>\[\d+\])?")
_WATCHED = {"wanted": "control_path.position", "flying": "control_begun.on", "done": "control_path.done",
            "pose": "robot.pose", "on_time": "robot.on_time", "switches": "robot.switches"}  # fmt: skip


@dataclass(frozen=True)
class Flown:
    """What came of the flight, while the path was commanded; as `flight.Flight` counts it."""

    rms_m: float
    max_m: float
    max_heading_rad: float
    on_time_s: float
    firings: int


def fly(
    side_m: float,
    command: Sequence[str | Path],
    directory: Path,
    changes: Mapping[str, object] | None = None,
    **figures: float | Sequence[float],
) -> Flown:
    """Once around the square. `command`: flotilla-run with the plant's blocks; `changes`: parameters of tasks, by
    `task.block.parameter`; `figures`: those of the plant that are not those of floating_robot.yml."""
    plan = virtual.square("wires", "", side_m)
    file = directory / "square.yml"
    file.write_text(yaml.safe_dump(task({**plan.changes, **(changes or {})}, figures)))
    watch = ",".join(_WATCHED.values())
    argv = [*command, "--no-wait", "--steps", str(round(plan.seconds / PERIOD_S)), "--watch", watch, file]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode:
        raise RuntimeError(f"{paths.shown(file)}: status {done.returncode}: {done.stderr}")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    flown = [{name: row[signal] for name, signal in _WATCHED.items()} for row in rows]
    path = [row for row in flown if row["flying"] and not row["done"]]
    if not flown[-1]["done"]:
        raise RuntimeError(f"{paths.shown(file)}: the path was not commanded to its end")
    return _of(path)


def _of(path: Sequence[dict[str, Any]]) -> Flown:
    errors = [math.dist(row["wanted"], row["pose"][:2]) for row in path]
    begin, end = path[0], path[-1]
    return Flown(
        math.sqrt(sum(error * error for error in errors) / len(errors)),
        max(errors),
        max(abs(row["pose"][2]) for row in path),
        sum(end["on_time"]) - sum(begin["on_time"]),
        (sum(end["switches"]) - sum(begin["switches"])) // 2,
    )


def task(changes: Mapping[str, object], figures: plant.Values) -> dict[str, Any]:
    """The whole as one task."""
    fleet = virtual.fleet("udp")
    described: dict[str, dict[str, Any]] = {
        name: yaml.safe_load(text)["blocks"]
        for robot in fleet.robots.values()
        for name, text in identity.control_tasks(fleet, robot).items()
    }
    for key, value in changes.items():
        name, block, parameter = key.split(".")
        described[name][block]["parameters"][parameter] = value
    blocks: dict[str, Any] = {}
    for index, name in enumerate(FIVE):
        before = FIVE[index - 1] if index else None
        for block, told in described[name].items():
            if told["type"] in _REMOVED or (name, block) == ("valves", "clock"):
                continue
            wired = {port: _wire(described, name, before, end) for port, end in told.get("in", {}).items()}
            if "parameters" in told:  # `on` and `off` are booleans in YAML 1.1
                told["parameters"] = {_SWITCHED.get(key, key): value for key, value in told["parameters"].items()}
            blocks[f"{name}_{block}"] = told | ({"in": wired} if wired else {})
    return {"period": f"{PERIOD_S:g} s", "priority": 0, "blocks": blocks | _robot(figures)}


def _wire(described: Mapping[str, dict[str, Any]], name: str, before: str | None, end: object) -> object:
    """The end of a wire in the joined task."""
    if not isinstance(end, str):
        return end
    found = _WIRE.fullmatch(end)
    assert found, end
    block, port, element = found["block"], found["port"], found["element"] or ""
    if block == "in":  # a message's signal is what its sender put into it
        assert before, end
        sent = described[before]["message"]["in"][port]
        return _wire(described, before, _before(before), f"{sent}{element}" if isinstance(sent, str) else sent)
    there = {
        "igps.position": "robot.igps",
        "igps.sequence": "count.low",
        "gyro.rate": "rate.out",
        "force.data": "force.out",
    }
    if wire := there.get(f"{block}.{port}") if name == "sensors" else None:
        return wire + element
    if port == "flag":
        return 1
    return f"{name}_{end}"


def _before(name: str) -> str | None:
    index = FIVE.index(name)
    return FIVE[index - 1] if index else None


def _robot(figures: plant.Values) -> dict[str, Any]:
    """The plant, and what its sensors and the queue of forces say."""
    return {
        "robot": {
            "type": "floating-robot",
            "in": {"valves": "thruster-mapping_thrusters.valves"},
            "parameters": yaml.safe_load(plant.ROBOT.read_text()) | dict(figures),
        },
        # The gyro's positive rate is clockwise.
        "rate": {"type": "gain", "in": {"in": "robot.rate_deg_s"}, "parameters": {"factor": -math.pi / 180}},
        "clock": {"type": "clock"},
        "counted": {
            "type": "pack",
            "in": {"step": "clock.step"},
            "parameters": {"names": ["step"], "types": ["uint64"]},
        },
        "count": {
            "type": "unpack",
            "in": {"in": "counted.out"},
            "parameters": {"names": ["low", "high"], "types": ["uint32", "uint32"]},
        },
        "force": {
            "type": "delay",
            "in": {"in": "valves_force.out"},
            "parameters": {"width": 3},
        },
    }
