"""Whether a robot has the network interfaces and addresses that its control tasks name: blocks wait for those."""

from __future__ import annotations

from collections.abc import Iterator

from flotilla.fleet.model import Fleet, Robot
from flotilla.fleet.privileges import can_interfaces

_UDP_BLOCKS = ("udp-receive", "udp-send")
"""Blocks on any interface unless they name one."""


def problems(description: object, fleet: Fleet, robot: Robot) -> Iterator[str]:
    """What is wrong with the interfaces of a control task, rendered and parsed, each with block, value and remedy.

    What is no task in other ways is the runtime's to say.
    """
    for name, parameter, used in can_interfaces(description):
        if used not in robot.can:
            others = f"{' or '.join(robot.can)}, or " if robot.can else ""
            yield (
                f"blocks.{name}.parameters.{parameter}: {robot.name} has no CAN interface {used}; "
                f"{others}add {used} with its bitrate to can: of {robot.name} in robots.yml"
            )
    blocks = description.get("blocks") if isinstance(description, dict) else None
    for name, block in blocks.items() if isinstance(blocks, dict) else ():
        kind = block.get("type") if isinstance(block, dict) else None
        if kind not in _UDP_BLOCKS:
            continue
        parameters = block.get("parameters")
        interface = parameters.get("interface") if isinstance(parameters, dict) else None
        own = fleet.interface(robot)
        if interface and interface not in (own, "lo"):
            yield (
                f"blocks.{name}.parameters.interface: {robot.name} has no address on {interface}; "
                f"{own}, lo, or leave it out for any"
            )
        local = parameters.get("local_address") if isinstance(parameters, dict) else None
        if local and local not in (str(robot.address), "127.0.0.1", "0.0.0.0"):
            yield (
                f"blocks.{name}.parameters.local_address: {local} is not {robot.name}'s; "
                f"{robot.address}, 127.0.0.1, or leave it out for any"
            )
