"""Cards of many robots that are like one of the fleet, for `make bench`.

`python -m evidence.bench_robots 3 100` makes those of a hundred like robot 3.
"""

from __future__ import annotations

import itertools
import sys

from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet, Robot
from flotilla.images import build

_MOST = 250
"""The highest number of a robot."""


def like(fleet: Fleet, one: Robot, count: int) -> list[Robot]:
    """So many further robots with the board and devices of `one`, with the first names, numbers and addresses that are
    free. UserError where there are fewer."""
    taken = {host.address for host in (*fleet.robots.values(), *fleet.stations)}
    numbers = sorted({*range(1, _MOST + 1)} - {robot.number for robot in fleet.robots.values()})
    addresses = [address for address in fleet.network.subnet.hosts() if address not in taken]
    free = min(len(numbers), len(addresses))
    if free < count:
        raise UserError(f"{count} robots are to be measured, and the fleet has numbers and addresses for {free} more")
    pairs = itertools.islice(zip(numbers, addresses, strict=False), count)
    return [
        one.model_copy(
            update={"name": f"measured{number}", "number": number, "address": address, "control_tasks": [], "apps": []}
        )
        for number, address in pairs
    ]


def main() -> None:
    number, count = map(int, sys.argv[1:])
    fleet = inventory.load_fleet()
    robots = like(fleet, inventory.robot(fleet, number), count)
    everyone = fleet.robots | {robot.number: robot for robot in robots}
    build.build(fleet.model_copy(update={"robots": everyone}), robots)


if __name__ == "__main__":
    main()
