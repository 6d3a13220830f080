"""What a slot holds: root, kernel and initramfs in one piece, the keys that sign its updates, and the header.

| from | what |
|---|---|
| 0 | root (squashfs) |
| then, each from a multiple of 4 KiB on | kernel, initramfs (where the kernel needs one), release keys |
| 4 KiB before the end of the slot | header: a block of GRUB's environment, which says where they lie |

The header is written last, and cleared first: a slot that has one is whole. All of it but the header is the `blob`,
which an update brings. Boot arguments are of the release, not of the boot loader.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Annotated

import pydantic

from flotilla.common import cache, paths, yaml_file
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Integer, between
from flotilla.images import card, environment_block

RELEASE_FILE = paths.PROJECT / "images" / "release.yml"
_ALIGNMENT = 4096
_NAMES = {"KERNEL": "vmlinuz", "INITRD": "initrd.img", "KEYS": "release_keys"}
"""Parts behind the root: their names in the header, and as files."""


class Release(pydantic.BaseModel):
    """What release.yml says."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    release: Annotated[Integer, between(1, 10**9, "a number that counts up with each release")]
    """Number of the release that is built from this checkout."""
    floor: Annotated[Integer, between(1, 10**9, "the number of a release")]
    """Robots that run this release reject every release below, even if the operator accepts an older one."""


def release() -> Release:
    found = yaml_file.read(RELEASE_FILE, Release)
    if found.floor > found.release:
        raise UserError(
            f"{paths.shown(RELEASE_FILE)}: floor: {found.floor}: is above release {found.release}, which robots would "
            "refuse themselves; take at most that"
        )
    return found


def build(board: Board, root: Path, keys: bytes, numbers: Release) -> Path:
    """Directory with `slot.img` (the blob), `header` and `header.json`, from the cache where nothing changed.

    `root`: what `rootfs.build` made. `keys`: who signs releases, as release_keys.py has it.
    """
    key = cache.digest(
        root.name, keys.decode(), board.model_dump_json(), numbers.model_dump_json(), Path(__file__),
        Path(card.__file__), Path(environment_block.__file__), str(card.LAYOUT),
    )  # fmt: skip

    return cache.result("slot", key, lambda out: write(board, root, keys, numbers, out))


def write(board: Board, root: Path, keys: bytes, numbers: Release, out: Path) -> None:
    """What `build` makes, in `out`."""
    squashfs, blob = root / "root.squashfs", out / "slot.img"
    shutil.copyfile(squashfs, blob)
    parts = {name: root / file for name, file in _NAMES.items() if (root / file).exists()}
    (out / "release_keys").write_bytes(keys)
    places = dict.fromkeys(_NAMES, "")
    with blob.open("r+b") as whole:
        for name, file in (parts | {"KEYS": out / "release_keys"}).items():
            start = whole.seek(-(-whole.seek(0, 2) // _ALIGNMENT) * _ALIGNMENT)
            content = file.read_bytes()
            whole.write(content)
            places[name] = f"{start // card.SECTOR}+{-(-len(content) // card.SECTOR)}"
        whole.truncate(-(-whole.seek(0, 2) // _ALIGNMENT) * _ALIGNMENT)
    size = blob.stat().st_size
    room = card.SLOTS[0].size - card.HEADER_ROOM
    if size > room:
        raise UserError(
            f"the root file system of {board.name} and its kernel are {size} bytes, a slot has room for {room}: "
            "leave out packages in images/packages/ or files in images/rootfs/exclude.list, or enlarge slot_mib in "
            "images/boot/card.yml"
        )
    with blob.open("rb") as whole:
        digest = hashlib.file_digest(whole, "sha256").hexdigest()
    header = {
        "RELEASE": str(numbers.release),
        "FLOOR": str(numbers.floor),
        "BOARD": board.name,
        "LAYOUT": str(card.LAYOUT.layout),
        "VERSION": json.loads((root / "contents.json").read_text())["kernel"],
        "BYTES": str(size),
        "BLOB": digest,
        **places,
        "ARGUMENTS": " ".join(card.kernel_arguments(board)),
    }
    (out / "header.json").write_text(json.dumps(header))
    (out / "header").write_bytes(environment_block.make(header, card.HEADER_BYTES))
    (out / "release_keys").unlink()
