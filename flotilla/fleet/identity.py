"""What makes a card robot 3: the templates of rootfs_overlay/ rendered for it."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from flotilla.common import paths, sources
from flotilla.common.errors import UserError
from flotilla.fleet import apps, dds_security, interfaces, keys, message_keys, operators, privileges, transport
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Board, Fleet, Host, Robot

if TYPE_CHECKING:
    import jinja2

TASKS = PurePosixPath("/etc/flotilla/tasks")
"""Where a robot's control tasks lie on it."""
_CAN = PurePosixPath("etc/systemd/network/20-can.network.j2")
"""Rendered for each CAN interface of the robot, with its name in the file's."""
_PRIVATE = {
    f"{name}.j2": 0o600
    for name in ("ssh_host_ed25519_key", message_keys.CREDENTIAL, dds_security.CREDENTIAL, "chrony.keys")
}
"""Modes of templates whose result is not for everyone."""


def hosts(fleet: Fleet) -> list[Host]:
    """Everyone with an address, in order of address."""
    return sorted([*fleet.robots.values(), *fleet.stations], key=lambda host: host.address)


def _first_dds_port(fleet: Fleet) -> int:
    """The first of the 250 that a domain has (DDSI-RTPS 2.1, 9.6.1)."""
    return 7400 + 250 * fleet.network.dds_domain


def dds_peers(fleet: Fleet, robot: Robot) -> list[str]:
    """Where a robot's DDS programs look for others: at all its own ports, and at `address:port` of each other robot's
    control tasks and of one program more.

    Programs of a computer take the first port that is free, whichever they are.
    """
    others = sorted((other for other in fleet.robots.values() if other != robot), key=lambda other: other.address)
    first = _first_dds_port(fleet) + 10
    ports = [f"{other.address}:{first + 2 * n}" for other in others for n in range(len(other.control_tasks) + 1)]
    return [str(robot.address), *ports]


def _description(fleet: Fleet, robot: Robot) -> dict[str, object]:
    """What control tasks may use, besides `message` of transport.py."""
    board = fleet.boards[robot.board]
    return {"fleet": fleet, "network": fleet.network, "robot": robot, "board": board, "addresses": transport.addresses}


def variables(fleet: Fleet, robot: Robot) -> dict[str, object]:
    """What the templates may use."""
    host_keys = keys.host_keys(fleet)
    shared_keys = message_keys.read()
    first = _first_dds_port(fleet)
    return _description(fleet, robot) | {
        "hosts": hosts(fleet),
        "interface": fleet.interface(robot),
        "dds_ports": f"{first}-{first + 249}",
        "dds_peers": dds_peers(fleet, robot),
        "dds": dds_security.variables(fleet, robot, shared_keys) if fleet.network.dds_security else {},
        "host_keys": host_keys,
        "revoked_keys": keys.revoked(),
        "host_public_key": host_keys[robot.name],
        "host_private_key": keys.here(keys.of_robot(robot)).read_text(),
        "message_keys": shared_keys.lines(robot, hosts(fleet)),
        "time_key": shared_keys.time,
        "operator_key": keys.public(keys.operator()),
        "operator_authority": keys.public(operators.authority()),
        "revoked_operators": operators.revoked(),
        # Stable, and not to be guessed back to anything (machine-id(5)).
        "machine_id": hashlib.sha256(f"machine-id {host_keys[robot.name]}".encode()).hexdigest()[:32],
    }


def templates() -> dict[PurePosixPath, Path]:
    """The overlay's files that are rendered for each robot, by their path in it."""
    return {name: path for name, path in sources.layered(paths.OVERLAY).items() if name.suffix == ".j2"}


@functools.cache
def _environment() -> jinja2.Environment:
    import jinja2  # here, because it takes a while, in which the build has other things to do

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader([*sources.layers(paths.OVERLAY), paths.TASKS]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )


