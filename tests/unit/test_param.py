"""Parameters of a robot's task from the station: what is asked of the robot, and what becomes of its answers."""

from __future__ import annotations

import os
import subprocess
import sys
from ipaddress import IPv4Address
from pathlib import Path

import pytest

from flotilla.cli import main as command_line
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.fleet.model import Robot
from flotilla.lab.wheeled.by_wires import INVENTORY
from flotilla.robot import parameters, ssh

ROBOT = Robot(name="robot3", number=3, board="smartcoret3", address=IPv4Address("10.0.0.3"))


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A directory of the robot's programs: ssh runs what it is sent in a shell, as there."""
    monkeypatch.setattr(ssh, "command", lambda _: ["sh", "-c", 'PATH="$0:$PATH" exec sh -c "$1"', str(tmp_path)])
    return tmp_path


def program(directory: Path, script: str) -> None:
    file = directory / "flotilla-param"
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(0o755)


def test_words_reach_the_robot_as_they_are(robot: Path) -> None:
    """Seen to fail with words that are joined by blanks: its shell takes them apart."""
    program(robot, 'for word; do echo "<$word>"; done')
    assert parameters.param(ROBOT, "heading", "a.b", "two words; $HOME") == "<heading>\n<a.b>\n<two words; $HOME>"
    assert parameters.param(ROBOT, "heading", "a.b", "") == "<heading>\n<a.b>\n<>"
    assert parameters.param(ROBOT, "heading") == "<heading>"


def test_its_reason_is_ours(robot: Path) -> None:
    program(robot, "echo 'flotilla-param: no task heading runs here' >&2; exit 1")
    with pytest.raises(UserError, match=r"^robot3: no task heading runs here$"):
        parameters.param(ROBOT, "heading")


def test_no_answer_is_no_refusal(robot: Path) -> None:
    program(robot, "echo 'ssh: connect to host: No route' >&2; exit 255")
    with pytest.raises(UserError, match=r"^robot3 did not answer: ssh: connect to host: No route; is it on"):
        parameters.param(ROBOT, "heading")


def test_a_value_may_be_negative(
    robot: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `make param` calls it."""
    program(robot, 'echo "$@"')
    monkeypatch.setattr(inventory, "load_fleet", lambda: None)
    monkeypatch.setattr(inventory, "robot", lambda _, number: ROBOT if number == ROBOT.number else None)
    monkeypatch.setattr(sys, "argv", ["flotilla", "param", "3", "heading", "a.b", "--", "-1e-3"])
    assert command_line.main() == 0
    assert capsys.readouterr().out == "heading a.b -1e-3\n"


@pytest.mark.parametrize("words", [["param", "1", "drive"], ["scope", "1", "drive"], ["ssh", "1"]])
def test_the_robot_is_that_of_the_inventory_that_was_given(tmp_path: Path, words: list[str]) -> None:
    """Seen to fail: whoever tuned the simulated rover tuned the robot 1 of the project's own inventory."""
    described = inventory.load_fleet(INVENTORY).robots[1].address
    assert described != inventory.load_fleet().robots[1].address
    for name in ("operator_ed25519", "known_hosts"):
        (tmp_path / name).touch()
    (tmp_path / "ssh").write_text('#!/bin/sh\necho "$*"\n')
    (tmp_path / "ssh").chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "KEYS": str(tmp_path)}
    environment |= {"INVENTORY": str(INVENTORY), "BUILD": str(tmp_path)}
    argv = [sys.executable, "-m", "flotilla", *words]
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f" {described}" in done.stdout
    environment["INVENTORY"] = "/nowhere"
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, "INVENTORY=/nowhere: there is no such directory" in done.stderr) == (1, True)


def test_a_limit_of_safety_is_asked_for_and_confirmed(robot: Path) -> None:
    program(
        robot, 'echo "flotilla-param: task drive: v_limit.max is a limit of safety: 0.5 → 0.6; confirm it" >&2; exit 1'
    )
    with pytest.raises(UserError) as refused:
        parameters.param(ROBOT, "drive", "v_limit.max", "0.6")
    assert parameters.questioned(refused.value) == "0.5"
    assert parameters.questioned(UserError("robot3: no task heading runs here")) is None
    program(robot, 'echo "$*"')
    assert parameters.param(ROBOT, "drive", "v_limit.max", "0.6", "0.5") == "--confirm 0.5 drive v_limit.max 0.6"
