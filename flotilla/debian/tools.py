"""The build tools (debootstrap, mksquashfs, mke2fs, GRUB …) at locked versions, whatever the host has.

They are unpacked, not installed, into a tree of their own. A tool that needs nothing but files of the caller runs
straight from there through the tree's own dynamic loader; the root file system is made in a chroot of the tree.
"""

from __future__ import annotations

import os
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from flotilla.common import cache, namespace, progress
from flotilla.common.errors import UserError
from flotilla.debian import pool
from flotilla.debian.lock import Lock, Package

_KIND = "tools"
"""Of results in the cache."""
_MERGED = ("bin", "sbin", "lib", "lib32", "lib64")
_LOADERS = {
    "amd64": "usr/lib/x86_64-linux-gnu/ld-linux-x86-64.so.2",
    "i386": "usr/lib/i386-linux-gnu/ld-linux.so.2",
}
"""The dynamic loader beside its C library, by architecture; a 64-bit PC runs programs of both. The names in which
programs ask for it are links that begin at the root: outside a chroot they lead to this computer's loader."""
_MOUNT_POINTS = ("dev", "proc", "sys", "tmp", "repository", "target", "out", "run")


def tree(lock: Lock) -> Path:
    """The tools of `lock`, unpacked once."""

    def unpack(directory: Path) -> None:
        pool.verify_hashes(lock)
        with progress.step(f"unpack {len(lock.packages)} build tools") as step:
            for name in _MERGED:
                (directory / "usr" / name).mkdir(parents=True)
                (directory / name).symlink_to(f"usr/{name}")
            with ThreadPoolExecutor(os.cpu_count()) as threads:
                for done, _ in enumerate(threads.map(lambda package: _unpack(package, directory), lock.packages)):
                    step.at(done + 1, len(lock.packages), "packages")
            for name in _MOUNT_POINTS:
                (directory / name).mkdir(exist_ok=True)
            # What the maintainer scripts would have set up.
            (directory / "usr/bin/awk").symlink_to("mawk")

    return cache.result(_KIND, _key(lock), unpack)


def name(lock: Lock) -> str:
    """Of the directory of what `tree` makes; it need not be made yet."""
    return cache.name(_KIND, _key(lock))


def _key(lock: Lock) -> str:
    return cache.digest(lock.digest, Path(__file__))


def _unpack(package: Package, directory: Path) -> None:
    pack = ["dpkg-deb", "--fsys-tarfile", str(pool.file(package))]
    extract = ["tar", "-x", "--keep-directory-symlink", "--no-same-owner", "-C", str(directory)]
    extract += [f"--exclude=./usr/share/{unused}" for unused in ("doc", "man", "locale")]
    with subprocess.Popen(pack, stdout=subprocess.PIPE) as archive:
        unpacked = subprocess.run(extract, stdin=archive.stdout)
    if archive.returncode != 0 or unpacked.returncode != 0:
        raise UserError(f"cannot unpack {package.name} {package.version} ({pool.file(package)})")


def command(tree: Path, program: str | Path, architecture: str = "amd64") -> list[str]:
    """The command that runs a program of a tree (`usr/sbin/mke2fs`), or one elsewhere by its absolute path, by the
    tree's own dynamic loader and libraries."""
    loader = tree / _LOADERS[architecture]
    return [str(loader), "--library-path", str(loader.parent), str(tree / program)]


class Tools:
    """Runs the unpacked tools on files of the caller, with time stopped at `epoch`."""

    def __init__(self, directory: Path, epoch: int) -> None:
        self.directory = directory
        self._environment = {
            "LC_ALL": "C.UTF-8",
            "TZ": "UTC",
            "SOURCE_DATE_EPOCH": str(epoch),
            "E2FSPROGS_FAKE_TIME": str(epoch),
            "MKE2FS_CONFIG": os.devnull,
            **namespace.moved_clock(),
        }

    def run(self, program: str, *arguments: str | Path, stdin: str | None = None) -> str:
        """Run a tool by its path in the tree (`usr/sbin/mke2fs`); its standard output."""
        argv = [*command(self.directory, program), *map(str, arguments)]
        progress.command([program, *map(str, arguments)])
        done = subprocess.run(argv, env=self._environment, input=stdin, capture_output=True, encoding="utf-8")
        if done.returncode != 0:
            raise UserError(
                f"{program} failed (status {done.returncode}): {done.stderr.strip() or done.stdout.strip()}"
            )
        return done.stdout
