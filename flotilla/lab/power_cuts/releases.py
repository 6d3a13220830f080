"""Small releases that tell themselves apart: a kernel that says its name and whether it was loaded whole."""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass
from pathlib import Path

from flotilla.lab.qemu.stub_computer import assemble_stub

_PROGRAM = 0x400
_SYSSIZE = 0x1F4
_WORDS = 0x410
_NAME = 0x414
_NAME_BYTES = 32
_START = 0x464C4F54
"""Where the stub begins to add: zeros, as of a file whose content was lost, do not add up."""


@dataclass(frozen=True)
class Release:
    """What an update brings."""

    name: str
    root: bytes
    """In the place of the squashfs."""
    kernel: bytes
    initramfs: bytes


def make(name: str, directory: Path, *, root: int, kernel: int, initramfs: int) -> Release:
    """A release of parts with these numbers of bytes, each a multiple of 512; the same name makes the same bytes."""
    chance = random.Random(name)
    stub = _named(assemble_stub(directory, release=True), name, kernel)
    body = stub[_PROGRAM:] + chance.randbytes(kernel - len(stub))
    return Release(
        name, chance.randbytes(root), stub[:_PROGRAM] + _balanced(body), _balanced(chance.randbytes(initramfs))
    )


def _named(stub: bytes, name: str, size: int) -> bytes:
    """The stub as the beginning of a kernel of this many bytes."""
    if len(name) >= _NAME_BYTES or size <= len(stub):
        raise ValueError(f"{name}: a name of at most {_NAME_BYTES - 1} bytes, a kernel of more than {len(stub)}")
    body = bytearray(stub)
    struct.pack_into("<I", body, _SYSSIZE, (size - _PROGRAM) // 16)
    struct.pack_into("<I", body, _WORDS, (size - _PROGRAM) // 4)
    struct.pack_into(f"<{_NAME_BYTES}s", body, _NAME, name.encode())
    return bytes(body)


def _balanced(content: bytes) -> bytes:
    """The content with its last word such that all its words and `_START` add up to zero."""
    words = struct.unpack(f"<{len(content) // 4}I", content)
    return content[:-4] + struct.pack("<I", -(_START + sum(words[:-1])) & 0xFFFFFFFF)


def stand_in(name: str, directory: Path, kernel: bytes, initramfs: bytes = b"") -> dict[tuple[int, int], bytes]:
    """What makes a real kernel say its release, as a small one does: by part (0: kernel) and sector, the new content.

    The rest stays, and is added up, so a part of which anything is missing is TORN.
    """
    stub = _named(assemble_stub(directory, release=True), name, len(kernel))
    parts = [stub[:_PROGRAM] + _balanced(stub[_PROGRAM:] + kernel[len(stub) :])]
    parts += [_balanced(initramfs)] if initramfs else []
    changed = {}
    for part, (before, after) in enumerate(zip((kernel, initramfs), parts, strict=False)):
        for at in range(0, len(after), 512):
            if before[at : at + 512] != after[at : at + 512]:
                changed[part, at // 512] = after[at : at + 512]
    return changed
