"""A robot that is restored from the state in which it had booted: the same answers as from one that boots."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from flotilla.fleet.model import Fleet
from tests.boot.guests import PENTIUM, boot_state, has_its_identity, nothing_failed, sh
from tests.conftest import GuestFactory, RobotGuest
from tests.figures import PROPERTY

CLOCKS_DIFFER_S = 2
"""At most, between the clock and the battery clock, which counts seconds."""


def answers(robot: RobotGuest, fleet: Fleet) -> dict[str, object]:
    """What has to be the same of both, as the tests of booted robots ask it."""
    has_its_identity(robot, fleet)
    nothing_failed(robot)
    clock, battery_clock = map(int, sh(robot, "echo $(date +%s) $(cat /sys/class/rtc/rtc0/since_epoch)").split())
    assert abs(clock - battery_clock) <= CLOCKS_DIFFER_S
    return {
        "boot state": boot_state(robot),
        "root": sh(robot, "findmnt -n -o SOURCE,FSTYPE,OPTIONS /"),
        "data": sh(robot, "findmnt -n -o SOURCE,FSTYPE,OPTIONS /data"),
        "units": sh(robot, "systemctl list-units --plain --no-legend --state=running | awk '{print $1}' | sort"),
        "listening": sh(robot, "ss -Hlntu | awk '{print $1, $5}' | sort"),
        "firewall": sh(robot, "nft -s list ruleset"),
    }


@pytest.mark.nightly  # a boot of its own; tests/boot/test_lab.py restores a tiny computer each time
def test_it_answers_as_one_that_boots(
    fresh_guest: GuestFactory, fleet: Fleet, record_property: Callable[[str, str], None]
) -> None:
    """Before and after its power is cut, too. Seen to fail where the clock was not set: it was late by the time since
    the state was saved."""
    begun = time.monotonic()
    cold = fresh_guest(PENTIUM, cold=True, label="cold")
    cold_s, cold_processor_s = time.monotonic() - begun, cold.machine.processor_s
    expected = answers(cold, fleet)
    cold.machine.cut()

    begun = time.monotonic()
    robot = fresh_guest(PENTIUM, label="restored")
    sh(robot, "true")
    record_property(
        PROPERTY,
        f"to the first command over SSH: boot {cold_s:.1f} s, {cold_processor_s:.1f} s of processor; "
        f"restored {time.monotonic() - begun:.1f} s, {robot.machine.processor_s:.1f} s of processor",
    )
    assert "login" not in robot.machine.console.text, "it has booted"
    assert answers(robot, fleet) == expected
    robot.machine.cut()
    robot.machine.on()
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    has_its_identity(robot, fleet)
    nothing_failed(robot)
