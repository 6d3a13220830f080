"""Courses in virtual time: one guest that boots the shipped system, with the robot's tasks, drivers and CAN.

The tasks are those that images bring, rendered for the fleet of `inventory/`. Two CAN boards are on one bus: the
robot's own, and the drives'. The scanner is a pseudo terminal, as its USB has no bit rate. A run repeats to the byte.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import progress
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.fleet import identity, message_keys
from flotilla.fleet.model import Board, Fleet
from flotilla.lab.latency import machine, results, subject
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.flight import Record, records
from flotilla.lab.scenarios.virtual import PLANT, far
from flotilla.lab.wheeled import plant
from flotilla.lab.wheeled.by_wires import fleet
from flotilla.lab.wheeled.plant import BITRATE, NO_HOME, NO_POWER, Plant, Trouble
from flotilla.station import telemetry

HERE = Path(__file__).parent
DIRECTORY = subject.DIRECTORY
# In slots whose interrupts differ: one that they share would wake the robot's threads for the drives' board, too.
CAN_BOARDS = (
    "-object", "can-bus,id=bus",
    "-device", "kvaser_pci,canbus=bus,addr=6", "-device", "kvaser_pci,canbus=bus,addr=7",
)  # fmt: skip
SHIFT = 2
"""An instruction takes 2**SHIFT ns: 250 million a second, twice those of other labs. Drives, scanner and floor take the
guest's processor, too; with the others' 125 million they left out two thirds of their steps."""
OWN, DRIVES = "can0", "can1"
BUS_OFF, RESTARTED = 0x40, 0x100
"""Reports of a controller: CAN_ERR_BUSOFF, CAN_ERR_RESTARTED."""
LASER = "/dev/robot/laser"
COMMAND_PORT = 5030
"""As drive.yml has it."""
TASKS = ("perceive", "drive")
_KEYS = f"{DIRECTORY}/{message_keys.CREDENTIAL}"
_BOOT_LIMIT_S = 600
_LIMIT_PER_SECOND = 40
"""Of the host's clock, for each virtual second: finite, and generous to a busy host."""

Said = tuple[float, float, float, bool]
"""v, omega, boom, enable."""


@dataclass(frozen=True)
class Course:
    """What a station commands, and what happens meanwhile. Times are seconds after the tasks' start."""

    name: str
    seconds: float
    commands: Sequence[tuple[float, Said | None]]
    """None: silence."""
    plant: Plant = field(default_factory=Plant)
    events: Sequence[tuple[float, Sequence[str | int]]] = ()
    """`link`, an interface, and `down` or `up`; or `report`, a CAN interface, and what its controller reports."""
    disturbances: Sequence[tuple[float, float, str]] = ()
    """From one time to another: what `Station.disturb` of guest.py does beside the commands."""


_OFF: Said = (0, 0, 0, False)
_ON: Said = (0, 0, 0, True)
BOOM_RAD = 20.0
"""Of the spindle, by which the boom is out when its drive gets power: 32 mm."""
COURSE = Course(
    "course", 26,
    [
        (0, _OFF), (3, _ON), (4, (0.4, 0, 0.1, True)), (6, (0.3, 0.3, 0.1, True)), (8, (0, -0.6, 0.1, True)),
        (9, (0, 0, 0.1, True)), (9.5, (0.5, 0, 0.1, True)), (18.5, (0, 0.8, 0.1, True)), (21, (0, 0, 0.1, True)),
        (21.5, (0.5, 0, 0.1, True)), (23, None),
    ],
    Plant(figures={"boom_begin": BOOM_RAD}),
)  # fmt: skip
"""Ahead, a curve, on the spot, towards the wall until it stops, away from it, and no more commands.

The boom searches its home meanwhile, and then goes where it is told to.
"""
SILENT_S = 23.0
TOWARDS_S = (9.5, 18.5)
_AROUND: Said = (0.3, 0.6, 0, True)
TROUBLES = Course(
    "troubles", 43,
    [
        (0, _OFF), (3, _ON), (4, _AROUND), (16, _OFF), (16.5, _ON), (17.5, _AROUND), (24, _OFF), (24.5, _ON),
        (25.5, _AROUND), (31.5, _OFF), (32, _ON), (33, _AROUND), (39.5, _OFF), (40, _ON), (41, _AROUND),
    ],
    Plant(
        troubles=[
            Trouble(0.5, 15, "boom", NO_HOME), Trouble(7, 10, "scanner"), Trouble(13, 14, "left", 0x2310),
            Trouble(36, 37, "right", NO_POWER),
        ]
    ),
    [
        (20, ("link", OWN, "down")), (22, ("link", OWN, "up")),
        (29, ("link", DRIVES, "down")), (29, ("report", OWN, BUS_OFF)),
        (31, ("link", DRIVES, "up")), (31, ("report", OWN, RESTARTED)),
    ],
)  # fmt: skip
"""Round and round; its boom finds no home, its scanner is unplugged for a while, a drive faults, its interface is set
down, its controller is bus-off, and a drive loses its power.

QEMU's controllers have no error counters, so the two reports of the last one are made by us, and the drives' interface
is down meanwhile, as nothing passes. They reach the task by the socket of the real interface.
"""

