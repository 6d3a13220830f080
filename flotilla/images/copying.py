"""Parts of one file into another, without their passing through this program.

A file system that shares blocks between files (btrfs, XFS) shares them, and writes nothing. Any other copies, and what
that takes of a processor is the page cache's doing for the most part. Files that are many, and that nobody reads soon,
go past it by direct input and output (open(2), O_DIRECT).
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from flotilla.common.errors import UserError

_FICLONERANGE = 0x4020940D
"""ioctl_ficlonerange(2)."""
_REFUSALS = {errno.EOPNOTSUPP, errno.ENOTTY, errno.EXDEV, errno.EINVAL}
"""What a file system says that does not share blocks, or takes no direct input and output."""
_PAGE = 4096
_AT_ONCE = 8 << 20

Extents = Sequence[tuple[int, int]]
"""Offset and length in bytes."""


def copy(source: Path, extents: Extents, target: Path, start: int = 0, *, past_page_cache: bool = False) -> None:
    """Copy the extents of `source` into the file `target`, which exists, so many bytes further from its beginning.

    `past_page_cache` may copy whole pages, and so what lies around an extent in `source`, too. UserError where `source`
    ends before an extent does.
    """
    size = source.stat().st_size
    if any(offset + length > size for offset, length in extents):
        raise UserError(f"{source} is shorter than its extents")
    with source.open("rb") as file, target.open("r+b") as out:
        if past_page_cache:
            pages = whole_pages(extents)
            if _share(file.fileno(), pages, out.fileno(), start) or _write_direct(file.fileno(), pages, target, start):
                return
        for offset, length in extents:
            at, end = offset, offset + length
            while at < end:
                copied = _copy_some(file.fileno(), at, end - at, out.fileno(), start + at)
                if not copied:
                    raise UserError(f"{source} became shorter while it was copied")
                at += copied


def _copy_some(source: int, at: int, length: int, target: int, start: int) -> int:
    """How many bytes were copied; by the kernel, if it does so from this file system to that one."""
    try:
        return os.copy_file_range(source, target, length, at, start)
    except OSError as error:
        if error.errno not in _REFUSALS:
            raise
    return os.pwrite(target, os.pread(source, min(length, _AT_ONCE), at), start)


def whole_pages(extents: Extents) -> list[tuple[int, int]]:
    """The pages that extents touch, each once, in order."""
    ranges: list[tuple[int, int]] = []
    for offset, length in sorted(extents):
        begin, end = offset // _PAGE * _PAGE, -(-(offset + length) // _PAGE) * _PAGE
        if ranges and begin <= ranges[-1][1]:
            begin, last = ranges.pop()
            end = max(end, last)
        ranges.append((begin, end))
    return [(begin, end - begin) for begin, end in ranges]


def _share(source: int, pages: Extents, target: int, start: int) -> bool:
    """Whether the file system shares blocks between the two."""
    with _refused() as refused:
        for offset, length in pages:
            fcntl.ioctl(target, _FICLONERANGE, struct.pack("=qQQQ", source, offset, length, start + offset))
    return not refused


def _write_direct(source: int, pages: Extents, target: Path, start: int) -> bool:
    """Whether the file system writes what lies in memory, here the pages of `source`, without a copy of its own."""
    with _refused() as refused, mmap.mmap(source, 0, access=mmap.ACCESS_READ) as mapped, memoryview(mapped) as content:
        out = os.open(target, os.O_WRONLY | os.O_DIRECT)
        try:
            for offset, length in pages:
                at, end = offset, min(offset + length, len(content))
                while at < end:
                    at += os.pwrite(out, content[at : min(end, at + _AT_ONCE)], start + at)
        finally:
            os.close(out)
    return not refused


@contextmanager
def _refused() -> Iterator[list[OSError]]:
    """What a file system refuses lands in the list."""
    refused: list[OSError] = []
    try:
        yield refused
    except OSError as error:
        if error.errno not in _REFUSALS:
            raise
        refused.append(error)
