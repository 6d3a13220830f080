"""Cards of the first layout, and how software would be updated on them: mistakes that the replay must find.

That layout had a boot partition (ext2) with the kernels of both slots, and one environment block, a file on it. MBR and
GRUB are the locked ones, the configuration is that of then; only the partitions are smaller.
"""

from __future__ import annotations

import io
import struct
import tarfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

import jinja2

from flotilla.debian.tools import Tools
from flotilla.fleet.model import Board
from flotilla.images import environment_block, filesystem
from flotilla.images.filesystem import BLOCK, Node
from flotilla.lab.power_cuts.releases import Release
from flotilla.lab.power_cuts.replay import Recording
from flotilla.lab.power_cuts.timeline import Read
from flotilla.lab.power_cuts.write_log import SECTOR, LogWriter

MIB = 1 << 20
_DISK = 0x464C4F54
_BOOT, _A, _B, _END = MIB, 9 * MIB, 10 * MIB, 11 * MIB
_MODULES = """
    biosdisk part_msdos ext2 memdisk tar linux normal configfile loadenv test true echo serial terminal sleep reboot
    iorw
"""
_ENV = "/grub/grubenv"
_WRITE = 128 * 1024
"""Bytes that a kernel writes at once to an IDE disk."""

Mistake = Literal["in place", "truncated", "mounted kernel"]
"""`in place`: one environment block, each write in its place and flushed, as the robots of then did. `truncated`: its
file is truncated before it is written, as grub-editenv does. `mounted kernel`: the new kernel goes to a mounted file
system, and nothing waits for it."""


