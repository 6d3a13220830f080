"""Read what the block `recorder` wrote, a file at a time; its C file tells the format. `segments.py` joins files."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from flotilla.common import paths
from flotilla.common.signals import CODES, size

MAGIC = b"FLOTREC1"
PREFIX = struct.Struct("<8sII")
CHECK = struct.Struct("<I")
MOST_HEADER_BYTES = 1 << 24
_MOST_RECORD_BYTES = 1 << 24
_MOST_NS = 1 << 62
CHUNK_BYTES = 1 << 20
"""Of a file in memory at once, about."""
_OUTERMOST = 1000
"""Records of which one has to be good, for a file not to be wholly damaged."""
Array = np.ndarray[Any, np.dtype[Any]]
Element = bool | int | float
Value = Element | tuple[Element, ...]


class RecordingError(Exception):
    """The file is no recording."""


@dataclass(frozen=True)
class Field:
    name: str
    type: str
    width: int
    offset: int
    """Bytes from the record's beginning."""

    @property
    def end(self) -> int:
        """Where the next one may begin."""
        return self.offset + size(self.type, self.width)

    def of(self, record: bytes) -> Value:
        """Its value in a record, which is little-endian: a tuple where there are several elements."""
        elements = struct.unpack_from(f"<{self.width}{CODES[self.type]}", record, self.offset)
        return elements if self.width > 1 else elements[0]

    @property
    def titles(self) -> list[str]:
        return [self.name] if self.width == 1 else [f"{self.name}[{i}]" for i in range(self.width)]


