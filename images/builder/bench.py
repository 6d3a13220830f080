"""How long images take, against public builders on the same packages and against copying the same bytes.

Everything runs as it would for a user: whole processes, from their start to their end.
"""

from __future__ import annotations

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

from flotilla.common import cache, paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet.model import Fleet, Robot
from images.builder import bench_mkosi, build, pool, rootfs, tools
from images.builder.lock import Lock, read_lock

_PACKAGES = paths.PROJECT / "images" / "bench-packages.txt"
_RUNS = 5
"""Of what takes about a second; the median counts."""
_MANY = 100
"""Robots that are made at once."""
_INITRAMFS = "initrd.img"
"""Of the robot that is built first."""
REPORT = paths.BUILD / "reports" / "bench.json"


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
        rows = _ours(work, fleet, first, others)
        repository = work / "repository"
        pool.repository(lock, repository)
        rows.append(_mmdebstrap(work, repository, lock))
        if mkosi:
            rows.append(_mkosi(mkosi, work / "mkosi", repository, lock, work / _INITRAMFS))
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


def _ours(work: Path, fleet: Fleet, first: Robot, others: list[Robot]) -> list[Row]:
    """Our own builds in `work`, from an empty cache on, and the copy of an image."""
    work.mkdir(parents=True)
    (work / "pool").symlink_to(paths.POOL)
    images = work / "images"

    def image(*robots: Robot) -> Callable[[], int]:
        def make() -> int:
            choice = ["--all"] if len(robots) == len(fleet.robots) else [str(robots[0].number)]
            _command([sys.executable, "-m", "flotilla", "image", *choice], BUILD=str(work), KEYS=str(paths.KEYS))
            return sum(_allocated(images / build.image_of(robot).name) for robot in robots)

        return make

    rows = [
        _measure(f"cold build of {first.name}: empty cache, packages in the pool", "bootable card", image(first), 1)
    ]
    for made in (work / "cache").glob(f"rootfs-*/{_INITRAMFS}"):  # one root so far
        shutil.copyfile(made, work / _INITRAMFS)
    if others:
        title = f"{others[0].name} after {first.name}"
        rows.append(_measure(title, "bootable card", image(others[0]), _RUNS))
    rows.append(_measure(f"{_MANY} more robots of that board", f"{_MANY} bootable cards", _many(work, first), 1))
    everyone = list(fleet.robots.values())
    boards = len({robot.board for robot in everyone})
    cards = f"{len(everyone)} bootable cards"
    rows.append(_measure(f"whole fleet after that: {boards - 1} more boards, cold", cards, image(*everyone), 1))
    rows.append(_measure("whole fleet again", cards, image(*everyone), _RUNS))

    def copy() -> int:
        source, target = images / build.image_of(first).name, work / "copy.img"
        target.unlink(missing_ok=True)
        _command(["cp", "--reflink=never", str(source), str(target)])
        return _allocated(target)

    rows.append(_measure("cp of an image, its pages in memory", "the same bytes", copy, _RUNS))
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
        shutil.copytree(paths.KEYS, keys)
        argv = [sys.executable, "-m", "images.builder.bench_robots", str(first.number), str(_MANY)]
        _command(argv, BUILD=str(work), KEYS=str(keys))
        made = list(images.glob("measured*.img"))
        size = sum(map(_allocated, made))
        cache.discard(keys)
        for file in images.glob("measured*"):
            file.unlink()
        return size

    return make


def _mmdebstrap(work: Path, repository: Path, lock: Lock) -> Row:
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

    return _measure("mmdebstrap, same packages without the kernel", "tar.zst, not bootable", make, 1)


def _mkosi(program: str, directory: Path, repository: Path, lock: Lock, initramfs: Path) -> Row:
    """The same packages, with the kernel, as a disk that starts."""
    grub = tools.tree(read_lock("tools")) / "usr/lib/grub/i386-pc"
    bench_mkosi.prepare(directory, lock, grub, initramfs)
    bench_mkosi.tools(directory / "tools")
    argv = bench_mkosi.command(program, directory, repository, lock)

    def make() -> int:
        _command(argv)
        return _allocated(directory / "disk.raw")

    made = "bootable disk without runtime, overlay and identity; its initramfs was given"
    return _measure("mkosi, same packages with the kernel", made, make, 1)


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


def _measure(work: str, made: str, make: Callable[[], int], runs: int) -> Row:
    seconds, processor = [], []
    size = 0
    with progress.step(work) as step:
        for run in range(runs):
            step.at(run, runs, "runs")
            started, used = time.monotonic(), _processor()
            size = make()
            seconds.append(time.monotonic() - started)
            processor.append(_processor() - used)
    return Row(work, made, statistics.median(seconds), statistics.median(processor), size, runs)


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
