"""No answer of a robot becomes a variable, a host or a group.

Ansible evaluates some members of a result whatever module returned it: `ansible_facts` become variables, `add_host`
sets variables of any host, `add_group` makes groups, `ansible_stats` sets statistics. An attacker who controls a robot
could return them, and so have options of their own for ssh executed on the station. No module of this project's
playbooks uses these members.

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
description: Removes from each module's answer the members that Ansible would turn into variables, hosts or groups.
"""
EVALUATED = ("add_group", "add_host", "ansible_facts", "ansible_stats")
_parse = ActionBase._parse_returned_data


def _without_orders(self: ActionBase, *arguments: Any, **more: Any) -> dict[str, Any]:
    answer: dict[str, Any] = _parse(self, *arguments, **more)
    for name in EVALUATED:
        answer.pop(name, None)
    return answer


ActionBase._parse_returned_data = _without_orders


class CallbackModule(CallbackBase):  # type: ignore[misc]  # Ansible has no types
    CALLBACK_VERSION = 2.0
    CALLBACK_TYPE = "notification"
    CALLBACK_NAME = "guard"
