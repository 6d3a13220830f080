"""What takes the room of an image: its packages, its directories, its partitions. Read from the image itself."""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import pool, tools
from flotilla.debian.lock import read_lock
from flotilla.images import card, manifest

_SHOWN = 20
_LISTED = re.compile(r"-\S+ +\S+ +(\d+) \d{4}-\d\d-\d\d \d\d:\d\d squashfs-root(/.*)")
_DPKG = "var/lib/dpkg/info"


def report(image: Path, remedy: str) -> str:
    """Readable tables about an image that is built."""
    if not image.is_file():
        raise UserError(f"{paths.shown(image)} is missing; `{remedy}`")
    described = manifest.read(image, remedy)
    tools_lock = read_lock("tools")
    pool.fill([tools_lock])
    toolset = tools.Tools(tools.tree(tools_lock), described.epoch)
    offset = str(card.SLOTS[0].start)
    files = regular_files(toolset.run("usr/bin/unsquashfs", "-offset", offset, "-lls", image))
    with tempfile.TemporaryDirectory() as directory:
        target = Path(directory) / "root"
        toolset.run("usr/bin/unsquashfs", "-n", "-no-xattrs", "-offset", offset, "-d", target, image, _DPKG)
        lists = {path.stem.partition(":")[0]: path.read_text() for path in (target / _DPKG).glob("*.list")}
    root = next(part.bytes for part in described.parts if part.name == "root.squashfs")
    total = sum(files.values())
    return "\n\n".join(
        (
            f"{paths.shown(image)}: {len(described.packages)} packages, {len(files)} files of {progress.size(total)}, "
            f"compressed to {progress.size(root)}",
            _table(("package", "in the image", "as declared"), _packages(described, by_package(files, lists))),
            _table(("directory", "in the image"), _directories(files)),
            _table(("partition", "size", "used", ""), _partitions(described)),
        )
    )


def regular_files(listing: str) -> dict[PurePosixPath, int]:
    """Size of every regular file in what `unsquashfs -lls` says."""
    found = (_LISTED.fullmatch(line) for line in listing.splitlines())
    return {PurePosixPath(match[2]): int(match[1]) for match in found if match}


def by_package(files: dict[PurePosixPath, int], lists: dict[str, str]) -> Counter[str]:
    """Bytes of each package, by dpkg's lists of files; what belongs to none is the image's own."""
    left = dict(files)
    sizes: Counter[str] = Counter()
    for package, text in sorted(lists.items()):
        for line in text.splitlines():
            # Lists name /lib; there it is a link to /usr/lib.
            merged = re.sub(r"^/(bin|sbin|lib|lib32|lib64)/", r"/usr/\1/", line)
            sizes[package] += left.pop(PurePosixPath(merged), 0)
    sizes["(made by the build)"] = sum(left.values())
    return sizes


def by_directory(files: dict[PurePosixPath, int], depth: int = 3) -> Counter[str]:
    """Bytes below each directory, down to `depth`."""
    sizes: Counter[str] = Counter()
    for path, size in files.items():
        for parent in path.parents[:-1]:
            if len(parent.parts) - 1 <= depth:
                sizes[str(parent)] += size
    return sizes


def _packages(described: manifest.Manifest, sizes: Counter[str]) -> list[tuple[str, ...]]:
    declared = {package.name: package.installed_kib << 10 for package in described.packages}
    return [
        (name, progress.size(size), progress.size(declared[name]) if name in declared else "")
        for name, size in sizes.most_common(_SHOWN)
    ]


def _directories(files: dict[PurePosixPath, int]) -> list[tuple[str, ...]]:
    return [(name, progress.size(size)) for name, size in by_directory(files).most_common(_SHOWN)]


def _partitions(described: manifest.Manifest) -> list[tuple[str, ...]]:
    return [
        (
            f"{partition.number} {partition.name} ({partition.content})",
            progress.size(partition.bytes),
            progress.size(partition.used),
            f"{100 * partition.used // partition.bytes} %",
        )
        for partition in described.partitions
    ]


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Names to the left, numbers to the right."""
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            [line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))]
        ).rstrip()
        for line in lines
    )
