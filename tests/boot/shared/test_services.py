"""Services of ours, as systemd has them: what each could do to the robot if somebody took it over."""

from __future__ import annotations

import re

from tests.boot.guests import sh
from tests.conftest import RobotGuest

EXPOSURE = 2.5
"""At most, by `systemd-analyze security`: 0 could do nothing, 10 anything."""


def _exposure(robot: RobotGuest, *units: str) -> dict[str, float]:
    said = sh(robot, f"systemd-analyze security --no-pager {' '.join(units)} | grep 'Overall exposure'")
    return {unit: float(level) for unit, level in re.findall(r"level for (\S+): ([0-9.]+)", said)}


def test_no_service_of_ours_may_do_what_it_does_not_need(robot: RobotGuest) -> None:
    """Seen to fail without the drop-in of all of them, and where task and app lacked their own lines."""
    listed = sh(robot, "systemctl list-unit-files --no-legend 'flotilla-*.service'").split("\n")
    units = [line.split()[0].replace("@.", "@any.") for line in listed]
    assert {"flotilla-task@any.service", "flotilla-app@any.service", "flotilla-receive.service"} <= set(units)
    found = _exposure(robot, *units)
    assert set(found) == set(units)
    assert not (exposed := {unit: level for unit, level in found.items() if level > EXPOSURE}), exposed
    assert _exposure(robot, "chrony.service")["chrony.service"] > EXPOSURE, "the figures tell services apart"
