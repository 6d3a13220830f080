"""The card: MBR, GRUB, boot partition, root slots A and B, data partition. A file, made without loop device or mount.

All cards of a board are the same up to the data partition: `base` makes that part once, `begin` copies it, `complete`
adds a robot's data.

| bytes from the start | what |
|---|---|
| 0 | MBR: GRUB's boot.img, disk identifier, partition table |
| 512 | GRUB's core image, with every module it needs, and its configuration |
| 1 MiB | boot (ext2): environment block, kernel and initramfs of each slot |
| 49 MiB | slot A (squashfs) |
| 209 MiB | slot B (empty until the first update) |
| 369 MiB | data (ext4): the robot's identity, then all that changes; grows to the card on first boot |
"""

from __future__ import annotations

import io
import json
import os
import struct
import tarfile
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
_GRUB_MODULES = """
    biosdisk part_msdos ext2 memdisk tar linux normal configfile loadenv test true echo serial terminal sleep reboot
    iorw
"""
_GRUB_TEMPLATE = paths.PROJECT / "images" / "grub.cfg.j2"
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

ENVIRONMENT_BLOCK = b"# GRUB Environment Block\nORDER=A B\nA_OK=1\nA_TRY=0\nB_OK=0\nB_TRY=0\n".ljust(1024, b"#")
"""What GRUB and the running system tell each other about the slots, as on a new card: A is good, B is empty."""

Extents = list[tuple[int, int]]
"""Byte ranges (offset, length) of a card that hold anything."""


def kernel_arguments(board: Board) -> list[str]:
    """The command line, but for what GRUB adds for the slot."""
    console = f"console={board.console.tty},{board.console.baud}n8"
    stop = board.watchdog and board.watchdog.stop
    own = [f"flotilla.watchdog_stop={stop.port}:{stop.value:o}"] if stop else []  # for preinit
    return [*COMMON_ARGUMENTS, *board.kernel_arguments, *own, "console=tty0", console]


def base(board: Board, root: Path, tools: Tools, epoch: int) -> Path:
    """Directory with `card.img`, everything but the data partition, and `extents.json`."""
    key = cache.digest(
        root.name, tools.directory.name, str(epoch), board.model_dump_json(), _GRUB_TEMPLATE, Path(__file__),
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
        kernel = [root / name for name in ("vmlinuz", "initrd.img") if (root / name).exists()]
        config = grub_config(board, initramfs=len(kernel) > 1)
        boot_extents = filesystem.make(
            tools, boot, BOOT.size, _boot_nodes(kernel), kind="ext2", label="boot", uuid=_UUIDS["boot"],
            epoch=epoch,
        )  # fmt: skip
        core = grub_core(board, tools, out, config)
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


def grub_config(board: Board, *, initramfs: bool) -> bytes:
    """What GRUB does on a card of the board."""
    import jinja2  # here, because the next robot's card does not need it

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    text: str = environment.from_string(_GRUB_TEMPLATE.read_text()).render(
        board=board, slots=SLOTS, kernel_arguments=kernel_arguments(board), initramfs=initramfs
    )
    return text.encode()


def _boot_nodes(kernel: list[Path]) -> list[Node]:
    return [
        Node(PurePosixPath("/grub")),
        Node(PurePosixPath("/grub/grubenv"), ENVIRONMENT_BLOCK, 0o644),
        Node(PurePosixPath("/A")),
        *(Node(PurePosixPath("/A") / file.name, file.read_bytes(), 0o644) for file in kernel),
        Node(PurePosixPath("/B")),
    ]


def grub_core(board: Board, tools: Tools, out: Path, config: bytes) -> bytes:
    """GRUB's core image, made in the directory `out`. It starts the watchdog before it reads anything.

    The configuration is inside it: where it lies, nothing is ever written, and GRUB stands still on some damaged ones.
    """
    core, begin, inside = out / "core.img", out / "begin.cfg", out / "memdisk.tar"
    start = board.watchdog and board.watchdog.start
    lines = [f"outb {start.port} {start.value}"] if start else []
    begin.write_text("".join(f"{line}\n" for line in [*lines, "configfile (memdisk)/grub.cfg"]))
    with tarfile.open(inside, "w", format=tarfile.USTAR_FORMAT) as archive:
        member = tarfile.TarInfo("grub.cfg")
        member.size = len(config)
        archive.addfile(member, io.BytesIO(config))
    modules = tools.directory / "usr/lib/grub/i386-pc"
    tools.run(
        "usr/bin/grub-mkimage", "-O", "i386-pc", "-d", modules, "-c", begin,
        "-m", inside, "-p", "(,msdos1)/grub",  # in this order: a memdisk moves the prefix into itself
        "-o", core, *_GRUB_MODULES.split(),
    )  # fmt: skip
    content = core.read_bytes()
    for file in (core, begin, inside):
        file.unlink()
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
