"""ext2 and ext4 file systems with given contents, identical to the byte wherever and by whomever they are made.

No mount and no privileges: mke2fs makes the empty file system, debugfs writes into it, both with their clock stopped.
"""

from __future__ import annotations

import re
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from flotilla.common.errors import UserError
from images.builder.tools import Tools

BLOCK = 4096
_FEATURES = {
    "ext2": "none,ext_attr,filetype,sparse_super,large_file",  # of the first layout of cards, which the lab replays
    "ext4": "none,has_journal,ext_attr,resize_inode,dir_index,filetype,extent,64bit,flex_bg,sparse_super,large_file,"
    "huge_file,dir_nlink,extra_isize,metadata_csum",
}


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
    yet. `nodes` must name parents before children.
    """
    if start is None:
        image.unlink(missing_ok=True)
    offset = start or 0
    within = f"{image}?offset={offset}"
    tools.run(
        "usr/sbin/mke2fs", "-q", "-F", "-b", str(BLOCK), "-I", "256", "-i", "8192", "-m", "1", "-O", _FEATURES[kind],
        "-L", label, "-U", uuid,
        "-E", f"hash_seed={uuid},lazy_itable_init=0,lazy_journal_init=0,nodiscard,root_owner=0:0,offset={offset}",
        image, str(size // BLOCK),
    )  # fmt: skip
    with tempfile.TemporaryDirectory(dir=image.parent) as directory:
        script = Path(directory) / "script"
        script.write_text("".join(_commands(nodes, Path(directory), epoch)))
        answer = tools.run("usr/sbin/debugfs", "-w", "-f", script, within)
    mistakes = [
        line for line in answer.splitlines() if not line.startswith(("debugfs: ", "Allocated inode: ", "debugfs 1."))
    ]
    if mistakes:
        raise UserError(f"cannot write {label} file system: " + "; ".join(mistakes))
    tools.run("usr/sbin/e2fsck", "-f", "-n", within)
    used = _used(tools.run("usr/sbin/dumpe2fs", within), size)
    return [(offset + place, length) for place, length in used]


def _commands(nodes: list[Node], directory: Path, epoch: int) -> list[str]:
    commands = []
    for number, node in enumerate(nodes):
        commands.append(f"cd {node.path.parent}\n")
        if node.target:
            commands.append(f"symlink {node.path.name} {node.target}\n")
            mode = stat.S_IFLNK | node.mode
        elif node.content is None:
            commands.append(f"mkdir {node.path.name}\n")
            mode = stat.S_IFDIR | node.mode
        else:
            source = directory / str(number)
            source.write_bytes(node.content)
            commands.append(f"write {source} {node.path.name}\n")
            mode = stat.S_IFREG | node.mode
        fields = {"mode": f"0{mode:o}", "uid": node.uid, "gid": node.gid}
        # Times on disk are the caller's clock unless set; `*_extra` carries nanoseconds.
        fields |= dict.fromkeys(("atime", "ctime", "mtime", "crtime"), f"@{epoch}")
        fields |= dict.fromkeys(("atime_extra", "ctime_extra", "mtime_extra", "crtime_extra"), 0)
        commands += [f"sif {node.path.name} {field} {value}\n" for field, value in fields.items()]
    return commands


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
