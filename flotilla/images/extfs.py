"""A reader of ext2 and ext4 file systems, which shares no code with the program that writes ours.

Layout: https://docs.kernel.org/filesystems/ext4/. It reads what filesystem.py makes, which has no data in inodes and no
encryption. The file system's own structure is e2fsck's to check.
"""

from __future__ import annotations

import os
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

_MAGIC = 0xEF53
_KNOWN = 0x2 | 0x40 | 0x80 | 0x200
"""Incompatible features that a reader has to know: file types in directories, extents, 64 bits, flexible groups."""
_64BIT = 0x80
_WITH_EXTENTS = 0x80000
"""Flag of an inode whose blocks are named by extents, and not one by one."""
_UNWRITTEN = 1 << 15
"""Lengths of extents above this: blocks that are reserved and read as zeros."""
_ROOT = 2
_IN_INODE = 60
"""Bytes of an inode that name its blocks, or are a short link's target."""


class Unreadable(Exception):
    """Why this is no file system that can be read here."""


@dataclass(frozen=True)
class Found:
    """What an inode holds."""

    mode: int
    """With the type."""
    uid: int
    gid: int
    times: list[int]
    """Of access, change, modification and creation: nanoseconds since 1970."""
    content: bytes
    """Of a file; of a symbolic link, its target."""


class Reader:
    """The file system that lies `start` bytes behind the beginning of `image`."""

    def __init__(self, image: IO[bytes], start: int = 0) -> None:
        self._image = image
        self._start = start
        block = self._at(1024, 1024)
        if struct.unpack_from("<H", block, 56)[0] != _MAGIC:
            raise Unreadable("it has no superblock")
        inodes, _, _, self.free_blocks, self.free_inodes, first, size = struct.unpack_from("<7I", block)
        incompatible, self._inodes_of_group = *struct.unpack_from("<I", block, 96), *struct.unpack_from("<I", block, 40)
        if unknown := incompatible & ~_KNOWN:
            raise Unreadable(f"it has unknown features {unknown:#x}")
        self._block = 1024 << size
        self._inode_size = struct.unpack_from("<H", block, 88)[0]
        wide = struct.unpack_from("<H", block, 254)[0] if incompatible & _64BIT else 32
        groups = -(-inodes // self._inodes_of_group)
        table = self._at((first + 1) * self._block, groups * wide)
        self._tables = [
            struct.unpack_from("<I", table, group * wide + 8)[0]
            + (struct.unpack_from("<I", table, group * wide + 40)[0] << 32 if wide > 32 else 0)
            for group in range(groups)
        ]

    def walk(self) -> Iterator[tuple[bytes, Found]]:
        """Every path below the root, parents first, with what it leads to."""
        waiting, seen = [(b"", _ROOT)], {_ROOT}
        while waiting:
            place, number = waiting.pop()
            for name, inode in self._names(self._content(self._inode(number))):
                path, found = place + b"/" + name, self._found(self._inode(inode))
                yield path, found
                if stat.S_ISDIR(found.mode):
                    if inode in seen:
                        raise Unreadable("it has a directory in two places")
                    seen.add(inode)
                    waiting.append((path, inode))

    def _at(self, offset: int, length: int) -> bytes:
        # Read, not mapped: a page of a hole that is mapped takes memory of a tmpfs, and there may be none left.
        found = os.pread(self._image.fileno(), length, self._start + offset)
        if len(found) != length:
            raise Unreadable(f"it ends before byte {offset + length}")
        return found

    def _inode(self, number: int) -> bytes:
        group, index = divmod(number - 1, self._inodes_of_group)
        if not 0 <= group < len(self._tables):
            raise Unreadable(f"it has no inode {number}")
        return self._at(self._tables[group] * self._block + index * self._inode_size, self._inode_size)

    def _found(self, raw: bytes) -> Found:
        mode, low_uid, _, atime, ctime, mtime, _, low_gid = struct.unpack_from("<HHIIIIIH", raw)
        high_uid, high_gid = struct.unpack_from("<HH", raw, 120)
        ctime_extra, mtime_extra, atime_extra, crtime, crtime_extra = struct.unpack_from("<5I", raw, 132)
        pairs = (atime, atime_extra), (ctime, ctime_extra), (mtime, mtime_extra), (crtime, crtime_extra)
        return Found(
            mode,
            low_uid | high_uid << 16,
            low_gid | high_gid << 16,
            [(time + ((extra & 3) << 32)) * 10**9 + (extra >> 2) for time, extra in pairs],
            b"" if stat.S_ISDIR(mode) else self._content(raw),
        )

    def _content(self, raw: bytes) -> bytes:
        mode, size = struct.unpack_from("<H", raw)[0], struct.unpack_from("<I", raw, 4)[0]
        if stat.S_ISLNK(mode) and size < _IN_INODE:
            return raw[40 : 40 + size]
        size += struct.unpack_from("<I", raw, 108)[0] << 32 if stat.S_ISREG(mode) else 0
        named = raw[40 : 40 + _IN_INODE]
        has_extents = struct.unpack_from("<I", raw, 32)[0] & _WITH_EXTENTS
        content = bytearray(size)
        needed = -(-size // self._block)
        for position, block, count in self._extents(named) if has_extents else self._blocks(named, needed):
            begin = position * self._block
            if (length := min(count * self._block, size - begin)) > 0:
                content[begin : begin + length] = self._at(block * self._block, length)
        return bytes(content)

    def _extents(self, node: bytes) -> Iterator[tuple[int, int, int]]:
        """Block of the file, block of the file system, and how many, of all that hold something."""
        magic, entries, _, depth = struct.unpack_from("<4H", node)
        if magic != 0xF30A:
            raise Unreadable("it has an inode without extents")
        for at in range(12, 12 + 12 * entries, 12):
            if depth:
                _, low, high = struct.unpack_from("<IIH", node, at)
                yield from self._extents(self._at((low | high << 32) * self._block, self._block))
            else:
                position, length, high, low = struct.unpack_from("<IHHI", node, at)
                if length <= _UNWRITTEN:
                    yield position, low | high << 32, length

    def _blocks(self, named: bytes, needed: int) -> Iterator[tuple[int, int, int]]:
        """The same of ext2: twelve blocks, then one that names others, one that names such, and one more."""
        numbers = struct.unpack("<15I", named)
        position = 0
        for depth, number in [*((0, number) for number in numbers[:12]), *zip((1, 2, 3), numbers[12:], strict=True)]:
            for block in self._named(number, depth, needed - position):
                if block:
                    yield position, block, 1
                position += 1

    def _named(self, number: int, depth: int, most: int) -> Iterator[int]:
        """Up to so many of the blocks that a block names; 0 is a hole."""
        below = (self._block // 4) ** depth
        if not depth or not number:
            yield from [number] * min(below, most)
            return
        for at, each in enumerate(struct.unpack(f"<{self._block // 4}I", self._at(number * self._block, self._block))):
            yield from self._named(each, depth - 1, most - at * below // (self._block // 4))

    def _names(self, directory: bytes) -> Iterator[tuple[bytes, int]]:
        at = 0
        while at < len(directory):
            inode, length, size = struct.unpack_from("<IHB", directory, at)
            if length < 8:
                raise Unreadable("it has a damaged directory")
            name = directory[at + 8 : at + 8 + size]
            if inode and name not in (b".", b".."):
                yield name, inode
            at += length
