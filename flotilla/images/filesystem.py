"""ext2 and ext4 file systems with given contents, identical to the byte wherever and by whomever they are made.

No mount and no privileges: mke2fs makes the empty file system, debugfs writes into it, both with their clock stopped.
debugfs does not fail where a command of its script does, so all that was written is read back and compared.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath

from flotilla.common.errors import UserError
from flotilla.common.paths import name_fault
from flotilla.debian.tools import Tools
from flotilla.images import extfs

BLOCK = 4096
_INODE_EVERY = 8192
"""Bytes of a file system for which it has one inode."""
_FEATURES = {
    "ext2": "none,ext_attr,filetype,sparse_super,large_file",  # of the first layout of cards, which the lab replays
    "ext4": "none,has_journal,ext_attr,resize_inode,dir_index,filetype,extent,64bit,flex_bg,sparse_super,large_file,"
    "huge_file,dir_nlink,extra_isize,metadata_csum",
}

_SHOWN = 5
"""Of what is wrong with a file system, so much is named."""


@dataclass(frozen=True)
class Node:
    """A file, a link (with a target), or (with neither content nor target) a directory. Owner and group are numbers on
    the robot."""

    path: PurePosixPath
    content: bytes | None = None
    mode: int = 0o755
    uid: int = 0
    gid: int = 0
    target: str = ""
    """Where a symbolic link leads."""


def make(
    tools: Tools,
    image: Path,
    size: int,
    nodes: list[Node],
    *,
    kind: str,
    label: str,
    uuid: str,
    epoch: int,
    start: int | None = None,
) -> list[tuple[int, int]]:
    """Make a file system of `size` bytes; return the extents of `image` (offset, length in bytes) that hold anything.

    It is the new file `image`, or lies `start` bytes behind the beginning of one that exists, where there is nothing
    yet. `nodes` must name parents before children. UserError where it does not hold all of them as they are.
    """
    if problems := [problem for node in nodes for problem in _unwritable(node)]:
        raise UserError("\n".join(problems))
    if start is None:
        image.unlink(missing_ok=True)
    offset = start or 0
    within = f"{image}?offset={offset}"
    tools.run(
        "usr/sbin/mke2fs", "-q", "-F", "-b", str(BLOCK), "-I", "256", "-i", str(_INODE_EVERY), "-m", "1",
        "-O", _FEATURES[kind], "-L", label, "-U", uuid,
        "-E", f"hash_seed={uuid},lazy_itable_init=0,lazy_journal_init=0,nodiscard,root_owner=0:0,offset={offset}",
        image, str(size // BLOCK),
    )  # fmt: skip
    with tempfile.TemporaryDirectory(dir=image.parent) as directory:
        script = Path(directory) / "script"
        script.write_text("".join(_commands(nodes, Path(directory), epoch)), encoding="utf-8")
        tools.run("usr/sbin/debugfs", "-w", "-f", script, within)
    _compare(nodes, image, offset, f"{label} file system of {size // BLOCK * BLOCK >> 20} MiB", epoch)
    tools.run("usr/sbin/e2fsck", "-f", "-n", within)
    used = _used(tools.run("usr/sbin/dumpe2fs", within), size)
    return [(offset + place, length) for place, length in used]


def taken(size: int) -> int:
    """What a file of so many bytes takes of a file system: its blocks, or the share that its inode has of all."""
    return max(-(-size // BLOCK) * BLOCK, _INODE_EVERY)


def _unwritable(node: Node) -> Iterator[str]:
    """Why a card cannot have a node of this name: what lists files, and debugfs, have a name on one line, in UTF-8."""
    if why := name_fault(node.path.name):
        yield f"{str(node.path)!a}: {why}"
    if why := name_fault(node.target, most=BLOCK - 1):
        yield f"{str(node.path)!a}: is a link to {node.target!a}, which {why}"


def _commands(nodes: Sequence[Node], directory: Path, epoch: int) -> Iterator[str]:
    for number, node in enumerate(nodes):
        yield f"cd {_quoted(node.path.parent)}\n"
        # `./`: debugfs takes <12> for the number of an inode.
        name, path = _quoted(node.path.name), _quoted(f"./{node.path.name}")
        if node.target:
            yield f"symlink {name} {_quoted(node.target)}\n"
        elif node.content is None:
            yield f"mkdir {name}\n"
        else:
            source = directory / str(number)
            source.write_bytes(node.content)
            yield f"write {_quoted(source)} {name}\n"
        fields = {"mode": f"0{_mode(node):o}", "uid": node.uid, "gid": node.gid}
        # Times on disk are the caller's clock unless set; `*_extra` carries nanoseconds.
        fields |= dict.fromkeys(("atime", "ctime", "mtime", "crtime"), f"@{epoch}")
        fields |= dict.fromkeys(("atime_extra", "ctime_extra", "mtime_extra", "crtime_extra"), 0)
        yield from (f"sif {path} {field} {value}\n" for field, value in fields.items())


def _quoted(word: str | PurePath) -> str:
    """A word of a command of debugfs (libss)."""
    return '"' + str(word).replace('"', '""') + '"'


def _mode(node: Node) -> int:
    kind = stat.S_IFLNK if node.target else stat.S_IFDIR if node.content is None else stat.S_IFREG
    return kind | node.mode


def _compare(nodes: Sequence[Node], image: Path, start: int, what: str, epoch: int) -> None:
    """UserError where the file system does not hold these nodes, or more."""
    wanted = {str(node.path).encode(): node for node in nodes}
    wrong, full = [], False
    try:
        with image.open("rb") as file:
            reader = extfs.Reader(file, start)
            full = not reader.free_blocks or not reader.free_inodes
            for path, found in reader.walk():
                node = wanted.pop(path, None)
                if node:
                    wrong += [f"{node.path}: {difference}" for difference in _differences(node, found, epoch)]
                elif path != b"/lost+found":
                    wrong.append(f"{os.fsdecode(path)}: should not be there")
    except extfs.Unreadable as error:
        wrong.append(str(error))
    wrong += [f"{node.path}: is missing" for node in wanted.values()]
    if not wrong:
        return
    more = f"; and {len(wrong) - _SHOWN} more" if len(wrong) > _SHOWN else ""
    largest = max(nodes, key=lambda node: len(node.content or b""))
    why = f"it is full; the largest file is {largest.path}, {len(largest.content or b'')} bytes: " if full else ""
    raise UserError(f"cannot write the {what}: {why}{'; '.join(wrong[:_SHOWN])}{more}")


def _differences(node: Node, found: extfs.Found, epoch: int) -> Iterator[str]:
    expected = extfs.Found(
        _mode(node), node.uid, node.gid, [epoch * 10**9] * 4, node.target.encode() or node.content or b""
    )
    if found.content != expected.content:
        yield f"has another content ({len(found.content)} bytes, not the {len(expected.content)} that were written)"
    for name in ("mode", "uid", "gid", "times"):
        if (one := getattr(found, name)) != (right := getattr(expected, name)):
            shown, wanted = (f"{value:#o}" if name == "mode" else str(value) for value in (one, right))
            yield f"has {name} {shown}, not {wanted}"


def _used(dump: str, size: int) -> list[tuple[int, int]]:
    """The blocks that are not free, metadata, journal and zeroed inode tables included."""
    free: list[tuple[int, int]] = []
    for match in re.finditer(r"^  Free blocks: (.+)$", dump, re.MULTILINE):
        for part in match[1].split(", "):
            first, _, last = part.partition("-")
            free.append((int(first), int(last or first) + 1))
    used, position = [], 0
    for first, end in [*sorted(free), (size // BLOCK, size // BLOCK)]:
        if first > position:
            used.append((position * BLOCK, (first - position) * BLOCK))
        position = max(position, end)
    return used
