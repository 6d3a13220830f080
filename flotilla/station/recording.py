"""Read what the block `recorder` wrote; its C file tells the format. As a program, print it as CSV:

python3 -m flotilla.station.recording log-000001.rec log-000002.rec >log.csv
"""

from __future__ import annotations

import csv
import json
import struct
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flotilla.common.signals import CODES, size

MAGIC = b"FLOTREC1"
PREFIX = struct.Struct("<8sII")
CHECK = struct.Struct("<I")
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
class Recording:
    name: str
    period_ns: int
    wall_less_monotonic_ns: int
    """Add it to `time_ns` for nanoseconds since 1970-01-01 UTC."""
    fields: list[Field]
    records: list[dict[str, Value]]
    """Those whose check is good, in the order in which they were written."""
    damaged: int
    """Whole records whose check is wrong."""
    rest: int
    """Bytes of half a record at the end: power went, or it is being written now."""


def _check_field(field: Field, bytes_of_record: int) -> None:
    if field.type not in CODES or field.width < 1 or field.offset < 0:
        raise ValueError(f"field {field.name} is of no known kind")
    if field.end > bytes_of_record - CHECK.size:
        raise ValueError(f"field {field.name} reaches beyond its record")


def parse(data: bytes) -> Recording:
    try:
        magic, bytes_of_header, bytes_of_record = PREFIX.unpack_from(data)
        if magic != MAGIC or bytes_of_header < PREFIX.size or bytes_of_record <= CHECK.size:
            raise ValueError("it does not begin as one")
        schema = json.loads(data[PREFIX.size : bytes_of_header])
        fields = [Field(**field) for field in schema["fields"]]
        for field in fields:
            _check_field(field, bytes_of_record)
        name, period, wall = schema["name"], schema["period_ns"], schema["wall_less_monotonic_ns"]
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"no recording: {error}") from error
    whole, rest = divmod(len(data) - bytes_of_header, bytes_of_record)
    records = []
    for begin in range(bytes_of_header, bytes_of_header + whole * bytes_of_record, bytes_of_record):
        record = data[begin : begin + bytes_of_record]
        if CHECK.unpack(record[-CHECK.size :]) == (zlib.crc32(record[: -CHECK.size]),):
            records.append({field.name: field.of(record) for field in fields})
    return Recording(name, period, wall, fields, records, whole - len(records), rest)


def read(path: Path) -> Recording:
    try:
        return parse(path.read_bytes())
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error


def _rows(recording: Recording) -> Iterator[list[Element]]:
    for record in recording.records:
        row: list[Element] = []
        for value in record.values():
            row.extend(value if isinstance(value, tuple) else (value,))
        yield row


def main(paths: list[str]) -> int:
    writer = csv.writer(sys.stdout)
    titles: list[str] | None = None
    for path in paths:
        try:
            recording = read(Path(path))
        except (OSError, RecordingError) as error:
            print(error, file=sys.stderr)
            return 1
        columns = [title for field in recording.fields for title in field.titles]
        if titles is None:
            writer.writerow(columns)
        elif columns != titles:
            print(f"{path}: other signals than in {paths[0]}", file=sys.stderr)
            return 1
        titles = columns
        writer.writerows(_rows(recording))
        if recording.damaged:
            print(f"{path}: {recording.damaged} damaged records left out", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
