"""Runs code that others wrote, or that somebody may have replaced: what is built for robots, and what is checked.

Bubblewrap gives it a root directory that has only what it needs: no keys, no network, no capabilities, no way to gain
privileges. Limits of time, of memory and of files' sizes end what does not end by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from flotilla.common import namespace
from flotilla.common.errors import UserError

SECONDS = 1800
"""As long as a robot may take for a build."""
_MEMORY = 8 << 30


def command(
    argv: Sequence[str | Path],
    *,
    root: Path | None = None,
    readable: Sequence[Path] = (),
    writable: Mapping[str, Path] | None = None,
    environment: Mapping[str, str] | None = None,
    mounted: Mapping[str, Path] | None = None,
    seconds: int = SECONDS,
    file_bytes: int = 4 << 30,
) -> list[str]:
    """The command line that runs `argv` there, and ends with the process that starts it.

    `root`: the tree that is the root directory, read-only; without one it is empty. `readable`: files and directories
    of this computer, at their own places. `mounted`, `writable`: directories by their places there.
    """
    options = ["--unshare-all", "--unshare-user", "--disable-userns", "--die-with-parent", "--new-session"]
    options += ["--cap-drop", "ALL", "--uid", "0", "--gid", "0"]
    options += ["--clearenv", *(word for item in (environment or {}).items() for word in ("--setenv", *item))]
    if root:
        options += ["--ro-bind", str(root), "/"]
    options += ["--dev", "/dev", "--proc", "/proc", "--size", str(_MEMORY), "--tmpfs", "/tmp", "--tmpfs", "/run"]
    for path in readable:
        options += ["--ro-bind", str(path), str(path)]
    for place, path in (mounted or {}).items():
        options += ["--ro-bind", str(path), place]
    for place, path in (writable or {}).items():
        options += ["--bind", str(path), place]
    options += [] if root else ["--remount-ro", "/"]
    limits = ["prlimit", "--core=0", f"--as={_MEMORY}", f"--fsize={file_bytes}"]
    return [
        *("setpriv", "--pdeathsig", "KILL", "timeout", "--foreground", "--signal", "KILL", str(seconds), *limits),
        *("bwrap", *options, "--chdir", "/", "--", *map(str, argv)),
    ]


def refusal(stderr: str) -> UserError | None:
    """Why there is no sandbox, where bubblewrap or its absence says so."""
    if line := next((line for line in stderr.splitlines() if line.startswith(("bwrap: ", "prlimit: "))), ""):
        remedy = namespace.cause(line, user=True)
        if line.startswith("prlimit: "):
            remedy = "install it: sudo apt-get install --no-install-recommends bubblewrap"
        return UserError(
            f"{line}: nothing that others wrote is built or checked without a sandbox" + f"; {remedy}" * bool(remedy)
        )
    return None
