"""One run of a guest in virtual time: from power on until it reboots, which ends QEMU.

The command line was tried to repeat to the byte: no default devices, one thread, a fixed seed and clock, translated
code that never has to be thrown away (`tb-size`), and outputs that are files, since pipes made runs differ. QEMU
records the run (`rr`) for the lock that this takes, not for the record, which goes nowhere: without it, the main loop
may find the processor halted before the instructions up to there are counted, and skips idle time from too early on.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import cache, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.debian import pool, tools
from flotilla.debian.lock import Lock, read_lock
from flotilla.fleet.model import Board
from flotilla.lab.qemu import qemu

INSTRUCTION_NS = 8
"""Virtual time of one instruction, `-icount shift=3`: 125 million instructions per second."""


_PROGRAMS = {"i386": "usr/libexec/qemu-system-i386", "x86_64": "usr/bin/qemu-system-x86_64"}
"""By the board's `qemu.system`; Debian's usr/bin/qemu-system-i386 is a script that starts the former."""


CONSOLE = "console.log"
RELAYS = ("-chardev", "null,id=relays", "-device", "isa-parallel,iobase=0x300,chardev=relays")
"""What can be written and read back at the relay board's first register: a printer port's data register."""
"""Where in a run's directory the guest's console stays."""
_ISA = ("ttyS0", "ttyS1", "ttyS2", "ttyS3")


@dataclass(frozen=True)
class Emulator:
    """QEMU as the lock `emulator` has it, run from where it is unpacked: the same one on every computer."""

    lock: Lock
    tree: Path

    def command(self, board: Board) -> list[str]:
        """What runs it, with its own firmware."""
        shared = self.tree / "usr/share"
        argv = tools.command(self.tree, _PROGRAMS[board.qemu.system])
        return [*argv, "-L", str(shared / "qemu"), "-L", str(shared / "seabios")]

    @property
    def environment(self) -> dict[str, str]:
        """Debian's QEMU loads parts of itself, the emulation of processors among them."""
        return {**os.environ, "QEMU_MODULE_DIR": str(self.tree / "usr/lib/x86_64-linux-gnu/qemu")}

    def version(self, name: str) -> str:
        """Of one of its packages."""
        return next(package.version for package in self.lock.packages if package.name == name)


def emulator() -> Emulator:
    """The locked QEMU, unpacked; downloaded where the pool lacks it."""
    lock = read_lock("emulator")
    with cache.exclusive():
        pool.fill([lock])
        return Emulator(lock, tools.tree(lock))


@dataclass(frozen=True)
class Machine:
    """A board, and what it boots."""

    emulator: Emulator
    board: Board
    kernel: Path
    initrd: Path
    arguments: tuple[str, ...]
    """Kernel command line."""
    disk: Path | None = None
    """A raw image as IDE disk. With one, results do not repeat: the host decides when it answers."""
    extra: tuple[str, ...] = ()
    """Further arguments of QEMU, such as devices that the board does not have by itself."""
    shift: int = 3
    """An instruction takes 2**shift ns of virtual time."""
    modules: bool = True
    """Whether the root's modules are the kernel's."""

    def run(self, directory: Path, timeout_s: float) -> bytes:
        """What the guest wrote to its `results_port`; `console.log` and `qemu.command` stay in `directory`.

        `timeout_s`: seconds of the host's clock.
        """
        argv = self.command_line(directory / CONSOLE, directory / "results")
        return execute(self.emulator, argv, directory, timeout_s)

    def command_line(self, console: Path, results: Path) -> list[str]:
        """The whole command; all but the results' connector and the console leads nowhere."""
        board = self.board
        argv = self.emulator.command(board)
        argv += ["-name", "latency", "-nodefaults", "-no-user-config", "-display", "none"]
        argv += ["-machine", f"{board.qemu.machine},usb=off,hpet=off", "-cpu", board.qemu.cpu]
        argv += ["-m", str(board.qemu.memory_mib), "-accel", "tcg,thread=single,tb-size=1024"]
        recorded = "" if self.disk else ",rr=record,rrfile=/dev/null"
        argv += [
            "-icount",
            f"shift={self.shift},sleep=off{recorded}",
            "-rtc",
            "base=2026-01-01T00:00:00,clock=vm",
            "-seed",
            "1",
        ]
        argv += ["-kernel", str(self.kernel), "-initrd", str(self.initrd), "-append", " ".join(self.arguments)]
        argv += ["-no-reboot", "-device", f"{board.qemu.network},id=nic,mac=52:54:00:f1:00:01,romfile="]
        if self.disk:
            drive = {"driver": "raw", "node-name": "disk", "file": {"driver": "file", "filename": str(self.disk)}}
            argv += ["-blockdev", json.dumps(drive), "-device", "ide-hd,drive=disk,bus=ide.0,unit=0"]
        argv += qemu.console(board, _file(console))
        for name, identifier in qemu.port_ids(board).items():
            end = _file(results) if name == results_port(board, modules=self.modules) else qemu.NULL
            argv += ["-chardev", qemu.chardev(identifier, end)]
        for device in board.qemu.devices:
            argv += ["-device", device]
        return [*argv, *self.extra]


