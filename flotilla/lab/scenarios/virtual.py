"""Flights in virtual time: the fleet's computers as network namespaces of one guest, which boots the shipped system.

Control tasks are those that images bring, rendered for the fleet of `inventory/`. Radios are simulated by
mac80211_hwsim; the cell, drivers and ports are not. The robot that flies is a plug-in, which reads the relay board's
I/O port and writes gyro frames into a serial port whose output is its own input. A run repeats to the byte.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from unittest import mock

import jinja2
import yaml

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.fleet import identity, inventory, message_keys
from flotilla.fleet.model import Board, Fleet, Host
from flotilla.lab import air
from flotilla.lab.latency import computable_keys, machine, results, subject
from flotilla.station import telemetry

HERE = Path(__file__).parent
INVENTORY = HERE / "inventory"
PLANT = HERE.parent / "plants"
DIRECTORY = subject.DIRECTORY
AIR = f"{DIRECTORY}/air.so"
RATE_MBIT_S = 11
"""Of frames to one computer on the air: the highest of 802.11b."""
STATION = "station"
SECOND = "second"
"""A further station, in the cell in each flight, and of the fleet in those whose plan says so."""
STANDBY = "-standby"
"""After the name of a task that stands by for another's."""
STRANGER = "stranger"
"""A computer in the cell that is not of the fleet."""
IGPS_BYTES = 16
"""Of a position's datagram."""
MEMORY_MIB = 768
"""Of the guest, which is five computers."""
BOOT_HOST_S = 60
HOST_S = 2.5
"""Of two cores, about: for a boot, and for each virtual second. A run's own rate tells it better."""
_BOOT_LIMIT_S = 600
_LIMIT_PER_SECOND = 10
"""Of the host's clock, for each virtual second: finite, and generous to a busy host."""


@dataclass(frozen=True)
class Event:
    """What happens in the midst of a flight; fly.py says what the actions do."""

    at_s: float
    """After the start of the tasks."""
    action: Literal["run", "spawn", "lose", "power-off", "power-on"]
    arguments: Sequence[str]

    @classmethod
    def on(cls, at_s: float, computer: str, *command: str) -> Event:
        """A command on one of the computers."""
        return cls(at_s, "run", ("ip", "netns", "exec", computer, *command))


@dataclass(frozen=True)
class Plan:
    """A flight."""

    name: str
    title: str
    seconds: float
    """Of virtual time, from the start of the tasks to their end."""
    transport: str = "udp"
    events: Sequence[Event] = ()
    plant: Mapping[str, object] = field(default_factory=dict)
    """Parameters that are not those of floating_robot.yml."""
    standby: Mapping[str, str] = field(default_factory=dict)
    """Robots by name, and the control task for which each stands by."""
    second_station: bool = False
    """A further station of the fleet receives what the first one does, and sends wrong positions of the robot."""
    stranger: bool = False
    """A computer that is not of the fleet sends to all ports of the control tasks, as often as they step."""
    changes: Mapping[str, object] = field(default_factory=dict)
    """Parameters of control tasks that are not those of their files, by `task.block.parameter`."""
    dds_security: bool = False
    """Messages by DDS prove who sent them; for guests in lock-step."""
    air_loss: float | None = None
    """Frames take their time on a channel of 802.11b that all share (`flotilla.lab.air`), and so many of the attempts
    get lost, 0 to 1; None: frames take no time on the air, and none gets lost."""

    @property
    def disturbed(self) -> bool:
        """Something happens that delays or loses messages on purpose."""
        return bool(self.events or self.stranger or self.air_loss is not None)


def square(name: str, title: str, side_m: float, **more: Any) -> Plan:
    """Once around a square at 1 cm/s, as published (there 1 m), after some seconds for the tasks to begin."""
    corners = [0, 0, side_m, 0, side_m, side_m, 0, side_m, 0, 0]
    return replace(Plan(name, title, 4 * side_m / 0.01 + 6, changes={"control.path.waypoints": corners}), **more)