OPERATORS = Course(
    "operators", 14, [(0, _OFF), (3, _ON), (3.5, _AROUND)],
    disturbances=[(5, 6, "second"), (8, 8.4, "rubbish"), (10.2, 10.8, "flood")],
)  # fmt: skip
"""Round and round; from the station's address come commands of a second operator, rubbish, and a flood of commands."""


@dataclass(frozen=True)
class Driven:
    """What came of a course. All times are of one clock."""

    plant: list[Record]
    reports: list[dict[str, Any]]
    """What the robot told the station, with `time_ns` when it came."""
    statistics: dict[str, dict[str, Any]]
    logs: dict[str, str]
    begin_ns: int
    statuses: dict[str, int]

    def at_s(self, record: Record) -> float:
        """After the tasks' start."""
        seconds: float = (record["time_ns"] - self.begin_ns) / 1e9
        return seconds

    def between(self, begin_s: float, end_s: float) -> list[Record]:
        """Of the plant."""
        return [record for record in self.plant if begin_s <= self.at_s(record) < end_s]

    def told(self, begin_s: float, end_s: float) -> list[dict[str, Any]]:
        return [report for report in self.reports if begin_s <= self.at_s(report) < end_s]


def files(courses: Sequence[Course], described: Fleet, board: Board, keys: Path) -> dict[str, bytes]:
    """What enters the guest: by path."""
    robot = described.robot_with("drive")
    tasks = identity.control_tasks(described, robot)
    there = {
        f"{DIRECTORY}/plant/plant.so": runtime.compile_plugin(PLANT, board.system),
        f"{DIRECTORY}/guest.py": (HERE / "guest.py").read_bytes(),
    }
    there |= {f"{DIRECTORY}/{name}.yml": _changed(tasks[name]) for name in TASKS}
    there[_KEYS] = virtual.credentials(described, robot, keys)
    listed = []
    for course in courses:
        file = f"{DIRECTORY}/{course.name}.yml"
        there[file] = yaml.safe_dump(plant.task(course.plant, DRIVES, LASER)).encode()
        own = [{"name": "plant", "file": file, "blocks": f"{DIRECTORY}/plant"}]
        own += [{"name": name, "file": f"{DIRECTORY}/{name}.yml"} for name in TASKS]
        listed.append(
            {"name": course.name, "seconds": course.seconds, "tasks": own, "commands": course.commands,
             "events": course.events, "disturbances": course.disturbances}
        )  # fmt: skip
    document = {
        "robot": str(robot.address), "station": str(described.stations[0].address), "command_port": COMMAND_PORT,
        "report_port": _stream(described).port, "laser": LASER, "interfaces": [OWN, DRIVES], "bitrate": BITRATE,
        "courses": listed,
    }  # fmt: skip
    return there | {f"{DIRECTORY}/session.json": json.dumps(document, sort_keys=True).encode()}


def _changed(task: bytes) -> bytes:
    """It takes commands without a proof: the guest's Python has no library that could make one. What it says itself it
    proves."""
    told = yaml.safe_load(task)
    for block in told["blocks"].values():
        if "keys" in block.get("parameters", {}):
            block["parameters"]["keys"] = "" if block["type"] == "udp-receive" else _KEYS
    return yaml.safe_dump(told, sort_keys=False).encode()


def _stream(described: Fleet) -> telemetry.Stream:
    return next(stream for stream in telemetry.streams(described) if stream.task == "drive")


def drive(courses: Sequence[Course], board: Board, out: Path) -> dict[str, Driven]:
    """Drive one course after the other in one guest; by their names."""
    described = fleet()
    (out / "keys").mkdir(parents=True, exist_ok=True)
    measured = subject.build(board)
    initrd = out / "initrd.img"
    commands = {"session": ["python3", f"{DIRECTORY}/guest.py", f"{DIRECTORY}/session.json"]}
    brought = files(courses, described, board, out / "keys")
    subject.write_initrd(measured, initrd, {"scenarios": [], "commands": commands}, brought)
    guest = machine.Machine(
        machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=CAN_BOARDS, shift=SHIFT
    )
    console = out / machine.CONSOLE
    console.unlink(missing_ok=True)
    seconds = {course.name: course.seconds for course in courses}
    with progress.step(f"{len(courses)} courses", lambda: far(progress.text(console), seconds)):
        limit_s = _BOOT_LIMIT_S + _LIMIT_PER_SECOND * sum(seconds.values())
        document = results.received(guest.run(out, limit_s))
    initrd.unlink()
    said = json.loads(document["commands"]["session"])
    for name, content in said["files"].items():
        file = out / "courses" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(base64.b64decode(content))
    if "error" in said:
        raise UserError(f"the course failed in the guest:\n{said['error'].strip()}")
    return {course.name: read(out / "courses" / course.name, described) for course in courses}


def read(directory: Path, described: Fleet) -> Driven:
    """What a course left in a folder."""
    stream = _stream(described)
    station = json.loads((directory / "station.json").read_text())
    return Driven(
        records(directory / "plant", "driven"),
        [{"time_ns": time_ns, **stream.unpack(bytes.fromhex(raw))} for time_ns, raw in station["reports"]],
        {name: json.loads((directory / name / "statistics.json").read_text()) for name in TASKS},
        {name: (directory / name / "log").read_text() for name in ("plant", *TASKS)},
        station["begin_ns"],
        station["statuses"],
    )
