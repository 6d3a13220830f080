"""Whether a robot is healthy by its data partition and by what its control tasks report, and the inventory requires.

`library/robot_state.py` brings what they say; units, files and settings are judged where they are compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from flotilla.common.errors import UserError
from flotilla.fleet.model import Health

_UNIT = "flotilla-task@"
READ_ONLY = (
    "/data is read-only after an error of its file system: restart the robot, which checks it; if that happens again, "
    "replace the card"
)


def policy(given: Any) -> Health:
    """Ansible's variable `health`, which a second inventory or the command line may say, too."""
    try:
        return Health.model_validate(given)
    except ValidationError as error:
        faults = (f"{'.'.join(map(str, ('health', *each['loc'])))}: {_why(each)}" for each in error.errors())
        raise UserError("; ".join(faults)) from error


def _why(detail: Any) -> str:
    context = detail.get("ctx", {})
    return f"{context['message']}; {context['remedy']}" if "remedy" in context else str(detail["msg"])


def complaints(state: Mapping[str, Any], wanted: Health) -> list[str]:
    """What is wrong, in words; nothing where the robot is healthy. `state`: what `robot_state` found."""
    tasks = sorted(state["tasks"].items())
    return [
        *([] if state["data_is_writable"] else [READ_ONLY]),
        *(each for unit, task in tasks for each in _of_task(unit, task.get("status"), wanted)),
    ]


def _of_task(unit: str, status: Any, wanted: Health) -> Iterator[str]:
    task = unit.removeprefix(_UNIT).removesuffix(".service")
    if not status:  # it does not run, which is its unit's affair
        return
    if "problem" in status:
        yield f"{task} does not report its status: {status['problem']}"
        return
    overruns, steps = status["lately"]["overruns"], status["lately"]["steps"]
    if 100 * overruns > wanted.overruns_percent * steps:
        yield f"{task}: {overruns} of the last {steps} steps overran, more than {wanted.overruns_percent:g} %"
    for block in wanted.sensors_of(task):
        sensor = status["sensors"].get(block)
        if not sensor:
            yield f"{task} has no sensor {block}; it has {', '.join(status['sensors']) or 'none'}"
        elif not sensor["flag"]:
            yield f"{task}.{block}: its flag is 0, its last good value {sensor['age_s']:.1f} s old"
