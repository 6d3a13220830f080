"""The card: boot loader, boot state, slots A and B, data partition. A file, made without loop device or mount.

All cards of a board are the same up to the data partition, but for the identifier of the disk: `base` makes that part
once, `begin` copies it, `complete` adds a robot's data and identifier. What is in a slot, `slot.py` makes.

| from | what |
|---|---|
| 0 | MBR: GRUB's boot.img, disk identifier, partition table; with UEFI a GPT |
| 512 bytes | GRUB's core image, with every module it needs, and its configuration |
| 1 MiB | with UEFI instead: the system partition (FAT16), in which that image is a program |
| 4 MiB | boot state, raw: tries, and two copies of the state, 4 MiB from each other (runtime/programs/boot_state.h) |
| then | slot A |
| then | slot B (empty until the first update) |
| then | data (ext4): the robot's identity, then all that changes; grows to the card on first boot |
| then | with UEFI: the GPT's copy, which the first boot moves to the end of the card |

`images/boot/card.yml` has the sizes. The identifier is the robot's, so that of two cards in a computer each boots its
own: GRUB reads it from the disk that it came from, and gives the kernel the root partition by it.
"""

from __future__ import annotations

import io
import json
import os
import struct
import tarfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, NamedTuple

import pydantic

from flotilla.common import cache, host, paths, yaml_file
from flotilla.common.errors import UserError
from flotilla.debian.tools import Tools
from flotilla.fleet.model import Board, Integer, between
from flotilla.images import bmap, copying, environment_block, filesystem, uefi
from flotilla.images.filesystem import Node

MIB = 1 << 20
_GRUB_MODULES = (
    "memdisk tar linux normal configfile loadenv test true echo serial terminal sleep reboot iorw regexp probe cpuid"
)


class _Grub(NamedTuple):
    """What GRUB is made of, by the board's firmware."""

    platform: str
    modules: str
    """Beside `_GRUB_MODULES`."""


_GRUB = {"bios": _Grub("i386-pc", "biosdisk part_msdos"), "uefi": _Grub("x86_64-efi", "part_gpt efi_gop")}
_GRUB_TEMPLATE = paths.PROJECT / "images" / "boot" / "grub.cfg.j2"
_LAYOUT = paths.PROJECT / "images" / "boot" / "card.yml"
_DATA_UUID = "5b0e4a3c-6f1d-4c58-9d0a-000000000004"


class Layout(pydantic.BaseModel):
    """What card.yml says."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    layout: Annotated[
        Integer, between(1, 1000, "a number that rises with each change of the card that an update cannot make")
    ]
    """Number of the layout. A robot accepts only updates with its own number."""
    slot_mib: Annotated[Integer, between(32, 16384, unit="MiB")]
    """Size of each of the two slots."""
    data_mib: Annotated[Integer, between(8, 16384, unit="MiB")]
    """Size of the data partition in the image. The first boot extends it to the end of the card."""


LAYOUT = yaml_file.read(_LAYOUT, Layout)
SOURCES = (_GRUB_TEMPLATE, _LAYOUT)
"""The files of images/boot/ that decide a card's bytes."""


@dataclass(frozen=True)
class Partition:
    number: int
    name: str
    start: int
    """Bytes from the start of the card."""
    size: int
    """Bytes."""

    def partuuid(self, board: Board, disk_id: int) -> str:
        """What `root=PARTUUID=` calls it on a card of the board with this identifier."""
        return guid(disk_id, self.number) if board.firmware == "uefi" else f"{disk_id:08x}-{self.number:02}"

    @property
    def end(self) -> int:
        return self.start + self.size


def guid(disk_id: int, number: int) -> str:
    """Of a partition in a GPT; 0: of the card."""
    return f"{disk_id:08x}-0000-4000-8000-{number:012}"


def disk_id(nodes: list[Node]) -> int:
    """The identifier of a robot's card, 32 bits in the MBR or the beginning of each GUID in the GPT: the beginning of
    the robot's machine ID."""
    (machine_id,) = (node.content for node in nodes if node.path == _MACHINE_ID)
    return int(machine_id or b"", 16) >> 96 or 1  # 0: no identifier, for the kernel