def card_command_line(emulator: Emulator, board: Board, card: Path, console: Path, results: Path) -> list[str]:
    """The machine that boots a card through its own boot loader. Its figures do not repeat: it has a disk.

    While the guest waits for the disk, the clock goes as the host's: skipping that time would count it many times over.
    """
    ports = {results_port(board): _file(results)}
    options = qemu.Options(console=_file(console), ports=ports, reboot=False, virtual_time=True)
    argv = qemu.command_line(board, card, options)[1:]
    return [*emulator.command(board), *(word.replace(",sleep=off", ",sleep=on") for word in argv)]


def execute(emulator: Emulator, argv: list[str], directory: Path, timeout_s: float) -> bytes:
    """Run a guest until it reboots; what it wrote to `results` in `directory`, where `console.log` stays, too."""
    with started(emulator, argv, directory) as process:
        return ended(process, directory, timeout_s)


@contextmanager
def started(emulator: Emulator, argv: list[str], directory: Path) -> Iterator[subprocess.Popen[str]]:
    """A guest that runs, at most as long as the body does."""
    (directory / "results").unlink(missing_ok=True)
    (directory / "qemu.command").write_text(shlex.join(argv) + "\n")
    progress.command(argv)
    with subprocess.Popen(
        [*DIE_WITH_PARENT, *argv],
        env=emulator.environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen[str], directory: Path, timeout_s: float) -> bytes:
    """Wait until a guest reboots; what it wrote to `results` in `directory`."""
    console = directory / CONSOLE
    try:
        _, said = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        raise UserError(f"the guest did not end within {timeout_s:g} s; {_tail(console)}") from None
    if process.returncode:
        raise UserError(f"QEMU ended with status {process.returncode}: {said.strip()}")
    content = (directory / "results").read_bytes()
    if not content:
        raise UserError(f"the guest ended without results; {_tail(console)}")
    return content


def results_port(board: Board, *, modules: bool = True) -> str:
    """The connector whose output is `results`: the last one, which nothing else is plugged into.

    Without modules, the last of those whose driver every kernel has built in.
    """
    names = [name for name in qemu.port_ids(board) if modules or board.ports[name].tty in _ISA]
    if not names:
        raise UserError(
            f"group_vars/board_{board.name}.yml: board.ports: {', '.join(board.ports) or '(none)'}: results leave a "
            "guest by a serial port that is not the console's; add one, and its chardev in board.qemu.devices"
        )
    return names[-1]


def without_paths(argv: Sequence[str]) -> str:
    """A command line without what differs from one computer to another."""
    return " ".join(re.sub(r"""(^|[="])/[^\s",]*""", r"\1PATH", word) for word in argv)


def _file(path: Path) -> str:
    return f"file,path={str(path).replace(',', ',,')}"


def _tail(console: Path) -> str:
    lines = console.read_text(errors="replace").splitlines() if console.exists() else []
    return f"the end of {paths.shown(console)}:\n" + "\n".join(lines[-30:])
