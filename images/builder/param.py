"""Control tasks and apps of a robot from the station: parameters, by its own `flotilla-param` (`make param`); start and
stop of control tasks."""

from __future__ import annotations

import shlex
import subprocess

from images.builder import boot
from images.builder.errors import UserError
from images.builder.fleet import Robot

_SSH_FAILED = 255
"""Status of `ssh` when there is no connection; every other one is the command's."""


def param(robot: Robot, task: str, parameter: str | None = None, value: str | None = None) -> str:
    """All parameters of the task, a line each; one's value; or what it was and is, and since which step.

    UserError with the robot's reason, or when it does not answer.
    """
    words = ["flotilla-param", task, *([parameter] if parameter else []), *([value] if value is not None else [])]
    return _said(robot, words)


def service(robot: Robot, task: str, do: str) -> str:
    """Start or stop a control task, as the playbook `tasks.yml` does. UserError as above."""
    return _said(robot, ["sudo", "systemctl", do, f"flotilla-task@{task}.service"])


def _said(robot: Robot, words: list[str]) -> str:
    argv = [*boot.ssh_command(robot), shlex.join(words)]
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", check=False)
    if done.returncode == _SSH_FAILED:
        raise boot.no_answer(robot, done.stderr.strip())
    if done.returncode:
        raise UserError(f"{robot.name}: {done.stderr.strip().removeprefix('flotilla-param: ')}")
    return done.stdout.rstrip("\n")
