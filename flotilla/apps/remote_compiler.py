"""Apps compiled on the robot: by the same locked compiler, which is sent there once, as a file system in a file.

A robot's root has no room for it; its data partition has. It runs there as nobody in particular, on a root of its own,
with the lowest priority: what controls the robot is not disturbed.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Sequence
from pathlib import Path

from flotilla.apps import remote
from flotilla.common import cache, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.processes import limited
from flotilla.debian import pool, tools
from flotilla.debian.chroot import Chroot
from flotilla.debian.lock import Lock, read_lock

_EXCLUDED = (
    "usr/share/locale", "usr/share/i18n", "usr/share/info", "usr/lib/*/gconv", "usr/bin/*lto-dump*",
    "usr/lib/python3*", "usr/bin/python3*",
)  # fmt: skip
"""What no app's build needs: other languages, and meson, which builds the runtime."""
_COMPRESSION = ("-comp", "zstd", "-Xcompression-level", "15", "-b", "256K")
_RESERVE_KIB = 16384
"""Of the data partition, for what the compiler makes."""


def packed(lock: Lock) -> Path:
    """The compiler and libraries of a lock as a squashfs."""
    packer = read_lock("tools")

    def make(out: Path) -> None:
        pool.fill([lock, packer])
        tree = tools.tree(lock)
        with progress.step(f"{lock.name} packed"):
            options = [*_COMPRESSION, "-all-root", "-noappend", "-no-progress", "-wildcards", "-e", *_EXCLUDED]
            packing = tools.Tools(tools.tree(packer), lock.epoch)
            packing.run("usr/bin/mksquashfs", tree, out / "root.squashfs", *options)

    return cache.result("compiler", cache.digest(lock.digest, packer.digest, Path(__file__)), make) / "root.squashfs"


class Compiler:
    """Runs on a robot what toolchain.run runs here."""

    def __init__(self, to: remote.Connection, name: str) -> None:
        self._to, self._name = to, name

    def run(self, lock_name: str, work: Path, command: Sequence[str], log: Path) -> None:
        """Run a command among the packages of a lock, where `work` is /out; its words are shown and kept in `log`."""
        lock = read_lock(lock_name)
        digest = self._bring(packed(lock))
        environment = Chroot(Path("/"), lock.epoch).environment
        argv = ["env", "-i", *(f"{key}={value}" for key, value in environment.items()), *command]
        with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".remote-") as directory:
            sent, made = Path(directory) / "sent.tar", Path(directory) / "made.tar"
            with tarfile.open(sent, "w") as tar:
                tar.add(work, arcname=".")
            need_kib = 2 * sent.stat().st_size // 1024 + _RESERVE_KIB
            with progress.step(f"{self._name} compiled on {self._to.robot.name}"):
                self._to.stream("compile", self._name, digest, str(need_kib), *argv, stdin=sent, stdout=made, log=log)
            # Into an empty directory, because tar follows links that are there: the other end may be anybody's by now.
            # Whoever reads what was made follows no link that leads out of `work`: flotilla.debian.runtime.command
            # refuses these. By standard input tar unpacks nothing that is compressed.
            unpacked = Path(directory) / "made"
            unpacked.mkdir()
            argv = [*limited(remote.MADE_BYTES), "tar", "-x", "--no-same-owner", "--no-same-permissions", "-f", "-"]
            with made.open("rb") as archive:
                done = subprocess.run(
                    [*argv, "-C", str(unpacked)], stdin=archive, capture_output=True, text=True, errors="replace",
                    check=False,
                )  # fmt: skip
            if done.returncode:
                raise UserError(f"{self._to.robot.name}: what it compiled is no archive: {done.stderr.strip()[:500]}")
            for old in work.iterdir():
                shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
            for new in unpacked.iterdir():
                new.rename(work / new.name)

    def _bring(self, image: Path) -> str:
        """Its hash; the robot has it now."""
        with image.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if not self._to.run("has-compiler", self._name, digest):
            size = image.stat().st_size
            with progress.step(f"compiler to {self._to.robot.name}, {progress.size(size)}"):
                need_kib = size // 1024 + _RESERVE_KIB
                self._to.run("receive-compiler", self._name, digest, str(need_kib), stdin=image.read_bytes())
        return digest
