"""Control tasks and apps of a robot from the station: parameters, by its own `flotilla-param` (`make param`); start and
stop of control tasks."""

from __future__ import annotations

from collections.abc import Sequence

from flotilla.fleet.model import Robot
from flotilla.robot import ssh


def param(robot: Robot, task: str, parameter: str | None = None, value: str | None = None) -> str:
    """All parameters of the task, a line each; one's value; or what it was and is, and since which step.

    UserError with the robot's reason, or when it does not answer.
    """
    words = ["flotilla-param", task, *([parameter] if parameter else []), *([value] if value is not None else [])]
    return ssh.output(robot, words)


def service(robot: Robot, tasks: Sequence[str], do: str, by: Sequence[str] | None = None) -> str:
    """Start or stop control tasks, all at once, as the playbook `tasks.yml` does. UserError as above. `by`: another way
    there than a new connection."""
    return ssh.output(robot, ["sudo", "systemctl", do, *(f"flotilla-task@{task}.service" for task in tasks)], by)
