"""All pages that are made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flotilla.common import paths
from flotilla.fleet import privileges
from flotilla.reference import blocks, commands, keys, task_file

FOLDER: Path = paths.PROJECT / "docs" / "reference"
PAGES: dict[str, Callable[[], str]] = {
    "commands.md": commands.page,
    "targets.txt": commands.targets,
    "keys.md": keys.page,
}
"""By file: what makes it."""
RUNTIME_PAGES: dict[Path, Callable[[Path], str]] = {
    FOLDER / "blocks.md": blocks.page,
    FOLDER / "task-file.md": task_file.page,
    privileges.RUNTIME_NEEDS: blocks.needs,
}
"""By file: what makes it from the directory of the built runtime. The last is a table for the station, and no page."""
