"""The air between simulated radios (mac80211_hwsim), in C: within one guest, or between guests in lock-step."""

from __future__ import annotations

from pathlib import Path

from flotilla.debian import runtime
from flotilla.fleet.model import System

HERE = Path(__file__).parent
_CHANNEL, _DRIVER = "channel.c", "hwsim.c"
ONE_GUEST = (_CHANNEL, _DRIVER, "one_guest.c")
"""Carries frames between the radios of one guest."""
MEMBER = (_DRIVER, "member.c")
"""Of each guest in lock-step."""
CONDUCTOR = (_CHANNEL, "conductor.c")
"""Of their host."""
BARRIER = ("barrier.c",)
"""Of QEMU."""
WIRE = ("wire.c",)
"""Of QEMU: who sends from a guest's cable."""
MAILBOX_BYTES = 1 << 20
"""As lockstep.h has it."""


def compiled(sources: tuple[str, ...], system: System) -> bytes:
    """A shared object of these."""
    options = ["-std=gnu11", *runtime.WARNINGS, "-fvisibility=hidden"]
    return runtime.compile_shared(HERE, sources, system, options)
