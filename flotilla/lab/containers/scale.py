"""How provisioning grows with the fleet: `fleet.yml` on robots in containers, all up to date. `make fleet-scale N=32`.

Each count of robots is a fleet of its own: its description, its keys, robots booted afresh (`light`), and no connection
left from before. Ansible runs as `make provision` runs it, at the robots' own addresses. Only description, keys and
report lie elsewhere, in `build/fleet-scale`, and forks are `FORKS_PER_PROCESSOR` for each processor.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import ansible, cache, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.images.build import image_of
from flotilla.lab.containers import container
from flotilla.lab.qemu import virtual_fleet as virtual
from flotilla.lab.qemu.timing import LabError

DIRECTORY = paths.BUILD / "fleet-scale"
RESULT = DIRECTORY / "scale.json"
_DONE = "booted"
"""In the directory of logs: a line for each robot that has booted."""
FORKS_PER_PROCESSOR = 8
PLAY_SECONDS = 900
TIMES = ("wall_s", "station_cpu_s", "robots_cpu_s")
"""Fields of `Sample` that grow with the fleet."""
MOST = 250
"""Robots of a fleet, by their numbers' range."""


@dataclass(frozen=True)
class Play:
    """A run of `fleet.yml` that has ended."""

    status: int
    wall_s: float
    output: str
    robots: dict[str, dict[str, Any]]
    """By name, what its report says."""

    def check_unchanged(self, names: Sequence[str]) -> None:
        """Complain unless each of the robots was found as it should be, and was left so."""
        wrong = {
            name: robot["messages"] or robot["repaired"] or robot["outcome"]
            for name, robot in self.robots.items()
            if robot["outcome"] != "up to date"
        } | {name: "was not reached" for name in names if name not in self.robots}
        if wrong or self.status:
            listed = "".join(f"\n{name}: {what}" for name, what in wrong.items())
            raise LabError(f"fleet.yml ended with status {self.status}; not up to date were:{listed or self.output}")


@dataclass(frozen=True)
class Sample:
    """`fleet.yml` on so many robots."""

    robots: int
    wall_s: float
    station_cpu_s: float
    robots_cpu_s: float
    """Processor time of it: what the station takes, and what robots take, here of the same processors. Where others
    keep these busy, it says more than `wall_s`."""
    boot_s: float
    """Of all robots; not part of `wall_s`."""
    memory_mib: float
    """That all robots take, shared pages counted once."""


def describe(count: int, board: str, directory: Path) -> Path:
    """The inventory of a fleet of `count` robots without devices and tasks; in all else the project's."""
    fleet = inventory.load_fleet()
    stations = {station.address for station in fleet.stations}
    free = (address for address in fleet.network.subnet.hosts() if address not in stations)
    addresses = list(itertools.islice(free, MOST))
    if not 1 <= count <= len(addresses):
        raise UserError(f"N={count}: give 1 to {len(addresses)} robots; {fleet.network.subnet} has room for no more")
    shutil.rmtree(directory, ignore_errors=True)
    ignore = shutil.ignore_patterns(*(f"board_{name}.yml" for name in fleet.boards if name != board))
    shutil.copytree(paths.INVENTORY / "group_vars", directory / "group_vars", ignore=ignore)
    robots = {
        f"robot{number}": {"number": number, "address": str(address)}
        for number, address in enumerate(addresses[:count], 1)
    }
    described = {
        "robots": {"children": {f"board_{board}": {"hosts": robots}}},
        "stations": {"hosts": {station.name: {"address": str(station.address)} for station in fleet.stations}},
    }
    (directory / "robots.yml").write_text(yaml.safe_dump(described))
    return directory


def forks() -> int:
    return FORKS_PER_PROCESSOR * len(os.sched_getaffinity(0))


