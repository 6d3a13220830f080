"""Where two card images differ: which part of the card, which file in it, from which byte on."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

from flotilla.debian.tools import Tools
from flotilla.images import card

_BLOCK = 4096
_CHUNK = 1 << 20
_EXCERPT = 16
_FILES_NAMED = 40


@dataclass(frozen=True)
class Part:
    """A range of the card with a meaning of its own."""

    name: str
    start: int
    end: int


PARTS = (
    Part("MBR", 0, 512),
    Part("GRUB's core image", 512, card.STATE.start),
    *(
        Part(name, partition.start, partition.start + partition.size)
        for name, partition in (
            ("boot state", card.STATE),
            *((f"slot {slot.name}", slot) for slot in card.SLOTS),
            ("data partition", card.DATA),
        )
    ),
)


@dataclass(frozen=True)
class Difference:
    """That a part differs."""

    part: Part
    first: int
    """Bytes from the start of the part to the first that differs."""
    blocks: int
    """How many blocks of 4096 bytes differ."""

    def __str__(self) -> str:
        return f"{self.part.name}: differs from byte {self.first} on, in {self.blocks} blocks"


@dataclass(frozen=True)
class Entry:
    """A file, directory or link in a file system."""

    metadata: str
    content: Path | None = None
    """A regular file's content."""


def differing_parts(first: Path, second: Path) -> list[Difference]:
    """The parts of the card that differ. Whatever lies beyond them counts as a part, too."""
    same_size, end = sorted(path.stat().st_size for path in (first, second))
    beyond = [Part("beyond the last partition", card.SIZE, end)] if end > card.SIZE else []
    found = []
    # Unbuffered: looking for holes moves the position that a buffer would rely on.
    with first.open("rb", buffering=0) as one, second.open("rb", buffering=0) as other:
        for part in (*PARTS, *beyond):
            position, blocks = None, 0
            for start in range(part.start, part.end, _CHUNK):
                size = min(_CHUNK, part.end - start)
                if start + size <= same_size and not any(holds_data(file, start, size) for file in (one, other)):
                    continue
                one.seek(start)
                other.seek(start)
                left, right = one.read(size), other.read(size)
                if left == right:
                    continue
                if position is None:
                    position = start - part.start + first_difference(left, right)
                blocks += sum(left[at : at + _BLOCK] != right[at : at + _BLOCK] for at in range(0, size, _BLOCK))
            if position is not None:
                found.append(Difference(part, position, blocks))
    return found


def holds_data(file: FileIO, start: int, size: int) -> bool:
    """Whether a range is anything but a hole."""
    try:
        return os.lseek(file.fileno(), start, os.SEEK_DATA) < start + size
    except OSError as error:
        if error.errno != errno.ENXIO:  # no data up to the end
            raise
        return False


def first_difference(left: bytes, right: bytes) -> int:
    """The first position where they differ; one may be the beginning of the other."""
    low, high = 0, min(len(left), len(right))
    if left[:high] == right[:high]:
        return high
    while high - low > 1:  # they differ between low and high, and nowhere before
        middle = (low + high) // 2
        low, high = (low, middle) if left[low:middle] != right[low:middle] else (middle, high)
    return low


def differing_files(first: Mapping[str, Entry], second: Mapping[str, Entry]) -> list[str]:
    """What differs between two file systems, a line each."""
    lines = []
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            lines.append(f"{name}: only in the {'first' if name in first else 'second'} image")
            continue
        one, other = first[name], second[name]
        if one.metadata != other.metadata:
            lines.append(f"{name}: {_contrast(one.metadata, other.metadata)}")
        if one.content and other.content:
            left, right = one.content.read_bytes(), other.content.read_bytes()
            if left != right:
                at = first_difference(left, right)
                excerpt = f": {left[at : at + _EXCERPT]!r} / {right[at : at + _EXCERPT]!r}"
                public = one.content.stat().st_mode & other.content.stat().st_mode & 0o004  # keys stay unseen
                lines.append(f"{name}: differs from byte {at} on{excerpt if public else ''}")
    return lines


