"""An Ethernet segment that guests share, and the host's way into it. Unprivileged, and never beyond the loopback.

A QEMU without a machine is the hub: a cable leads from it to each robot, and its user-mode network stands for the
station, with a loopback port forwarded to each robot's SSH.

Not multicast, where every member hears itself: QEMU's user-mode network answers its own packets, thousands a second.
"""

from __future__ import annotations

import socket
from collections.abc import Collection, Iterable
from contextlib import ExitStack
from ipaddress import IPv4Address
from pathlib import Path

from flotilla.fleet.model import Fleet, Network, Robot
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.process import Emulator


class Segment:
    """Give each guest its `link()`; `ssh_port()` leads to it. Guests may come and go."""

    def __init__(
        self, network: Network, robots: Iterable[IPv4Address], station: IPv4Address, directory: Path,
        datagrams: Collection[tuple[IPv4Address, int]] = (), outward: bool = True, trunk: bool = False,
    ) -> None:  # fmt: skip
        """`station`: the address under which the host appears on the segment.

        `datagrams`: robots' UDP ports to which the host is to send, to each by its `udp_port()`; then what robots send
        to the station comes to the host's loopback ports. Without `outward` it does not.

        `trunk`: one cable leads to all robots, such as the one into a radio cell.
        """
        directory.mkdir(parents=True, exist_ok=True)
        robots = list(robots)
        ends = 1 if trunk else len(robots)
        ports = iter(free_udp_ports(2 * ends + len(datagrams)))
        self._wires = [qemu.Wire(next(ports), next(ports)) for _ in range(ends)]
        self._links = dict(zip(robots, self._wires * (len(robots) if trunk else 1), strict=True))
        self._udp = dict(zip(datagrams, ports, strict=True))
        user = qemu.user_netdev("user", network.subnet, station, dict.fromkeys(robots, 0), self._udp, outward)
        self._emulator = Emulator(lambda qmp: self._command_line(user, qmp), directory)
        self._ports = self._emulator.forwards()

    def __enter__(self) -> Segment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def link(self, robot: IPv4Address) -> qemu.Wire:
        """The robot's end of its cable, or of the trunk."""
        return self._links[robot]

    def options(self, robot: Robot) -> qemu.Options:
        """The robot's computer with its cable."""
        return qemu.Options(name=robot.name, mac=qemu.robot_mac(robot.number), link=self.link(robot.address))

    def ssh_port(self, robot: IPv4Address) -> int:
        """The loopback port that leads to a robot's SSH."""
        return self._ports[str(robot)]

    def udp_port(self, robot: IPv4Address, port: int) -> int:
        """The loopback port that leads to a robot's UDP port; to the robot, the station sends."""
        return self._udp[robot, port]

    def close(self) -> None:
        self._emulator.kill()

    def _command_line(self, user: str, qmp: str) -> list[str]:
        argv = [qemu.find_tool("qemu-system-i386"), "-name", "segment", "-nodefaults", "-no-user-config"]
        argv += ["-machine", "none", "-display", "none"]
        argv += ["-chardev", qemu.chardev("qmp", qmp), "-mon", "chardev=qmp,mode=control"]
        netdevs = {"user": user}
        for number, wire in enumerate(self._wires):
            netdevs[f"wire{number}"] = qemu.wire_netdev(f"wire{number}", wire.other_end)
        for name, netdev in netdevs.items():
            argv += ["-netdev", netdev, "-netdev", f"hubport,id=hub-{name},hubid=0,netdev={name}"]
        return argv


def station_address(fleet: Fleet) -> IPv4Address:
    """The address under which guests of the fleet see the host: the first station's, or one that no robot has."""
    if fleet.stations:
        return fleet.stations[0].address
    return qemu.station_address(fleet.network, *(robot.address for robot in fleet.robots.values()))


def free_udp_ports(count: int) -> list[int]:
    """Ports that nobody has; parallel test workers get others."""
    with ExitStack() as held:  # all at once, or the same one would be found again
        probes = [held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]
