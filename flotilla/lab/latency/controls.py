"""Negative controls: faults planted for the gate to find. What a gate is worth shows by what it notices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

from flotilla.debian import kernel
from flotilla.fleet.model import Board
from flotilla.lab.latency.scenarios import Command

DELAY_US = 300
_MODULE = "preemptirq_delay_test"
_BURST = 10
"""Delays in a row, with a gap of a few instructions: longer than a period, so that none falls between two wake-ups."""
_TRIGGER = f"while sleep 0.1; do echo 1 >/sys/kernel/{_MODULE}/trigger; done"


@dataclass(frozen=True)
class Control:
    """What is wrong with the system that is measured; by default nothing."""

    kernel: str | None = None
    """Instead of the system's own, `BOARD-kernel` of kernel/. The root's modules are not for it: what it has built
    in must do."""
    delay: Literal["irq", "preempt"] | None = None
    """What the kernel's own test module switches off for DELAY_US at a time: interrupts or preemption."""

    def files(self, board: Board, directory: PurePosixPath) -> dict[str, bytes]:
        """What it needs in `directory` of the guest. The image has no such module, the kernel's package does."""
        if not self.delay:
            return {}
        return {str(directory / f"{_MODULE}.ko"): kernel.board_kernel(board).file(f"*/{_MODULE}.ko")}

    def commands(self, directory: PurePosixPath) -> dict[str, list[str]]:
        """What runs in the guest before the scenarios."""
        if not self.delay:
            return {}
        settings = [f"test_mode={self.delay}", f"delay={DELAY_US}", f"burst_size={_BURST}"]
        return {"plant": ["insmod", str(directory / f"{_MODULE}.ko"), *settings]}

    @property
    def load(self) -> tuple[Command, ...]:
        """What runs beside every scenario; above its load, so that the fault occurs however busy the system is."""
        return (("chrt", "--fifo", "1", "sh", "-c", _TRIGGER),) if self.delay else ()


NOTHING = Control()
NO_RT = Control(kernel="no-rt")
"""The same kernel without PREEMPT_RT."""
