"""No answer of a robot becomes a variable, a host or a group.

Ansible heeds some members of a result whatever module it comes from: `ansible_facts` become variables, `add_host` gives
variables to any host, `add_group` makes groups, `ansible_stats` figures. A robot in other hands would answer with
them, and have options of its own for ssh executed on the station. No module of this project's playbooks uses them.

Ansible has no hook for this. The function that reads what a module answered is replaced when Ansible loads this file,
which is before it starts the processes that talk to robots.
"""

from __future__ import annotations

from typing import Any

from ansible.plugins.action import ActionBase
from ansible.plugins.callback import CallbackBase

DOCUMENTATION = """
name: guard
type: notification
short_description: no variables from robots
description: Takes out of each module's answer what Ansible would make a variable, a host or a group of.
"""
HEEDED = ("add_group", "add_host", "ansible_facts", "ansible_stats")
_parse = ActionBase._parse_returned_data


def _without_orders(self: ActionBase, *arguments: Any, **more: Any) -> dict[str, Any]:
    answer: dict[str, Any] = _parse(self, *arguments, **more)
    for name in HEEDED:
        answer.pop(name, None)
    return answer


ActionBase._parse_returned_data = _without_orders


class CallbackModule(CallbackBase):  # type: ignore[misc]  # Ansible has no types
    CALLBACK_VERSION = 2.0
    CALLBACK_TYPE = "notification"
    CALLBACK_NAME = "guard"
