"""Robots as guests that tests ask: shells and Python programs on them, and what every healthy one says."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

from flotilla.fleet import identity
from flotilla.fleet.model import Fleet
from tests.conftest import RobotGuest

PENTIUM = 3
"""The robot that has what only its board has."""
SECONDS = 600
"""Limit for what takes a few on an idle host."""


def label(robot: RobotGuest) -> str:
    """What a figure is about."""
    return f"{robot.board.name} {robot.board.kernel}"


def sh(robot: RobotGuest, script: str, *, check: bool = True, timeout: float = SECONDS) -> str:
    """What a shell script prints as root."""
    return robot.shell.script(script, check=check, timeout=timeout).stdout.strip()


def until(robot: RobotGuest, condition: str) -> None:
    """Wait until a shell command succeeds as root. Only the host's limit ends it: a busy host makes the guest slow."""
    sh(robot, f"until {condition}; do sleep 0.2; done")


def call(robot: RobotGuest, program: ModuleType, *arguments: object, timeout: float = SECONDS) -> Any:
    """What `main` of a module of `probes` returns, which runs there as root; it imports the standard library alone."""
    source = Path(str(program.__file__)).read_text()
    source += "\nimport json, sys\nprint(json.dumps(main(*json.loads(sys.argv[1]))))\n"
    argv = ["sudo", "python3", "-", json.dumps(arguments)]
    return json.loads(robot.shell.run(argv, stdin=source, timeout=timeout).stdout)


def boot_state(robot: RobotGuest) -> dict[str, Any]:
    """What `flotilla-slot show` says."""
    shown: dict[str, Any] = json.loads(sh(robot, "flotilla-slot show"))
    return shown


def tries(robot: RobotGuest) -> list[int]:
    """Of A and B, since the state was written."""
    slots = boot_state(robot)["slots"]
    return [slots[name]["tries"] for name in "AB"]


def nothing_failed(robot: RobotGuest) -> None:
    """No unit did."""
    assert sh(robot, "systemctl --failed --plain --no-legend") == ""
    assert sh(robot, "systemctl is-system-running", check=False) == "running"


def has_its_identity(robot: RobotGuest, fleet: Fleet) -> None:
    """Of the inventory, and nobody else's."""
    assert sh(robot, "hostname") == robot.robot.name
    assert sh(robot, "cat /etc/machine-id") == identity.variables(fleet, robot.robot)["machine_id"]
    for host in identity.hosts(fleet):
        shown = sh(robot, f"getent hosts {host.name}")
        assert str(host.address) in shown.split(), f"{host.name} is {shown!r}, not {host.address}"