def fleet(
    transport: str,
    standby: Mapping[str, str] | None = None,
    *,
    second_station: bool = False,
    dds_security: bool = False,
    board: Board | None = None,
) -> Fleet:
    """The published laboratory's, with robots that stand by for others, and a further station; or on another board."""
    described = inventory.load_fleet(INVENTORY)
    if board:
        described = _moved(described, board)
    network = described.network.model_copy(update={"transport": transport, "dds_security": dds_security})
    robots = dict(described.robots)
    for number, robot in described.robots.items():
        if task := (standby or {}).get(robot.name):
            more = {"control_tasks": [*robot.control_tasks, task], "standby": [task]}
            robots[number] = robot.model_copy(update=more)
    stations = described.stations + [second(described)] * second_station
    return described.model_copy(update={"network": network, "robots": robots, "stations": stations})


def _moved(described: Fleet, board: Board) -> Fleet:
    """The same robots, as computers of another kind."""
    free = [name for name, port in board.ports.items() if port.tty != board.console_tty]
    for robot in described.robots.values():
        for name, device in robot.devices.items():
            if device.port not in free:
                raise UserError(
                    f"{paths.shown(INVENTORY / 'robots.yml')}: {robot.name}.devices.{name}.port: {device.port}: the "
                    f"board {board.name} has no such port to plug it into; it has {', '.join(free) or 'none'}"
                )
    robots = {number: robot.model_copy(update={"board": board.name}) for number, robot in described.robots.items()}
    return described.model_copy(update={"boards": {board.name: board}, "robots": robots})


def second(described: Fleet) -> Host:
    return Host(name=SECOND, address=described.network.subnet.broadcast_address - 3)


def rendered(fleet: Fleet, keys: Path) -> dict[str, dict[str, bytes]]:
    """Files of each robot by its name and their path; keys are made in `keys`."""
    with mock.patch.object(paths, "KEYS", keys):
        computable_keys.write()
        return {
            robot.name: {str(path): content for path, (content, _) in identity.render(fleet, robot).items()}
            for robot in fleet.robots.values()
        }


def credentials(fleet: Fleet, host: Host, keys: Path) -> bytes:
    """The file with the keys of a computer's messages; they are made in `keys`."""
    with mock.patch.object(paths, "KEYS", keys):
        computable_keys.write()
        return message_keys.read().lines(host, identity.hosts(fleet)).encode()


def changed(name: str, content: bytes, changes: Mapping[str, object]) -> bytes:
    """A control task with the parameters of `changes` that are its own."""
    own = {key.split(".", 1)[1]: value for key, value in changes.items() if key.split(".")[0] == name}
    if not own:
        return content
    task = _parsed(content)
    for key, value in own.items():
        block, parameter = key.split(".")
        task["blocks"][block]["parameters"][parameter] = value
    return str(yaml.safe_dump(task)).encode()


def _own(template: str, **values: object) -> bytes:
    """A task of the scenario's own, from its template."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE), undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template).render(values, keys=message_keys.CREDENTIAL).encode()


def station(described: Fleet) -> bytes:
    """The station's task. It receives a stream of each task that sends one."""
    streams = {stream.task: stream for stream in telemetry.streams(described)}
    return _own("station.yml.j2", controllers=described.robots_with("control"), **streams)


def plant(plan: Plan, described: Fleet, board: Board) -> bytes:
    """The task of the robot that flies, and of what measures it."""
    return _own(
        "plant.yml.j2",
        parameters=yaml.safe_load((PLANT / "floating_robot.yml").read_text()) | dict(plan.plant),
        robot_address=described.robot_with("valves").address,
        gyro=gyro_device(described, board),
    )


def lab_tasks(directory: Path | PurePosixPath) -> list[dict[str, str]]:
    """Of station and plant, as fly.py starts them, whose files and `lab_files` are in a directory."""
    own = {"computer": STATION, "credentials": f"{directory}/{STATION}"}
    return [
        own | {"name": "station", "file": f"{directory}/station.yml"},
        own | {"name": "plant", "file": f"{directory}/plant.yml", "blocks": f"{DIRECTORY}/plant"},
    ]


def lab_files(
    plan: Plan, described: Fleet, board: Board, keys: Path, directory: Path | PurePosixPath
) -> dict[str, bytes]:
    """What `lab_tasks` need, by path."""
    first = described.stations[0]
    return {
        f"{directory}/plant.yml": plant(plan, described, board),
        f"{directory}/station.yml": station(described),
        f"{directory}/{STATION}/{message_keys.CREDENTIAL}": credentials(described, first, keys),
    }


