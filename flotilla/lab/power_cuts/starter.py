"""A computer in QEMU that is reset for each state of its card, and says which release its boot loader started.

Boot loader and card are real, the kernels are those of `releases.py`.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from flotilla.fleet.model import Board
from flotilla.lab.power_cuts.write_log import SECTOR
from flotilla.lab.qemu.stub_computer import GAVE_UP, START_SECONDS, StubComputer, slot_of

_STARTED = r"stub kernel: release (\S+) (whole|TORN) (whole|TORN) (.*?)\r?\nstub kernel ends"
_BIOS_GAVE_UP = r"No bootable device|Boot failed"

Content = Mapping[int, bytes]
"""Bytes of sectors, by number."""


@dataclass(frozen=True, slots=True)
class Started:
    """What came of a power-on."""

    slot: str | None
    """None: the boot loader gave up."""
    release: str | None
    """The one of which the kernel is."""
    whole: bool
    """The kernel and its initramfs were loaded whole."""


class Starter(StubComputer):
    """Reset for each state."""

    def __init__(
        self,
        board: Board,
        base: Path,
        directory: Path,
        unreadable: Iterable[int] = (),
        log_writes: Path | None = None,
    ) -> None:
        """`base`: the card of which states are changes; `unreadable`: sectors that fail when read.

        With `log_writes`, what the computer writes goes to `base` itself, and to this log.
        """
        directory.mkdir(parents=True, exist_ok=True)
        self._base = base
        self._disk = directory / "disk"
        if log_writes is None:
            subprocess.run(["cp", "--sparse=always", str(base), str(self._disk)], check=True)
        else:
            self._disk.unlink(missing_ok=True)
            self._disk.hardlink_to(base)
        self._planted: Content = {}
        self.reads = directory / "reads.log"
        """QEMU's trace of what the computer read of the card."""
        trace = ("-trace", f"enable=blk_co_preadv,file={self.reads}")
        super().__init__(board, self._disk, directory, unreadable=unreadable, log_writes=log_writes, extra=trace)

    def plant(self, content: Content, own: Iterable[int]) -> None:
        """Make the card the base with this content, while the computer stands still.

        `own`: sectors that the boot loader writes by itself.
        """
        own = set(own)
        end = self._base.stat().st_size // SECTOR  # what is behind is Linux's to read
        content = {sector: data for sector, data in content.items() if sector < end}
        with self._base.open("rb") as base, self._disk.open("r+b") as disk:
            for sector in (self._planted.keys() | own) - content.keys():
                base.seek(sector * SECTOR)
                disk.seek(sector * SECTOR)
                disk.write(base.read(SECTOR).ljust(SECTOR, b"\0"))
            for sector, data in content.items():
                if sector in own or self._planted.get(sector) is not data:  # equal contents are one object
                    disk.seek(sector * SECTOR)
                    disk.write(data)
        self._planted = content

    def power_on(self) -> Started:
        """Start the computer with its card as it is, and wait for what comes of it."""
        self.reset()
        found = self.console.expect(f"{_STARTED}|{GAVE_UP}|{_BIOS_GAVE_UP}", START_SECONDS)
        self.stop()  # one that gave up would start again and again
        return Started(slot_of(found[4]), found[1], found[2] == found[3] == "whole")

    def sectors_read(self) -> set[int]:
        """All sectors of the card that the computer has read since it was made."""
        places = re.findall(r"blk_co_preadv .*? offset (\d+) bytes (\d+)", self.reads.read_text())
        return {
            sector
            for offset, length in places
            for sector in range(int(offset) // SECTOR, -(-(int(offset) + int(length)) // SECTOR))
        }
