"""A card's own boot loader in QEMU, and the states of the card that it is started with.

MBR, GRUB's core image and the boot state are the card's; in both slots lies `stub_kernel.S` as kernel and initramfs,
with a header. A state of the card is a set of changed bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flotilla.fleet.model import Board
from flotilla.images import card, environment_block
from flotilla.lab.qemu.stub_computer import GAVE_UP, START_SECONDS, StubComputer, assemble_stub, slot_of

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
        gpt = self.head[512:520] == b"EFI PART"
        (self.disk_id,) = struct.unpack_from("<I", self.head, 512 + 56 if gpt else 440)
        """The card's identifier."""
        self.stub = assemble_stub(directory, release=False)
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
        return environment_block.make(values | changed, card.HEADER_BYTES)

    def write(self, disk: Path, head: bytes | None = None) -> None:
        """Write the card to a file; `head`: instead of its own bytes before the first partition."""
        with disk.open("wb") as file:
            file.truncate(card.SIZE)
            file.write((head or self.head) + self.state)
            for offset, content in self.slots.items():
                file.seek(offset)
                file.write(content)

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


class BootLoader(StubComputer):
    """Reset for each state."""

    def __init__(
        self,
        board: Board,
        stubbed: StubCard,
        directory: Path,
        *,
        unreadable: Sequence[int] = (),
        head: bytes | None = None,
        first: Path | None = None,
    ) -> None:
        """`unreadable`: offsets on the card of sectors that fail when read; `head`: instead of the card's; `first`:
        another disk, before the card."""
        directory.mkdir(parents=True, exist_ok=True)
        self.board = board
        self.disk_id = stubbed.disk_id
        self._disk = directory / "disk"
        stubbed.write(self._disk, head)
        self._before: dict[int, bytes] = {}
        self._tries = stubbed.state[: card.TRIES + card.SECTOR]  # what GRUB itself writes
        sectors = [offset // card.SECTOR for offset in unreadable]
        super().__init__(board, self._disk, directory, unreadable=sectors, first=first)

    def start(self, state: State) -> Started:
        """Reset the computer with the card in this state, and wait for what comes of it."""
        begin = len(self.console.text)
        self.plant(state)
        found = self.console.expect(rf"stub kernel: (.*?)\r?\nstub kernel ends|{GAVE_UP}", START_SECONDS)
        arguments = found[1] or ""
        return Started(slot_of(arguments), arguments, self.console.text[begin:])

    def plant(self, state: State) -> None:
        """Reset the computer with the card in this state."""
        self.stop()
        with self._disk.open("r+b") as disk:
            for changes in (self._before, {card.STATE.start: self._tries} | dict(state)):
                kept = {}
                for offset, content in changes.items():
                    disk.seek(offset)
                    kept[offset] = disk.read(len(content))
                    disk.seek(offset)
                    disk.write(content)
            self._before = dict(reversed(kept.items()))
        self.reset()

    def read(self, offset: int, length: int) -> bytes:
        """Bytes of the card as the last start left them."""
        with self._disk.open("rb") as disk:
            disk.seek(offset)
            return disk.read(length)
