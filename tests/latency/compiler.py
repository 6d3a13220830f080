"""The measurement's own program, as one static file."""

from __future__ import annotations

from pathlib import Path

from images.builder import toolchain
from images.builder.fleet import Board


def compile_static(source: Path, board: Board) -> bytes:
    """Compile a C program for a board by the locked compiler, so that every development computer measures the same."""
    return toolchain.compile_static(
        source, board.architecture, ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-pthread"]
    )
