"""A card's own boot loader in QEMU, with a kernel that only says how it was started: a second for each start.

MBR, GRUB's core image and the boot state are the card's; in both slots lies `stub_kernel.S` as kernel and initramfs,
with a header. A state of the card is a set of changed bytes. Time is virtual: waiting takes no time, and a slow host
makes no difference.
"""

from __future__ import annotations

import json
import re
import socket
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from flotilla.fleet.model import Board
from images.builder import card, environment_block, slot
from lab.qemu import qemu
from lab.qemu.console import SerialConsole
from lab.qemu.process import Emulator

START_SECONDS = 120
"""Limit for what takes one second on an idle host."""
_FAILED = r"no slot can be loaded|slot .* does not boot|grub rescue>|grub>"
_KERNEL, _INITRD = 0, 8
"""Where the stub lies in a slot, in sectors."""

State = Mapping[int, bytes]
"""Bytes by their offset on the card."""


@dataclass(frozen=True)
class Started:
    """What came of a start."""

    slot: str | None
    """The slot whose kernel was started; None: GRUB gave up."""
    arguments: str
    """The kernel's command line."""
    said: str
    """All that the console said."""


class StubCard:
    """What the boot loader reads of a card: the card's own up to the slots, and in both slots the stub."""

    def __init__(self, image: Path, directory: Path) -> None:
        """`image`: the card's; `directory`: for files of its own."""
        directory.mkdir(parents=True, exist_ok=True)
        with image.open("rb") as file:
            self.head = file.read(card.STATE.start)
            """The bytes of the card before its first partition."""
            self.state = file.read(card.STATE.size)
            """The boot state of the new card."""
        self.stub = _stub(directory).read_bytes()
        self.stub += bytes(-len(self.stub) % card.SECTOR)

    @property
    def slots(self) -> State:
        """Both slots: a stub in each, with the arguments of robots' kernels."""
        return {
            place: content
            for slot in card.SLOTS
            for place, content in (
                (slot.start + _KERNEL * card.SECTOR, self.stub),
                (slot.start + _INITRD * card.SECTOR, self.stub),
                (header_place(slot), self.header()),
            )
        }

    def header(self, **changed: str) -> bytes:
        """The header of a slot with the stub, with other values for some names."""
        sectors = len(self.stub) // card.SECTOR
        values = {
            "RELEASE": "1",
            "KERNEL": f"{_KERNEL}+{sectors}",
            "INITRD": f"{_INITRD}+{sectors}",
            "ARGUMENTS": "quiet a=b",
        }
        return environment_block.make(values | changed, slot.HEADER_BYTES)

    def with_core(self, core: bytes) -> bytes:
        """The bytes before the first partition, with another core image."""
        return (self.head[:512] + core).ljust(len(self.head), b"\0")


def header_place(slot: card.Partition) -> int:
    """Where on the card the header of a slot lies."""
    return slot.end - card.HEADER_ROOM


def kernel_place(slot: card.Partition) -> int:
    """Where on the card the stub lies as the kernel of a slot."""
    return slot.start + _KERNEL * card.SECTOR


def initrd_place(slot: card.Partition) -> int:
    """Where on the card the stub lies as the initramfs of a slot."""
    return slot.start + _INITRD * card.SECTOR


class BootLoader:
    """A computer that is reset for each state. Use it as a context manager."""

    def __init__(
        self,
        board: Board,
        stubbed: StubCard,
        directory: Path,
        *,
        unreadable: Sequence[int] = (),
        head: bytes | None = None,
    ) -> None:
        """`unreadable`: offsets on the card of sectors that fail when read; `head`: instead of the card's."""
        directory.mkdir(parents=True, exist_ok=True)
        self._disk = directory / "disk"
        with self._disk.open("wb") as disk:
            disk.truncate(card.SIZE)
            disk.write((head or stubbed.head) + stubbed.state)
            for offset, content in stubbed.slots.items():
                disk.seek(offset)
                disk.write(content)
        self._before: dict[int, bytes] = {}
        self._tries = stubbed.state[: card.TRIES + card.SECTOR]  # what GRUB itself writes
        file: dict[str, object] = {"driver": "file", "filename": str(self._disk)}
        if unreadable:
            sectors = [offset // card.SECTOR for offset in unreadable]
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
            for changes in (self._before, {card.STATE.start: self._tries} | dict(state)):
                kept = {}
                for offset, content in changes.items():
                    disk.seek(offset)
                    kept[offset] = disk.read(len(content))
                    disk.seek(offset)
                    disk.write(content)
            self._before = dict(reversed(kept.items()))
        self._emulator.execute("system_reset")
        self._emulator.execute("cont")

    def read(self, offset: int, length: int) -> bytes:
        """Bytes of the card as the last start left them."""
        with self._disk.open("rb") as disk:
            disk.seek(offset)
            return disk.read(length)

    def execute(self, command: str, **arguments: object) -> Any:
        """A QMP command."""
        return self._emulator.execute(command, **arguments)

    def wait_event(self, name: str, timeout: float) -> dict[str, object]:
        """A QMP event, such as WATCHDOG."""
        return self._emulator.wait_event(name, timeout)


def _stub(directory: Path) -> Path:
    kernel, linked = directory / "stub_kernel", directory / "stub_kernel.o"
    source = Path(__file__).with_name("stub_kernel.S")
    for argv in (
        ["as", "--32", "-o", str(linked), str(source)],
        ["objcopy", "-O", "binary", "-j", ".text", str(linked), str(kernel)],
    ):
        subprocess.run(argv, check=True, capture_output=True, text=True)
    return kernel
