"""Files as the block `recorder` writes them, by its description in recorder.c and not by what reads them."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SIGNALS = {"position": ("double", 2), "good": ("boolean", 1), "count": ("int32", 1)}
CODES = {"double": "d", "single": "f", "boolean": "?", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
MS_NS = 1_000_000


def content(
    rows: Sequence[Sequence[Any]], signals: Mapping[str, tuple[str, int]] = SIGNALS, *, name: str = "log",
    first: int = 0, begin_ns: int = 5_000_000_000, wall_ns: int = 1_767_225_600_000_000_000,
) -> bytes:  # fmt: skip
    """Records of 10 ms each; a row has its elements in order. `first` is the number of its first step, `begin_ns` when
    step 0 was due."""
    fields, codes, at = [], "", 0
    own = {"time_ns": ("int64", 1), "step": ("uint64", 1), "lost": ("uint32", 1)}
    for each, (kind, width) in (own | dict(signals)).items():
        fields.append({"name": each, "type": kind, "width": width, "offset": at})
        codes += f"{width}{CODES[kind]}"
        at = struct.calcsize(f"<{codes}")
    schema = {"name": name, "period_ns": 10 * MS_NS, "wall_less_monotonic_ns": wall_ns, "fields": fields}
    said = json.dumps(schema).encode() + b"\n"
    said += b" " * (-(len(said) + 16) % 64)
    written = b"FLOTREC1" + struct.pack("<II", 16 + len(said), at + 4) + said
    for step, row in enumerate(rows, first):
        record = struct.pack(f"<{codes}", begin_ns + step * 10 * MS_NS, step, 0, *row)
        written += record + struct.pack("<I", zlib.crc32(record))
    return written


def ring(directory: Path, *, count: int = 300, files: int = 3, name: str = "log", **more: Any) -> list[Path]:
    """`count` steps in `files` files, the oldest first: position (step, -step), good in even steps, count 1000 less."""
    directory.mkdir(parents=True, exist_ok=True)
    each, made = count // files, []
    for number in range(files):
        rows = [(step, -step, step % 2 == 0, step - 1000) for step in range(number * each, (number + 1) * each)]
        file = directory / f"{name}-{number + 1:06}.rec"
        file.write_bytes(content(rows, name=name, first=number * each, **more))
        made.append(file)
    return made