class Layout1:
    """What the boot chain reads of such a card: all of it but the slots, which GRUB 2.06 cannot read."""

    always: Sequence[range] = (range(_A // SECTOR),)
    slots: Mapping[str, int] = {"A": _A // SECTOR, "B": _B // SECTOR}
    loaded: Mapping[str, Sequence[range]] = {}

    def __init__(self, damaged: Sequence[range]) -> None:
        self.damaged = damaged

    def startable(self, slot: str, read: Read) -> bool:
        return True


class Card:
    """A card with a release in slot A, and what becomes of it when another one is brought to B."""

    def __init__(self, board: Board, tools: Tools, directory: Path, release: Release) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._tools = tools
        self._release = release
        self._directory = directory
        self._boot = directory / "boot"
        nodes = [
            Node(PurePosixPath("/grub")), Node(PurePosixPath(_ENV), _environment("A B", a="10", b="00"), 0o644),
            Node(PurePosixPath("/A")), Node(PurePosixPath("/A/vmlinuz"), release.kernel, 0o644),
            Node(PurePosixPath("/A/initrd.img"), release.initramfs, 0o644), Node(PurePosixPath("/B")),
        ]  # fmt: skip
        uuid = "5b0e4a3c-6f1d-4c58-9d0a-000000000001"
        filesystem.make(tools, self._boot, _A - _BOOT, nodes, kind="ext2", label="boot", uuid=uuid, epoch=0)
        self.image = directory / "card"
        content = _boot_sector(tools) + _core(board, tools, directory)
        content = content.ljust(_BOOT, b"\0") + self._boot.read_bytes() + release.root
        self.image.write_bytes(content.ljust(_END, b"\0"))

    def update(self, release: Release, out: Path, mistake: Mistake) -> Recording:
        """An update to B, its first start, its confirmation, and a start after that. `out`: for the log."""
        phases = []
        with LogWriter(out) as log:
            phases.append((log.number, frozenset({"old"})))
            for at in range(0, len(release.root), _WRITE):
                log.write((_B + at) // SECTOR, release.root[at : at + _WRITE])
            log.flush()
            files = {"vmlinuz": release.kernel, "initrd.img": release.initramfs}
            for name, content in files.items():
                source = self._directory / name
                source.write_bytes(content)
                self._written(log, f"write {source} /B/{name}")
            if mistake != "mounted kernel":
                log.flush()
            phases.append((log.number, frozenset({"old", "new"})))
            self._environment(log, _environment("B A", a="10", b="10"), mistake)
            self._environment(log, _environment("B A", a="10", b="11"), "in place")  # the first start
            self._environment(log, _environment("B A", a="10", b="10"), mistake)  # its confirmation
            phases.append((log.number, frozenset({"new"})))
            self._environment(log, _environment("B A", a="10", b="11"), "in place")
            self._environment(log, _environment("B A", a="10", b="10"), mistake)
        releases = {self._release.name: {"A": self._release.root}, release.name: {"B": release.root}}
        # Even where programs make no mistake, this layout does not survive damage: then that is not what is found.
        layout = Layout1([range(_END // SECTOR)] if mistake == "in place" else [])
        return Recording(self.image, out, layout, releases, phases, range(_BOOT // SECTOR, _A // SECTOR))

    def _environment(self, log: LogWriter, content: bytes, mistake: Mistake) -> None:
        if mistake == "truncated":
            self._written(log, f"sif {_ENV} size 0")
        place = int(self._tools.run("usr/sbin/debugfs", "-R", f"bmap {_ENV} 0", self._boot)) * BLOCK
        log.write((_BOOT + place) // SECTOR, content)
        with self._boot.open("r+b") as boot:
            boot.seek(place)
            boot.write(content)
        if mistake == "truncated":
            self._written(log, f"sif {_ENV} size {len(content)}")
        log.flush()

    def _written(self, log: LogWriter, command: str) -> None:
        """What a command of debugfs(8) changes, as writes."""
        before = self._boot.read_bytes()
        self._tools.run("usr/sbin/debugfs", "-w", "-R", command, self._boot)
        after = self._boot.read_bytes()
        changed = [at for at in range(0, len(after), BLOCK) if after[at : at + BLOCK] != before[at : at + BLOCK]]
        for start, end in _runs(changed):
            log.write((_BOOT + start) // SECTOR, after[start:end])


def _runs(places: Iterable[int]) -> Iterator[tuple[int, int]]:
    """Blocks that follow each other, as one range of bytes up to what a kernel writes at once."""
    start = end = -1
    for place in places:
        if place != end or end - start >= _WRITE:
            if end > start:
                yield start, end
            start = place
        end = place + BLOCK
    if end > start:
        yield start, end


def _environment(order: str, a: str, b: str) -> bytes:
    """Of each slot OK and TRY."""
    values = {"ORDER": order, "A_OK": a[0], "A_TRY": a[1], "B_OK": b[0], "B_TRY": b[1]}
    return environment_block.make(values, 1024)


def _core(board: Board, tools: Tools, directory: Path) -> bytes:
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(Path(__file__).with_name("layout_1.cfg.j2").read_text())
    slots = [{"name": name, "partuuid": f"{_DISK:08x}-{number:02}"} for number, name in ((2, "A"), (3, "B"))]
    config = template.render(board=board, slots=slots, kernel_arguments=["quiet"], initramfs=True).encode()
    core, begin, inside = directory / "core.img", directory / "begin.cfg", directory / "memdisk.tar"
    begin.write_text("configfile (memdisk)/grub.cfg\n")
    with tarfile.open(inside, "w", format=tarfile.USTAR_FORMAT) as archive:
        member = tarfile.TarInfo("grub.cfg")
        member.size = len(config)
        archive.addfile(member, io.BytesIO(config))
    tools.run(
        "usr/bin/grub-mkimage", "-O", "i386-pc", "-d", tools.directory / "usr/lib/grub/i386-pc", "-c", begin,
        "-m", inside, "-p", "(,msdos1)/grub", "-o", core, *_MODULES.split(),
    )  # fmt: skip
    return core.read_bytes()


def _boot_sector(tools: Tools) -> bytes:
    code = (tools.directory / "usr/lib/grub/i386-pc/boot.img").read_bytes()[:440]
    entries = b""
    for status, start, end in ((0x80, _BOOT, _A), (0, _A, _B), (0, _B, _END)):
        chs = b"\xfe\xff\xff"  # beyond what CHS can say: LBA counts
        entries += struct.pack("<B3sB3sII", status, chs, 0x83, chs, start // SECTOR, (end - start) // SECTOR)
    return code + struct.pack("<IH", _DISK, 0) + entries.ljust(64, b"\0") + b"\x55\xaa"
