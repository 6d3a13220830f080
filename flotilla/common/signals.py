"""Types of signals, by the names that blocks have for them (runtime/include/flotilla/block.h)."""

from __future__ import annotations

import struct

CODES = {
    "boolean": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "single": "f",
    "double": "d",
}
"""Of struct(3)."""


def size(kind: str, width: int = 1) -> int:
    """Bytes of a signal with `width` elements, which lie without gaps."""
    return struct.calcsize(f"<{width}{CODES[kind]}")
