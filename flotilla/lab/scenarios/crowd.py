"""Robots on one channel: what the control loop's latency and loss are with 2, 4, 8 and 16 of them.

A loop is the scenario's five control tasks, spread over four robots, or over two; further robots make further loops,
each with a station of its own that hears its reports. All are in one ad hoc cell, in virtual time. Nothing is plugged
in and nothing flies: messages go around all the same, good or not.

The simulated radio has neither air time nor collisions. So the curve is what the computers cost, which share one
processor here, and what it costs to pass each frame to everybody: more than either costs in the field, and nothing of
what a busy channel does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from flotilla.fleet import identity, message_keys
from flotilla.fleet.model import Board, Fleet, Host
from flotilla.lab.latency.results import Latency
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.flight import Flight, records

SIZES = (2, 4, 8, 16)
SECONDS = 6.0
"""Of virtual time, from the start of the tasks to their end."""
SHIFT = 0
"""1000 million instructions a second: at the scenario's 125, the one processor is busy with eight robots."""
PER_LOOP = 4
_APART = 16
"""Between the addresses of two loops."""
_RELAYS = ("0x300", "0x240", "0x260", "0x280")
"""Where a loop's relay board would be: not at another one's."""


@dataclass(frozen=True)
class Crowd:
    """What was measured with so many robots."""

    robots: int
    loops: int
    steps: int
    """Of all sensors, from each one's first whose command reached the valves to its last."""
    lost: int
    latency: Latency
    """Of all loops: from when the sensors' step was due until the valves are switched."""


def fleet(loop: int, robots: int, board: Board | None = None) -> Fleet:
    """One loop's, of two robots or four."""
    described = virtual.fleet("udp", board=board)
    (tasks, *others) = [robot.control_tasks for robot in described.robots.values()]
    if robots < PER_LOOP:
        others = [[task for each in others for task in each]]
    moved = {
        robot.number: robot.model_copy(
            update={
                "name": f"robot{robot.number + PER_LOOP * loop}",
                "address": robot.address + _APART * loop,
                "control_tasks": its_tasks,
            }
        )
        for robot, its_tasks in zip(described.robots.values(), [tasks, *others], strict=False)
    }
    (station,) = described.stations
    station = station.model_copy(update={"name": f"station{loop}", "address": station.address - loop})
    return described.model_copy(update={"robots": moved, "stations": [station]})


def _loop(described: Fleet, loop: int, directory: str, keys: Path) -> tuple[list[dict[str, str]], dict[str, bytes]]:
    """Tasks, and files by path."""
    changes = {
        "valves.relays.base": _RELAYS[loop],
        "valves.to_sensors.name": f"/force{loop}",
        "sensors.force.name": f"/force{loop}",
    }
    (station,) = described.stations
    of_robots = {
        robot.name: {
            str(identity.TASKS / f"{name}.yml"): virtual.changed(name, task, changes)
            for name, task in identity.control_tasks(described, robot).items()
        }
        for robot in described.robots.values()
    }
    there = {f"{directory}/station{loop}.yml": virtual.station(described)} | {
        f"{directory}/{host.name}/{message_keys.CREDENTIAL}": virtual.credentials(described, host, keys)
        for host in (station, *described.robots.values())
    }
    files = [("station", station.name, f"{directory}/station{loop}.yml")]
    for robot in described.robots.values():
        for path, task in of_robots[robot.name].items():
            name = Path(path).stem
            there[f"{directory}/{loop}-{name}.yml"] = task
            files.append((name, robot.name, f"{directory}/{loop}-{name}.yml"))
    tasks = [
        {"name": f"{loop}-{name}", "computer": computer, "file": file, "credentials": f"{directory}/{computer}"}
        for name, computer, file in files
    ]
    return tasks, there


def files(robots: int, keys: Path, board: Board | None = None) -> dict[str, bytes]:
    """What enters the guest: by path."""
    directory = f"{virtual.DIRECTORY}/{robots}"
    there: dict[str, bytes] = {}
    tasks: list[dict[str, str]] = []
    fleets = [fleet(loop, robots, board) for loop in range(math.ceil(robots / PER_LOOP))]
    for loop, described in enumerate(fleets):
        its_tasks, its_files = _loop(described, loop, directory, keys)
        tasks += its_tasks
        there |= its_files
    hosts: list[Host] = [host for described in fleets for host in (*described.robots.values(), *described.stations)]
    flight = {"name": str(robots), "seconds": SECONDS, "tasks": tasks, "events": []}
    return there | virtual.session(fleets[0], hosts, [flight], keys, {}, [])


def measure(robots: int, board: Board, out: Path) -> Crowd:
    """A guest with so many robots."""
    keys = out / "keys"
    keys.mkdir(parents=True, exist_ok=True)
    directory = virtual.run(files(robots, keys, board), board, out, {str(robots): SECONDS}, SHIFT) / str(robots)
    loops = [Flight([], records(each, "steps"), []) for each in sorted(directory.glob("*-station"))]
    counts: dict[int, int] = {}
    for loop in loops:
        for us, count in loop.latency().histogram_us.items():
            counts[us] = counts.get(us, 0) + count
    lost = sum(loop.lost() for loop in loops)
    latency = Latency.of(counts)
    return Crowd(robots, len(loops), latency.samples + lost, lost, latency)
