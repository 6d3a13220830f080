"""The robot's two tasks and its plant as one task, on this computer, by a clock that counts: seconds for a minute.

The tasks are those that images bring. In place of blocks with devices and of the queue there are wires to the plant;
datagrams with commands come from a file. What drivers, bus and scheduling add, `virtual.py` shows.
"""

from __future__ import annotations

import json
import struct
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import paths
from flotilla.fleet import identity, inventory
from flotilla.fleet.model import Fleet
from flotilla.lab.plants import wheeled
from flotilla.lab.wheeled import plant
from flotilla.lab.wheeled.guest import COMMAND
from flotilla.lab.wheeled.plant import AXES, Trouble

INVENTORY = Path(__file__).parent / "inventory"
PERIOD_S = 0.01
SLOWER = 10
"""Steps of `drive` in one of `perceive`."""
SCAN_AGE_S = 0.1
"""Of a scan when `perceive` takes it: a turn of the scanner after its first point."""
_REMOVED = {
    "perceive": ("laser", "to_drive"),
    "drive": ("clearance", "report", "to_station", *AXES),
}

Row = dict[str, Any]


_INTERVAL_S = 0.1
"""Between two commands of a station."""


@dataclass(frozen=True)
class Command:
    """What a station says from `at_s` on."""

    at_s: float
    v: float = 0
    omega: float = 0
    boom: float = 0
    enable: bool = True
    heard: bool = True
    """False: it says nothing."""


Datagram = tuple[float, bytes]
"""When it arrives, in s after the start, and its bytes."""


def datagrams(commands: Sequence[Command], seconds: float, operator: int = 1, phase_s: float = 0) -> list[Datagram]:
    """What a station sends, from the first command on; the times of sending begin at `phase_s`."""
    sent: list[Datagram] = []
    for index in range(round(seconds / _INTERVAL_S)):
        at_s = index * _INTERVAL_S + phase_s
        said = [command for command in commands if command.at_s <= at_s + 1e-6]
        if said and said[-1].heard:
            now = said[-1]
            values = (operator, len(sent) + 1, now.v, now.omega, now.boom, now.enable)
            sent.append((at_s, COMMAND.pack(*values)))
    return sent


