"""What provisioning makes of a robot's state, as systemd and the kernel say it."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import jinja2
import pytest
import yaml
from ansible.plugins.test.core import TestModule as CoreTests
from ansible.plugins.test.mathstuff import TestModule as SetTests

from images.builder import inventory, paths

ANSIBLE = paths.PROJECT / "ansible"
UNIT = {
    "Type": "notify",
    "ActiveState": "active",
    "SubState": "running",
    "Result": "success",
    "ConditionResult": "yes",
    "RemainAfterExit": "no",
}
ONCE = {"Type": "oneshot", "ActiveState": "inactive", "SubState": "dead"}


@pytest.fixture(scope="module")
def library() -> ModuleType:
    """The module that runs on robots."""
    spec = importlib.util.spec_from_file_location("library_robot_state", ANSIBLE / "library" / "robot_state.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("there", "up"),
    [
        ({}, True),
        ({"ActiveState": "reloading", "SubState": "reload"}, True),
        ({"ActiveState": "activating", "SubState": "start"}, True),
        ({"ActiveState": "activating", "SubState": "auto-restart", "Result": "exit-code"}, False),
        ({"ActiveState": "failed", "SubState": "failed", "Result": "watchdog"}, False),
        ({"ActiveState": "inactive", "SubState": "dead"}, False),
        ({"ActiveState": "inactive", "SubState": "dead", "ConditionResult": "no"}, True),
        (ONCE, True),
        (ONCE | {"Result": "exit-code"}, False),
        (ONCE | {"RemainAfterExit": "yes"}, False),
    ],
)
def test_a_service_is_up_when_it_does_or_begins_what_it_is_there_for(
    library: ModuleType, there: dict[str, str], up: bool
) -> None:
    """Seen to fail where any service that is being started counted as down, and where any counted as up."""
    assert library.is_up(UNIT | there) is up


@pytest.mark.parametrize(
    ("board", "machine", "right"),
    [
        ("smartcoret3", "i686", True),
        ("smartcoret3", "i586", True),
        ("smartcoret3", "x86_64", False),
        ("x86_64", "x86_64", True),
        ("x86_64", "i686", False),
        ("x86_64", "x86_64_v2", False),
    ],
)
def test_a_computer_of_another_kind_is_refused(board: str, machine: str, right: bool) -> None:
    """By the very condition of the playbook. Seen to fail with an exact name, and without an end to the pattern."""
    (play,) = yaml.safe_load((ANSIBLE / "fleet.yml").read_text())
    (judged,) = (task["ansible.builtin.assert"]["that"] for task in play["pre_tasks"] if "computer" in task["name"])
    language = jinja2.Environment()
    language.tests |= CoreTests().tests() | SetTests().tests()
    robot = {
        "state": {"machine": machine, "uarts": ["ttyS0"]},
        "wanted": {"machine": inventory.load_fleet().boards[board].machine, "uarts": ["ttyS0"]},
    }
    assert all(language.compile_expression(each)(robot=robot) for each in judged) is right