def play(inventories: Sequence[Path], *more: str) -> Play:
    """Run `fleet.yml`, with no connections left from another run."""
    argv = [str(Path(sys.executable).with_name("ansible-playbook")), "--forks", str(forks())]
    for each in inventories:
        argv += ["-i", str(each)]
    report = paths.BUILD / "reports/fleet.json"
    report.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="ansible-") as home:
        environment = ansible.environment() | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "ANSIBLE_HOME": home,
            "ANSIBLE_NOCOLOR": "1",
            "BUILD": str(paths.BUILD),
            "KEYS": str(paths.KEYS),
        }
        progress.command(argv)
        started = time.monotonic()
        done = subprocess.run(
            [*argv, *more, "fleet.yml"], cwd=paths.PROJECT / "ansible", env=environment, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=PLAY_SECONDS, check=False,
        )  # fmt: skip
        wall_s = time.monotonic() - started
    robots = json.loads(report.read_text())["robots"] if report.exists() else {}
    return Play(done.returncode, wall_s, done.stdout + done.stderr, robots)


def stage(directory: Path, image: Path, log: Path) -> Sample:
    """In namespaces: boot the fleet that `directory` describes, and play on it."""
    fleet = inventory.load_fleet(directory)
    robots = list(fleet.robots.values())
    started = time.monotonic()
    log.mkdir(parents=True, exist_ok=True)
    with (log / _DONE).open("w", buffering=1) as done:
        container.boot(fleet, robots, image, log, lambda robot: done.write(f"{robot.name}\n"))
    boot_s = time.monotonic() - started
    memory = sum(_memory_bytes()) + sum(container.written_bytes(robot) for robot in robots)
    before = container.cpu_s()
    played = play([directory])
    station_cpu_s, robots_cpu_s = (after - start for start, after in zip(before, container.cpu_s(), strict=True))
    played.check_unchanged([robot.name for robot in robots])
    return Sample(
        robots=len(robots),
        wall_s=round(played.wall_s, 2),
        station_cpu_s=round(station_cpu_s, 2),
        robots_cpu_s=round(robots_cpu_s, 2),
        boot_s=round(boot_s, 2),
        memory_mib=round(memory / (1 << 20), 1),
    )


def environment(directory: Path) -> Mapping[str, str]:
    """For processes that are to leave the real fleet's keys and reports alone."""
    return os.environ | {"BUILD": str(directory), "KEYS": str(directory / "keys"), "PYTHONPATH": str(paths.IMPORTS)}


def image_for(fleet: Fleet, board: str) -> Path:
    """A card image of the board: its root slot is all its robots'."""
    robots = [robot for robot in fleet.robots.values() if robot.board == board]
    if not robots:
        raise UserError(f"board {board}: no robot has it, so there is no image; put one in its group in robots.yml")
    for robot in robots:
        if image_of(robot).exists():
            return image_of(robot)
    raise UserError(f"there is no image of a robot with board {board}; build one: make image ROBOT={robots[0].number}")


def far(done: str, count: int) -> progress.Far:
    """How far a measurement is of which _DONE has `done`."""
    booted = len(done.splitlines())
    return progress.Far(booted, count, "robots booted", "boot") if booted < count else progress.Far(part="fleet.yml")