REGION = 4 * MIB
"""Each block of the boot state has a region of its own: flash may lose what lies beside a sector that it writes."""
STATE = Partition(1, "state", REGION, 3 * REGION)
_A = Partition(2, "A", STATE.end, LAYOUT.slot_mib * MIB)
SLOTS = [_A, Partition(3, "B", _A.end, LAYOUT.slot_mib * MIB)]
DATA = Partition(4, "data", SLOTS[-1].end, LAYOUT.data_mib * MIB)
SIZE = DATA.end
SYSTEM = Partition(5, "system", MIB, STATE.start - MIB)
"""Where UEFI finds the boot loader. It has the last number, so that all others have the same on every card."""

SECTOR = 512
TRIES = SECTOR
"""Where the tries lie in the partition `STATE`: behind a tar header, by which GRUB finds the sector to write."""
COPIES = [REGION, 2 * REGION]
"""Where the copies of the state lie in it."""

COMMON_ARGUMENTS = ["ro", "rootfstype=squashfs", "init=/usr/lib/flotilla/preinit", "net.ifnames=0", "panic=1",
                    "sysctl.kernel.sysrq=0",
                    "cpufreq.default_governor=performance", "cryptomgr.notests", "noisapnp", "quiet"]  # fmt: skip
"""Kernel command line of every card; the board adds its own.

Self-tests of the kernel's ciphers take two seconds of each boot under emulation, and more on the board; a search for
ISA cards without jumpers takes a third of a second. A panic restarts the robot after a second, because until then its
outputs stay as they are. Without SysRq a break on the serial line and a letter, as a plug or noise makes them, neither
restart nor stop the robot. Debian's kernel takes both for a command, and so does our own."""

HEADER_ROOM, HEADER_BYTES = 4096, 1024
"""Before a slot's end: there its header begins, of so many bytes."""
_TYPES = {"state": 0xDA, "A": 0x83, "B": 0x83, "data": 0x83}
"""Of partitions, in the MBR: 0xDA is data without a file system."""
_GPT_TYPES = {"system": "C12A7328-F81F-11D2-BA4B-00A0C93EC93B"} | dict.fromkeys(
    _TYPES, "0FC63DAF-8483-4772-8E79-3D69D8477DE4"
)
"""Of partitions, in a GPT: UEFI's system partition, and data of Linux, which no other system touches."""
_MACHINE_ID = PurePosixPath("/A/etc/machine-id")
"""In the data partition: 32 hexadecimal digits."""
_MBR_ID = 440
"""Where the identifier lies in an MBR."""
_GPT_HEAD, _GPT_TAIL = 34 * 512, MIB
"""Bytes at the beginning of an image, an MBR that protects it, header and 128 entries; at its end, for their copy."""

Extents = list[tuple[int, int]]
"""Byte ranges (offset, length) of a card that hold anything."""


def partitions(board: Board) -> list[Partition]:
    """Those of a card of the board, in the order in which they lie."""
    if board.firmware == "bios":
        return [STATE, *SLOTS, DATA]
    return [SYSTEM, STATE, *SLOTS, data(board)]


def data(board: Board) -> Partition:
    """The data partition: a GPT has its copy behind it."""
    return DATA if board.firmware == "bios" else replace(DATA, size=DATA.size - _GPT_TAIL)


def kernel_arguments(board: Board) -> list[str]:
    """The command line, but for what GRUB adds for the slot."""
    serial = [f"console={board.console.tty},{board.console.baud}n8"] if board.console else []
    stop = board.watchdog and board.watchdog.stop
    own = [f"flotilla.watchdog_stop={stop.port}:{stop.value:o}"] if stop else []  # for preinit
    return [*COMMON_ARGUMENTS, *_isolation(board), *board.kernel_arguments, *own, "console=tty0", *serial]


def _isolation(board: Board) -> list[str]:
    """What keeps all but control tasks from the isolated processors: services, interrupts, the kernel's callbacks."""
    isolated = ",".join(map(str, board.isolated_processors))
    if not isolated:
        return []
    others = ",".join(str(each) for each in range(board.processors) if each not in board.isolated_processors)
    return [f"isolcpus=managed_irq,domain,{isolated}", f"irqaffinity={others}", f"rcu_nocbs={isolated}"]


