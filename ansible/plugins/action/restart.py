"""Restarts a robot and waits until it is up again, by Ansible's `reboot`.

That one asks for facts of the system and for the place of its commands first. No fact of a robot enters the station
(plugin `guard`), and every robot has the same system, so both are known here.
"""

from __future__ import annotations

from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import reboot
from flotilla.common import text


class ActionModule(reboot.ActionModule):  # type: ignore[misc]  # Ansible has no types
    """`timeout_s`: seconds until a robot that does not come up has failed, a whole number from 1 on."""

    _VALID_ARGS = frozenset({"timeout_s"})
    DEFAULT_POST_REBOOT_DELAY = 2

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> dict[str, Any]:
        given = str(self._task.args["timeout_s"])
        if not given.isdecimal() or not int(given):
            raise AnsibleActionFail(f"timeout_s={given}: give seconds, a whole number from 1 on")
        self.DEFAULT_REBOOT_TIMEOUT = int(given)
        result: dict[str, Any] = super().run(tmp, task_vars)
        name = (task_vars or {})["inventory_hostname"]
        if result.get("failed") and result.get("rebooted"):
            result["msg"] = f"{name} was not up again after {given} s: look at it, or give it more: -e timeout_s=1800"
        elif result.get("failed"):
            result["msg"] = f"{name}: {text.shown(str(result['msg']))}"
        return result

    def get_distribution(self, task_vars: dict[str, Any]) -> dict[str, str]:
        return {"name": "debian", "version": "", "family": "debian"}

    def get_shutdown_command(self, task_vars: dict[str, Any], distribution: dict[str, str]) -> str:
        return "systemctl"

    def get_shutdown_command_args(self, distribution: dict[str, str]) -> str:
        return "reboot"
