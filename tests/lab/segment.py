"""An Ethernet segment that guests share, and the host's way into it. Unprivileged, and never beyond the loopback.

The segment is multicast datagrams between QEMU processes. A QEMU without a machine stands on it for the station: it
forwards a loopback port to each robot's SSH. It is one for all guests, because each of several would answer what is
meant for another.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Mapping
from ipaddress import IPv4Address
from pathlib import Path

from images.builder import qemu
from images.builder.fleet import Network
from tests.lab.emulator import Emulator


class Segment:
    """Give `link` to the guests; `ssh_port()` leads to each of them."""

    def __init__(self, network: Network, robots: Iterable[IPv4Address], station: IPv4Address, directory: Path) -> None:
        """`station`: the address under which the host appears on the segment."""
        directory.mkdir(parents=True, exist_ok=True)
        self.link = qemu.SegmentLink(_free_udp_port())
        forwards = dict.fromkeys(robots, 0)
        self._emulator = Emulator(lambda qmp: self._command_line(network, station, forwards, qmp), directory)
        self._ports = self._emulator.forwards()

    def __enter__(self) -> Segment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ssh_port(self, robot: IPv4Address) -> int:
        """The loopback port that leads to a robot's SSH."""
        return self._ports[str(robot)]

    def close(self) -> None:
        self._emulator.kill()

    def _command_line(
        self, network: Network, station: IPv4Address, forwards: Mapping[IPv4Address, int], qmp: str
    ) -> list[str]:
        kind, _, rest = qmp.partition(",")
        argv = [qemu.find_tool("qemu-system-i386"), "-name", "station", "-nodefaults", "-no-user-config"]
        argv += ["-machine", "none", "-display", "none", "-chardev", f"{kind},id=qmp,{rest}"]
        argv += ["-mon", "chardev=qmp,mode=control"]
        argv += ["-netdev", qemu.user_netdev("user", network.subnet, station, forwards)]
        argv += ["-netdev", qemu.segment_netdev("segment", self.link)]
        for end in ("user", "segment"):
            argv += ["-netdev", f"hubport,id=hub-{end},hubid=0,netdev={end}"]
        return argv


def _free_udp_port() -> int:
    """A port of its own for each segment keeps those of parallel test workers apart."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
