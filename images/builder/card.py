"""The card: MBR, GRUB, boot partition, root slots A and B, data partition. A file, made without loop device or mount.

All cards of a board are the same up to the data partition: `base` makes that part once, `begin` copies it, `complete`
adds a robot's data.

| bytes from the start | what |
|---|---|
| 0 | MBR: GRUB's boot.img, disk identifier, partition table |
| 512 | GRUB's core image, with every module it needs |
| 1 MiB | boot (ext2): grub.cfg, environment block, kernel and initramfs of each slot |
| 49 MiB | slot A (squashfs) |
| 209 MiB | slot B (empty until the first update) |
| 369 MiB | data (ext4): the robot's identity, then all that changes; grows to the card on first boot |
"""

from __future__ import annotations

import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from images.builder import cache, filesystem, paths
from images.builder.errors import UserError
from images.builder.filesystem import Node
from images.builder.fleet import Board
from images.builder.tools import Tools

MIB = 1 << 20
DISK_ID = 0x464C4F54
"""MBR identifier of every card. One per card is in a robot, so it needs no more to be found by."""
_GRUB_MODULES = "biosdisk part_msdos ext2 linux normal configfile loadenv test echo serial terminal sleep reboot"
_UUIDS = {"boot": "5b0e4a3c-6f1d-4c58-9d0a-000000000001", "data": "5b0e4a3c-6f1d-4c58-9d0a-000000000004"}


@dataclass(frozen=True)
class Partition:
    number: int
    name: str
    start: int
    """Bytes from the start of the card."""
    size: int
    """Bytes."""

    @property
    def partuuid(self) -> str:
        return f"{DISK_ID:08x}-{self.number:02}"


BOOT = Partition(1, "boot", 1 * MIB, 48 * MIB)
SLOTS = [Partition(2, "A", 49 * MIB, 160 * MIB), Partition(3, "B", 209 * MIB, 160 * MIB)]
DATA = Partition(4, "data", 369 * MIB, 32 * MIB)
SIZE = DATA.start + DATA.size

COMMON_ARGUMENTS = ["ro", "rootfstype=squashfs", "init=/usr/lib/flotilla/preinit", "net.ifnames=0", "panic=10",
                    "cpufreq.default_governor=performance", "cryptomgr.notests", "noisapnp", "quiet"]  # fmt: skip
"""Kernel command line of every card; the board adds its own. The kernel's self-tests of its ciphers take two seconds of
each boot under emulation, and more on the board; to look for ISA cards without jumpers, a third of one."""

Extents = list[tuple[int, int]]
"""Byte ranges (offset, length) of a card that hold anything."""


def kernel_arguments(board: Board) -> list[str]:
    """The command line, but for what GRUB adds for the slot."""
    console = f"console={board.console.tty},{board.console.baud}n8"
    return [*COMMON_ARGUMENTS, *board.kernel_arguments, "console=tty0", console]


def base(board: Board, root: Path, tools: Tools, epoch: int) -> Path:
    """Directory with `card.img`, everything but the data partition, and `extents.json`."""
    template = paths.PROJECT / "images" / "grub.cfg.j2"
    key = cache.digest(
        root.name, tools.directory.name, str(epoch), board.model_dump_json(), template, Path(__file__),
        Path(filesystem.__file__),
    )  # fmt: skip

    def make(out: Path) -> None:
        squashfs = root / "root.squashfs"
        if squashfs.stat().st_size > SLOTS[0].size:
            raise UserError(
                f"the root file system of {board.name} is {squashfs.stat().st_size} bytes, a slot {SLOTS[0].size}: "
                "leave out packages in images/packages/ or files in images/rootfs/exclude.list"
            )
        boot = out / "boot.img"
        boot_extents = filesystem.make(
            tools, boot, BOOT.size, _boot_nodes(board, root, template), kind="ext2", label="boot", uuid=_UUIDS["boot"],
            epoch=epoch,
        )  # fmt: skip
        core = _core(tools, out)
        with (out / "card.img").open("wb") as card:
            card.truncate(SIZE)
            card.write(_boot_sector(tools))
            card.seek(512)
            card.write(core)
            copied = [(0, 512 + len(core))]
            copied += _place(boot, boot_extents, card.fileno(), BOOT)
            copied += _place(squashfs, [(0, squashfs.stat().st_size)], card.fileno(), SLOTS[0])
        (out / "extents.json").write_text(json.dumps(copied))
        boot.unlink()

    return cache.result("card", key, make)


