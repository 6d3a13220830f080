"""Which files of the project enter images: the one rule for what is copied, for the keys of the cache and manifests.

Files that git does not know enter, and are counted: a build does not depend on git. What programs leave behind beside
the files of their users enters nowhere, and an empty directory neither: git keeps none.
"""

from __future__ import annotations

import fnmatch
import os
import stat
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from flotilla.common import paths
from flotilla.common.errors import UserError

LEFT_BEHIND = (
    "__pycache__", "*.py[co]",  # Python: they name the directory that they were compiled in
    ".pytest_cache", ".mypy_cache", ".ruff_cache",  # tests and checks of Python beside an app
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


_IN_HOME = {"rootfs_overlay": "overlay"}
"""Names of the tool's folders that have another name in a fleet's home."""


def layers(directory: Path) -> list[Path]:
    """The folders whose files count: the fleet's own, where it has a home with such a folder, and one of the tool's."""
    return [each for each in dict.fromkeys((own(directory), directory)) if each.is_dir()]


def own(directory: Path) -> Path:
    """The fleet's own folder in place of one of the tool's; it need not exist. Without a home it is the tool's."""
    return paths.HOME / _IN_HOME.get(directory.name, directory.name) if paths.OWN_HOME else directory


def find(directory: Path, name: str | PurePosixPath) -> Path:
    """A file of a folder of the tool's, or the fleet's own in its place; where neither exists, the fleet's own."""
    found = [layer / name for layer in layers(directory)]
    return next((path for path in found if path.is_file() or path.is_symlink()), own(directory) / name)


def layered(directory: Path) -> dict[PurePosixPath, Path]:
    """The files of a folder of the tool's by their path in it, in order, with the fleet's own in their place."""
    found = {
        PurePosixPath(path.relative_to(layer)): path
        for layer in reversed(layers(directory))
        for path in files(layer)
    }  # fmt: skip
    return dict(sorted(found.items(), key=lambda item: item[0].parts))


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