def base(board: Board, slot: Path, tools: Tools, epoch: int) -> Path:
    """Directory with `card.img`, everything but the data partition, and `extents.json`.

    `slot`: what `slot.build` made, for slot A.
    """
    key = cache.digest(
        slot.name, tools.directory.name, str(epoch), board.model_dump_json(), *SOURCES, Path(__file__),
        Path(filesystem.__file__), Path(environment_block.__file__), Path(copying.__file__), Path(uefi.__file__),
        paths.PROJECT / "requirements/build.lock",  # jinja2
    )  # fmt: skip

    def make(out: Path) -> None:
        content, header = slot / "slot.img", (slot / "header").read_bytes()
        blocks = [(STATE.start, tries_block())] + [(STATE.start + place, state_copy()) for place in COPIES]
        blocks += [
            (SLOTS[0].end - HEADER_ROOM, header),
            (SLOTS[1].end - HEADER_ROOM, environment_block.make({}, HEADER_BYTES)),
            *boot_loader(board, tools, out, grub_core(board, tools, out, grub_config(board))),
        ]
        with (out / "card.img").open("wb") as card:
            card.truncate(SIZE)
            for place, block in blocks:
                card.seek(place)
                card.write(block)
        size = content.stat().st_size
        copying.copy(content, [(0, size)], out / "card.img", SLOTS[0].start)
        held = [(place, -(-len(block) // SECTOR) * SECTOR) for place, block in blocks]
        (out / "extents.json").write_text(json.dumps(sorted([*held, (SLOTS[0].start, size)])))

    return cache.result("card", key, make)


def boot_loader(board: Board, tools: Tools, work: Path, core: bytes) -> list[tuple[int, bytes]]:
    """What lies before the boot state, and of a GPT behind the data partition: places on the card, and bytes.

    `core`: GRUB's core image. `work`: a directory for what is thrown away.
    """
    if board.firmware == "bios":
        return [(0, _boot_sector(tools)), (SECTOR, core)]
    head, tail = _gpt(board, tools, work / "gpt", 0)
    return [(0, head), (SYSTEM.start, uefi.system_partition(tools, work, SYSTEM.size, core)), (SIZE - len(tail), tail)]


def _gpt(board: Board, tools: Tools, work: Path, disk_id: int) -> tuple[bytes, bytes]:
    """Beginning and end of a card with a GPT. `work`: a file for what is thrown away."""
    lines = ["label: gpt", f"label-id: {guid(disk_id, 0)}", "unit: sectors", "first-lba: 34", "table-length: 128"]
    lines += [
        f"{one.number}: start={one.start // SECTOR}, size={one.size // SECTOR}, name={one.name}, "
        f"type={_GPT_TYPES[one.name]}, uuid={one.partuuid(board, disk_id)}"
        for one in sorted(partitions(board), key=lambda one: one.number)
    ]
    with work.open("wb") as card:
        card.truncate(SIZE)
    tools.run("usr/sbin/sfdisk", "--quiet", "--no-reread", "--no-tell-kernel", work, stdin="\n".join(lines) + "\n")
    with work.open("rb") as card:
        head = card.read(_GPT_HEAD)
        card.seek(-33 * SECTOR, os.SEEK_END)
        tail = card.read()
    work.unlink()
    return head, tail


def tries_block(name: str = "tries") -> bytes:
    """The first sectors of the boot state: a tar header (POSIX.1-1988, ustar), and behind it no tries.

    `name`: of the file; GRUB writes to `tries` alone.
    """
    header = bytearray(SECTOR)
    fields = {0: name, 100: "0000644", 108: "0000000", 116: "0000000", 124: f"{SECTOR:011o}", 136: "0" * 11,
              148: " " * 8, 156: "0", 257: "ustar", 263: "00"}  # fmt: skip
    for place, text in fields.items():
        header[place : place + len(text)] = text.encode()
    header[148:155] = f"{sum(header):06o}\0".encode()
    return bytes(header) + environment_block.make({"FOR": "0"}, SECTOR)


def state_copy(sequence: int = 1, *, order: str = "A B", good: str = "A", trial: str = "") -> bytes:
    """A copy of the state as flotilla-slot writes it; that of a new card: A is good, B is empty."""
    lines = {"SEQ": str(sequence), "ORDER": order, "A_OK": str(int("A" in good)), "B_OK": str(int("B" in good))}
    body = environment_block.lines(lines | {"TRIAL": trial})
    return environment_block.of(body + f"CRC={zlib.crc32(body.encode()):08x}\nEND={sequence}\n", SECTOR)


def extents(base_directory: Path) -> Extents:
    """Where the board's part of a card holds anything: what comes before the first partition, then the partitions."""
    return [(start, length) for start, length in json.loads((base_directory / "extents.json").read_text())]


def begin(base_directory: Path, out: Path, *, past_page_cache: bool = False) -> Extents:
    """Write the card `out` up to the robot's data partition. Only what holds anything is written.

    It is for its owner alone: the data partition holds the robot's private key. `past_page_cache`: see copying.py.
    """
    out.unlink(missing_ok=True)
    out.touch(0o600, exist_ok=False)
    os.truncate(out, SIZE)
    held = extents(base_directory)
    copying.copy(base_directory / "card.img", held, out, past_page_cache=past_page_cache)
    return held


def complete(board: Board, tools: Tools, card: Path, nodes: list[Node], epoch: int) -> Extents:
    """Add the data partition with the robot's files, and its identifier, to a card that `begin` made."""
    identify(board, tools, card, disk_id(nodes))
    return data_partition(board, tools, card, nodes, epoch, DATA.start)


def identify(board: Board, tools: Tools, card: Path, disk_id: int) -> None:
    """Give a card its identifier."""
    changes = [(_MBR_ID, struct.pack("<I", disk_id))]
    if board.firmware == "uefi":
        head, tail = _gpt(board, tools, card.with_suffix(".gpt"), disk_id)
        changes = [(0, head), (SIZE - len(tail), tail)]
    with card.open("r+b") as file:
        for place, content in changes:
            file.seek(place)
            file.write(content)


def without_identifier(ranges: Iterable[bmap.Range]) -> list[bmap.Range]:
    """Of ranges of a board's cards those that are the same on all of them."""
    first, last = _GPT_HEAD // bmap.BLOCK, (SIZE - _GPT_TAIL) // bmap.BLOCK
    return [each for each in ranges if each.first > first and each.last < last]


def data_partition(
    board: Board, tools: Tools, out: Path, nodes: list[Node], epoch: int, start: int | None = None
) -> Extents:
    """Write the data partition with the robot's files, as the file `out`, or so many bytes behind its beginning."""
    # Here, because debugfs does not report a full disk, and the caller removes what fills it.
    with host.explaining_a_full_disk():
        return filesystem.make(
            tools, out, data(board).size, nodes, kind="ext4", label="data", uuid=_DATA_UUID, epoch=epoch, start=start
        )


def grub_config(board: Board) -> bytes:
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
        board=board,
        slots=SLOTS,
        place=lambda partition: f"($disk,{'gpt' if board.firmware == 'uefi' else 'msdos'}{partition.number})",
        state_partition=STATE,
        tries=TRIES // SECTOR,
        copies=[place // SECTOR for place in COPIES],
        header_of=lambda slot: (slot.size - HEADER_ROOM) // SECTOR,
    )
    return text.encode()


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
    grub = _GRUB[board.firmware]
    modules = tools.directory / "usr/lib/grub" / grub.platform
    tools.run(
        "usr/bin/grub-mkimage", "-O", grub.platform, "-d", modules, "-c", begin,
        "-m", inside, "-p", "(memdisk)",  # in this order: a memdisk moves the prefix into itself
        "-o", core, *grub.modules.split(), *_GRUB_MODULES.split(),
    )  # fmt: skip
    content = core.read_bytes()
    for file in (core, begin, inside):
        file.unlink()
    if board.firmware == "bios" and len(content) > STATE.start - SECTOR:
        raise UserError(f"GRUB's core image of {len(content)} bytes does not fit before the first partition")
    return content


def _boot_sector(tools: Tools) -> bytes:
    """MBR: GRUB's first stage (it loads sector 1 on), the identifier, and four partitions by LBA."""
    code = (tools.directory / "usr/lib/grub/i386-pc/boot.img").read_bytes()[:440]
    entries = b""
    for partition in (STATE, *SLOTS, DATA):
        status = 0x80 if partition is STATE else 0
        chs = b"\xfe\xff\xff"  # beyond what CHS can say: LBA counts
        entries += struct.pack(
            "<B3sB3sII", status, chs, _TYPES[partition.name], chs, partition.start // 512, partition.size // 512
        )
    return code + bytes(6) + entries + b"\x55\xaa"  # without an identifier
