"""The station's half of `robot_files`: of the drift that `robot_state` found, repairs what its role looks after.

It asks nothing of a robot where nothing drifted, so an up-to-date robot costs a single round trip in all.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import ActionBase
from flotilla.apps import assigned
from flotilla.robot import answers, provision

PRIVATE = "(private)\n"


class ActionModule(ActionBase):  # type: ignore[misc]  # Ansible has no types
    """Needs `robot`, the registered result of `robot_state`.

    `then`: a shell command that makes files take effect, and repairs the other faults of its role.
    `apps`: whether the role is that of the apps. Those are put right before the files are written: an app's listing
    comes when the app is there, and goes when the app is gone.
    Result `paths`: the files that were, or would be, repaired.
    """

    _supports_check_mode = True
    _requires_connection = True

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> dict[str, Any]:
        super().run(tmp, task_vars)
        task_vars = task_vars or {}
        role = self._task._role.get_name()
        drift = [found for found in task_vars["robot"]["state"]["drift"] if found["role"] == role]
        faults = task_vars["robot"]["faults"].get(role, [])
        result: dict[str, Any] = {"changed": bool(drift or faults), "paths": [found["path"] for found in drift]}
        if not result["changed"]:
            return result
        place = Path(task_vars["inventory_dir"]), task_vars["inventory_hostname"]
        fleet, robot = provision.robot(*place)
        built = assigned.built(fleet, [robot])[robot.name]
        files = provision.files(*place, built)
        if unknown := [found["path"] for found in drift if found["action"] == "write" and found["path"] not in files]:
            raise AnsibleActionFail(f"{robot.name} asks for {', '.join(unknown)}, which it should not have")
        result["diff"] = [
            {
                "before_header": f"{found['path']} {found['why']}",
                "after_header": found["path"],
                "before": found["before"],
                "after": _after(found, files),
            }
            for found in drift
        ]
        result["diff"] += [{"before_header": "now", "before": f"{fault}\n", "after": ""} for fault in faults]
        if self._task.check_mode:
            return result
        paths = {
            action: [found["path"] for found in drift if found["action"] == action]
            for action in ("write", "remove", "restore")
        }
        written = {
            path: {"content": base64.b64encode(files[path][0]).decode(), "mode": files[path][1]}
            for path in paths["write"]
        }
        arguments = paths | {"write": written, "then": self._task.args.get("then", "true")}
        arguments["before"] = []
        if self._task.args.get("apps"):
            arguments["before"] = assigned.repairs(task_vars["robot"]["app_actions"], built)
        result |= answers.outcome(self._execute_module("robot_files", arguments, task_vars=task_vars))
        return result


def _after(found: dict[str, Any], files: dict[str, tuple[bytes, int]]) -> str:
    """What a person is shown of the file as it will be."""
    if found["action"] == "restore":
        return "(as in the image)\n"
    content, mode = files.get(found["path"], (b"", 0o644))
    return content.decode(errors="replace") if mode & 0o004 else PRIVATE
