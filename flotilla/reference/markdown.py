"""Markdown that the pages consist of."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

MADE = "<!-- Made from the sources by `make reference`: edit those. -->"
"""First line of each page."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table whose cells are Markdown, without the columns that are empty throughout."""
    cells = [[" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in rows]
    used = [column for column in range(len(head)) if any(row[column] for row in cells)]
    lines = [[head[column] for column in used], ["---"] * len(used), *([row[n] for n in used] for row in cells)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def code(text: str) -> str:
    return f"`{text}`" if text else ""


def literal(text: str) -> str:
    """Text that is no Markdown but for `code`: its signs stand for themselves."""
    pieces = re.split(r"(`[^`]*`)", text)
    return "".join(piece if piece.startswith("`") else re.sub(r"([\\*_<\[\]])", r"\\\1", piece) for piece in pieces)
