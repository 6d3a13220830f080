"""Which release each robot runs: what robots say, and those that say nothing.

A shell on this computer stands in for `ssh` and the robot: it runs the very command that a robot is sent, with programs
of this file in the place of the robot's.
"""

from __future__ import annotations

import json
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from flotilla.cli import main as command_line
from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.fleet.model import Robot
from flotilla.robot import releases, ssh

NOW = datetime(2026, 11, 23, 12, 0, tzinfo=UTC)
BLOB = "5f70bf18a086007016e948b04aed3b82103a36bea41755b6cddfaf10ace3c6ef"


def state(running: str = "A", trial: str | None = None, ok: bool = True, release: str | None = "3") -> dict[str, Any]:
    slots = {
        "A": {"ok": True, "release": "2", "blob": "0" * 64, "kernel": "6.12.100"},
        "B": {"ok": False, "release": None, "blob": None, "kernel": None},
    }
    slots[running] = {"ok": ok, "release": release, "blob": BLOB, "kernel": "6.12.117-flotilla"}
    return {"running": running, "sequence": 17, "order": ["A", "B"], "trial": trial, "slots": slots}


class Fleet:
    """Robots that say what the test puts into `says`, or do what it puts into `does`."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def says(self, number: int, said: object) -> None:
        (self.directory / f"robot{number}.json").write_text(json.dumps(said))
        self.does(number, f'[ "$*" = show ] && cat {self.directory}/robot{number}.json')

    def does(self, number: int, script: str) -> None:
        (self.directory / f"robot{number}.sh").write_text(script)


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    programs = {
        "sudo": 'exec "$@"',
        "flotilla-slot": f". {tmp_path}/$ROBOT.sh",
        "cat": '[ "$1" = /proc/uptime ] && exec echo 3600.25 7000.00; exec /bin/cat "$@"',
    }
    for name, script in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setattr(ssh, "command", lambda robot: ["env", f"ROBOT={robot.name}", "sh", "-c"])
    return Fleet(tmp_path)


def robot(number: int) -> Robot:
    words = {"name": f"robot{number}", "number": number, "address": f"10.42.0.{number}", "board": "smartcoret3"}
    return Robot.model_validate(words)


def ask(*numbers: int) -> list[releases.Answer]:
    return releases.ask([robot(number) for number in numbers], NOW)


# --- what a robot says ---


def test_table(fleet: Fleet) -> None:
    """Seen to fail where the other slot's release is shown as the one that runs."""
    fleet.says(1, state())
    fleet.says(2, state(running="B", trial="B", ok=False, release="4"))
    fleet.does(3, "echo No route to host >&2; exit 255")
    answers = ask(1, 2, 3)
    assert releases.table(answers).splitlines() == [
        "robot   release    slot  state      kernel             blob          since             other slot",
        "robot1  3          A     confirmed  6.12.117-flotilla  5f70bf18a086  2026-11-23 10:59  B: empty",
        "robot2  4          B     on trial   6.12.117-flotilla  5f70bf18a086  2026-11-23 10:59  A: 2",
        "robot3  no answer",
        "",
        "release 3: robot1",
        "release 4: robot2",
        "unknown: robot3",
    ]
    assert releases.problems(answers) == [
        "robot3 did not answer: No route to host; is it on and reachable? `make ssh ROBOT=3`"
    ]


@pytest.mark.parametrize(
    ("said", "standing"),
    [
        (state(), "confirmed"),
        (state(trial="B"), "confirmed"),  # the other one's trial has not begun
        (state(trial="A", ok=False), "on trial"),
        (state(ok=False), "not confirmed"),
    ],
)
def test_trial_or_confirmed(fleet: Fleet, said: object, standing: str) -> None:
    """Seen to fail where any trial counts as the running slot's."""
    fleet.says(1, said)
    (answer,) = ask(1)
    assert answer.state is not None
    assert answer.state.standing == standing


