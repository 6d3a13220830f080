"""The restart of a robot by the station: no fact of the robot is needed, and its time is limited."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import pytest

from flotilla.common import paths

Make = Callable[[str], Any]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes the plugin's action with a limit of time. A robot's boot identifier changes by `systemctl reboot`."""
    place = paths.PROJECT / "ansible/plugins/action/restart.py"
    specification = importlib.util.spec_from_file_location("restart", place)
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    monkeypatch.setattr(module.reboot.ActionBase, "run", lambda *_: {})
    monkeypatch.setattr(module.reboot.time, "sleep", lambda _: None)

    def make(timeout_s: str) -> Any:
        made = object.__new__(module.ActionModule)
        task = {"args": {"timeout_s": timeout_s}, "action": "restart", "check_mode": False}
        made._task = type("Task", (), task)
        made._connection = type("Connection", (), {"transport": "ssh", "get_option": lambda *_: None})()
        made.ran = []
        made.failure, made.timed_out = module.AnsibleActionFail, module.reboot.TimedOutException

        def execute(command: str, **_: Any) -> dict[str, Any]:
            made.ran.append(command)
            return {"rc": 0, "stdout": str(made.ran.count("systemctl reboot")), "stderr": ""}

        made._low_level_execute_command = execute
        return made

    return make


def test_a_robot_restarts_without_a_fact(make: Make) -> None:
    """Seen to fail, since no answer becomes a fact: `Failed to get distribution information. Missing "ansible_facts"`;
    so no robot restarted, and none started a new release."""
    action = make("600")
    result = action.run(None, {"inventory_hostname": "robot3"})
    assert (result["rebooted"], result.get("failed")) == (True, None)
    boot = "cat /proc/sys/kernel/random/boot_id"
    assert action.ran == [boot, "systemctl reboot", boot, "whoami"]


def test_a_robot_that_does_not_come_up_is_named(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    action = make("120")

    def end(_: Any, **given: Any) -> None:
        assert given["reboot_timeout"] == 120
        raise action.timed_out

    monkeypatch.setattr(type(action), "do_until_success_or_timeout", end)
    result = action.run(None, {"inventory_hostname": "robot3"})
    assert result["failed"]
    assert result["msg"].startswith("robot3 was not up again after 120 s: ")


def test_a_robot_that_does_not_restart_is_named(make: Make) -> None:
    """With its answer in a form that can be displayed."""
    action = make("600")
    action._low_level_execute_command = lambda *_, **__: {"rc": 1, "stdout": "", "stderr": "no \x1b[2Jentry"}
    result = action.run(None, {"inventory_hostname": "robot3"})
    assert result["failed"]
    assert result["msg"].startswith("robot3: ")
    assert "no \\x1b[2Jentry" in result["msg"]
    assert "\x1b" not in result["msg"]


@pytest.mark.parametrize("timeout_s", ["0", "-1", "1.5", "long", ""])
def test_a_limit_of_time_is_a_number_of_seconds(make: Make, timeout_s: str) -> None:
    action = make(timeout_s)
    with pytest.raises(action.failure, match=f"^timeout_s={timeout_s}: give seconds, a whole number from 1 on$"):
        action.run(None, {})
    assert action.ran == []
