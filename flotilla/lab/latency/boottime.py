"""Where a boot spends its (virtual) time, and how long a real-time task has to wait for its first period.

With a disk, figures do not repeat to the byte: the host decides when it answers. They have bounds.
"""

from __future__ import annotations

import itertools
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from flotilla.common import progress
from flotilla.fleet.model import Board
from flotilla.images import card
from flotilla.images.filesystem import Node
from flotilla.lab.latency import machine, results, subject
from flotilla.lab.qemu import qemu

ARGUMENTS = ("initcall_debug", "log_buf_len=1M")
COMMANDS = {
    "dmesg": ["dmesg"],
    "show": ["systemctl", "show"],
    "blame": ["systemd-analyze", "--no-pager", "blame"],
    "chain": ["systemd-analyze", "--no-pager", "critical-chain"],
}
_PLAN: dict[str, Any] = {"scenarios": [], "commands": COMMANDS}
_ON_CARD = PurePosixPath("/var/lib/latency")
"""Of the measurement's own files, on the data partition."""
_LINE = re.compile(r"\[\s*(\d+\.\d+)\] (.*)")
_INITCALL = re.compile(r"initcall (\S+) returned -?\d+ after (\d+) usecs")
_MOST = 12
_TIMEOUT_S = 600


@dataclass(frozen=True, order=True)
class Share:
    """A part of the boot."""

    seconds: float
    name: str


@dataclass(frozen=True)
class Boots:
    """What two boots of a board's system said."""

    board: Board
    card: dict[str, Any]
    """From a card as it is shipped, but for a task and this measurement on its data partition."""
    memory: dict[str, Any]
    """Without boot loader and disk, and every initialisation call of the kernel reported, which itself takes time."""

    @property
    def first_step_s(self) -> float:
        """From the boot loader's end to the first SCHED_FIFO period of a service.

        When GRUB ended nobody says, but the kernel that it loaded unpacks itself as it does in memory, where but for
        the BIOS's part nothing else comes before its clock.
        """
        return float(self.memory["boot"]["before_kernel_us"] + self.card["boot"]["first_step_us"]) / 1e6


def measure(board: Board, out: Path) -> Boots:
    measured, emulator = subject.build(board), machine.emulator()
    out.mkdir(parents=True, exist_ok=True)
    with progress.step(f"boot of {board.name} with its {board.kernel} kernel from a card"):
        card_boot = results.received(_boot_card(measured, emulator, out))
    initrd = out / "initrd.img"
    subject.write_initrd(measured, initrd, _PLAN, {})
    guest = machine.Machine(emulator, board, measured.kernel, initrd, (*measured.arguments(), *ARGUMENTS))
    with progress.step(f"boot of {board.name} with its {board.kernel} kernel from memory"):
        memory_boot = results.received(guest.run(out, _TIMEOUT_S))
    initrd.unlink()
    return Boots(board, card_boot, memory_boot)


def _boot_card(measured: subject.Subject, emulator: machine.Emulator, out: Path) -> bytes:
    """The very card of a robot, through its boot loader; what is added came with its identity."""
    board, made = measured.board, measured.made
    image, overlay = out / "card.img", out / "card.qcow2"
    files = {str(_ON_CARD / name): file for name, file in subject.measurement(board, _PLAN).items()}
    files |= {f"/A/etc/systemd/system/{name}": (0o644, text) for name, text in subject.units(board, _ON_CARD).items()}
    with tempfile.TemporaryDirectory(dir=out) as work:
        nodes = subject.identity_nodes(board, Path(work) / "keys")
        present = {node.path for node in nodes}
        parents = {parent for path in files for parent in PurePosixPath(path).parents} - present - {PurePosixPath("/")}
        nodes += [Node(path) for path in parents]
        nodes += [Node(PurePosixPath(path), content, mode) for path, (mode, content) in files.items()]
        card.begin(made.base, image)
        card.complete(made.board, made.tools, image, sorted(nodes, key=lambda node: node.path.parts), made.lock.epoch)
    qemu.make_overlay(image, overlay, qemu.CARD_BYTES)
    argv = machine.card_command_line(emulator, board, overlay, out / "console.log", out / "results")
    found = machine.execute(emulator, argv, out, _TIMEOUT_S)
    image.unlink()
    overlay.unlink()
    return found


def timeline(document: dict[str, Any]) -> list[Share]:
    """What a boot went through one after the other, from the start of the kernel's clock."""
    outputs = document["commands"]
    stamps = {
        name: int(value) / 1e6 for name, value in re.findall(r"^(\w+)TimestampMonotonic=(\d+)$", outputs["show"], re.M)
    }
    kernel_s = next(at for at, text in lines(outputs["dmesg"]) if text.startswith("Run "))
    marks = [
        ("kernel, until its first program", kernel_s),
        ("preinit: data partition and layers", stamps["Userspace"]),
        ("systemd, until its generators", stamps["GeneratorsStart"]),
        ("generators", stamps["GeneratorsFinish"]),
        ("unit files", stamps["UnitsLoadFinish"]),
        ("until the first SCHED_FIFO period of a service", document["boot"]["first_step_us"] / 1e6),
        ("until everything has started", stamps["Finish"]),
    ]
    return [Share(round(at - before, 6), name) for (_, before), (name, at) in itertools.pairwise([("", 0.0), *marks])]


def account(boots: Boots) -> str:
    board, shipped, outputs = boots.board, boots.card["boot"], boots.memory["commands"]
    kernel_s = boots.memory["boot"]["userspace_us"] / 1e6
    return "\n".join(
        [
            f"{board.name}, {boots.card['release']}: virtual seconds, at {1000 // machine.INSTRUCTION_NS} million "
            "instructions a second",
            f"\nfrom a card as shipped: {boots.first_step_s:.3f} from the boot loader's end to the first SCHED_FIFO "
            f"period of a service, {(shipped['before_kernel_us'] + shipped['first_step_us']) / 1e6:.3f} from power on",
            f"{shipped['before_kernel_us'] / 1e6:8.3f} BIOS, boot loader, unpacking of the kernel; the latter without "
            f"a boot loader: {boots.memory['boot']['before_kernel_us'] / 1e6:.3f}",
            *[f"{share.seconds:8.3f} {share.name}" for share in timeline(boots.card)],
            "\nuser space, longest units:",
            *boots.card["commands"]["blame"].splitlines()[:_MOST],
            "\nuser space, critical path:",
            *[line for line in boots.card["commands"]["chain"].splitlines() if line.strip()],
            "\nfrom memory, kernel, longest initialisation calls:",
            *_table(initcalls(outputs["dmesg"])),
            "\nfrom memory, kernel, longest times between two messages, by the later one:",
            *_table(silences([line for line in lines(outputs["dmesg"]) if line[0] <= kernel_s])),
        ]
    )


def lines(dmesg: str) -> list[tuple[float, str]]:
    """Seconds and text of each message."""
    return [(float(match[1]), match[2]) for line in dmesg.splitlines() if (match := _LINE.match(line))]


def initcalls(dmesg: str) -> list[Share]:
    return [Share(int(match[2]) / 1e6, match[1]) for match in _INITCALL.finditer(dmesg)]


def silences(messages: list[tuple[float, str]]) -> list[Share]:
    return [Share(round(after[0] - before[0], 6), after[1]) for before, after in itertools.pairwise(messages)]


def _table(shares: list[Share]) -> list[str]:
    return [f"{share.seconds:8.3f} {share.name[:100]}" for share in sorted(shares, reverse=True)[:_MOST]]
