"""What building asks of the development computer, checked before anything begins and reported all at once."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError

_COMMANDS = {
    "bwrap": "bubblewrap",
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
_SPACE = 32 << 20
"""Bytes of disk without which nothing is begun."""
_FULL = 16 << 20
"""Bytes below which a disk counts as full: files are larger than this."""
_FULL_DISK = (errno.ENOSPC, errno.EDQUOT)
_was_full = threading.Event()
"""Once a failure found the disk full: what it removes then makes room, and work at the same time fails all the same."""
_MEMORY = 1 << 30
"""Bytes of memory for the root file system while it is made."""


def check(space: int = _SPACE) -> None:
    """Refuse a build that could not succeed here. `space`: bytes of disk that it takes, as far as that is known."""
    problems = [*_missing_commands(), *_missing_space(space), *_missing_memory()]
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


def check_space(needed: int) -> None:
    """Refuse a build for which the disk has no room."""
    if problems := _missing_space(needed):
        raise UserError(*problems)


def _missing_space(needed: int) -> list[str]:
    needed = max(needed, _SPACE)
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(paths.BUILD).free
    if free >= needed:
        return []
    return [
        f"{paths.shown(paths.BUILD)}: {progress.size(free)} free on its disk, a build needs {progress.size(needed)}; "
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
        free = shutil.disk_usage(paths.BUILD).free
        if free <= _FULL or _says_full(error):
            _was_full.set()
        if not _was_full.is_set():
            raise
        raise _FullDisk(
            f"{paths.shown(paths.BUILD)}: no space left on its disk, {progress.size(free)} free, so the build failed; "
            "the last good images are untouched; make room, or choose another place with BUILD=directory "
            f"({str(error).splitlines()[0]})"
        ) from error


def _says_full(error: UserError | OSError) -> bool:
    """Whether it is a full disk's, or a quota's, as this program or one that it ran says it."""
    if isinstance(error, OSError):
        return error.errno in _FULL_DISK
    return any(os.strerror(number) in str(error) for number in _FULL_DISK)
