"""The station's half of `robot_state`: says what the robot should be, by the code that makes card images."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import ActionBase

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))  # the project

from images.builder import health, provision
from images.builder.errors import UserError

KEEP = [
    "/etc/mtab",  # made by systemd at boot
    "/etc/systemd/system/flotilla-app@*",  # made by `make deploy`
    "/etc/systemd/system/multi-user.target.wants/flotilla-app@*",  # with KEEP=1
]
"""What a robot has in its layer of /etc besides, as shell patterns."""
TASK = "flotilla-task@"


class ActionModule(ActionBase):  # type: ignore[misc]  # Ansible has no types
    """Result `state`: what `library/robot_state.py` found, each drift with the `role` that mends it; `wanted`: what the
    inventory says; `faults`: by role, what is wrong besides files; `up_to_date`: nothing is to be mended; `unhealthy`:
    what the variable `health` does not permit of what control tasks say of themselves.
    """

    _supports_check_mode = True
    _requires_connection = True

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> dict[str, Any]:
        super().run(tmp, task_vars)
        task_vars = task_vars or {}
        place = Path(task_vars["inventory_dir"]), task_vars["inventory_hostname"]
        try:
            fleet, robot = provision.robot(*place)
            files = provision.files(*place)
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
            faults = _faults(state, wanted)
            result |= {
                "wanted": wanted,
                "faults": faults,
                "up_to_date": not state["drift"] and not any(faults.values()),
                "unhealthy": health.complaints(state["tasks"], policy),
            }
        return result


def _faults(state: dict[str, Any], wanted: dict[str, Any]) -> dict[str, list[str]]:
    """What is wrong besides files, in words, by the role that mends it."""
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