def test_a_robot_that_was_started_from_no_slot(fleet: Fleet) -> None:
    """As one in a container. Seen to fail where every robot was taken to run a slot."""
    fleet.says(1, state() | {"running": None})
    assert releases.table(ask(1)).splitlines()[1].split() == [
        "robot1", "?", "none", "of", "no", "slot", "?", "?", "2026-11-23", "10:59", "A:", "3,", "B:", "empty"
    ]  # fmt: skip


def test_json(fleet: Fleet) -> None:
    fleet.says(1, state())
    fleet.does(2, "exit 255")
    one, two = json.loads(releases.as_json(ask(1, 2)))
    boot_state = one.pop("boot_state")
    assert one == {
        "robot": "robot1", "number": 1, "release": "3", "slot": "A", "state": "confirmed",
        "kernel": "6.12.117-flotilla", "blob": BLOB, "since": "2026-11-23T10:59:59+00:00",
    }  # fmt: skip
    assert boot_state == state()
    assert two["robot"] == "robot2"
    assert two["problem"].startswith("robot2 did not answer")


# --- what goes wrong ---


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo sudo: flotilla-slot: command not found >&2; exit 1", "robot1: has no flotilla-slot; its card is older"),
        (
            "echo both state blocks are unreadable >&2; exit 2",
            "robot1: flotilla-slot: both state blocks are unreadable",
        ),
        ("exit 3", "robot1: flotilla-slot: status 3"),
        ("echo hello", "robot1: does not report the state of its slots (Invalid JSON"),
        ("echo '{}'", "robot1: does not report the state of its slots (running: Field required)"),
    ],
)
def test_why_a_robot_has_no_release(fleet: Fleet, script: str, said: str) -> None:
    fleet.does(1, script)
    (problem,) = releases.problems(ask(1))
    assert problem.startswith(said)


def test_a_state_without_its_running_slot_is_none(fleet: Fleet) -> None:
    """Seen to fail, with a KeyError in the table, without the model's check."""
    fleet.says(1, state() | {"running": "C"})
    (problem,) = releases.problems(ask(1))
    assert "there is no slot C" in problem


def test_one_that_never_ends_its_answer_is_named(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail, by never ending, without the timeout."""
    monkeypatch.setattr(releases, "_TIMEOUT_S", 0.1)
    fleet.does(1, f"exec {' '.join(DIE_WITH_PARENT)} sleep infinity")
    (problem,) = releases.problems(ask(1))
    assert problem.startswith("robot1 did not answer: nothing in")


def test_missing_keys_are_said_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    def command(_: Robot) -> list[str]:
        raise UserError("keys/known_hosts is missing")

    monkeypatch.setattr(ssh, "command", command)
    assert releases.problems(ask(1, 2)) == ["keys/known_hosts is missing"] * 2


def test_robots_are_asked_at_once(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits until all are asked. Seen to fail, by the barrier's timeout, with one thread."""
    numbers = range(1, 9)
    barrier = threading.Barrier(len(numbers))
    reached = ssh.command

    def command(robot: Robot) -> list[str]:
        barrier.wait(timeout=60)
        return reached(robot)

    monkeypatch.setattr(ssh, "command", command)
    for number in numbers:
        fleet.says(number, state(release=str(number)))
    answers = ask(*numbers)
    assert [answer.state and answer.state.slot.release for answer in answers] == [str(each) for each in numbers]


# --- the command ---


def test_command(fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Seen to fail where a robot without an answer leaves the status 0."""
    for number in range(1, 20):
        fleet.says(number, state(release=f"r{number}"))
    monkeypatch.setattr("sys.argv", ["flotilla", "releases"])
    assert command_line.main() == 0
    assert "release r1: robot1\n" in capsys.readouterr().out

    fleet.does(2, "exit 255")
    assert command_line.main() == 1
    output = capsys.readouterr()
    assert "unknown: robot2" in output.out
    assert "error: robot2 did not answer" in output.err

    monkeypatch.setattr("sys.argv", ["flotilla", "releases", "1", "--json"])
    assert command_line.main() == 0
    assert [each["robot"] for each in json.loads(capsys.readouterr().out)] == ["robot1"]
