"""The measurement's own programs, each as one static file."""

from __future__ import annotations

from pathlib import Path

from flotilla.debian import toolchain
from flotilla.fleet.model import Board

SOURCES = ("serial_latency.c", "first_step.c")


def programs(board: Board) -> dict[str, bytes]:
    """All of them by name, by the locked compiler, so that every development computer measures the same."""
    here = Path(__file__).parent
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-pthread"]
    return {Path(name).stem: toolchain.compile_static(here / name, board, options) for name in SOURCES}
