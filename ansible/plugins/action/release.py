"""Brings a release to a robot, by the robot's `/usr/lib/flotilla/update.py`: `do: stage`, `activate` or `confirm`."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import ActionBase
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.robot import provision, release

BATCH_BYTES = 8 << 20
"""Sent at a time: what is cut off begins anew there."""


class ActionModule(ActionBase):  # type: ignore[misc]  # Ansible has no types
    """`do: stage` sends what the idle slot lacks, of the board's bundle or `bundle`, until all of it is on the card.
    `do: activate`: the next start tries it. `do: confirm`: the running slot stays. `do: back`: the next start tries the
    other slot.

    Result `told`: what the robot said; `sent_bytes`.
    """

    _supports_check_mode = True
    _requires_connection = True

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> dict[str, Any]:
        super().run(tmp, task_vars)
        task_vars = task_vars or {}
        do = self._task.args["do"]
        try:
            if do == "stage":
                return self._stage(self._bundle(task_vars))
        except UserError as error:
            raise AnsibleActionFail(str(error)) from error
        if self._task.check_mode:
            return {"changed": True}
        if do == "activate":
            return {"changed": True, "told": self._update("activate")}
        if do == "confirm":
            return {"changed": True, "told": self._ask(["flotilla-slot", "confirm"])}
        if do == "back":
            state = json.loads(self._ask(["flotilla-slot", "show"]))
            other = "B" if state["running"] == "A" else "A"
            if not state["slots"][other]["ok"]:
                raise AnsibleActionFail(f"slot {other} holds no release that worked: there is nothing to go back to")
            return {"changed": True, "told": self._ask(["flotilla-slot", "trial", other])}
        raise AnsibleActionFail(f"do={do}: one of stage, activate, confirm, back")

    def _bundle(self, task_vars: dict[str, Any]) -> release.Bundle:
        _, robot = provision.robot(Path(task_vars["inventory_dir"]), task_vars["inventory_hostname"])
        return release.read(Path(self._task.args.get("bundle") or paths.BUNDLES / f"{robot.board}.bundle"))

    def _stage(self, bundle: release.Bundle) -> dict[str, Any]:
        told = self._update("begin", bundle.offer)
        result: dict[str, Any] = {"changed": not told["running"] and not told["staged"], "sent_bytes": 0}
        if result["changed"] and not self._task.check_mode:
            delta = release.delta_of(told["base"], bundle.header["BLOB"])
            if told["missing"] and delta.exists():
                content = delta.read_bytes()
                told = self._update("delta", content)
                result["sent_bytes"] += len(content)
            else:
                told = self._update("copy")
            for batch in bundle.chunks(told["missing"], BATCH_BYTES):
                self._update("write", batch)
                result["sent_bytes"] += len(batch)
            told = self._update("finish")
            if told["missing"]:
                raise AnsibleActionFail(f"the card does not keep chunks {told['missing']}: it needs another one")
        return result | {"told": told}

    def _update(self, command: str, content: bytes | None = None) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self._ask(["/usr/lib/flotilla/update.py", command], content))
        return told

    def _ask(self, argv: list[str], content: bytes | None = None) -> str:
        done = self._low_level_execute_command(shlex.join(argv), in_data=content)
        if done["rc"]:
            said = done["stderr"].strip().splitlines() or done["stdout"].strip().splitlines() or ["nothing"]
            raise AnsibleActionFail(f"{' '.join(argv)}: {said[-1]}")
        return str(done["stdout"])
