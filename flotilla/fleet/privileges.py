"""What the service of a control task or an app may do beyond files: its user, and privileges for the devices that its
blocks drive.

Services have none (runtime/systemd/), because who drives I/O ports can do whatever the computer can. What blocks need,
their types say (FL_CAN_INTERFACE and the like in flotilla/block.h).
"""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

SHARED_USER = "control"
"""Of tasks that somebody brings to a robot by hand. Its group is that of message queues between tasks."""
MOST_TASKS = 16
"""Control tasks of a robot: each has a user of its own, and users are in the root, which does not know the tasks."""
USERS = {SHARED_USER: 901, "app": 902} | {f"{SHARED_USER}{number}": 910 + number for number in range(1, MOST_TASKS + 1)}
"""Numbers by name, which are fixed, because the data partition outlives releases."""
UPDATE_USER, UPDATE_NUMBER = "update", 903
"""Who reads what others send of an update; owns nothing else. `runtime/programs/flotilla_patch.c` has the number."""
DEVICES = "/dev/robot/"
"""Where a robot's devices are, by their names in the inventory."""
RUNTIME_NEEDS = Path(__file__).with_name("block_needs.json")
"""What blocks of the runtime need, as `flotilla-blocks --json` lists it: `make reference` writes it."""
DROP_IN = "io-ports.conf"
"""Name of the file that has `IO_PORTS`, in the folder of a service's drop-ins."""
IO_PORTS = """\
# It drives I/O ports.
[Service]
AmbientCapabilities=CAP_SYS_RAWIO
CapabilityBoundingSet=CAP_SYS_RAWIO
SystemCallFilter=@raw-io
"""
USER_DROP_IN = "user.conf"
"""Name of the file that has what `user` says."""


class Need(NamedTuple):
    """A parameter of a block that names what the block needs a permission for."""

    parameter: str
    what: Literal["can", "io-ports", "camera"]
    default: str = ""


Needs = Mapping[str, Sequence[Need]]
"""By type of block; blocks without any may be left out."""


def needs_of(listing: Sequence[Mapping[str, Any]]) -> dict[str, list[Need]]:
    """What blocks need that `flotilla-blocks --json` lists."""
    found = {
        block["name"]: [
            Need(parameter["name"], parameter["needs"], parameter.get("default", ""))
            for parameter in block["parameters"]
            if "needs" in parameter
        ]
        for block in listing
    }
    return {name: needs for name, needs in found.items() if needs}


@functools.cache
def runtime_needs() -> Needs:
    """What blocks of the runtime need, which control tasks consist of."""
    listed: dict[str, list[list[str]]] = json.loads(RUNTIME_NEEDS.read_text(encoding="utf-8"))
    return {name: [Need(*need) for need in needs] for name, needs in listed.items()}  # type: ignore[arg-type]


def needs_page(listing: Sequence[Mapping[str, Any]]) -> str:
    """The content of `RUNTIME_NEEDS`."""
    lines = (f"  {json.dumps(name)}: {json.dumps(needs)}" for name, needs in needs_of(listing).items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def can_interfaces(description: object) -> Iterator[tuple[str, str, str]]:
    """Which CAN interfaces a control task uses, rendered and parsed: block, parameter, interface."""
    for name, block, need in _needed(description, runtime_needs()):
        if need.what == "can":
            parameters = block.get("parameters")
            given = parameters.get(need.parameter) if isinstance(parameters, dict) else None
            yield name, need.parameter, str(given or need.default)


def user(number: int, description: object, needs: Needs | None = None) -> str:
    """The user of a robot's control task and the groups of its devices, as a drop-in of its service.

    `number`: which of the robot's tasks it is, from 0. `description`: the task, rendered and parsed. Its own ports are
    given to it by udev. `needs`: of its blocks, where they are not the runtime's.
    """
    needed = {need.what for _, _, need in _needed(description, runtime_needs() if needs is None else needs)}
    groups = ["realtime", SHARED_USER]
    if any(path.startswith("/dev/tty") for path in _device_paths(description)):
        groups.append("dialout")
    if "camera" in needed:
        groups.append("video")
    lines = [
        "# A user of its own, and no devices but its own.",
        "[Service]",
        f"User={_name(number)}",
        "SupplementaryGroups=",
        f"SupplementaryGroups={' '.join(groups)}",
        "# By these two it shares its message queues with the robot's other tasks.",
        f"Environment=FLOTILLA_QUEUE_GROUP={SHARED_USER}",
        "SystemCallFilter=fchown fchown32",
    ]
    if "can" not in needed:
        lines.append("RestrictAddressFamilies=~AF_CAN")
    return "".join(f"{line}\n" for line in lines)


def task_users(count: int) -> list[str]:
    """Users of so many tasks of a robot."""
    return [_name(number) for number in range(count)]


def device_users(descriptions: Mapping[str, object]) -> dict[str, str]:
    """Whose each device of a robot is that its tasks name: the user by the device's name.

    `descriptions`: of all tasks, rendered and parsed, in the inventory's order.
    """
    return {
        device: _name(number)
        for number, description in enumerate(descriptions.values())
        for device in devices(description)
    }


def devices(description: object) -> set[str]:
    """Names of the robot's devices that a task opens."""
    return {path.removeprefix(DEVICES) for path in _device_paths(description) if path.startswith(DEVICES)}


def shared_devices(descriptions: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    """Tasks that name a device of another, and how that is wrong: a port is open once."""
    first: dict[str, str] = {}
    for name, description in descriptions.items():
        for device in sorted(devices(description)):
            if (other := first.setdefault(device, name)) != name:
                yield name, f"{DEVICES}{device} is open in {other} too: read it in one task, and send its values"


def drives_io_ports(description: object, needs: Needs | None = None, inside: Collection[str] = ()) -> bool:
    """Whether a task, as parsed, has a block that does. What is no task in other ways is the runtime's to say.

    `needs`: of blocks that the runtime does not have. `inside`: types of blocks that these contain.
    """
    contained = {"blocks": {name: {"type": name} for name in inside}}
    known = {**runtime_needs(), **(needs or {})}
    return any(need.what == "io-ports" for each in (description, contained) for _, _, need in _needed(each, known))


def _name(number: int) -> str:
    return f"{SHARED_USER}{number + 1}"


def _blocks(description: object) -> dict[str, dict[str, object]]:
    found = description.get("blocks") if isinstance(description, dict) else None
    return {name: block for name, block in found.items() if isinstance(block, dict)} if isinstance(found, dict) else {}


def _needed(description: object, needs: Needs) -> Iterator[tuple[str, dict[str, object], Need]]:
    """Each block's name and content, with each thing that it needs."""
    for name, block in _blocks(description).items():
        for need in needs.get(str(block.get("type")), ()):
            yield name, block, need


def _device_paths(description: object) -> Iterator[str]:
    for block in _blocks(description).values():
        parameters = block.get("parameters")
        for value in parameters.values() if isinstance(parameters, dict) else ():
            if isinstance(value, str) and value.startswith("/dev/"):
                yield value
