"""Where a boot spends its (virtual) time: initialisation calls and silences of the kernel, units, the critical path.

A measurement of its own, because the kernel is asked to report every initialisation call, which itself takes time.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from images.builder import progress
from images.builder.fleet import Board
from tests.latency import machine, results, subject

ARGUMENTS = ("initcall_debug", "log_buf_len=1M")
COMMANDS = {
    "dmesg": ["dmesg"],
    "blame": ["systemd-analyze", "--no-pager", "blame"],
    "chain": ["systemd-analyze", "--no-pager", "critical-chain"],
}
_LINE = re.compile(r"\[\s*(\d+\.\d+)\] (.*)")
_INITCALL = re.compile(r"initcall (\S+) returned -?\d+ after (\d+) usecs")
_MOST = 12
_TIMEOUT_S = 600


@dataclass(frozen=True, order=True)
class Share:
    """A part of the boot."""

    seconds: float
    name: str


def measure(board: Board, out: Path) -> str:
    """Boot once; the account of it in words."""
    measured = subject.build(board)
    out.mkdir(parents=True, exist_ok=True)
    initrd = out / "initrd.img"
    subject.write_initrd(measured, initrd, {"scenarios": [], "commands": COMMANDS}, {}, machine.results_tty(board))
    guest = machine.Machine(board, measured.kernel, initrd, (*measured.arguments(), *ARGUMENTS))
    with progress.step(f"boot of {board.name} with its {board.kernel} kernel"):
        document = results.received(guest.run(out, _TIMEOUT_S))
    initrd.unlink()
    return account(board, document)


def account(board: Board, document: dict[str, Any]) -> str:
    boot, said = document["boot"], document["commands"]
    kernel_s, whole_s = boot["userspace_us"] / 1e6, boot["finished_us"] / 1e6
    until_userspace = [line for line in lines(said["dmesg"]) if line[0] <= kernel_s]
    return "\n".join(
        [
            f"{board.name}, {document['release']}: virtual seconds, at {1000 // machine.INSTRUCTION_NS} million "
            "instructions a second; the root comes from memory, and the kernel reports each initialisation call",
            f"{kernel_s:8.3f} kernel, until the first program of the root",
            f"{whole_s - kernel_s:8.3f} user space, until everything has started",
            f"{boot['first_step_us'] / 1e6:8.3f} from the start to the first SCHED_FIFO period of a service",
            "\nkernel, longest initialisation calls:",
            *_table(initcalls(said["dmesg"])),
            "\nkernel, longest times between two messages, by the later one:",
            *_table(silences(until_userspace)),
            "\nuser space, longest units:",
            *said["blame"].splitlines()[:_MOST],
            "\nuser space, critical path:",
            *[line for line in said["chain"].splitlines() if line.strip()],
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
