"""Runs code that others wrote, or that somebody may have replaced: what is built for robots, and what is checked.

Bubblewrap gives it a root directory with the files that it needs alone: no keys, no network, no capabilities, no way to
gain privileges. The files that it writes are in memory until it has ended. `sandbox_guard` ends it at its limits.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from flotilla.common import namespace, sandbox_guard
from flotilla.common.errors import UserError

_LAST = 30
"""Lines of messages in which a limit is looked for."""


@dataclass(frozen=True)
class Limits:
    """Of a sandbox; at each of them it is ended."""

    seconds: int = 1800
    """As long as a robot may take for a build."""
    processes: int = 1024
    """At once; threads count."""
    memory_bytes: int = 8 << 30
    """Of all processes together, without files."""
    disk_bytes: int = 2 << 30
    """Of all files together, which are in memory, too."""
    file_bytes: int = 2 << 30
    """Of a file, holes included."""
    output_bytes: int = 64 << 20
    """Of its messages."""


BUILD = Limits()
CHECK = Limits(seconds=60, memory_bytes=2 << 30, disk_bytes=64 << 20, file_bytes=1 << 20, output_bytes=1 << 20)


def command(
    argv: Sequence[str | Path],
    limits: Limits,
    *,
    root: Path | None = None,
    readable: Sequence[Path] = (),
    writable: Mapping[str, Path] | None = None,
    environment: Mapping[str, str] | None = None,
    mounted: Mapping[str, Path] | None = None,
) -> list[str]:
    """The command line that runs `argv` there, and ends with the process that starts it.

    `root`: the tree that is the root directory, read-only; without one it is empty. `readable`: files and directories
    of this computer, at their own places. `mounted`, `writable`: directories by their places there. A writable one
    is a copy, which takes the place of the directory when `argv` has ended with status 0.
    """
    memory = sandbox_guard.PLACE
    options = ["--unshare-all", "--unshare-user", "--disable-userns", "--die-with-parent", "--new-session"]
    options += ["--cap-drop", "ALL", "--uid", "0", "--gid", "0"]
    options += ["--clearenv", *(word for item in (environment or {}).items() for word in ("--setenv", *item))]
    if root:
        options += ["--ro-bind", str(root), "/"]
    options += ["--dev", "/dev", "--bind", f"{memory}/shm", "/dev/shm", "--remount-ro", "/dev"]
    # Read-only: /proc/sys looks at the user alone, so that root's sandbox could set the kernel's core_pattern.
    options += ["--proc", "/proc", "--remount-ro", "/proc"]
    options += ["--bind", f"{memory}/tmp", "/tmp", "--size", str(1 << 20), "--tmpfs", "/run"]
    for path in readable:
        options += ["--ro-bind", str(path), str(path)]
    for place, path in (mounted or {}).items():
        options += ["--ro-bind", str(path), place]
    copies = {f"writable{number}": item for number, item in enumerate((writable or {}).items())}
    for name, (place, _) in copies.items():
        options += ["--bind", f"{memory}/{name}", place]
    options += [] if root else ["--remount-ro", "/"]
    settings = asdict(limits) | {
        "argv": ["bwrap", *options, "--chdir", "/", "--", *map(str, argv)],
        "writable": {name: str(path) for name, (_, path) in copies.items()},
    }
    mapping = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    world = ["unshare", *mapping, "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "--"]
    guard = [sys.executable, "-I", "-S", sandbox_guard.__file__, json.dumps(settings)]
    return ["setpriv", "--pdeathsig", "KILL", *world, *guard]


def refusal(stderr: str, limits: Limits, status: int = 1) -> UserError | None:
    """Why a sandbox ended that failed, or why there is none; None where its program failed by itself.

    `status`: the exit status of the command, where it started no other programs.
    """
    lines = stderr.splitlines()
    if lines and lines[-1].startswith(sandbox_guard.LIMIT):
        return _at(lines[-1].removeprefix(sandbox_guard.LIMIT))
    if line := next((line for line in lines if line.startswith(("bwrap: ", "unshare: ", "mount: "))), ""):
        remedy = namespace.cause(line, user=True)
        if line == "bwrap: is missing":
            remedy = "install it: sudo apt-get install --no-install-recommends bubblewrap"
        return UserError(
            f"{line}: nothing that others wrote is built or checked without a sandbox" + f"; {remedy}" * bool(remedy)
        )
    # Programs may end at a limit of the kernel's before the guard sees it.
    last = "\n".join(lines[-_LAST:])
    if "No space left on device" in last:
        return _at(f"{limits.disk_bytes >> 20} MiB for files")
    if "File size limit exceeded" in last or status == 128 + signal.SIGXFSZ:
        return _at(f"{limits.file_bytes >> 20} MiB for a file")
    return None


def _at(limit: str) -> UserError:
    remedy = "look for a loop without an end in it, or change it so that it needs less"
    return UserError(f"it was ended at the sandbox's limit of {limit}; {remedy}")
