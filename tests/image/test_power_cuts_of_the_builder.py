"""The power of a builder is cut, during a build and after it: the next build makes the same image.

A disk is a file on XFS, and carries an ext4 with Debian's defaults in which a build has its outputs and its keys. A
snapshot is a clone of that file, which the kernel makes between two writes: it has what ext4 has sent to its device by
then, and nothing of what waits in memory. That is what a power cut leaves. Then the snapshot is the disk.
"""

from __future__ import annotations

import hashlib
import os
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from flotilla.common import paths, progress

pytestmark = pytest.mark.nightly

MOMENTS = 20
AFTER_S = 40
"""ext4 commits its journal after 5 s, and the kernel writes contents that are 30 s old."""
BETWEEN_S = 10
"""After a result got its name: names are on the disk by then, contents that nobody synced are not."""
PATIENCE_S = 3600
REPORT = paths.BUILD / "reports" / "power-cuts-of-the-builder.txt"
ENDED = re.compile(r"^(.+): \d+\.\d s$", re.MULTILINE)
"""A line of progress about what was made."""


@dataclass
class Disk:
    """Mounted in a namespace of its own, whose end takes the mounts and loop devices away."""

    directory: Path
    holder: subprocess.Popen[bytes]
    snapshots: dict[str, Path] = field(default_factory=dict)

    @property
    def place(self) -> Path:
        """Where it is mounted, for processes inside."""
        return self.directory / "disk"

    @property
    def seen(self) -> Path:
        """The same for this process."""
        return Path(f"/proc/{self.holder.pid}/root{self.place}")

    def argv(self, *argv: str | Path) -> list[str]:
        enter = ["nsenter", f"--mount=/proc/{self.holder.pid}/ns/mnt"]  # which makes / the working directory
        return [*enter, "env", "-C", str(paths.PROJECT), *map(str, argv)]

    def run(self, *argv: str | Path) -> str:
        done = subprocess.run(self.argv(*argv), capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{argv}: {done.stdout}{done.stderr}"
        return done.stdout

    def snapshot(self, moment: str) -> None:
        moment = f"{len(self.snapshots) + 1}: {moment}"  # two results of a kind are two moments
        if len(self.snapshots) % 2:  # another program syncs a file of its own: names get to the disk, contents do not
            (self.seen / "another").touch()
            self.run("sync", self.place / "another")
            moment += ", names synced"
        snapshot = self.directory / "outer" / f"{len(self.snapshots)}.img"
        self.run("cp", "--reflink=always", self.directory / "outer" / "disk.img", snapshot)
        self.snapshots[moment] = snapshot

    def start_from(self, moment: str) -> None:
        """The computer starts again: the snapshot is its disk."""
        snapshot = self.snapshots[moment]
        self.run("umount", self.place)
        check = subprocess.run(self.argv("e2fsck", "-f", "-p", snapshot), capture_output=True, text=True, check=False)
        assert check.returncode in (0, 1), f"{moment}: {check.stdout}"  # 1: the journal was replayed
        self.run("mount", "-o", "loop", snapshot, self.place)

    def discard(self, moment: str) -> None:
        """What builds write to all of them would fill a disk."""
        self.run("umount", self.place)
        self.run("rm", self.snapshots[moment])
        self.run("mount", "-o", "loop", self.directory / "outer" / "disk.img", self.place)

    def build(self) -> subprocess.Popen[str]:
        environment = os.environ | {"BUILD": str(self.place / "build"), "KEYS": str(self.place / "keys")}
        argv = self.argv("setpriv", "--pdeathsig", "KILL", sys.executable, "-m", "flotilla", "image", "3")
        pipe = subprocess.PIPE
        return subprocess.Popen(argv, env=environment, stdout=pipe, stderr=pipe, text=True)

    def image(self) -> str:
        """Its SHA-256; with the one that lies beside it."""
        file = self.seen / "build" / "images" / "robot3.img"
        with file.open("rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        assert file.with_suffix(".sha256").read_text() == f"{found}  {file.name}\n"
        return found


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    if os.geteuid() != 0:
        pytest.fail("mounts disks: run it in a container or a virtual machine where you are root", pytrace=False)
    directory = tmp_path.resolve()
    argv = ["setpriv", "--pdeathsig", "KILL", "unshare", "--mount", "cat"]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdin
        assert holder.stdout
        try:
            holder.stdin.write(b"in its namespace\n")
            holder.stdin.flush()
            holder.stdout.readline()
            disk = Disk(directory, holder)
            for name in ("outer", "disk"):
                (directory / name).mkdir()
            disk.run("truncate", "-s", "40G", directory / "outer.img")
            disk.run("mkfs.xfs", "-q", "-m", "reflink=1", directory / "outer.img")
            disk.run("mount", "-o", "loop", directory / "outer.img", directory / "outer")
            disk.run("truncate", "-s", "12G", directory / "outer" / "disk.img")
            disk.run("mkfs.ext4", "-q", directory / "outer" / "disk.img")
            disk.run("mount", "-o", "loop", directory / "outer" / "disk.img", disk.place)
            (disk.seen / "build").mkdir()
            yield disk
        finally:
            holder.kill()
    shutil.rmtree(directory)


def _watch(disk: Disk, build: subprocess.Popen[str]) -> None:
    """Take a snapshot whenever a result got its name, and some time later, until the build ends."""
    cache = disk.seen / "build" / "cache"
    known: set[str] = set()
    due = float("inf")
    descriptor = os.pidfd_open(build.pid)
    timer = select.poll()  # waits for the build's end, and wakes now and then to look for results
    timer.register(descriptor, select.POLLIN)
    try:
        while not timer.poll(100):
            names = {path.name for path in cache.glob("[!.]*-*[0-9a-f]")} - known
            if names:
                disk.snapshot(f"{' '.join(sorted(name.rpartition('-')[0] for name in names))} just made")
                known |= names
                due = time.monotonic() + BETWEEN_S
            elif time.monotonic() > due:
                disk.snapshot(f"{BETWEEN_S} s after that")
                due = float("inf")
    finally:
        os.close(descriptor)


def _after(disk: Disk, moments_s: Sequence[float]) -> None:
    """Take snapshots so long after the end of the build: the kernel's own clock decides what it writes when."""
    ended = time.monotonic()
    for moment in moments_s:
        time.sleep(max(0.0, ended + moment - time.monotonic()))
        disk.snapshot(f"{moment:.0f} s after the end")


def _filled(disk: Disk) -> None:
    """Keys and packages were on the disk long before."""
    shutil.copytree(paths.KEYS, disk.seen / "keys")
    (disk.seen / "build" / "pool").mkdir()
    for package in paths.POOL.glob("*.deb"):
        shutil.copy(package, disk.seen / "build" / "pool")
    disk.run("sync")


def test_the_next_build_after_a_power_cut_makes_the_same_image(disk: Disk) -> None:
    """Seen to fail: after cuts at two of twelve moments the inventory that the cache keeps was empty, and every command
    that reads it ended with a traceback."""
    _filled(disk)
    build = disk.build()
    _watch(disk, build)
    said = build.communicate()
    during = len(disk.snapshots)
    count = MOMENTS - during
    assert build.returncode == 0, said[1]
    right = disk.image()
    _after(disk, [AFTER_S * number / (count - 1) for number in range(count)])
    lines, wrong = [], []
    for moment in disk.snapshots:
        started = time.monotonic()
        disk.start_from(moment)
        again = disk.build()
        _, errors = again.communicate(timeout=PATIENCE_S)
        same = again.returncode == 0 and disk.image() == right
        left = [path.name for path in (disk.seen / "build" / "cache").glob("*.part")]
        anew = "; ".join(re.sub(r" \(.*", "", title) for title in ENDED.findall(errors))
        lines.append(
            f"{moment}: {'the same image' if same else f'WRONG (status {again.returncode})'}, "
            f"{time.monotonic() - started:.0f} s; {anew}\n"
        )
        progress.say(lines[-1].rstrip())
        if not same or left:
            wrong.append(f"{moment}: {left} {errors}")
        disk.discard(moment)
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    REPORT.write_text("".join(lines))
    assert len(lines) == MOMENTS
    assert not wrong, "\n".join(wrong)


MAKE_KEYS = """
from flotilla.common import paths
from flotilla.fleet import keys
keys.make("robot3_ed25519", "robot3")
keys.write_once(paths.KEYS / "fleet_secret", "secret")
"""


def test_a_key_that_was_made_is_there_after_a_power_cut(disk: Disk) -> None:
    """Cards may have been flashed with it. Seen to fail: right after it was made it was not on the disk."""
    environment = os.environ | {"KEYS": str(disk.place / "keys")}
    subprocess.run(disk.argv(sys.executable, "-c", MAKE_KEYS), env=environment, check=True)
    public = (disk.seen / "keys" / "robot3_ed25519.pub").read_text()
    _after(disk, (0, BETWEEN_S))
    for moment in disk.snapshots:
        disk.start_from(moment)
        place = disk.place / "keys"
        assert disk.run("ssh-keygen", "-y", "-f", place / "robot3_ed25519") == public, moment
        assert (disk.seen / "keys" / "fleet_secret").read_text() == "secret", moment
