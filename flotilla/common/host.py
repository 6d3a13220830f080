"""What building asks of the development computer, checked before anything begins and reported all at once."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError

_COMMANDS = {
    "chroot": "coreutils",
    "dpkg-deb": "dpkg",
    "git": "git",
    "mount": "mount",
    "setpriv": "util-linux",
    "ssh-keygen": "openssh-client",
    "tar": "tar",
    "unshare": "util-linux",
}
"""Programs by the Debian package that has them."""
_USER_COMMANDS = {"newuidmap": "uidmap", "newgidmap": "uidmap"}
"""What ordinary users need besides, to map the users of the image."""
_SPACE = 1 << 30
"""Bytes of disk for the pool, one board's results and an image."""
_FULL = 16 << 20
"""Bytes below which a disk counts as full: files are larger than this."""
_was_full = threading.Event()
"""Once a failure found the disk full: what it removes then makes room, and work at the same time fails all the same."""
_MEMORY = 1 << 30
"""Bytes of memory for the root file system while it is made."""


def check() -> None:
    """Refuse a build that could not succeed here."""
    problems = [*_missing_commands(), *_missing_space(), *_missing_memory()]
    if problems:
        raise UserError("\n".join(problems))


def _missing_commands() -> list[str]:
    needed = _COMMANDS if os.geteuid() == 0 else _COMMANDS | _USER_COMMANDS
    search = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    missing = {command: package for command, package in needed.items() if not shutil.which(command, path=search)}
    if not missing:
        return []
    packages = " ".join(sorted(set(missing.values())))
    return [
        f"missing on this computer: {', '.join(sorted(missing))}; "
        f"install with `sudo apt-get install --no-install-recommends {packages}`"
    ]


def _missing_space() -> list[str]:
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(paths.BUILD).free
    if free >= _SPACE:
        return []
    return [
        f"{paths.shown(paths.BUILD)}: {progress.size(free)} free on its disk, a build needs {progress.size(_SPACE)}; "
        "make room, or choose another place with BUILD=directory"
    ]


def _missing_memory(meminfo: Path = Path("/proc/meminfo")) -> list[str]:
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    available = sum(int(fields[name].split()[0]) * 1024 for name in ("MemAvailable", "SwapFree") if name in fields)
    if available >= _MEMORY:
        return []
    return [
        f"{progress.size(available)} of memory available, a build needs {progress.size(_MEMORY)}: the root file system "
        "is made in memory; close other programs, or add swap"
    ]


class _FullDisk(UserError):
    """A failure that was explained."""


@contextlib.contextmanager
def explaining_a_full_disk() -> Iterator[None]:
    """Whatever way a full disk made a step fail, say that it was the disk."""
    try:
        yield
    except _FullDisk:
        raise
    except (UserError, OSError) as error:
        if shutil.disk_usage(paths.BUILD).free <= _FULL:
            _was_full.set()
        if not _was_full.is_set():
            raise
        raise _FullDisk(
            f"{paths.shown(paths.BUILD)}: no space left on its disk, so the build failed; the last good images are "
            f"untouched; make room, or choose another place with BUILD=directory ({str(error).splitlines()[0]})"
        ) from error
