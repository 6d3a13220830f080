"""All pages that are made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flotilla.common import paths
from flotilla.reference import blocks, commands, keys, task_file

FOLDER: Path = paths.PROJECT / "docs" / "reference"
PAGES: dict[str, Callable[[], str]] = {"commands.md": commands.page, "keys.md": keys.page}
"""By file: what makes it."""
RUNTIME_PAGES: dict[str, Callable[[Path], str]] = {"blocks.md": blocks.page, "task-file.md": task_file.page}
"""By file: what makes it from the directory of the built runtime."""