def _receivers(described: Fleet, brought: Mapping[str, Mapping[str, bytes]]) -> list[str]:
    """Where computers receive datagrams, and of what length: `address:port:length`."""
    heard = [
        f"{station.address}:{stream.port}:{stream.length}"
        for station in described.stations
        for stream in telemetry.streams(described)
    ]
    return heard + [
        f"{robot.address}:{block['parameters']['port']}:{block['parameters'].get('length', IGPS_BYTES)}"
        for robot in described.robots.values()
        for name in robot.control_tasks
        for block in _parsed(brought[robot.name][_path(name)])["blocks"].values()
        if block["type"] in ("udp-receive", "igps")
    ]


def _path(task: str) -> str:
    return str(identity.TASKS / f"{task}.yml")


def _parsed(task: bytes) -> Any:
    """All is text to the runtime, `on` and `off` too."""
    return yaml.load(task, yaml.BaseLoader)


def _flight(plan: Plan, board: Board, keys: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """A flight as fly.py reads it, and its files by path."""
    directory = DIRECTORY / plan.name
    described = fleet(plan.transport, plan.standby, second_station=plan.second_station, board=board)
    flying = described.robot_with("valves")
    brought = rendered(described, keys)
    there = lab_files(plan, described, board, keys, directory)
    tasks = lab_tasks(directory)
    if plan.second_station:
        # A file is its task's lock: two computers of one guest need two.
        there[f"{directory}/{SECOND}.yml"] = there[f"{directory}/station.yml"]
        there[f"{directory}/{SECOND}-igps.yml"] = _own("second.yml.j2", robot_address=flying.address)
        own = f"{directory}/{SECOND}"
        there[f"{own}/{message_keys.CREDENTIAL}"] = credentials(described, second(described), keys)
        tasks += [
            {"name": name, "computer": SECOND, "file": f"{directory}/{name}.yml", "credentials": own}
            for name in (SECOND, f"{SECOND}-igps")
        ]
    for robot in described.robots.values():
        its_keys = f"{directory}/{robot.name}"
        configuration = f"{directory}/{robot.name}-cyclonedds.xml"
        its_files = {configuration: "cyclonedds.xml", f"{its_keys}/{message_keys.CREDENTIAL}": message_keys.CREDENTIAL}
        there |= {path: brought[robot.name][f"/etc/flotilla/{name}"] for path, name in its_files.items()}
        for name in robot.control_tasks:
            called = name + STANDBY if name in robot.standby else name
            file = f"{directory}/{called}.yml"
            there[file] = changed(name, brought[robot.name][_path(name)], plan.changes)
            task = {"name": called, "computer": robot.name, "file": file}
            tasks.append(task | {"cyclonedds": configuration, "credentials": its_keys})
    events = [asdict(event) for event in plan.events]
    if plan.stranger:
        shout = ["python3", f"{DIRECTORY}/stranger.py", str(plan.seconds), *_receivers(described, brought)]
        events.append(asdict(Event(0, "spawn", ["ip", "netns", "exec", STRANGER, *shout])))
    flight = {"name": plan.name, "seconds": plan.seconds, "tasks": tasks, "events": events}
    if plan.air_loss is not None:
        flight["air"] = {"library": AIR, "loss": plan.air_loss, "mbit_s": RATE_MBIT_S}
    return flight, there


def gyro_device(described: Fleet, board: Board) -> str:
    """Where the flying robot's gyro is plugged in."""
    return f"/dev/{board.ports[described.robot_with('valves').devices['gyro'].port].tty}"


def files(plans: Sequence[Plan], board: Board, keys: Path) -> dict[str, bytes]:
    """What enters the guest: by path."""
    described = fleet("udp", board=board)
    there = {
        f"{DIRECTORY}/plant/plant.so": runtime.compile_plugin(PLANT, board.system),
        f"{DIRECTORY}/stranger.py": (HERE / "stranger.py").read_bytes(),
        AIR: air.compiled(air.ONE_GUEST, board.system),
    }
    flights = []
    for plan in plans:
        flight, brought = _flight(plan, board, keys)
        flights.append(flight)
        there |= brought
    stranger = Host(name=STRANGER, address=described.network.subnet.broadcast_address - 2)
    hosts = [*described.robots.values(), *described.stations, second(described), stranger]
    links = {"/dev/robot/gyro": gyro_device(described, board)}
    return there | session(described, hosts, flights, keys, links, [f"{DIRECTORY}/{plans[0].name}/valves.yml"])


def session(
    described: Fleet,
    hosts: Sequence[Host],
    flights: Sequence[Mapping[str, Any]],
    keys: Path,
    links: Mapping[str, str],
    safe: Sequence[str],
) -> dict[str, bytes]:
    """fly.py and what it reads: flights of these computers in the fleet's cell."""
    cell = f"{DIRECTORY}/ibss.conf"
    length = described.network.subnet.prefixlen
    document = {
        "computers": [{"name": host.name, "address": f"{host.address}/{length}"} for host in hosts],
        "links": {**links, "/etc/flotilla/ibss.conf": cell},
        "safe": safe,
        "flights": flights,
    }
    return {
        f"{DIRECTORY}/fly.py": (HERE / "fly.py").read_bytes(),
        cell: rendered(described, keys)[described.robot_with("valves").name]["/etc/flotilla/ibss.conf"],
        f"{DIRECTORY}/session.json": json.dumps(document, sort_keys=True).encode(),
    }


def fly(plans: Sequence[Plan], board: Board, out: Path) -> dict[str, Path]:
    """Fly one after the other in one guest; where each left what recorders and tasks wrote, a folder for each task."""
    keys = out / "keys"
    keys.mkdir(parents=True, exist_ok=True)
    flights = run(files(plans, board, keys), board, out, {plan.name: plan.seconds for plan in plans})
    return {plan.name: flights / plan.name for plan in plans}


def far(console: str, flights: Mapping[str, float]) -> progress.Far:
    """How far a session is whose guest has written `console`; `flights`: virtual seconds of each, in their order."""
    total = sum(flights.values())
    moments = re.findall(r"flight: (\S+) ([\d.e+]+) s\n", console)
    if not moments:
        return progress.Far(0, total, "virtual seconds", part="boot")
    name, passed = moments[-1]
    names = list(flights)
    before = sum(flights[each] for each in names[: names.index(name)])
    return progress.Far(before + float(passed), total, "virtual seconds", part=name)


def run(there: Mapping[str, bytes], board: Board, out: Path, flights: Mapping[str, float], shift: int = 3) -> Path:
    """Have a guest run the session of session.json among these files; the folder that has one for each flight.

    `flights`: virtual seconds of each, in their order. An instruction takes 2**`shift` ns.
    """
    seconds = sum(flights.values())
    measured = subject.build(board)
    board = board.model_copy(update={"qemu": board.qemu.model_copy(update={"memory_mib": MEMORY_MIB})})
    initrd = out / "initrd.img"
    commands = {"session": ["python3", f"{DIRECTORY}/fly.py", f"{DIRECTORY}/session.json"]}
    subject.write_initrd(measured, initrd, {"scenarios": [], "commands": commands}, dict(there))
    guest = machine.Machine(
        machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=machine.RELAYS, shift=shift
    )
    console = out / machine.CONSOLE
    console.unlink(missing_ok=True)  # of an earlier run
    title = f"{len(flights)} flight{'s' * (len(flights) != 1)}"
    with progress.step(title, lambda: far(progress.text(console), flights)):
        document = results.received(guest.run(out, _BOOT_LIMIT_S + _LIMIT_PER_SECOND * seconds))
    initrd.unlink()
    if error := unpack(document, out / "flights"):
        raise UserError(f"the scenario failed in the guest:\n{error}")
    return out / "flights"


def unpack(document: Mapping[str, Any], directory: Path) -> str:
    """Write the files that a guest's session left; what it said of an error, or nothing."""
    answer = json.loads(document["commands"]["session"])
    for name, content in answer["files"].items():
        file = directory / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(base64.b64decode(content))
    error: str = answer.get("error", "")
    return error.strip()