def extents(base_directory: Path) -> Extents:
    """Where the board's part of a card holds anything: what comes before the first partition, then the partitions."""
    return [(start, length) for start, length in json.loads((base_directory / "extents.json").read_text())]


def begin(base_directory: Path, out: Path) -> Extents:
    """Write the card `out` up to the robot's data partition. Only what holds anything is written.

    It is for its owner alone: the data partition holds the robot's private key.
    """
    whole = Partition(0, "card", 0, SIZE)
    out.unlink(missing_ok=True)
    out.touch(0o600, exist_ok=False)
    with out.open("r+b") as card:
        card.truncate(SIZE)
        return _place(base_directory / "card.img", extents(base_directory), card.fileno(), whole)


def complete(card: Path, data: Path, data_extents: Extents) -> Extents:
    """Add the robot's data partition to a card that `begin` made."""
    with card.open("r+b") as file:
        return _place(data, data_extents, file.fileno(), DATA)


def data_partition(tools: Tools, out: Path, nodes: list[Node], epoch: int) -> Extents:
    """Write the data partition `out` with the robot's files."""
    return filesystem.make(tools, out, DATA.size, nodes, kind="ext4", label="data", uuid=_UUIDS["data"], epoch=epoch)


def _place(source: Path, extents: Extents, card: int, partition: Partition) -> Extents:
    """Copy the extents of `source` to a partition; where they lie on the card."""
    with source.open("rb") as file:
        for start, length in extents:
            position, end = start, start + length
            while position < end:
                copied = os.copy_file_range(file.fileno(), card, end - position, position, partition.start + position)
                if not copied:
                    raise UserError(f"{source} is shorter than its extents")
                position += copied
    return [(partition.start + start, length) for start, length in extents]


def _boot_nodes(board: Board, root: Path, template: Path) -> list[Node]:
    import jinja2  # here, because the next robot's card does not need it

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    files = [root / name for name in ("vmlinuz", "initrd.img") if (root / name).exists()]
    config = environment.from_string(template.read_text()).render(
        board=board, slots=SLOTS, kernel_arguments=kernel_arguments(board), initramfs=len(files) > 1
    )
    variables = "# GRUB Environment Block\nORDER=A B\nA_OK=1\nA_TRY=0\nB_OK=0\nB_TRY=0\n"
    return [
        Node(PurePosixPath("/grub")),
        Node(PurePosixPath("/grub/grub.cfg"), config.encode(), 0o644),
        Node(PurePosixPath("/grub/grubenv"), variables.encode().ljust(1024, b"#"), 0o644),
        Node(PurePosixPath("/A")),
        *(Node(PurePosixPath("/A") / file.name, file.read_bytes(), 0o644) for file in files),
        Node(PurePosixPath("/B")),
    ]


def _core(tools: Tools, out: Path) -> bytes:
    """GRUB's core image; it reads its configuration from the boot partition of the disk it came from."""
    core = out / "core.img"
    modules = tools.directory / "usr/lib/grub/i386-pc"
    tools.run(
        "usr/bin/grub-mkimage",
        "-O",
        "i386-pc",
        "-d",
        modules,
        "-p",
        "(,msdos1)/grub",
        "-o",
        core,
        *_GRUB_MODULES.split(),
    )
    content = core.read_bytes()
    core.unlink()
    if len(content) > BOOT.start - 512:
        raise UserError(f"GRUB's core image of {len(content)} bytes does not fit before the first partition")
    return content


def _boot_sector(tools: Tools) -> bytes:
    """MBR: GRUB's first stage (it loads sector 1 on), the identifier, and four partitions by LBA."""
    code = (tools.directory / "usr/lib/grub/i386-pc/boot.img").read_bytes()[:440]
    entries = b""
    for partition in (BOOT, *SLOTS, DATA):
        status = 0x80 if partition is BOOT else 0
        chs = b"\xfe\xff\xff"  # beyond what CHS can say: LBA counts
        entries += struct.pack("<B3sB3sII", status, chs, 0x83, chs, partition.start // 512, partition.size // 512)
    return code + struct.pack("<IH", DISK_ID, 0) + entries + b"\x55\xaa"
