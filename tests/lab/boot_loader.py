"""A card's own boot loader in QEMU, with a kernel that only says how it was started: a second for each start.

MBR, GRUB's core image and the boot partition are the card's; in the place of each slot's kernel and initramfs lies
`stub_kernel.S`. A state of the card is a set of changed bytes. Time is virtual: waiting takes no time, and a slow host
makes no difference.
"""

from __future__ import annotations

import json
import re
import socket
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from images.builder import card, qemu
from images.builder.fleet import Board
from images.builder.tools import Tools
from tests.lab.console import SerialConsole
from tests.lab.emulator import Emulator

START_SECONDS = 120
"""Limit for what takes one second on an idle host."""
_BLOCK = 4096
_FAILED = r"no slot can be loaded|slot .* does not boot|grub rescue>|grub>"

State = Mapping[int, bytes]
"""Bytes by their offset on the boot partition."""


@dataclass(frozen=True)
class Started:
    """What came of a start."""

    slot: str | None
    """The slot whose kernel was started; None: GRUB gave up."""
    arguments: str
    """The kernel's command line."""
    said: str
    """All that the console said."""


class BootPartition:
    """The boot partition of a card, with the stub in both slots, and states of it."""

    def __init__(self, image: Path, tools: Tools, directory: Path) -> None:
        """`image`: the card's; `directory`: for files of its own."""
        directory.mkdir(parents=True, exist_ok=True)
        self._tools = tools
        self._directory = directory
        self.head = _head(image)
        """The bytes of the card before the partition."""
        self._file = directory / "boot"
        with image.open("rb") as file:
            file.seek(card.BOOT.start)
            self._file.write_bytes(file.read(card.BOOT.size))
        self._stub = _stub(directory)
        self._debugfs(
            f"rm /{slot}/{name}\nwrite {self._stub} /{slot}/{name}\n"
            for slot in ("A", "B")
            for name in ("vmlinuz", "initrd.img")
        )
        self.content = self._file.read_bytes()

    def with_core(self, core: bytes) -> bytes:
        """The bytes of the card before the partition, with another core image."""
        return (self.head[:512] + core).ljust(len(self.head), b"\0")

    def changed(self, *commands: str) -> State:
        """The state after these commands of debugfs(8)."""
        self._file.write_bytes(self.content)
        self._debugfs(f"{command}\n" for command in commands)
        after = self._file.read_bytes()
        starts = range(0, len(after), _BLOCK)
        return {
            start: after[start : start + _BLOCK]
            for start in starts
            if after[start : start + _BLOCK] != self.content[start : start + _BLOCK]
        }

    def place(self, path: str) -> int:
        """Offset of a file's first block on the partition."""
        self._file.write_bytes(self.content)
        return int(self._tools.run("usr/sbin/debugfs", "-R", f"bmap {path} 0", self._file)) * _BLOCK

    def with_file(self, path: str, content: bytes) -> State:
        """The state in which a file has this content, in new blocks."""
        return self.changed(f"rm {path}", f"write {self.file(content)} {path}")

    def file(self, content: bytes) -> Path:
        """A file for debugfs to write."""
        other = self._directory / "file"
        other.write_bytes(content)
        return other

    def _debugfs(self, commands: Iterable[str]) -> None:
        script = self._directory / "script"
        script.write_text("".join(commands))
        self._tools.run("usr/sbin/debugfs", "-w", "-f", script, self._file)


class BootLoader:
    """A computer that is reset for each state. Use it as a context manager."""

    def __init__(
        self,
        board: Board,
        partition: BootPartition,
        directory: Path,
        *,
        unreadable: Sequence[int] = (),
        head: bytes | None = None,
    ) -> None:
        """`unreadable`: offsets on the partition of sectors that fail when read; `head`: instead of the card's."""
        directory.mkdir(parents=True, exist_ok=True)
        self._partition = partition
        self._disk = directory / "disk"
        with self._disk.open("wb") as disk:
            disk.truncate(card.SIZE)
            disk.write((head or partition.head) + partition.content)
        self._planted: set[tuple[int, int]] = set()
        file: dict[str, object] = {"driver": "file", "filename": str(self._disk)}
        if unreadable:
            sectors = [(card.BOOT.start + offset) // 512 for offset in unreadable]
            rules = [{"event": "none", "iotype": "read", "sector": sector, "errno": 5} for sector in sectors]
            file = {"driver": "blkdebug", "image": file, "inject-error": rules}
        blockdev = {"driver": "raw", "node-name": "card", "cache": {"no-flush": True}, "file": file}
        ours, theirs = socket.socketpair()
        self.console = SerialConsole(directory / "console.log", lambda: self._emulator.explain())
        options = qemu.Options(console=qemu.inherited_socket(theirs.fileno()), paused=True, virtual_time=True)

        def argv(qmp: str) -> list[str]:
            words = qemu.command_line(board, self._disk, options)
            words[words.index("-blockdev") + 1] = json.dumps(blockdev)
            return [*words, "-chardev", qemu.chardev("qmp", qmp), "-mon", "chardev=qmp,mode=control"]

        with theirs:
            self._emulator = Emulator(argv, directory, inherited=[theirs.fileno()])
        self.console.attach(ours)

    def __enter__(self) -> BootLoader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._emulator.kill()
        self.console.close()
        self._disk.unlink()

    def start(self, state: State) -> Started:
        """Reset the computer with the card in this state, and wait for what comes of it."""
        begin = len(self.console.text)
        self.plant(state)
        found = self.console.expect(rf"stub kernel: (.*?)\r?\nstub kernel ends|{_FAILED}", START_SECONDS)
        arguments = found[1] or ""
        slot = re.search(r"flotilla\.slot=(\w+)", arguments)
        return Started(slot and slot[1], arguments, self.console.text[begin:])

    def plant(self, state: State) -> None:
        """Reset the computer with the card in this state."""
        self._emulator.execute("stop")
        with self._disk.open("r+b") as disk:
            for offset, length in self._planted:
                disk.seek(card.BOOT.start + offset)
                disk.write(self._partition.content[offset : offset + length])
            for offset, content in state.items():
                disk.seek(card.BOOT.start + offset)
                disk.write(content)
        self._planted = {(offset, len(content)) for offset, content in state.items()}
        self._emulator.execute("system_reset")
        self._emulator.execute("cont")

    def read(self, offset: int, length: int) -> bytes:
        """Bytes of the boot partition as the last start left them; they are put back by the next."""
        self._planted.add((offset, length))
        with self._disk.open("rb") as disk:
            disk.seek(card.BOOT.start + offset)
            return disk.read(length)

    def wait_event(self, name: str, timeout: float) -> dict[str, object]:
        """A QMP event, such as WATCHDOG."""
        return self._emulator.wait_event(name, timeout)


def _head(image: Path) -> bytes:
    with image.open("rb") as file:
        return file.read(card.BOOT.start)


def _stub(directory: Path) -> Path:
    kernel, linked = directory / "stub_kernel", directory / "stub_kernel.o"
    source = Path(__file__).with_name("stub_kernel.S")
    for argv in (
        ["as", "--32", "-o", str(linked), str(source)],
        ["objcopy", "-O", "binary", "-j", ".text", str(linked), str(kernel)],
    ):
        subprocess.run(argv, check=True, capture_output=True, text=True)
    return kernel
