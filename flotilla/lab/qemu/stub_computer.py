"""A computer in QEMU whose boot loader is real and whose kernel only says how it was started: a second for each start.

Its card is a plain file, which changes while the computer stands still. Time is virtual: waiting takes none, and a slow
host makes no difference.
"""

from __future__ import annotations

import json
import re
import socket
import subprocess
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flotilla.fleet.model import Board
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.console import SerialConsole
from flotilla.lab.qemu.process import Emulator

START_SECONDS = 600
"""Limit for what takes one second on an idle host."""
GAVE_UP = r"no slot can be loaded|slot .* does not boot|grub rescue>|grub>"
"""What the console shows when the boot loader starts nothing."""


class StubComputer:
    """Paused until its first reset. Use it as a context manager; at the end its disk is removed."""

    def __init__(
        self,
        board: Board,
        disk: Path,
        directory: Path,
        *,
        unreadable: Iterable[int] = (),
        log_writes: Path | None = None,
        extra: tuple[str, ...] = (),
        first: Path | None = None,
    ) -> None:
        """`disk`: file with the card's content; `unreadable`: sectors that fail when read.

        `log_writes`: log of what the computer writes; `extra`: further arguments of QEMU; `first`: a file with the
        content of another disk, from which the firmware boots if it can.
        """
        self._disk = disk
        blockdev = _blockdev(disk, unreadable, log_writes)
        ours, theirs = socket.socketpair()
        self.console = SerialConsole(directory / "console.log", lambda: self._emulator.explain())
        options = qemu.Options(
            console=qemu.inherited_socket(theirs.fileno()), paused=True, virtual_time=True, extra=extra
        )

        def argv(qmp: str) -> list[str]:
            words = qemu.command_line(board, disk, options)
            words[words.index("-blockdev") + 1] = json.dumps(blockdev)
            if first:
                words = [word.replace("bootindex=0", "bootindex=1") for word in words]
                words += ["-drive", f"if=none,id=first,format=raw,snapshot=on,file={first}"]
                words += ["-device", "ide-hd,drive=first,bootindex=0"]
            return [*words, "-chardev", qemu.chardev("qmp", qmp), "-mon", "chardev=qmp,mode=control"]

        with theirs:
            self._emulator = Emulator(argv, directory, inherited=[theirs.fileno()])
        self.console.attach(ours)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._emulator.kill()
        self.console.close()
        self._disk.unlink()

    def stop(self) -> None:
        """Halt the computer: the moment to change its disk."""
        self._emulator.execute("stop")

    def reset(self) -> None:
        """Start the computer with its disk as it is."""
        self._emulator.execute("system_reset")
        self._emulator.execute("cont")

    def execute(self, command: str, **arguments: object) -> Any:
        """A QMP command."""
        return self._emulator.execute(command, **arguments)

    def wait_event(self, name: str, timeout: float) -> dict[str, object]:
        """A QMP event, such as WATCHDOG."""
        return self._emulator.wait_event(name, timeout)


def slot_of(arguments: str | None) -> str | None:
    """The slot that a kernel's command line names."""
    found = re.search(r"flotilla\.slot=(\w+)", arguments or "")
    return found and found[1]


def assemble_stub(directory: Path, *, release: bool) -> bytes:
    """The kernel; `release`: one that also says which release it is, as `flotilla.lab.power_cuts.releases` does."""
    return assemble("stub_kernel", directory, *(["--defsym", "RELEASE=1"] if release else []))


def assemble(name: str, directory: Path, *options: str) -> bytes:
    """The bytes of a program of this directory. `directory`: for files of its own."""
    linked, program = directory / f"{name}.o", directory / name
    source = Path(__file__).with_name(f"{name}.S")
    for argv in (
        ["as", "--32", *options, "-o", str(linked), str(source)],
        ["objcopy", "-O", "binary", "-j", ".text", str(linked), str(program)],
    ):
        subprocess.run(argv, check=True, capture_output=True, text=True)
    return program.read_bytes()


def _blockdev(disk: Path, unreadable: Iterable[int], log_writes: Path | None) -> dict[str, object]:
    """The card as QEMU's block device."""
    file: dict[str, object] = {"driver": "file", "filename": str(disk)}
    rules = [{"event": "none", "iotype": "read", "sector": sector, "errno": 5} for sector in sorted(unreadable)]
    if rules:
        file = {"driver": "blkdebug", "image": file, "inject-error": rules}
    node: dict[str, object] = {"driver": "raw", "cache": {"no-flush": True}, "file": file}
    if log_writes is not None:
        node = qemu.logged(node, log_writes)
    return node | {"node-name": "card"}
