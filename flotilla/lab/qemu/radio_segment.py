"""A radio cell that guests share, and the host's way into it: `flotilla/lab/qemu/segment.py` through the air."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from ipaddress import IPv4Address
from pathlib import Path

from flotilla.fleet.model import Fleet, Robot
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.air import Air
from flotilla.lab.qemu.segment import Segment, station_address

STATION = "station"
"""The member of the cell that stands for the host."""


class RadioSegment(Segment):
    """Give each guest its `options()`; `ssh_port()` leads to it. Guests may come and go."""

    def __init__(
        self, fleet: Fleet, robots: Sequence[Robot], station: IPv4Address, directory: Path,
        datagrams: Collection[tuple[IPv4Address, int]] = (),
    ) -> None:  # fmt: skip
        """As `Segment`. `air`: what may be disturbed."""
        ibss = fleet.network.ibss
        assert ibss, "the fleet has no cell"
        addresses = [robot.address for robot in robots]
        super().__init__(fleet.network, addresses, station, directory, datagrams, trunk=True)
        self.air = Air()
        self._adapters = {
            robot.name: self.air.adapter(robot.name, qemu.robot_mac(robot.number, radio=True)) for robot in robots
        }
        self.air.cable(STATION, self.link(addresses[0]), ibss)

    def __enter__(self) -> RadioSegment:
        self.air.__enter__()
        return self

    def close(self) -> None:
        super().close()
        self.air.close()

    def options(self, robot: Robot) -> qemu.Options:
        """The robot's computer with the adapter; nothing is plugged into its wired port."""
        return replace(super().options(robot), link=None, extra=self._adapters[robot.name].arguments)


def segment_of(
    fleet: Fleet, robots: Sequence[Robot], directory: Path, datagrams: Collection[tuple[IPv4Address, int]] = ()
) -> Segment:
    """What the fleet's `network.link` connects its guests and the station with."""
    station = station_address(fleet)
    if fleet.network.link == "ibss":
        return RadioSegment(fleet, robots, station, directory, datagrams)
    return Segment(fleet.network, [robot.address for robot in robots], station, directory, datagrams)
