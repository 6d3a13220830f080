"""A computer that `make accept WATCHDOG=1` hangs: its watchdog restarts it, and it answers again."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from flotilla.fleet.model import Fleet
from flotilla.lab.acceptance import checks, facts
from tests.boot.guests import PENTIUM, nothing_failed, sh
from tests.conftest import GuestFactory


@pytest.mark.nightly  # two boots for one answer; each time, test_boot_loader.py has QEMU's watchdog bite
def test_a_hang_ends_by_the_watchdog(fresh_guest: GuestFactory, fleet: Fleet, tmp_path: Path) -> None:
    """Seen to fail where QEMU's watchdog does nothing, as it does while nobody asks."""
    guest = fresh_guest(PENTIUM)
    sh(guest, "systemctl is-system-running --wait", check=False)
    guest.machine.execute("watchdog-set-action", action="reset")
    found = facts.ask(fleet, guest.robot, guest.shell, tmp_path, plan=None, seconds=1, bite=True)
    assert found.bite_s is not None
    assert math.isfinite(found.bite_s)
    guest.machine.execute("watchdog-set-action", action="none")
    assert not checks.judge(fleet, guest.robot, found, "none").failures
    sh(guest, "systemctl is-system-running --wait", check=False)
    nothing_failed(guest)
