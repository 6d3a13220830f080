"""The robot's two tasks and its plant as one task, on this computer, by a clock that counts: seconds for a minute.

The tasks are those that images bring. In place of blocks with devices, of the queue and of datagrams there are wires
to the plant and to a script of commands. What drivers, bus and scheduling add, `virtual.py` shows.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import paths
from flotilla.fleet import identity, inventory
from flotilla.fleet.model import Fleet
from lab.plants import wheeled
from lab.wheeled import plant
from lab.wheeled.plant import AXES, Trouble

INVENTORY = Path(__file__).parent / "inventory"
PERIOD_S = 0.01
SLOWER = 10
"""Steps of `drive` in one of `perceive`."""
SCAN_AGE_S = 0.07
"""Of a scan when its last point is measured."""
_REMOVED = {
    "perceive": ("laser", "to_drive"),
    "drive": ("clearance", "command", "in", "report", "to_station", *AXES),
}

Row = dict[str, Any]


@dataclass(frozen=True)
class Command:
    """What a station says from `at_s` on."""

    at_s: float
    v: float = 0
    omega: float = 0
    boom: float = 0
    enable: bool = True
    heard: bool = True
    """False: nothing comes, or too long ago."""


@dataclass(frozen=True)
class Course:
    """A drive."""

    seconds: float
    commands: Sequence[Command]
    room: str = "corner"
    troubles: Sequence[Trouble] = ()
    figures: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    """Parameters that are not those of wheeled_robot.yml."""
    changes: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the tasks that are not those of their files, by `block.parameter`."""


def fleet() -> Fleet:
    return inventory.load_fleet(INVENTORY)


def task(course: Course, described: Fleet) -> dict[str, Any]:
    """The whole as one task."""
    tasks = identity.control_tasks(described, described.robot_with("drive"))
    blocks: dict[str, Any] = {}
    wires = _wires()
    for name, slower in (("perceive", SLOWER), ("drive", 1)):
        for block, told in yaml.safe_load(tasks[name])["blocks"].items():
            if block in _REMOVED[name]:
                continue
            if slower > 1:
                told["every"] = slower
            ends = {port: _wire(wires[name], name, wire) for port, wire in told.get("in", {}).items()}
            told["in"] = {port: end for port, end in ends.items() if end is not None}
            blocks[f"{name}_{block}"] = told
    for key, value in course.changes.items():
        block, parameter = key.split(".")
        blocks[block]["parameters"][parameter] = value
    blocks |= _script(course)
    drive = yaml.safe_load(tasks["drive"])["blocks"]
    for port, kind in (("target", "double"), ("enable", "boolean")):
        ends = [_wire(wires["drive"], "drive", drive[name]["in"][port]) for name in AXES]
        blocks[port] = {
            "type": "join",
            "in": {f"in{i}": end for i, end in enumerate(ends)},
            "parameters": {"inputs": len(ends), "type": kind},
        }
    blocks["robot"] = {
        "type": "wheeled-robot",
        "in": {"target": "target.out", "enable": "enable.out", "fault": "fault.out"},
        "parameters": {
            "figures": wheeled.figures(**course.figures),
            "walls": wheeled.walls(wheeled.ROOMS / f"{course.room}.yml"),
            "cluster": 4,
        },
    }
    return {"period": f"{PERIOD_S:g} s", "priority": 0, "blocks": blocks}


def _wires() -> dict[str, dict[str, object]]:
    """What becomes of outputs of the blocks that are not there, by task; None: the wire goes, too."""
    drive: dict[str, object] = {
        "clearance.data": "perceive_message.out", "clearance.flag": 1, "clearance.age": 0,
        "clearance.sequence": "robot.scans", "command.flag": "heard.on", "in.v": "script.position[0]",
        "in.omega": "script.position[1]", "in.boom": "script.position[2]", "in.enable": "enabled.on",
    }  # fmt: skip
    for index, name in enumerate(AXES):
        drive |= {
            f"{name}.enabled": f"robot.enabled[{index}]", f"{name}.position": f"robot.position[{index}]",
            f"{name}.flag": 1, f"{name}.sequence": None,
        }  # fmt: skip
    return {"drive": drive, "perceive": {"laser.ranges": "robot.ranges", "laser.flag": "sound.on",
                                         "laser.age": SCAN_AGE_S}}  # fmt: skip


def _wire(wires: Mapping[str, object], task: str, wire: object) -> object:
    if not isinstance(wire, str):
        return wire
    return wires.get(wire, f"{task}_{wire}")


def _script(course: Course) -> dict[str, Any]:
    rows: list[tuple[float, Sequence[float]]] = [
        (each.at_s, [each.v, each.omega, each.boom, float(each.enable), float(each.heard)]) for each in course.commands
    ]
    blocks = {"script": plant.steps(rows)}
    for index, name in ((3, "enabled"), (4, "heard")):
        blocks[name] = _flag(f"script.position[{index}]")
    for number, what in enumerate(("scanner", *AXES)):
        at: list[tuple[float, Sequence[float]]] = [(0.0, [0.0])]
        for trouble in course.troubles:
            if trouble.what == what:
                at += [(trouble.begin_s, [1.0]), (trouble.end_s, [0.0])]
        blocks[f"trouble{number}"] = plant.steps(at)
        blocks[f"is{number}"] = _flag(f"trouble{number}.position[0]")
    blocks["sound"] = {"type": "schmitt-trigger", "in": {"in": "well.out"}, "parameters": {"on": 0.5, "off": 0.5}}
    blocks["well"] = {"type": "sum", "in": {"in0": 1, "in1": "trouble0.position[0]"}, "parameters": {"signs": "+-"}}
    blocks["fault"] = {
        "type": "join",
        "in": {f"in{i}": f"is{i + 1}.on" for i in range(len(AXES))},
        "parameters": {"inputs": len(AXES), "type": "boolean"},
    }
    return blocks


def _flag(wire: str) -> dict[str, Any]:
    return {"type": "schmitt-trigger", "in": {"in": wire}, "parameters": {"on": 0.5, "off": 0.5}}


WATCHED = {
    "pose": "robot.pose", "motion": "robot.motion", "slip": "robot.slip", "contacts": "robot.contacts",
    "least": "robot.least", "position": "robot.position", "x": "drive_odometry.x", "y": "drive_odometry.y",
    "heading": "drive_odometry.heading", "seeing": "drive_seeing.out", "limited": "drive_stop.limited",
    "v": "drive_v_limit.out", "omega": "drive_omega_limit.out", "free": "drive_stop.free",
    "boom": "drive_boom_length.out",
}  # fmt: skip


def drive(course: Course, command: Sequence[str | Path], directory: Path, described: Fleet | None = None) -> list[Row]:
    """What was after each step. `command`: flotilla-run with the plant's blocks."""
    file = directory / "wheeled.yml"
    file.write_text(yaml.safe_dump(task(course, described or fleet())))
    steps = round(course.seconds / PERIOD_S)
    argv = [*command, "--no-wait", "--steps", str(steps), "--watch", ",".join(WATCHED.values()), file]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode:
        raise RuntimeError(f"{paths.shown(file)}: status {done.returncode}: {done.stderr}")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return [{name: line[signal] for name, signal in WATCHED.items()} for line in lines]
