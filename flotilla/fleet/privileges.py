"""What the service of a control task or an app may do beyond files: its user, and privileges for the devices that its
blocks drive.

Services have none (runtime/systemd/), because who drives I/O ports can do whatever the computer can.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

SHARED_USER = "control"
"""Of tasks that somebody brings to a robot by hand. Its group is that of message queues between tasks."""
MOST_TASKS = 16
"""Control tasks of a robot: each has a user of its own, and users are in the root, which does not know the tasks."""
USERS = {SHARED_USER: 901, "app": 902} | {f"{SHARED_USER}{number}": 910 + number for number in range(1, MOST_TASKS + 1)}
"""Numbers by name, which are fixed, because the data partition outlives releases."""
DEVICES = "/dev/robot/"
"""Where a robot's devices are, by their names in the inventory."""
_PORT_BLOCKS = ("ir104-pbf",)
"""Blocks that drive I/O ports (ioperm(2))."""
_CAMERA_BLOCKS = ("frame-grabber-iidc", "frame-grabber-v4l2")
CAN_BLOCKS = ("can-receive", "can-send", "epos2")
"""Blocks on a CAN interface, `can0` unless they say another."""
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


def user(number: int, description: object) -> str:
    """The user of a robot's control task and the groups of its devices, as a drop-in of its service.

    `number`: which of the robot's tasks it is, from 0. `description`: the task, rendered and parsed. Its own ports are
    given to it by udev.
    """
    kinds = {block.get("type") for block in _blocks(description)}
    groups = ["realtime", SHARED_USER]
    if any(path.startswith("/dev/tty") for path in _device_paths(description)):
        groups.append("dialout")
    if not kinds.isdisjoint(_CAMERA_BLOCKS):
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
    if kinds.isdisjoint(CAN_BLOCKS):
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
                yield name, f"{DEVICES}{device} is open in {other} too: read it in one task, and send what it says"


def drives_io_ports(description: object) -> bool:
    """Whether a task, as parsed, has a block that does. What is no task in other ways is the runtime's to say."""
    return any(block.get("type") in _PORT_BLOCKS for block in _blocks(description))


def _name(number: int) -> str:
    return f"{SHARED_USER}{number + 1}"


def _blocks(description: object) -> list[dict[str, object]]:
    found = description.get("blocks") if isinstance(description, dict) else None
    return [block for block in found.values() if isinstance(block, dict)] if isinstance(found, dict) else []


def _device_paths(description: object) -> Iterator[str]:
    for block in _blocks(description):
        parameters = block.get("parameters")
        for value in parameters.values() if isinstance(parameters, dict) else ():
            if isinstance(value, str) and value.startswith("/dev/"):
                yield value
