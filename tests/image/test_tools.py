"""The build tools as they are unpacked: nothing of this computer's libraries runs in them."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from flotilla.common import cache
from flotilla.debian import pool, tools
from flotilla.debian.lock import read_lock

PROGRAMS = {
    "tools": (
        "usr/bin/grub-mkimage", "usr/bin/mcopy", "usr/bin/mksquashfs", "usr/bin/unsquashfs", "usr/sbin/debugfs",
        "usr/sbin/dumpe2fs", "usr/sbin/e2fsck", "usr/sbin/mke2fs", "usr/sbin/mkfs.fat", "usr/sbin/sfdisk",
    ),
    "updates": ("usr/bin/xdelta3",),
    "emulator": ("usr/bin/qemu-system-x86_64", "usr/libexec/qemu-system-i386"),
}  # fmt: skip
"""By lock, those that run on this computer without a chroot."""


def _tree(lock_name: str) -> Path:
    lock = read_lock(lock_name)
    with cache.exclusive():
        pool.fill([lock])
        return tools.tree(lock)


def test_a_running_tool_maps_files_of_its_tree_alone() -> None:
    """Seen to fail: the loader that ran was the host's, and on Debian 13 no card could be made."""
    tree = _tree("tools")
    argv = [*tools.command(tree, "usr/bin/cat"), "/proc/self/maps"]
    maps = subprocess.run(argv, env={"LC_ALL": "C"}, capture_output=True, text=True, check=True).stdout
    mapped = {Path(words[5]) for line in maps.splitlines() if len(words := line.split(maxsplit=5)) == 6}
    files = {path for path in mapped if path.is_absolute()}
    assert {path.name for path in files} >= {"cat", "libc.so.6", "ld-linux-x86-64.so.2"}
    assert {path for path in files if not path.is_relative_to(tree.resolve())} == set()


@pytest.mark.parametrize(("lock", "program"), [(lock, each) for lock in PROGRAMS for each in PROGRAMS[lock]])
def test_libraries_of_a_tool_are_those_of_its_tree(lock: str, program: str) -> None:
    tree = _tree(lock)
    loader, *rest = tools.command(tree, program)
    listed = subprocess.run([loader, "--list", *rest], capture_output=True, text=True, check=True).stdout
    libraries = {Path(path) for line in listed.splitlines() if (path := line.partition(" => ")[2].partition(" (")[0])}
    assert libraries
    assert {path for path in libraries if not path.resolve().is_relative_to(tree.resolve())} == set()
