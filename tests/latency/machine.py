"""One run of a guest in virtual time: from power on until it reboots, which ends QEMU.

The command line was tried to repeat to the byte: no default devices, one thread, a fixed seed and clock, translated
code that never has to be thrown away (`tb-size`), and outputs that are files, since pipes made runs differ.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from images.builder import paths, progress, qemu
from images.builder.boot import DIE_WITH_PARENT
from images.builder.errors import UserError
from images.builder.fleet import Board

INSTRUCTION_NS = 8
"""Virtual time of one instruction, `-icount shift=3`: 125 million instructions per second."""


@dataclass(frozen=True)
class Machine:
    """A board, and what it boots."""

    board: Board
    kernel: Path
    initrd: Path
    arguments: tuple[str, ...]
    """Kernel command line."""
    disk: Path | None = None
    """A raw image as IDE disk. With one, results do not repeat: the host decides when it answers."""

    def run(self, directory: Path, timeout_s: float) -> bytes:
        """What the guest wrote to its last serial connector; `console.log` and `qemu.command` stay in `directory`.

        `timeout_s`: seconds of the host's clock.
        """
        results, console = directory / "results", directory / "console.log"
        results.unlink(missing_ok=True)
        argv = self.command_line(console, results)
        (directory / "qemu.command").write_text(shlex.join(argv) + "\n")
        progress.command(argv)
        try:
            done = subprocess.run(
                [*DIE_WITH_PARENT, *argv],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                timeout=timeout_s,
            )
        except subprocess.TimeoutExpired:
            raise UserError(f"the guest did not end within {timeout_s:g} s; {_tail(console)}") from None
        if done.returncode:
            raise UserError(f"QEMU ended with status {done.returncode}: {done.stderr.strip()}")
        content = results.read_bytes()
        if not content:
            raise UserError(f"the guest ended without results; {_tail(console)}")
        return content

    def command_line(self, console: Path, results: Path) -> list[str]:
        """The whole command; all but the results' connector and the console leads nowhere."""
        board = self.board
        argv = [qemu.program(board), "-name", "latency", "-nodefaults", "-no-user-config", "-display", "none"]
        argv += ["-machine", f"{board.qemu.machine},usb=off,hpet=off", "-cpu", board.qemu.cpu]
        argv += ["-m", str(board.qemu.memory_mib), "-accel", "tcg,thread=single,tb-size=1024"]
        argv += ["-icount", "shift=3,sleep=off", "-rtc", "base=2026-01-01T00:00:00,clock=vm", "-seed", "1"]
        argv += ["-kernel", str(self.kernel), "-initrd", str(self.initrd), "-append", " ".join(self.arguments)]
        argv += ["-no-reboot", "-device", f"{board.qemu.network},id=nic,mac=52:54:00:f1:00:01,romfile="]
        if self.disk:
            drive = {"driver": "raw", "node-name": "disk", "file": {"driver": "file", "filename": str(self.disk)}}
            argv += ["-blockdev", json.dumps(drive), "-device", "ide-hd,drive=disk,bus=ide.0,unit=0"]
        argv += ["-chardev", qemu.chardev("console", _file(console)), *["-serial", "none"] * int(board.console.tty[4:])]
        argv += ["-serial", "chardev:console"]
        *silent, last = qemu.port_ids(board).values()
        for identifier in silent:
            argv += ["-chardev", qemu.chardev(identifier, qemu.NULL)]
        argv += ["-chardev", qemu.chardev(last, _file(results))]
        for device in board.qemu.devices:
            argv += ["-device", device]
        return argv


def results_tty(board: Board) -> str:
    """Kernel name of the connector that `run` listens to: the last one, which nothing else is plugged into."""
    last = list(qemu.port_ids(board))[-1]
    return board.ports[last].tty


def version(board: Board) -> str:
    """QEMU's version, package revision included: `7.2.22 (Debian 1:7.2+dfsg-7+deb12u18)`."""
    done = subprocess.run([qemu.program(board), "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0].partition(" version ")[2]


def firmware(board: Board) -> Path:
    """The BIOS that QEMU loads: it has a version of its own, and runs before the kernel."""
    done = subprocess.run([qemu.program(board), "-L", "help"], capture_output=True, text=True, check=True)
    for directory in done.stdout.splitlines():
        if (found := Path(directory) / "bios-256k.bin").exists():
            return found
    raise UserError(f"QEMU's BIOS bios-256k.bin is in none of {', '.join(done.stdout.split())}; install seabios")


def without_paths(argv: Sequence[str]) -> str:
    """A command line without what differs from one computer to another."""
    return " ".join(re.sub(r"""(^|[="])/[^\s",]*""", r"\1PATH", word) for word in argv)


def _file(path: Path) -> str:
    return f"file,path={str(path).replace(',', ',,')}"


def _tail(console: Path) -> str:
    lines = console.read_text(errors="replace").splitlines() if console.exists() else []
    return f"the end of {paths.shown(console)}:\n" + "\n".join(lines[-30:])