@dataclass(frozen=True)
class Course:
    """A drive."""

    seconds: float
    commands: Sequence[Command]
    room: str = "corner"
    troubles: Sequence[Trouble] = ()
    figures: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    """Parameters that are not those of wheeled_robot.yml."""
    others: Sequence[Datagram] = ()
    """What comes to the robot's port beside the commands."""
    changes: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the tasks that are not those of their files, by `block.parameter`."""


def fleet() -> Fleet:
    return inventory.load_fleet(INVENTORY)


def task(courses: Sequence[Course], described: Fleet, directory: Path) -> dict[str, Any]:
    """The whole as one task; datagrams go to files there. Of several courses each is another robot's, in the room of
    the first."""
    blocks = _blocks(courses[0], described, directory / "datagrams")
    if len(courses) > 1:
        blocks = {}
        for index, course in enumerate(courses):
            own = _blocks(replace(course, room=courses[0].room), described, directory / f"datagrams{index}")
            blocks |= {_of(index, name): _renamed(block, index) for name, block in own.items()}
        for index in range(len(courses)):
            _meet(blocks, index, [other for other in range(len(courses)) if other != index])
    return {"period": f"{PERIOD_S:g} s", "priority": 0, "blocks": blocks}


def _of(index: int, name: str) -> str:
    """A block's name, or a signal's, of one of several robots."""
    return f"robot{index}_{name}"


def _renamed(block: dict[str, Any], index: int) -> dict[str, Any]:
    wires = {port: _of(index, wire) if isinstance(wire, str) else wire for port, wire in block.get("in", {}).items()}
    return block | ({"in": wires} if wires else {})


def _meet(blocks: dict[str, Any], index: int, others: Sequence[int]) -> None:
    """Let a robot see others, where they were in the step before."""
    poses = [f"{_of(other, 'robot')}.pose[{axis}]" for other in others for axis in range(3)]
    for name, kind, wires in (("others", "double", poses), ("there", "boolean", [1] * len(others))):
        blocks[_of(index, name)] = {
            "type": "join",
            "in": {f"in{i}": wire for i, wire in enumerate(wires)},
            "parameters": {"inputs": len(wires), "type": kind},
        }
        blocks[_of(index, "robot")]["in"][name] = f"{_of(index, name)}.out"
    blocks[_of(index, "robot")]["parameters"]["others"] = len(others)


def _blocks(course: Course, described: Fleet, file: Path) -> dict[str, Any]:
    """Of one robot; datagrams go to `file`."""
    tasks = identity.control_tasks(described, described.robot_with("drive"))
    blocks: dict[str, Any] = {}
    wires = _wires()
    for name, slower in (("perceive", SLOWER), ("drive", 1)):
        for block, told in yaml.safe_load(tasks[name])["blocks"].items():
            if block in _REMOVED[name]:
                continue
            if slower > 1:
                told["every"] = slower
            wired = {port: _wire(wires[name], name, wire) for port, wire in told.get("in", {}).items()}
            told["in"] = {port: end for port, end in wired.items() if end is not None}
            told.get("parameters", {}).pop("keys", None)  # nobody listens to its reports, or checks them
            blocks[f"{name}_{block}"] = told
    come = sorted([*datagrams(course.commands, course.seconds), *course.others], key=lambda each: each[0])
    file.write_bytes(b"".join(struct.pack("=d", at_s) + datagram for at_s, datagram in come))
    network = blocks["drive_command"]["parameters"]
    here = {"file": str(file), "length": network["length"], "timeout": network["timeout"]}
    blocks["drive_command"] = {"type": "datagrams", "parameters": here}
    for key, value in course.changes.items():
        block, parameter = key.split(".")
        blocks[block]["parameters"][parameter] = value
    blocks |= _troubles(course)
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
    return blocks


def _wires() -> dict[str, dict[str, object]]:
    """What becomes of outputs of the blocks that are not there, by task; None: the wire goes, too."""
    drive: dict[str, object] = {
        "clearance.data": "perceive_message.out", "clearance.flag": 1, "clearance.age": 0,
        "clearance.sequence": "robot.scans",
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


def _troubles(course: Course) -> dict[str, Any]:
    blocks: dict[str, Any] = {}
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
    "boom": "drive_boom_length.out", "alive": "drive_alive.out", "operator": "drive_guard.operator",
    "other": "drive_guard.other", "conflict": "drive_guard.conflict", "refused": "drive_guard.refused",
    "command": "drive_in.sequence", "enabled": "drive_in.enable",
}  # fmt: skip


def drive(course: Course, command: Sequence[str | Path], directory: Path, described: Fleet | None = None) -> list[Row]:
    """What was after each step. `command`: flotilla-run with the plant's blocks."""
    (rows,) = drive_together([course], command, directory, described)
    return rows


def drive_together(
    courses: Sequence[Course], command: Sequence[str | Path], directory: Path, described: Fleet | None = None
) -> list[list[Row]]:
    """Several robots in the room of the first course, for as long as that: each one's rows. They see each other."""
    file = directory / "wheeled.yml"
    file.write_text(yaml.safe_dump(task(courses, described or fleet(), directory)))
    steps = round(courses[0].seconds / PERIOD_S)
    watched = [
        {name: _of(index, signal) if len(courses) > 1 else signal for name, signal in WATCHED.items()}
        for index in range(len(courses))
    ]
    watch = ",".join(signal for each in watched for signal in each.values())
    argv = [*command, "--no-wait", "--steps", str(steps), "--watch", watch, file]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode:
        raise RuntimeError(f"{paths.shown(file)}: status {done.returncode}: {done.stderr}")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return [[{name: line[signal] for name, signal in each.items()} for line in lines] for each in watched]
