"""The block map of a card image: which blocks matter, each range with its checksum.

The format is bmap 2.0, so bmaptool writes our cards as well as `make flash` does. Its checksums are also what a written
card is read back against. Which blocks matter is the builder's knowledge (partition layout, used blocks of the file
systems) and not the holes of the image file: an inode table full of zeros is a hole to the file and data to the card.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

from flotilla.common import durable
from flotilla.common.errors import UserError
from flotilla.common.paths import shown

BLOCK = 4096
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Range:
    """Consecutive mapped blocks, `first` to `last` inclusive."""

    first: int
    last: int
    sha256: str


@dataclass(frozen=True)
class BlockMap:
    image_size: int
    """Bytes."""
    ranges: tuple[Range, ...]
    """Ascending, apart from each other."""

    def span(self, blocks: Range) -> tuple[int, int]:
        """First byte of the range and the byte after its last; the image may end inside its last block."""
        return blocks.first * BLOCK, min((blocks.last + 1) * BLOCK, self.image_size)

    @property
    def mapped(self) -> int:
        """Bytes to write."""
        return sum(end - start for start, end in map(self.span, self.ranges))


def bmap_of(image: Path) -> Path:
    """Where the map of an image lies; bmaptool looks there by itself."""
    return image.with_suffix(".bmap")


def block_map(image: Path, extents: Iterable[tuple[int, int]], known: Iterable[Range] = ()) -> BlockMap:
    """The map of `image`, of which the `extents` (offset and length in bytes, in any order) matter. `known`: ranges of
    another image that has the same there, which are not read again."""
    checksums = {(blocks.first, blocks.last): blocks.sha256 for blocks in known}
    # Read, not mapped: a page of a hole that is mapped takes memory of a tmpfs, and there may be none left.
    with image.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        ranges = tuple(
            Range(first, last, checksums.get((first, last)) or _hash(file, first * BLOCK, (last + 1) * BLOCK))
            for first, last in _blocks(extents, size)
        )
    return BlockMap(size, ranges)


def _hash(file: IO[bytes], start: int, end: int) -> str:
    """SHA-256 of a range of bytes, or of what the file has of it."""
    digest = hashlib.sha256()
    file.seek(start)
    while chunk := file.read(min(_CHUNK, end - start)):
        digest.update(chunk)
        start += len(chunk)
    return digest.hexdigest()


def write_bmap(image: Path, extents: Iterable[tuple[int, int]], bmap: Path, known: Iterable[Range] = ()) -> BlockMap:
    """Write the map of `image`; arguments as for `block_map`."""
    result = block_map(image, extents, known)
    durable.write(bmap, _xml(result))
    return result


def read_bmap(path: Path) -> BlockMap:
    """Read a map that `write_bmap` wrote; anything else, or a damaged one, is refused."""
    content = path.read_bytes()
    try:
        stated = _CHECKSUM.search(content)
        if stated is None or _checksum(content) != stated[2].decode():
            raise ValueError("its own checksum does not match")
        return _parsed(content)
    except (ValueError, ElementTree.ParseError) as error:
        raise UserError(f"{shown(path)}: damaged block map, {error}; build the image again") from error


def _blocks(extents: Iterable[tuple[int, int]], size: int) -> list[tuple[int, int]]:
    """First and last blocks of the extents, aligned outward; those that overlap or touch become one."""
    merged: list[tuple[int, int]] = []
    for offset, length in sorted(extents):
        if offset < 0 or length < 0 or offset + length > size:
            raise ValueError(f"extent of {length} bytes at {offset} is not inside the image of {size} bytes")
        if not length:
            continue
        first, last = offset // BLOCK, (offset + length - 1) // BLOCK
        if merged and first <= merged[-1][1] + 1:
            before = merged.pop()
            first, last = before[0], max(last, before[1])
        merged.append((first, last))
    return merged


_CHECKSUM = re.compile(rb"(<BmapFileChecksum>\s*)([0-9a-f]{64})")


def _checksum(content: bytes) -> str:
    """SHA-256 of the map's text with zeros in the place of that checksum, as the format wants it."""
    return hashlib.sha256(_CHECKSUM.sub(rb"\g<1>" + b"0" * 64, content, count=1)).hexdigest()


def _count(size: int) -> int:
    return (size + BLOCK - 1) // BLOCK


def _mapped_count(ranges: Iterable[Range]) -> int:
    return sum(blocks.last - blocks.first + 1 for blocks in ranges)


def _xml(bmap: BlockMap) -> bytes:
    lines = [
        '<?xml version="1.0" ?>',
        "<!-- The blocks of a card image that have to be written; the others may hold anything. -->",
        '<bmap version="2.0">',
        f"    <ImageSize> {bmap.image_size} </ImageSize>",
        f"    <BlockSize> {BLOCK} </BlockSize>",
        f"    <BlocksCount> {_count(bmap.image_size)} </BlocksCount>",
        f"    <MappedBlocksCount> {_mapped_count(bmap.ranges)} </MappedBlocksCount>",
        "    <ChecksumType> sha256 </ChecksumType>",
        f"    <BmapFileChecksum> {'0' * 64} </BmapFileChecksum>",
        "    <BlockMap>",
        *(f'        <Range chksum="{blocks.sha256}"> {_numbers(blocks)} </Range>' for blocks in bmap.ranges),
        "    </BlockMap>",
        "</bmap>",
        "",
    ]
    content = "\n".join(lines).encode()
    return content.replace(b"0" * 64, _checksum(content).encode(), 1)


def _numbers(blocks: Range) -> str:
    return str(blocks.first) if blocks.first == blocks.last else f"{blocks.first}-{blocks.last}"


def _parsed(content: bytes) -> BlockMap:
    root = ElementTree.fromstring(content)

    def field(name: str) -> str:
        return (root.findtext(name) or "").strip()

    size = int(field("ImageSize"))
    ranges = tuple(_range(element) for element in root.iterfind("BlockMap/Range"))
    expected = {
        "version": (root.get("version"), "2.0"),
        "ChecksumType": (field("ChecksumType"), "sha256"),
        "BlockSize": (field("BlockSize"), str(BLOCK)),
        "BlocksCount": (field("BlocksCount"), str(_count(size))),
        "MappedBlocksCount": (field("MappedBlocksCount"), str(_mapped_count(ranges))),
    }
    for name, (found, right) in expected.items():
        if found != right:
            raise ValueError(f"{name} is {found} instead of {right}")
    position = -1
    for blocks in ranges:
        if not position < blocks.first <= blocks.last < _count(size):
            raise ValueError(f"range {_numbers(blocks)} is out of order or outside the image")
        position = blocks.last
    return BlockMap(size, ranges)


def _range(element: ElementTree.Element) -> Range:
    first, _, last = (element.text or "").strip().partition("-")
    return Range(int(first), int(last or first), element.get("chksum", ""))
