"""What `ansible/library/robot_state.py` is asked about a robot, and what is wrong by its answer, in words."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flotilla.fleet import privileges
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Fleet, Health, Robot
from flotilla.robot import provision

_KEEP = [
    "/etc/mtab",  # made by systemd at boot
    "/etc/systemd/system/flotilla-app@*",  # of apps: `library/robot_state.py` looks at them as parts of those
    "/etc/systemd/system/multi-user.target.wants/flotilla-app@*",
]
"""What a robot has in its layer of /etc besides, as shell patterns."""
_TASK = "flotilla-task@"


def arguments(directory: Path, fleet: Fleet, robot: Robot, built: Sequence[BuiltApp], policy: Health) -> dict[str, Any]:
    """Of `robot_state`. `directory`: the inventory's; `built`: the robot's apps."""
    files = provision.files(directory, robot.name, built)
    return {
        "expected": {
            path: {"sha256": hashlib.sha256(content).hexdigest(), "mode": mode}
            for path, (content, mode) in files.items()
        },
        "keep": _KEEP,
        "interface": fleet.interface(robot),
        "control_tasks": robot.control_tasks,
        "apps": {app.name: _described(app) for app in built},
        "required_sensors": policy.required_sensors,
    }


def _described(app: BuiltApp) -> dict[str, Any]:
    """An app as the robot should have it."""
    return {
        "version": app.version,
        "files": {path: {"sha256": sha256, "mode": mode} for path, (sha256, mode) in app.hashes.items()},
    }


def wanted(fleet: Fleet, robot: Robot) -> dict[str, Any]:
    """What a robot should be by the inventory, besides files."""
    board = fleet.boards[robot.board]
    return {
        "name": robot.name,
        "interface": fleet.interface(robot),
        "addresses": [f"{robot.address}/{fleet.network.subnet.prefixlen}"],
        "subnet": str(fleet.network.subnet),
        "machine": board.machine,
        "uarts": sorted(port.tty for port in board.ports.values() if port.tty.startswith("ttyS")),
        "users": privileges.task_users(len(robot.control_tasks)),
    }


def faults(state: dict[str, Any], wanted: dict[str, Any]) -> dict[str, list[str]]:
    """What is wrong besides files and apps, in words, by the role that repairs it."""
    name, addresses = state["hostname"], state["addresses"]
    down = {is_task: [unit for unit in state["down"] if unit.startswith(_TASK) == is_task] for is_task in (True, False)}
    return {
        "identity": [f"host name {name}"] if name != wanted["name"] else [],
        "network": [f"address {', '.join(addresses)}"] if addresses != wanted["addresses"] else [],
        "firewall": [] if state["firewall_is_loaded"] else ["the rules in force are others"],
        "realtime": [f"{key} = {value}, not {right}" for key, value, right in state["sysctl"]],
        "runtime": [f"{unit} does not run" for unit in down[False]],
        "control_tasks": [
            *(f"{unit} does not run" for unit in down[True]),
            *(f"{unit} runs, but is not the robot's" for unit in state["superfluous_tasks"]),
        ],
    }


def release_drift(found: dict[str, Any] | None, wanted: str | None) -> str:
    """In words, how the release that runs differs from that of the robot's image here; empty where it does not.

    `found`: what `flotilla-slot show` says.
    """
    if not found or not found["running"] or not wanted:  # in a container, or without an image
        return ""
    runs = found["slots"][found["running"]]
    if runs["blob"] == wanted:
        return ""
    return (
        f"runs release {runs['release']} with kernel {runs['kernel']} and content {str(runs['blob'])[:16]}, its image "
        f"here is {wanted[:16]}: make bundle, make update"
    )
