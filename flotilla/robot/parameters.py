"""Control tasks and apps of a robot from the station: parameters, by its own `flotilla-param` (`make param`); start and
stop of control tasks."""

from __future__ import annotations

import shlex
import subprocess

from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import ssh


def param(robot: Robot, task: str, parameter: str | None = None, value: str | None = None) -> str:
    """All parameters of the task, a line each; one's value; or what it was and is, and since which step.

    UserError with the robot's reason, or when it does not answer.
    """
    words = ["flotilla-param", task, *([parameter] if parameter else []), *([value] if value is not None else [])]
    return _output(robot, words)


def service(robot: Robot, task: str, do: str) -> str:
    """Start or stop a control task, as the playbook `tasks.yml` does. UserError as above."""
    return _output(robot, ["sudo", "systemctl", do, f"flotilla-task@{task}.service"])


def _output(robot: Robot, words: list[str]) -> str:
    argv = [*ssh.command(robot), shlex.join(words)]
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", check=False)
    if done.returncode == ssh.FAILED:
        raise ssh.no_answer(robot, done.stderr.strip())
    if done.returncode:
        raise UserError(f"{robot.name}: {done.stderr.strip().removeprefix('flotilla-param: ')}")
    return done.stdout.rstrip("\n")
