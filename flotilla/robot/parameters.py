"""Control tasks and apps of a robot from the station: parameters, by its own `flotilla-param` (`make param`); start and
stop of control tasks."""

from __future__ import annotations

import re
from collections.abc import Sequence

from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import ssh

_QUESTION = re.compile(r"is a limit of safety: (\S+) → .*; confirm it")


def param(
    robot: Robot, task: str, parameter: str | None = None, value: str | None = None, confirm: str | None = None
) -> str:
    """All parameters of the task, a line each; one's value; or what it was and is, and since which step.

    `confirm`: what a limit of safety is now. UserError with the robot's reason, or when it does not answer.
    """
    confirmed = ["--confirm", confirm] if confirm is not None else []
    words = [
        "flotilla-param",
        *confirmed,
        task,
        *([parameter] if parameter else []),
        *([value] if value is not None else []),
    ]
    return ssh.output(robot, words)


def questioned(error: UserError) -> str | None:
    """What a limit of safety is now, where the robot asks whether it shall be set."""
    asked = _QUESTION.search(str(error))
    return asked[1] if asked else None


def service(robot: Robot, tasks: Sequence[str], do: str, by: Sequence[str] | None = None) -> str:
    """Start or stop control tasks, all at once, as the playbook `tasks.yml` does. UserError as above. `by`: another way
    there than a new connection."""
    return ssh.output(robot, ["sudo", "systemctl", do, *(f"flotilla-task@{task}.service" for task in tasks)], by)