def run_inside(
    directory: Path, module: str, *arguments: object, timeout: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a Python module in namespaces of its own, of which nothing stays.

    `directory`: for its keys and reports; `timeout`: seconds.
    """
    try:
        return subprocess.run(
            container.inside([sys.executable, "-m", module, *map(str, arguments)]), env=environment(directory),
            cwd=paths.PROJECT, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout, check=False,
        )  # fmt: skip
    finally:
        container.clean()


def measure(count: int, board: str, image: Path) -> Sample:
    """One count of robots, in namespaces of its own."""
    directory = describe(count, board, DIRECTORY / "inventory")
    done = run_inside(DIRECTORY, "flotilla.lab.containers.scale", directory, image, DIRECTORY / "log")
    if done.returncode:
        raise UserError(f"{count} robots: {done.stderr.strip()}")
    return Sample(**json.loads(done.stdout))


def guests() -> tuple[int, float] | None:
    """How many guests the virtual fleet has, and how long `fleet.yml` took on them; None when none runs."""
    names = list(virtual.guest_ports())
    if not names:
        return None
    played = play([paths.INVENTORY, virtual.GUESTS], "-l", "guests")
    played.check_unchanged(names)
    return len(names), round(played.wall_s, 2)


def summary(samples: Sequence[Sample], there: tuple[int, float] | None = None) -> dict[str, Any]:
    """What the samples say together: of each time, the least-squares line over the count of robots."""
    lines = {}
    for name in TIMES if len(samples) > 1 else ():
        line = statistics.linear_regression(
            [sample.robots for sample in samples], [getattr(sample, name) for sample in samples]
        )
        lines[name] = {"per_robot": round(line.slope, 3), "of_no_robot": round(line.intercept, 2)}
    return {
        "samples": [asdict(sample) for sample in samples],
        "lines": lines,
        "forks": forks(),
        "processors": len(os.sched_getaffinity(0)),
        "guests": {"robots": there[0], "wall_s": there[1]} if there else None,
    }


def table(result: Mapping[str, Any]) -> str:
    """For people: a row for each count, and what it comes to in words."""
    rows = [("robots", "fleet.yml", "per further robot", "station's CPU", "robots' CPU", "boot", "memory")]
    before: dict[str, Any] = {}
    for sample in result["samples"]:
        further = (sample["wall_s"] - before["wall_s"]) / (sample["robots"] - before["robots"]) if before else None
        rows.append((
            str(sample["robots"]), f"{sample['wall_s']:.1f} s", "" if further is None else f"{further:.2f} s",
            f"{sample['station_cpu_s']:.1f} s", f"{sample['robots_cpu_s']:.1f} s", f"{sample['boot_s']:.1f} s",
            f"{sample['memory_mib']:.0f} MiB",
        ))  # fmt: skip
        before = sample
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    if there := result["guests"]:
        lines.append(f"{there['robots']} guests of the virtual fleet, which ran meanwhile: {there['wall_s']:.1f} s")
    if line := result["lines"].get("wall_s"):
        lines.append(
            f"fleet.yml takes {line['of_no_robot']} s and {line['per_robot']} s for each robot that is up to date "
            f"(least squares), with {result['forks']} forks on {result['processors']} processors; no robot was changed"
        )
    return "\n".join(lines)


def _memory_bytes() -> Iterator[int]:
    """What each process of these namespaces but this one takes, its share of shared pages."""
    for each in Path("/proc").glob("[0-9]*"):
        if each.name != str(os.getpid()):
            with suppress(OSError):  # it has just ended
                fields = (each / "smaps_rollup").read_text().split()
                yield int(fields[fields.index("Pss:") + 1]) * 1024


def _look(count: int) -> progress.Far:
    return far(progress.text(DIRECTORY / "log" / _DONE), count)


def grow(count: int, board: str | None) -> None:
    """`make fleet-scale`."""
    container.check()
    fleet = inventory.load_fleet()
    board = fleet.board(board).name
    image = image_for(fleet, board)
    with cache.locked(DIRECTORY / "lock"):
        describe(count, board, DIRECTORY / "inventory")  # complains where it cannot be
        container.clean()
        there = guests()
        samples: list[Sample] = []
        for each in sorted({count >> shift for shift in range(count.bit_length())}):
            (DIRECTORY / "log" / _DONE).unlink(missing_ok=True)
            look = functools.partial(_look, each)
            with progress.step(f"boot {each} robots in containers and play fleet.yml", look):
                samples.append(measure(each, board, image))
        result = {"board": board} | summary(samples, there)
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(f"{table(result)}\n{paths.shown(RESULT)}")


def arguments(parser: argparse.ArgumentParser) -> None:
    variable(parser.add_argument("count", type=int, help="of robots; its halves are measured too"), "N")
    parser.add_argument("--board", help="name in the inventory (that of the first robot)")


def run(arguments: argparse.Namespace) -> None:
    try:
        grow(arguments.count, arguments.board)
    except LabError as error:
        raise UserError(str(error)) from error


if __name__ == "__main__":  # the part that runs in namespaces of its own
    print(json.dumps(asdict(stage(*map(Path, sys.argv[1:])))))
