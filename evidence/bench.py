"""How long images take, against public builders on the same packages and against copying the same bytes.

Everything runs as it would for a user: whole processes, from their start to their end.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from evidence import bench_mkosi
from flotilla.common import cache, paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import pool, tools
from flotilla.debian.lock import Lock, read_lock
from flotilla.fleet import inventory
from flotilla.fleet import keys as fleet_keys
from flotilla.fleet.model import Fleet, Robot
from flotilla.images import build, rootfs

_PACKAGES = Path(__file__).with_name("bench-packages.txt")
_RUNS = 5
"""Of what takes about a second; the median counts."""
_COLD_RUNS = 3
"""Of a cold build and of mkosi's, in turn: a computer's speed differs by a fifth between one minute and the next."""
_MANY = 100
"""Robots that are made at once."""
REPORT = paths.BUILD / "reports" / "bench.json"


@dataclass(frozen=True)
class Work:
    """What is measured."""

    name: str
    made: str
    """What it produces."""
    make: Callable[[], int]
    """Does it, in processes of its own; the bytes that it produced."""
    prepare: Callable[[], None] = lambda: None
    """Is done before each run, and is not measured."""


@dataclass(frozen=True)
class Row:
    """One measurement."""

    work: str
    made: str
    """What it produced."""
    seconds: float
    processor: float
    """Seconds that its processes took of all processors: other work on the computer moves them less."""
    bytes: int
    """Of what it produced, holes not counted."""
    runs: int


def bench(fleet: Fleet, first: Robot) -> str:
    """Measure, `first` being the robot that is built first, and return the table; also written to `REPORT`."""
    others = [other for other in fleet.robots.values() if other.board == first.board and other != first]
    others.sort(key=lambda other: (other.number < first.number, other.number))
    lock = read_lock(first.board)
    mkosi = bench_mkosi.program()
    if mkosi and fleet.boards[first.board].kernel != "debian":
        raise UserError(
            f"MKOSI={mkosi}: the disk of mkosi takes Debian's kernel and the card's initramfs, and {first.name} has a "
            f"kernel of our own without one (board {first.board}); name another robot, or leave out MKOSI"
        )
    subprocess.run([paths.PROJECT / "images" / "install-host-packages", _PACKAGES], check=True)
    pool.fill([lock, read_lock("tools")])
    work = paths.BUILD / "bench"
    cache.discard(work)
    load = os.getloadavg()[0]
    try:
        ours, repository = work / "ours", work / "repository"
        pool.repository(lock, repository)
        cold = [_cold(ours, first)]
        if mkosi:
            bench_mkosi.tools(work / "mkosi-tools")
            cold.append(_mkosi(mkosi, work, repository, lock, ours / "cache"))
        rows = [*_in_turn(cold, _COLD_RUNS if mkosi else 1), *_warm(ours, fleet, first, others)]
        rows.append(_measure(_mmdebstrap(work, repository, lock), 1))
    finally:
        cache.discard(work)
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    report = {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "load": load,
        "rows": [asdict(row) for row in rows],
    }
    REPORT.write_text(json.dumps(report, indent=1) + "\n")
    lines = [table(rows), f"{os.cpu_count()} cores; load before: {load:.1f}"]
    return "\n".join(lines if mkosi else [*lines, bench_mkosi.MISSING])


def _image(work: Path, *robots: Robot) -> Callable[[], int]:
    """Makes the images of a robot, or of the whole fleet, in the build directory `work`."""
    images = work / "images"

    def make() -> int:
        choice = [str(robots[0].number)] if len(robots) == 1 else ["--all"]
        _command([sys.executable, "-m", "flotilla", "image", *choice], BUILD=str(work), KEYS=str(paths.KEYS))
        return sum(_allocated(images / build.image_of(robot).name) for robot in robots)

    return make


def _cold(work: Path, first: Robot) -> Work:
    """The image of a robot from an empty cache on."""

    def prepare() -> None:
        cache.discard(work)
        work.mkdir(parents=True)
        (work / "pool").symlink_to(paths.POOL)

    name = f"cold build of {first.name}: empty cache, packages in the pool"
    return Work(name, "bootable card", _image(work, first), prepare)


def _warm(work: Path, fleet: Fleet, first: Robot, others: list[Robot]) -> list[Row]:
    """Our own builds in `work` after a cold one, and the copy of an image."""
    images, rows = work / "images", []
    if others:
        title = f"{others[0].name} after {first.name}"
        rows.append(_measure(Work(title, "bootable card", _image(work, others[0])), _RUNS))
    many = Work(f"{_MANY} more robots of that board", f"{_MANY} bootable cards", _many(work, first))
    rows.append(_measure(many, 1))
    everyone = list(fleet.robots.values())
    boards = len({robot.board for robot in everyone})
    cards = f"{len(everyone)} bootable cards"
    whole = _image(work, *everyone)
    rows.append(_measure(Work(f"whole fleet after that: {boards - 1} more boards, cold", cards, whole), 1))
    rows.append(_measure(Work("whole fleet again", cards, whole), _RUNS))

    def copy() -> int:
        source, target = images / build.image_of(first).name, work / "copy.img"
        target.unlink(missing_ok=True)
        _command(["cp", "--reflink=never", str(source), str(target)])
        return _allocated(target)

    rows.append(_measure(Work("cp of an image, its pages in memory", "the same bytes", copy), _RUNS))
    return rows


def _many(work: Path, first: Robot) -> Callable[[], int]:
    """Cards of many robots, with keys that are made for them and thrown away."""
    images, keys, one = work / "images", work / "keys", build.image_of(first).name

    def make() -> int:
        needed = _MANY * _allocated(images / one)
        if (free := shutil.disk_usage(work).free) < needed:
            raise UserError(
                f"{paths.shown(work)}: {_MANY} cards need {progress.size(needed)}, and {progress.size(free)} are free; "
                "make room, or let BUILD= name a folder on a larger disk"
            )
        fleet_keys.copy_for_image(first, keys)
        argv = [sys.executable, "-m", "evidence.bench_robots", str(first.number), str(_MANY)]
        _command(argv, BUILD=str(work), KEYS=str(keys))
        made = list(images.glob("measured*.img"))
        size = sum(map(_allocated, made))
        cache.discard(keys)
        for file in images.glob("measured*"):
            file.unlink()
        return size

    return make


def _mmdebstrap(work: Path, repository: Path, lock: Lock) -> Work:
    """The same packages from the same files, but for the kernel."""
    out = work / "root.tar.zst"
    names = ",".join(_userland(lock))
    rules = [(keep, pattern) for keep, pattern in rootfs.path_rules() if not pattern.startswith("/etc/")]
    argv = [
        *("mmdebstrap", "--quiet", "--variant=minbase", f"--architectures={lock.architecture}", f"--include={names}"),
        *(f"--dpkgopt=path-{'include' if keep else 'exclude'}={pattern}" for keep, pattern in rules),
        "--hook-dir=/usr/share/mmdebstrap/hooks/merged-usr",
        *(lock.release, str(out), f"deb [trusted=yes] copy://{repository} {lock.release} main"),
    ]

    def make() -> int:
        _command(argv, SOURCE_DATE_EPOCH=str(lock.epoch))
        return out.stat().st_size

    return Work("mmdebstrap, same packages without the kernel", "tar.zst, not bootable", make)


def _mkosi(program: str, work: Path, repository: Path, lock: Lock, made: Path) -> Work:
    """The same packages, with the kernel, as a disk that starts; `made` is the cache of a cold build of ours."""
    directory = work / "mkosi"
    argv = bench_mkosi.command(program, directory, work / "mkosi-tools", repository, lock)

    def prepare() -> None:
        cache.discard(directory)
        grub = tools.tree(read_lock("tools")) / "usr/lib/grub/i386-pc"
        (initramfs,) = made.glob("rootfs-*/initrd.img")
        bench_mkosi.prepare(directory, lock, grub, initramfs)

    def make() -> int:
        _command(argv)
        return _allocated(directory / "disk.raw")

    what = "bootable disk without runtime, overlay and identity; its initramfs was given"
    return Work("mkosi, same packages with the kernel", what, make, prepare)


def _userland(lock: Lock) -> list[str]:
    """What mmdebstrap installs: it takes a kernel with all its dependencies only."""
    return [package.name for package in lock.having("required", "userland")]


def _command(argv: list[str], **environment: str) -> None:
    progress.command(argv)
    done = subprocess.run(
        argv, env=os.environ | environment, cwd=paths.PROJECT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise UserError(f"{argv[0]} failed (status {done.returncode}): {done.stderr.strip()[-2000:]}")


def _allocated(path: Path) -> int:
    return path.stat().st_blocks * 512


def _in_turn(works: list[Work], runs: int) -> list[Row]:
    """One run of each after the other, `runs` times: whatever slows the computer for minutes slows them alike."""
    measured: list[list[tuple[float, float, int]]] = []
    with progress.step(", ".join(work.name for work in works)) as step:
        for run in range(runs):
            step.at(run, runs, "runs")
            measured.append([_run(work) for work in works])
    return [_row(work, list(column)) for work, column in zip(works, zip(*measured, strict=True), strict=True)]


def _measure(work: Work, runs: int) -> Row:
    with progress.step(work.name) as step:
        measured = []
        for run in range(runs):
            step.at(run, runs, "runs")
            measured.append(_run(work))
    return _row(work, measured)


def _run(work: Work) -> tuple[float, float, int]:
    """Seconds, processor seconds and bytes of one run."""
    work.prepare()
    started, used = time.monotonic(), _processor()
    size = work.make()
    return time.monotonic() - started, _processor() - used, size


def _row(work: Work, measured: list[tuple[float, float, int]]) -> Row:
    seconds, processor, sizes = zip(*measured, strict=True)
    median = statistics.median
    return Row(work.name, work.made, median(seconds), median(processor), sizes[-1], len(measured))


def _processor() -> float:
    """Seconds that processes took which have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(rows: list[Row]) -> str:
    """The rows as text; ratios are to the first."""
    cells = [("work", "seconds", "ratio", "processor", "bytes", "made")]
    for row in rows:
        figures = (f"{row.seconds:.2f}", f"{row.seconds / rows[0].seconds:.4f}", f"{row.processor:.2f}")
        cells.append((row.work, *figures, progress.size(row.bytes), row.made))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for first, *rest, last in cells:
        middle = (cell.rjust(width) for cell, width in zip(rest, widths[1:-1], strict=True))
        lines.append("  ".join((first.ljust(widths[0]), *middle, last)))
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", type=int, nargs="?", help="number in the inventory (the first)")
    fleet = inventory.load_fleet()
    robot = parser.parse_args().robot
    print(bench(fleet, inventory.robot(fleet, next(iter(fleet.robots)) if robot is None else robot)))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")
