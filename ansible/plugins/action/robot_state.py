"""The station's half of `robot_state`: says what the robot should be, by the code that makes card images."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import ActionBase
from flotilla.apps import assigned
from flotilla.common.errors import UserError
from flotilla.fleet.apps import BuiltApp
from flotilla.robot import apps, health, provision, release

KEEP = [
    "/etc/mtab",  # made by systemd at boot
    "/etc/systemd/system/flotilla-app@*",  # of apps: `library/robot_state.py` looks at them as parts of those
    "/etc/systemd/system/multi-user.target.wants/flotilla-app@*",
]
"""What a robot has in its layer of /etc besides, as shell patterns."""
TASK = "flotilla-task@"


class ActionModule(ActionBase):  # type: ignore[misc]  # Ansible has no types
    """Result `state`: what `library/robot_state.py` found, each drift with the `role` that repairs it.

    `wanted`: what the inventory says. `release_drift`: in words, how root, kernel or runtime differ from the image's.
    `faults`: by role, what is wrong besides files. `up_to_date`: there is no drift and no fault. `app_actions`: what
    the role `apps` has to do. `by_hand`: words on apps that the robot has beside the inventory's. `unhealthy`: what the
    variable `health` does not permit of what control tasks say of themselves.
    """

    _supports_check_mode = True
    _requires_connection = True

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> dict[str, Any]:
        super().run(tmp, task_vars)
        task_vars = task_vars or {}
        place = Path(task_vars["inventory_dir"]), task_vars["inventory_hostname"]
        try:
            fleet, robot = provision.robot(*place)
            built = assigned.built(fleet, [robot])[robot.name]
            files = provision.files(*place, built)
            policy = health.policy(task_vars.get("health", {}))
        except UserError as error:
            raise AnsibleActionFail(str(error)) from error
        arguments = {
            "expected": {
                path: {"sha256": hashlib.sha256(content).hexdigest(), "mode": mode}
                for path, (content, mode) in files.items()
            },
            "keep": KEEP,
            "interface": fleet.interface(robot),
            "control_tasks": robot.control_tasks,
            "apps": {app.name: _described(app) for app in built},
            "required_sensors": policy.required_sensors,
        }
        result: dict[str, Any] = self._execute_module("robot_state", arguments, task_vars=task_vars)
        if "state" in result:
            state = result["state"]
            wanted = {
                "name": robot.name,
                "interface": arguments["interface"],
                "addresses": [f"{robot.address}/{fleet.network.subnet.prefixlen}"],
                "subnet": str(fleet.network.subnet),
                "machine": fleet.boards[robot.board].machine,
                "uarts": sorted(
                    port.tty for port in fleet.boards[robot.board].ports.values() if port.tty.startswith("ttyS")
                ),
            }
            for found in state["drift"]:
                found["role"] = provision.role_of(found["path"])
            judged = apps.judge(robot.number, state["apps"], built)
            faults = _faults(state, wanted) | {"apps": judged.faults}
            if judged.notes:
                result["warnings"] = [f"{robot.name}: {note}" for note in judged.notes]
            result |= {
                "wanted": wanted,
                "faults": faults,
                "app_actions": judged.actions,
                "by_hand": judged.notes,
                "up_to_date": not state["drift"] and not any(faults.values()),
                "unhealthy": health.complaints(state["tasks"], policy),
                "release_drift": _release_drift(state["release"], release.wanted(robot)),
            }
        return result


def _release_drift(found: dict[str, Any] | None, wanted: str | None) -> str:
    """In words, how the release that runs differs from that of the robot's image here; empty where it does not."""
    if not found or not found["running"] or not wanted:  # in a container, or without an image
        return ""
    runs = found["slots"][found["running"]]
    if runs["blob"] == wanted:
        return ""
    return (
        f"runs release {runs['release']} with kernel {runs['kernel']} and content {runs['blob'][:16]}, its image here "
        f"is {wanted[:16]}: make bundle, make update"
    )


def _described(app: BuiltApp) -> dict[str, Any]:
    """An app as the robot should have it."""
    return {
        "version": app.version,
        "files": {path: {"sha256": sha256, "mode": mode} for path, (sha256, mode) in app.hashes.items()},
    }


def _faults(state: dict[str, Any], wanted: dict[str, Any]) -> dict[str, list[str]]:
    """What is wrong besides files, in words, by the role that repairs it."""
    name, addresses = state["hostname"], state["addresses"]
    down = {is_task: [unit for unit in state["down"] if unit.startswith(TASK) == is_task] for is_task in (True, False)}
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
