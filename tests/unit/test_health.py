"""What of a task's own report makes a robot unhealthy, and the inventory's word on it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Health
from flotilla.lab.qemu import virtual_fleet as virtual
from flotilla.robot import health

UNIT = "flotilla-task@heading.service"
GYRO = Health(required_sensors=["heading.gyro"])


def tasks(steps: int = 100, overruns: int = 0, **flags: bool) -> dict[str, Any]:
    sensors = {name: {"flag": flag, "age_s": 12.34} for name, flag in flags.items()}
    return {UNIT: {"status": {"sensors": sensors, "lately": {"steps": steps, "overruns": overruns}}}}


@pytest.mark.parametrize(
    ("there", "wanted", "said"),
    [
        (tasks(), Health(), []),
        (tasks(overruns=1), Health(), []),
        (tasks(overruns=2), Health(), ["heading: 2 of the last 100 steps overran, more than 1 %"]),
        (tasks(overruns=1), Health(overruns_percent=0), ["heading: 1 of the last 100 steps overran, more than 0 %"]),
        (tasks(overruns=100), Health(overruns_percent=100), []),
        (tasks(gyro=False, laser=False), Health(), []),
        (tasks(gyro=True, laser=False), GYRO, []),
        (tasks(gyro=False), GYRO, ["heading.gyro: its flag is 0, its last good value 12.3 s old"]),
        (tasks(gyro=False), Health(required_sensors=["other.gyro"]), []),
        (tasks(laser=True), GYRO, ["heading has no sensor gyro; it has laser"]),
        (tasks(), GYRO, ["heading has no sensor gyro; it has none"]),
        ({UNIT: {"status": {"problem": "it sleeps"}}}, Health(), ["heading does not report its status: it sleeps"]),
        ({UNIT: {"status": None}}, GYRO, []),
    ],
)
def test_complaints(there: dict[str, Any], wanted: Health, said: list[str]) -> None:
    """Seen to fail with every silent sensor a fault, and with any overrun one."""
    assert health.complaints({"tasks": there, "data_is_writable": True}, wanted) == said


def test_a_data_partition_that_is_read_only_is_unhealthy() -> None:
    """Seen to fail: such a robot was healthy, and a roll-out went on to the next wave."""
    assert health.complaints({"tasks": tasks(), "data_is_writable": False}, Health()) == [health.READ_ONLY]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"overruns_percent": 101}, r"^health\.overruns_percent: is out of range; 0 to 100"),
        ({"overruns_percent": "1"}, r"^health\.overruns_percent: Input should be a valid number"),
        ({"required_sensors": ["gyro"]}, r"^health\.required_sensors\.0: is not TASK\.BLOCK; .*heading\.gyro"),
        ({"sensors": []}, r"^health\.sensors: Extra inputs"),
        ("good", r"^health: Input should be"),
    ],
)
def test_a_wrong_wish_is_said(given: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        health.policy(given)


def test_guests_are_not_judged_by_their_hosts_time_nor_by_empty_ports(tmp_path: Path) -> None:
    """By the variable as Ansible merges it. Seen to fail without it, and where it is the group's."""
    guests = tmp_path / "guests.yml"
    guests.write_text(virtual.guests_inventory({"robot1": 4711}))
    program = str(Path(sys.executable).with_name("ansible-inventory"))
    argv = [program, "-i", str(paths.INVENTORY), "-i", str(guests), "--host", "robot1"]
    # Ansible refuses a standard error that some ssh before has left non-blocking.
    said = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    wanted = health.policy(json.loads(said)["health"])
    assert health.complaints({"tasks": tasks(overruns=100, gyro=False), "data_is_writable": True}, wanted) == []
