"""Commands that somebody runs through sudo: they leave files that belong to root, which that user cannot change.

Only a command that declares so needs root. All others end with an error: after a killed run nothing would return its
files to the user, and make, pip and compilers would be root for nothing. The few return their files when they end.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from flotilla.common import paths
from flotilla.common.errors import UserError


class Caller(NamedTuple):
    """The user who called sudo."""

    user: int
    group: int
    places: tuple[Path, ...]
    """Where files of root are returned to the user."""


def caller(environment: Mapping[str, str] = os.environ) -> Caller | None:
    """None without sudo, and in a checkout that belongs to root."""
    user, group = (environment.get(name, "") for name in ("SUDO_UID", "SUDO_GID"))
    through = os.geteuid() == 0 and user.isdecimal() and group.isdecimal() and int(user) != 0
    if not through or paths.WORKPLACE.stat().st_uid == 0:
        return None
    # Keys elsewhere may belong to root on purpose.
    keys = () if paths.KEYS.exists() and paths.KEYS.stat().st_uid == 0 else (paths.KEYS,)
    return Caller(int(user), int(group), (paths.WORKPLACE, paths.BUILD, *keys))


def refusal(command: str) -> UserError:
    """The Makefile has the same message, before it makes anything."""
    return UserError(f"{command} needs no root: run it without sudo")


def hand_back(to: Caller) -> None:
    """Give files of root to the user who called sudo; no link is followed, no other file system entered."""
    for place in filter(Path.exists, to.places):
        chown = ("chown", "--no-dereference", f"{to.user}:{to.group}", "{}", "+")
        subprocess.run(["find", place, "-xdev", "-uid", "0", "-exec", *chown], check=False)


def left_by_root(error: PermissionError) -> UserError | None:
    """The remedy where root owns the file, or the directory that it is in; None where something else forbids it."""
    file = Path(os.fsdecode(error.filename or "/")).absolute()
    place = next((each for each in (paths.BUILD, paths.KEYS, paths.WORKPLACE) if file.is_relative_to(each)), None)
    if os.geteuid() == 0 or not place:
        return None
    for each in (file, *file.parents):
        if each == paths.WORKPLACE:
            break
        with suppress(OSError):
            if each.lstat().st_uid == 0:
                return UserError(
                    f"{paths.shown(file)}: {error.strerror}: {paths.shown(each)} belongs to root, as after a run with "
                    f"sudo; `sudo chown -R $USER {place}` gives it back"
                )
    return None
