"""Flights in virtual time: the fleet's computers as network namespaces of one guest, which boots the shipped system.

Control tasks are those that images bring, rendered for the fleet of `inventory/`; radios are simulated (mac80211_hwsim),
the cell, drivers and ports are not. The robot that flies is a plug-in, which reads the relay board's I/O port and writes
gyro frames into a serial port whose output is its own input. A run repeats to the byte.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from unittest import mock

import jinja2
import yaml

from images.builder import identity, inventory, paths, runtime
from images.builder.errors import UserError
from images.builder.fleet import Board, Fleet
from tests.latency import machine, results, subject

HERE = Path(__file__).parent
INVENTORY = HERE / "inventory"
PLANT = paths.PROJECT / "tests" / "plant"
DIRECTORY = subject.DIRECTORY
STATION = "station"
RELAYS = ("-chardev", "null,id=relays", "-device", "isa-parallel,iobase=0x300,chardev=relays")
"""What can be written and read back at the relay board's first register: a printer port's data register."""
_BOOT_LIMIT_S = 600
_LIMIT_PER_SECOND = 5
"""Of the host's clock, for each virtual second."""


@dataclass(frozen=True)
class Event:
    """A command of the guest, in the midst of a flight."""

    at_s: float
    """After the start of the tasks."""
    command: Sequence[str]

    @classmethod
    def on(cls, at_s: float, computer: str, *command: str) -> Event:
        """On one of the computers."""
        return cls(at_s, ("ip", "netns", "exec", computer, *command))


@dataclass(frozen=True)
class Plan:
    """A flight. `seconds` of it are virtual ones."""

    seconds: float
    transport: str = "udp"
    events: Sequence[Event] = ()
    plant: Mapping[str, object] = field(default_factory=dict)
    """Parameters that are not those of floating_robot.yml."""


def fleet(transport: str) -> Fleet:
    """The published laboratory's."""
    described = inventory.load_fleet(INVENTORY)
    network = described.network.model_copy(update={"transport": transport})
    return described.model_copy(update={"network": network})


def rendered(fleet: Fleet, keys: Path) -> dict[str, dict[str, bytes]]:
    """Files below /etc of each robot, by its name and theirs; keys are made in `keys`."""
    with mock.patch.object(paths, "KEYS", keys):
        return {
            robot.name: {str(path): content for path, (content, _) in identity.render(fleet, robot).items()}
            for robot in fleet.robots.values()
        }


def _plant(plan: Plan, robot_address: str, gyro: str) -> bytes:
    parameters = yaml.safe_load((PLANT / "floating_robot.yml").read_text()) | dict(plan.plant)
    template = jinja2.Template((HERE / "plant.yml.j2").read_text(), undefined=jinja2.StrictUndefined)
    return template.render(parameters=parameters, robot_address=robot_address, gyro=gyro).encode()


def files(plan: Plan, board: Board, keys: Path) -> dict[str, bytes]:
    """What enters the guest: by path."""
    fleet_ = fleet(plan.transport)
    flying = fleet_.robot_with("valves")
    device = f"/dev/{board.ports[flying.devices['gyro'].port].tty}"
    there: dict[str, bytes] = {}
    tasks = []
    each = rendered(fleet_, keys)
    for robot in fleet_.robots.values():
        brought = each[robot.name]
        for name in ("ibss.conf", "cyclonedds.xml"):
            there[f"{DIRECTORY}/{robot.name}/{name}"] = brought[f"/etc/flotilla/{name}"]
        for name in robot.control_tasks:
            file = f"{DIRECTORY}/{robot.name}/{name}.yml"
            there[file] = brought[str(identity.TASKS / f"{name}.yml")]
            tasks.append({"name": name, "computer": robot.name, "file": file,
                          "cyclonedds": f"{DIRECTORY}/{robot.name}/cyclonedds.xml"})  # fmt: skip
    there[f"{DIRECTORY}/plant/plant.so"] = runtime.compile_plugin(PLANT, board.architecture)
    there[f"{DIRECTORY}/plant.yml"] = _plant(plan, str(flying.address), device)
    there[f"{DIRECTORY}/station.yml"] = (HERE / "station.yml").read_bytes()
    tasks = [
        {"name": "station", "computer": STATION, "file": f"{DIRECTORY}/station.yml"},
        {"name": "plant", "computer": STATION, "file": f"{DIRECTORY}/plant.yml", "blocks": f"{DIRECTORY}/plant"},
        *tasks,
    ]
    length = fleet_.network.subnet.prefixlen
    hosts = [*fleet_.robots.values(), *fleet_.stations]
    there[f"{DIRECTORY}/fly.py"] = (HERE / "fly.py").read_bytes()
    there[f"{DIRECTORY}/flight.json"] = json.dumps(
        {
            "computers": [{"name": host.name, "address": f"{host.address}/{length}"} for host in hosts],
            "links": {"/dev/robot/gyro": device, "/etc/flotilla/ibss.conf": f"{DIRECTORY}/{flying.name}/ibss.conf"},
            "tasks": tasks,
            "seconds": plan.seconds,
            "events": [asdict(event) for event in plan.events],
        },
        sort_keys=True,
    ).encode()
    return there


def fly(plan: Plan, board: Board, out: Path) -> Path:
    """Fly it; what recorders and tasks left is in the directory that is returned, a folder for each task."""
    out.mkdir(parents=True, exist_ok=True)
    measured = subject.build(board)
    initrd = out / "initrd.img"
    commands = {"flight": ["python3", f"{DIRECTORY}/fly.py", f"{DIRECTORY}/flight.json"]}
    keys = out / "keys"
    keys.mkdir(exist_ok=True)
    subject.write_initrd(measured, initrd, {"scenarios": [], "commands": commands}, files(plan, board, keys))
    guest = machine.Machine(machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=RELAYS)
    document = results.received(guest.run(out, _BOOT_LIMIT_S + _LIMIT_PER_SECOND * plan.seconds))
    initrd.unlink()
    flight = json.loads(document["commands"]["flight"])
    if "error" in flight:
        raise UserError(f"the flight failed in the guest:\n{flight['error'].strip()}")
    left = out / "flight"
    for name, content in flight["files"].items():
        (left / name).parent.mkdir(parents=True, exist_ok=True)
        (left / name).write_bytes(base64.b64decode(content))
    (left / "statuses.json").write_text(json.dumps(flight["statuses"], indent=1))
    return left
