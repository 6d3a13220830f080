"""What provisioning makes of a robot's state, as systemd and the kernel say it."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import pytest
import yaml
from ansible.plugins.test.core import TestModule as CoreTests
from ansible.plugins.test.mathstuff import TestModule as SetTests

from flotilla.common import paths
from flotilla.fleet import inventory

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


@pytest.mark.parametrize(("there", "right"), [(["root", "control1", "control2"], True), (["root", "control"], False)])
def test_a_release_without_users_of_tasks_is_refused(there: list[str], right: bool) -> None:
    """Seen to fail without the condition: its tasks would not start."""
    (play,) = yaml.safe_load((ANSIBLE / "fleet.yml").read_text())
    (judged,) = (task["ansible.builtin.assert"]["that"] for task in play["pre_tasks"] if "users" in task["name"])
    language = jinja2.Environment()
    language.tests |= CoreTests().tests() | SetTests().tests()
    robot = {"state": {"users": there}, "wanted": {"users": ["control1", "control2"]}}
    assert language.compile_expression(judged)(robot=robot) is right


PARAM = """#!/bin/sh
[ "$*" = "--status=json heading" ] || {{ echo "flotilla-param: no task runs here" >&2; exit 1; }}
echo . >>{directory}/calls
exec cat {directory}/$(wc -l <{directory}/calls)
"""


def looked_at(library: ModuleType, directory: Path, *said: dict[str, Any], required: tuple[str, ...] = ()) -> Any:
    """What comes of a task that says these one after the other, and the last one again and again."""
    program = directory / "flotilla-param"
    program.write_text(PARAM.format(directory=directory))
    program.chmod(0o755)
    for number in range(1, 30):
        (directory / str(number)).write_text(json.dumps(said[min(number, len(said)) - 1]))
    return library.Watch(["heading"]).end(list(required))["heading"]


def told(steps: int, overruns: int, flag: bool = True) -> dict[str, Any]:
    return {"steps": steps, "overruns": overruns, "sensors": {"gyro": {"flag": flag, "age_s": 0.1}}}


@pytest.fixture
def robot(library: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where its programs lie; its time does not pass but by sleeping."""
    now = [0.0]
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr(library.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(library.time, "sleep", lambda seconds: now.append(now.pop() + seconds))
    return tmp_path


def test_overruns_of_the_time_it_is_looked_at(library: ModuleType, robot: Path) -> None:
    """Seen to fail with all overruns since the start, and with a start anew taken for a count that goes back."""
    assert looked_at(library, robot, told(1000, 7), told(1100, 9))["lately"] == {"steps": 100, "overruns": 2}
    (robot / "calls").unlink()
    assert looked_at(library, robot, told(1000, 7), told(40, 3))["lately"] == {"steps": 40, "overruns": 3}
    assert library.time.monotonic() == 2 * library.LOOKED_AT_S


def test_required_sensors_are_waited_for_and_no_others(library: ModuleType, robot: Path) -> None:
    """Those of another task neither. Seen to fail where the first answer counts, and without an end."""
    silent = told(100, 0, flag=False)
    for required, flag in ((("heading.gyro",), True), (("other.gyro",), False), ((), False)):
        found = looked_at(library, robot, silent, silent, told(300, 0), required=required)
        assert found["sensors"]["gyro"]["flag"] is flag
        (robot / "calls").unlink()
    before = library.time.monotonic()
    assert looked_at(library, robot, silent, required=("heading.gyro",))["sensors"]["gyro"]["flag"] is False
    assert library.PATIENCE_S < library.time.monotonic() - before < library.PATIENCE_S + 1


def test_a_task_that_says_nothing(library: ModuleType, robot: Path) -> None:
    (robot / "flotilla-param").write_text("#!/bin/sh\necho 'flotilla-param: no task x runs here' >&2; exit 1\n")
    (robot / "flotilla-param").chmod(0o755)
    assert library.Watch(["x"]).end([]) == {"x": {"problem": "flotilla-param: no task x runs here"}}


def test_a_robot_without_tasks_is_not_waited_for(library: ModuleType, robot: Path) -> None:
    assert library.Watch([]).end(["heading.gyro"]) == {}
    assert library.time.monotonic() == 0