def render(fleet: Fleet, robot: Robot, built: Sequence[BuiltApp] = ()) -> dict[PurePosixPath, tuple[bytes, int]]:
    """The robot's files by path on the robot: content and mode. An empty result means no file.

    `built`: the robot's apps, each of them.
    """
    import jinja2

    if [app.name for app in built] != robot.apps:  # a defect of the caller's: a card would lack them without a word
        raise ValueError(f"{robot.name} has the apps {robot.apps}, not {[app.name for app in built]}")

    tasks = _control_tasks(fleet, robot)
    descriptions = {name: description for name, (_, description) in tasks.items()}
    values = variables(fleet, robot) | {"device_users": privileges.device_users(descriptions)}
    files = {}
    for name, template in templates().items():
        each: dict[PurePosixPath, dict[str, object]] = {name.with_suffix(""): {}}
        if name == _CAN:
            each = {_CAN.with_name(f"20-{can}.network"): {"can": can, "bus": bus} for can, bus in robot.can.items()}
        for path, further in each.items():
            try:
                content = _environment().get_template(str(name)).render(values | further).encode()
            except jinja2.TemplateError as error:
                raise UserError(f"{paths.shown(template)}: {error}") from error
            if content.strip():
                files[PurePosixPath("/") / path] = (content, _PRIVATE.get(template.name, 0o644))
    for number, (task_name, (task, description)) in enumerate(tasks.items()):
        files[TASKS / f"{task_name}.yml"] = (task, 0o644)
        drop_ins = apps.SYSTEM / f"flotilla-task@{task_name}.service.d"
        files[drop_ins / privileges.USER_DROP_IN] = (privileges.user(number, description).encode(), 0o644)
        if privileges.drives_io_ports(description):
            files[drop_ins / privileges.DROP_IN] = (privileges.IO_PORTS.encode(), 0o644)
    return files | apps.listings(built)


def control_tasks(fleet: Fleet, robot: Robot) -> dict[str, bytes]:
    """The robot's control tasks by name. Without keys: whoever only reads a description pins nothing."""
    return {name: task for name, (task, _) in _control_tasks(fleet, robot).items()}


def _control_tasks(fleet: Fleet, robot: Robot) -> dict[str, tuple[bytes, object]]:
    """Each rendered, and parsed."""
    values = _description(fleet, robot)
    message = functools.partial(transport.hop, fleet, robot)
    tasks = {name: _task(name, values | {"message": functools.partial(message, name)}) for name in robot.control_tasks}
    parsed = {name: _parsed(task) for name, task in tasks.items()}
    problems = []
    shared_devices = list(privileges.shared_devices(parsed))
    for name, description in parsed.items():
        found = [
            *(problem for task, problem in shared_devices if task == name),
            *_problems_of_processor(description, fleet.boards[robot.board]),
            *_problems_of_priority(description),
            *interfaces.problems(description, fleet, robot),
            *transport.problems(fleet, name, description),
        ]
        problems += [f"{paths.shown(paths.TASKS / f'{name}.yml')}: {problem}" for problem in found]
    if problems:
        raise UserError("\n".join(problems))
    return {name: (task, parsed[name]) for name, task in tasks.items()}


def _problems_of_processor(task: object, board: Board) -> list[str]:
    cpu = task.get("cpu") if isinstance(task, dict) else None
    if not isinstance(cpu, int) or cpu < board.processors:  # what is no number is the runtime's to say
        return []
    return [
        f"cpu: {cpu}: board {board.name} has processors 0 to {board.processors - 1}; choose one of them, or correct "
        f"`processors:` in group_vars/board_{board.name}.yml"
    ]


def interrupt_priorities() -> dict[str, int]:
    """Priorities of interrupt threads on robots, by the pattern of their names."""
    lines = sources.find(paths.OVERLAY, "etc/flotilla/irq-priorities").read_text(encoding="utf-8").splitlines()
    return {(words := line.split())[0]: int(words[1]) for line in lines if line and not line.startswith("#")}


def _problems_of_priority(task: object) -> list[str]:
    """A thread waits for others of its priority: an interrupt's would wait for each step."""
    priority = task.get("priority") if isinstance(task, dict) else None
    if not isinstance(priority, int) or not (
        same := [pattern for pattern, value in interrupt_priorities().items() if value == priority]
    ):
        return []
    return [
        f"priority: {priority}: threads of interrupts have it, too ({', '.join(same)}), and would wait for each step; "
        f"take {priority - 1}, or for short steps {priority + 1}"
    ]


def _task(name: str, values: dict[str, object]) -> bytes:
    import jinja2

    file = paths.TASKS / f"{name}.yml"
    try:
        return _environment().from_string(file.read_text(encoding="utf-8")).render(values).encode()
    except (jinja2.TemplateError, OSError, UserError) as error:
        raise UserError(f"{paths.shown(file)}: {error}") from error


def _parsed(task: bytes) -> object:
    """None if it is no YAML, which is the runtime's to say."""
    import yaml  # here, because robots without control tasks need none

    try:
        return yaml.safe_load(task)
    except yaml.YAMLError:
        return None
