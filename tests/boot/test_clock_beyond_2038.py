"""A robot whose battery clock says 2040: Debian's programs have 32-bit times on i386."""

from __future__ import annotations

import pytest

from flotilla.lab.qemu.saved import BOOT_SECONDS
from tests.boot.guests import nothing_failed, sh
from tests.conftest import GuestFactory

WITH_A_TASK = 1


@pytest.mark.nightly  # a boot; what is compiled for robots is compiled with long times in test_long_times.py
def test_a_robot_with_a_clock_of_2040_runs_its_tasks(fresh_guest: GuestFactory) -> None:
    """Seen to fail: `no disk with root partition … appeared`, and a panic, at each boot."""
    robot = fresh_guest(WITH_A_TASK, boot=False, qemu_options={"extra": ("-rtc", "base=2040-01-01T00:00:00")})
    robot.machine.on()
    robot.machine.console.expect("the clock is beyond 2037, and was set back", BOOT_SECONDS)
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    assert sh(robot, "date +%Y") < "2038"
    assert sh(robot, "systemctl is-active flotilla-task@heading") == "active"
    nothing_failed(robot)
