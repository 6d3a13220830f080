"""Homes of fleets, for tests that build cards in them."""

from __future__ import annotations

from pathlib import Path

from flotilla.common import paths

KEPT = ("cache", "pool")
"""Of the outputs those that are named by their content."""


def share_outputs(home: Path) -> None:
    """Give a new home the outputs of this checkout that are named by their content."""
    (home / "build").mkdir()
    for name in KEPT:
        (home / "build" / name).symlink_to(paths.BUILD / name)
