"""Which files of the project enter images: the one rule for what is copied, for the keys of the cache and manifests.

Files that git does not know enter, and are counted: a build does not depend on git. What programs leave behind beside
the files of their users enters nowhere, and an empty directory neither: git keeps none.
"""

from __future__ import annotations

import fnmatch
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from flotilla.common import paths
from flotilla.common.errors import UserError

LEFT_BEHIND = (
    "__pycache__", "*.py[co]",  # Python: they name the directory that they were compiled in
    "*~", ".#*", "#*#", ".*.sw[a-p]", ".*.kate-swp",  # editors
    "*.orig", "*.rej",  # patch and git
    ".git", ".DS_Store", "Thumbs.db",
)  # fmt: skip
"""Names of files and directories, as shell patterns."""


def left_behind(name: str) -> bool:
    """Whether no image gets what has this name."""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in LEFT_BEHIND)


def ignored(_: object, names: Iterable[str]) -> set[str]:
    """Those of `names` that no image gets: for `ignore` of shutil.copytree."""
    return {name for name in names if left_behind(name)}


def files(directory: Path) -> list[Path]:
    """The files and links below a directory, in order. UserError with what is neither."""
    found = []
    for path in sorted(directory.iterdir()):
        if left_behind(path.name):
            continue
        mode = path.lstat().st_mode
        if stat.S_ISDIR(mode):
            found += files(path)
        elif stat.S_ISREG(mode) or stat.S_ISLNK(mode):
            found.append(path)
        else:
            raise UserError(f"{paths.shown(path)}: is neither a file nor a link nor a directory; remove it")
    return found


def strays(directory: Path) -> dict[Path, str]:
    """What nobody may read who wants the files of a directory: links that lead out of it, with where they lead, and
    what is neither a file nor a link nor a directory."""
    root, found = os.path.realpath(directory), {}
    for path in directory.rglob("*"):
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode) and Path(root) not in [where := Path(os.path.realpath(path)), *where.parents]:
            found[path] = f"leads out of {paths.shown(directory)}"
        elif not (stat.S_ISLNK(mode) or stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            found[path] = "is neither a file nor a link nor a directory"
    return found


def inside(directory: Path, path: Path) -> bool:
    """Whether a path, after all links on its way, is in the directory."""
    return path.resolve().is_relative_to(directory.resolve())


def executable(path: Path) -> bool:
    """Whether the file is a program, wherever it is an image's: by its mode alone, as git has it.

    What access(2) answers depends on the user and on how the file system is mounted.
    """
    return bool(path.stat().st_mode & stat.S_IXUSR)
