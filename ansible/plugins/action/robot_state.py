"""The station's half of `robot_state`: says what the robot should be, by the code that makes card images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import ActionBase
from flotilla.apps import assigned
from flotilla.common.errors import UserError
from flotilla.robot import answers, apps, health, provision, release, state


class ActionModule(ActionBase):  # type: ignore[misc]  # Ansible has no types
    """Result `state`: what `library/robot_state.py` found, each drift with the `role` that repairs it.

    `wanted`: what the inventory says. `release_drift`: in words, how root, kernel or runtime differ from the image's.
    `faults`: by role, what is wrong besides files. `up_to_date`: there is no drift and no fault. `app_actions`: what
    the role `apps` has to do. `by_hand`: words on apps that the robot has beside the inventory's. `unhealthy`: what the
    variable `health` does not permit of what control tasks report, and a data partition that is read-only.
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
            policy = health.policy(task_vars.get("health", {}))
            arguments = state.arguments(place[0], fleet, robot, built, policy)
        except UserError as error:
            raise AnsibleActionFail(str(error)) from None
        answer = self._execute_module("robot_state", arguments, task_vars=task_vars)
        if "state" not in answer:
            return answers.outcome(answer)
        try:
            found = answers.judged(robot.name, answer["state"], answers.State)
        except UserError as error:
            raise AnsibleActionFail(str(error)) from None
        wanted = state.wanted(fleet, robot)
        for file in found["drift"]:
            file["role"] = provision.role_of(file["path"])
        judged = apps.judge(robot.number, found["apps"], built)
        faults = state.faults(found, wanted) | {"apps": judged.faults}
        return {
            "changed": False,
            "state": found,
            "wanted": wanted,
            "faults": faults,
            "app_actions": judged.actions,
            "by_hand": judged.notes,
            "warnings": [f"{robot.name}: {note}" for note in judged.notes],
            "up_to_date": not found["drift"] and not any(faults.values()),
            "unhealthy": health.complaints(found, policy),
            "release_drift": state.release_drift(found["release"], release.wanted(robot)),
        }
