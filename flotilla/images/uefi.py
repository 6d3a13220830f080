"""What UEFI starts: a program in a FAT file system, at the place for removable media, so that nothing is set up."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from flotilla.debian.tools import Tools

_PROGRAM = PurePosixPath("EFI/BOOT/BOOTX64.EFI")
"""UEFI specification 2.10, 3.5.1.1 "Removable Media Boot Behavior"."""
_VOLUME = "464C4F54"


def system_partition(tools: Tools, work: Path, size: int, program: bytes) -> bytes:
    """A system partition of so many bytes with one program; made in the directory `work`.

    FAT16, as the specification (13.3) allows on removable media and as firmware reads it everywhere: FAT32 begins at
    33 MiB.
    """
    image, file = work / "system.fat", work / "program"
    file.write_bytes(program)
    with image.open("wb") as empty:
        empty.truncate(size)
    tools.run("usr/sbin/mkfs.fat", "-F", "16", "-s", "1", "-i", _VOLUME, "-n", "SYSTEM", "--invariant", image)
    for directory in _PROGRAM.parents[-2::-1]:
        tools.run("usr/bin/mmd", "-i", image, f"::{directory}")
    tools.run("usr/bin/mcopy", "-i", image, file, f"::{_PROGRAM}")
    content = image.read_bytes()
    for each in (image, file):
        each.unlink()
    return content