@dataclass(frozen=True)
class Header:
    """What a file says of itself before its records."""

    name: str
    period_ns: int
    wall_less_monotonic_ns: int
    """Add it to `time_ns` for nanoseconds since 1970-01-01 UTC."""
    fields: tuple[Field, ...]
    bytes_of_header: int
    bytes_of_record: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of a record: a field of several elements is an array."""
        kinds = [dtype(field.type) for field in self.fields]
        return np.dtype(
            {
                "names": [field.name for field in self.fields],
                "formats": [
                    (kind, (field.width,)) if field.width > 1 else kind
                    for kind, field in zip(kinds, self.fields, strict=True)
                ],
                "offsets": [field.offset for field in self.fields],
                "itemsize": self.bytes_of_record,
            }
        )


@dataclass
class Found:
    """What was in a file besides good records; it grows while records are read."""

    records: int = 0
    """Those whose check is good."""
    damaged: int = 0
    """Whole records whose check is wrong."""
    first_damaged: int | None = None
    """Where in the file the first of these is, in bytes."""
    rest: int = 0
    """Bytes of half a record at the end: power went, or it is being written now."""


@dataclass(frozen=True)
class Recording:
    """A whole file in memory."""

    name: str
    period_ns: int
    wall_less_monotonic_ns: int
    """Add it to `time_ns` for nanoseconds since 1970-01-01 UTC."""
    fields: list[Field]
    records: list[dict[str, Value]]
    """Those whose check is good, in the order in which they were written."""
    damaged: int
    rest: int
    """This and `damaged`: as `Found` has them."""


_NUMBERED = {("time_ns", "int64", 1), ("step", "uint64", 1)}
"""Fields of every recording: name, type and width."""


def dtype(kind: str) -> np.dtype[Any]:
    """Of an element of a signal, little-endian."""
    return np.dtype(CODES[kind]).newbyteorder("<")


def _check_field(field: Field, bytes_of_record: int) -> None:
    if not isinstance(field.name, str) or {type(field.width), type(field.offset)} != {int}:
        raise ValueError("a field has no name, width or offset")
    if field.type not in CODES or field.width < 1 or field.offset < 0:
        raise ValueError(f"field {field.name} is of no known kind")
    if field.end > bytes_of_record - CHECK.size:
        raise ValueError(f"field {field.name} reaches beyond its record")


def parse_header(data: bytes) -> Header:
    """Of a file that begins so. RecordingError where it is no recording, or ends within its header."""
    try:
        magic, bytes_of_header, bytes_of_record = PREFIX.unpack_from(data)
        if magic != MAGIC or bytes_of_header < PREFIX.size or bytes_of_record <= CHECK.size:
            raise ValueError("it does not begin as one")
        if bytes_of_record > _MOST_RECORD_BYTES:
            raise ValueError(f"its records have {bytes_of_record} bytes each, {_MOST_RECORD_BYTES} at most are read")
        if bytes_of_header > min(len(data), MOST_HEADER_BYTES):
            raise ValueError("it ends within its header")
        schema = json.loads(data[PREFIX.size : bytes_of_header])
        fields = tuple(Field(**field) for field in schema["fields"])
        for field in fields:
            _check_field(field, bytes_of_record)
        if _NUMBERED - {(field.name, field.type, field.width) for field in fields}:
            raise ValueError("it has no time_ns or step, or these are no whole numbers")
        if len({field.name for field in fields}) < len(fields):
            raise ValueError("it has a field twice")
        name, period_ns, wall_ns = str(schema["name"]), int(schema["period_ns"]), int(schema["wall_less_monotonic_ns"])
        if not 0 < period_ns < _MOST_NS or abs(wall_ns) >= _MOST_NS:
            raise ValueError("its times are none")
    except (struct.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordingError(f"no recording: {error}") from error
    return Header(name, period_ns, wall_ns, fields, bytes_of_header, bytes_of_record)


def read_header(file: Path) -> Header:
    """RecordingError as above."""
    with file.open("rb") as opened:
        return _header(opened)


def _header(opened: IO[bytes]) -> Header:
    begin = opened.read(PREFIX.size)
    length = PREFIX.unpack(begin)[1] if len(begin) == PREFIX.size else 0
    return parse_header(begin + opened.read(min(max(length - len(begin), 0), MOST_HEADER_BYTES)))


def chunks(file: Path, found: Found) -> Iterator[Array]:
    """Its good records, in order, some at a time; `found` counts them, and what is left out."""
    with file.open("rb") as opened:
        header = _header(opened)
        length, kind = header.bytes_of_record, header.dtype
        while data := opened.read(max(CHUNK_BYTES // length, 1) * length):
            whole, found.rest = divmod(len(data), length)
            good = [_is_good(data[at * length : (at + 1) * length]) for at in range(whole)]
            if found.first_damaged is None and not all(good):
                found.first_damaged = header.bytes_of_header + (found.records + good.index(False)) * length
            found.records += sum(good)
            found.damaged += whole - sum(good)
            records = np.frombuffer(data, kind, whole)
            yield records if all(good) else records[np.array(good, bool)]


def ends(file: Path) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """`time_ns` and `step` of the first and of the last good record; None where none of the outermost ones is good."""
    with file.open("rb") as opened:
        header = _header(opened)
        length = header.bytes_of_record
        whole = (file.stat().st_size - header.bytes_of_header) // length
        near = range(min(whole, _OUTERMOST))

        def first_of(numbers: Iterable[int]) -> tuple[int, int] | None:
            for number in numbers:
                opened.seek(header.bytes_of_header + number * length)
                record = opened.read(length)
                if _is_good(record):
                    values = np.frombuffer(record, header.dtype)[0]
                    return int(values["time_ns"]), int(values["step"])
            return None

        return first_of(near), first_of(whole - 1 - number for number in near)


def _is_good(record: bytes) -> bool:
    return CHECK.unpack(record[-CHECK.size :]) == (zlib.crc32(record[: -CHECK.size]),)


def parse(data: bytes) -> Recording:
    """A whole file's content. RecordingError as above."""
    header = parse_header(data)
    length = header.bytes_of_record
    whole, rest = divmod(len(data) - header.bytes_of_header, length)
    records = []
    for begin in range(header.bytes_of_header, header.bytes_of_header + whole * length, length):
        record = data[begin : begin + length]
        if _is_good(record):
            records.append({field.name: field.of(record) for field in header.fields})
    return Recording(
        header.name, header.period_ns, header.wall_less_monotonic_ns, list(header.fields), records,
        whole - len(records), rest,
    )  # fmt: skip


def read(path: Path) -> Recording:
    """A whole file. RecordingError that names it."""
    try:
        return parse(path.read_bytes())
    except RecordingError as error:
        raise RecordingError(f"{paths.shown(path)}: {error}") from error
