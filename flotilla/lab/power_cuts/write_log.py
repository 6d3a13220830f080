"""Logs of all writes and flushes of a disk, in the order in which they were completed.

The format is that of Linux's dm-log-writes (Documentation/admin-guide/device-mapper/log-writes.rst and
drivers/md/dm-log-writes.c), which QEMU's block driver `blklogwrites` writes too: a super block, then for each entry a
sector that describes it and the sectors written. All numbers are little-endian.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from flotilla.lab.qemu.timing import LabError

SECTOR = 512
"""Bytes of a sector of the disk and of the log: QEMU is told so, see `qemu.Options.log_writes`."""
_MAGIC = 0x6A736677736872
_VERSION = 1
_SUPER = struct.Struct("<QQQI")  # magic, version, number of entries, bytes of a sector
_ENTRY = struct.Struct("<QQQQ")  # sector, number of sectors, flags, bytes of data that are the log's own
_FLUSH, _FUA, _DISCARD, _MARK = 1, 2, 4, 8


@dataclass(frozen=True, slots=True)
class Entry:
    """What was done to the disk at one moment."""

    sector: int
    """The first that was written or discarded."""
    count: int
    """Sectors written or discarded; 0: a flush or a mark alone."""
    flush: bool
    """All that was complete before is on the medium."""
    fua: bool
    """This write is on the medium, whatever becomes of those before."""
    discard: bool
    mark: str | None
    """A name for this moment."""
    place: int
    """Offset of the written bytes in the log."""

    @property
    def writes(self) -> bool:
        return self.count > 0 and not self.discard


def count_entries(path: Path) -> int:
    """How many entries a log has that is being written; 0 if nothing was yet."""
    with path.open("rb") as file:
        found = file.read(_SUPER.size)
    return int(_SUPER.unpack(found)[2]) if len(found) == _SUPER.size else 0


class WriteLog:
    """A log that is complete. Use it as a context manager."""

    def __init__(self, path: Path) -> None:
        """Read the log. Anything but a log raises `LabError`."""
        self._path = path
        with path.open("rb") as file:
            if not path.stat().st_size:
                raise LabError(f"{path}: empty, not a log of writes")
            self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.entries: Sequence[Entry] = list(self._read())

    def __enter__(self) -> WriteLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bytes.close()

    def content(self, entry: Entry, number: int) -> bytes:
        """The bytes of one of the sectors that an entry wrote; `number` counts from its first."""
        start = entry.place + number * SECTOR
        return self._bytes[start : start + SECTOR]

    def _read(self) -> Iterator[Entry]:
        if len(self._bytes) < _SUPER.size:
            raise LabError(f"{self._path}: {len(self._bytes)} bytes, not a log of writes")
        magic, version, number, size = _SUPER.unpack_from(self._bytes)
        if (magic, version, size) != (_MAGIC, _VERSION, SECTOR):
            raise LabError(
                f"{self._path}: magic {magic:#x}, version {version}, sectors of {size} bytes: not such a log"
            )
        place = SECTOR
        for index in range(number):
            if place + SECTOR > len(self._bytes):
                raise LabError(f"{self._path}: ends before entry {index} of {number}")
            sector, count, flags, own = _ENTRY.unpack_from(self._bytes, place)
            text = self._bytes[place + _ENTRY.size : place + _ENTRY.size + own]
            place += SECTOR
            yield Entry(
                sector=sector,
                count=count,
                flush=bool(flags & _FLUSH),
                fua=bool(flags & _FUA),
                discard=bool(flags & _DISCARD),
                mark=text.decode() if flags & _MARK else None,
                place=place,
            )
            if not flags & _DISCARD:
                place += count * SECTOR
            if place > len(self._bytes):
                raise LabError(f"{self._path}: ends within entry {index} of {number}")


class LogWriter:
    """Writes a log: for programs that stand in for a robot's, and for changed copies of recorded logs."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._file.write(bytes(SECTOR))
        self.number = 0
        """Entries so far."""

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.seek(0)
        self._file.write(_SUPER.pack(_MAGIC, _VERSION, self.number, SECTOR))
        self._file.close()

    def write(self, sector: int, content: bytes, *, fua: bool = False) -> None:
        """A write of whole sectors."""
        if len(content) % SECTOR:
            raise ValueError(f"{len(content)} bytes are no whole sectors")
        self._entry(sector, len(content) // SECTOR, _FUA * fua)
        self._file.write(content)

    def flush(self) -> None:
        self._entry(0, 0, _FLUSH)

    def discard(self, sector: int, count: int) -> None:
        self._entry(sector, count, _DISCARD)

    def mark(self, name: str) -> None:
        """A name for this moment."""
        self._entry(0, 0, _MARK, name.encode())

    def copy(self, log: WriteLog, entry: Entry, *, sector: int | None = None) -> None:
        """An entry of another log, elsewhere on the disk if asked for."""
        flags = _FLUSH * entry.flush | _FUA * entry.fua | _DISCARD * entry.discard | _MARK * (entry.mark is not None)
        own = (entry.mark or "").encode()
        self._entry(entry.sector if sector is None else sector, entry.count, flags, own)
        if not entry.discard:
            for number in range(entry.count):
                self._file.write(log.content(entry, number))

    def _entry(self, sector: int, count: int, flags: int, own: bytes = b"") -> None:
        self._file.write((_ENTRY.pack(sector, count, flags, len(own)) + own).ljust(SECTOR, b"\0"))
        self.number += 1