def _contrast(one: str, other: str) -> str:
    """The words that differ."""
    left, right = one.split(), other.split()
    if len(left) != len(right):
        return f"{one} / {other}"
    pairs = [(mine, theirs) for mine, theirs in zip(left, right, strict=True) if mine != theirs]
    return f"{' '.join(mine for mine, _ in pairs)} / {' '.join(theirs for _, theirs in pairs)}"


def images(first: Path, second: Path, tools: Tools, work: Path) -> list[str]:
    """What differs between two card images, a line each; nothing when they are identical. `work` is for files."""
    lines = []
    for difference in differing_parts(first, second):
        lines.append(str(difference))
        part = difference.part
        if part.name.startswith("slot"):
            read = squashfs_files
        elif part.name.endswith(" partition"):
            read = ext_files
        else:
            lines.append(f"  {_bytes_at(first, part, difference.first)} / {_bytes_at(second, part, difference.first)}")
            continue
        place = work / part.name.replace(" ", "-")
        trees = []
        for number, image in enumerate((first, second)):
            (place / str(number)).mkdir(parents=True)
            trees.append(read(tools, image, part.start, place / str(number)))
        files = differing_files(*trees)
        lines += [f"  {line}" for line in files[:_FILES_NAMED]] or ["  the same files, stored differently"]
        if len(files) > _FILES_NAMED:
            lines.append(f"  and {len(files) - _FILES_NAMED} more files")
    return lines


def _bytes_at(image: Path, part: Part, position: int) -> str:
    with image.open("rb") as file:
        file.seek(part.start + position)
        return file.read(_EXCERPT).hex(" ")


def squashfs_files(tools: Tools, image: Path, offset: int, work: Path) -> dict[str, Entry]:
    """The files of the squashfs at `offset`, unpacked into `work`."""
    listing = tools.run("usr/bin/unsquashfs", "-o", str(offset), "-lln", image)
    tools.run("usr/bin/unsquashfs", "-o", str(offset), "-q", "-n", "-no-xattrs", "-f", "-d", work, image)
    return squashfs_listing(listing, work)


def squashfs_listing(listing: str, work: Path) -> dict[str, Entry]:
    """The entries of `unsquashfs -lln`, whose contents are in `work`."""
    entries = {}
    for line in listing.splitlines():
        if match := re.fullmatch(r"(\S+ +\d+/\d+ .*\d{4}-\d\d-\d\d \d\d:\d\d) squashfs-root(.*)", line):
            name, _, target = match[2].partition(" -> ")
            content = work / name.removeprefix("/") if line.startswith("-") else None
            words = match[1].split()
            if line.startswith("d"):
                del words[2]  # the size of a directory in squashfs tells where others lie
            entries[name or "/"] = Entry(" ".join((*words, *([f"-> {target}"] if target else []))), content)
    return entries


def ext_files(tools: Tools, image: Path, offset: int, work: Path) -> dict[str, Entry]:
    """The files of the ext2 or ext4 at `offset`, unpacked into `work`, with their inodes."""
    where = f"{image}?offset={offset}"
    (work / "files").mkdir()
    tools.run("usr/sbin/debugfs", "-R", f"rdump / {work / 'files'}", where)
    found = {"/" + str(path.relative_to(work / "files")): path for path in sorted((work / "files").rglob("*"))}
    script = work / "script"
    script.write_text("".join(f'stat "{name}"\n' for name in found))
    inodes = tools.run("usr/sbin/debugfs", "-f", script, where).split("debugfs: stat ")[1:]
    return {
        name: Entry(" ".join(inode.split("\n", 1)[1].split()), path if path.is_file() else None)
        for (name, path), inode in zip(found.items(), inodes, strict=True)
    }
