"""A computer in QEMU that is reset for each state of its card, and says which release its boot loader started.

Boot loader and card are real, the kernels are those of `releases.py`: a second for each start. Time is virtual, so
waiting takes none, and a slow host makes no difference.
"""

from __future__ import annotations

import json
import re
import socket
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from flotilla.fleet.model import Board
from lab.power_cuts.write_log import SECTOR
from lab.qemu import qemu
from lab.qemu.console import SerialConsole
from lab.qemu.process import Emulator

START_SECONDS = 120
"""Limit for what takes one second on an idle host."""
_STARTED = r"stub kernel: release (\S+) (whole|TORN) (whole|TORN) (.*?)\r?\nstub kernel ends"
_GAVE_UP = r"no slot can be loaded|slot .* does not boot|grub rescue>|grub>"
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


class Starter:
    """Use it as a context manager."""

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
        file: dict[str, object] = {"driver": "file", "filename": str(self._disk)}
        if rules := [
            {"event": "none", "iotype": "read", "sector": sector, "errno": 5} for sector in sorted(unreadable)
        ]:
            file = {"driver": "blkdebug", "image": file, "inject-error": rules}
        blockdev: dict[str, object] = {"driver": "raw", "cache": {"no-flush": True}, "file": file}
        if log_writes is not None:
            blockdev = qemu.logged(blockdev, log_writes)
        blockdev |= {"node-name": "card"}
        ours, theirs = socket.socketpair()
        self.console = SerialConsole(directory / "console.log", lambda: self._emulator.explain())
        self.reads = directory / "reads.log"
        """QEMU's trace of what the computer read of the card."""
        options = qemu.Options(
            console=qemu.inherited_socket(theirs.fileno()),
            paused=True,
            virtual_time=True,
            extra=("-trace", f"enable=blk_co_preadv,file={self.reads}"),
        )

        def argv(qmp: str) -> list[str]:
            words = qemu.command_line(board, self._disk, options)
            words[words.index("-blockdev") + 1] = json.dumps(blockdev)
            return [*words, "-chardev", qemu.chardev("qmp", qmp), "-mon", "chardev=qmp,mode=control"]

        with theirs:
            self._emulator = Emulator(argv, directory, inherited=[theirs.fileno()])
        self.console.attach(ours)

    def __enter__(self) -> Starter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._emulator.kill()
        self.console.close()
        self._disk.unlink()

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
        self._emulator.execute("system_reset")
        self._emulator.execute("cont")
        found = self.console.expect(f"{_STARTED}|{_GAVE_UP}|{_BIOS_GAVE_UP}", START_SECONDS)
        self._emulator.execute("stop")  # one that gave up would start again and again
        slot = re.search(r"flotilla\.slot=(\w+)", found[4] or "")
        return Started(slot and slot[1], found[1], found[2] == found[3] == "whole")

    def sectors_read(self) -> set[int]:
        """All sectors of the card that the computer has read since it was made."""
        places = re.findall(r"blk_co_preadv .*? offset (\d+) bytes (\d+)", self.reads.read_text())
        return {
            sector
            for offset, length in places
            for sector in range(int(offset) // SECTOR, -(-(int(offset) + int(length)) // SECTOR))
        }
