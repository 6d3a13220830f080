"""Validates what robots answer to provisioning before the station uses it: an attacker may control a robot.

Members on which the station acts have a type and bounds. All others, such as the statistics of control tasks, are kept
in a form that can be displayed: text without control characters, finite numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

import pydantic

from flotilla.common.errors import UserError
from flotilla.common.text import shown

_DEPTH = 16
_TEXT = 1 << 17
"""Characters of a text: what `library/robot_state.py` shows of a file is half of that at most."""

Text = Annotated[str, pydantic.StringConstraints(max_length=_TEXT)]
Word = Annotated[str, pydantic.StringConstraints(pattern=r"^[A-Za-z0-9_.@:/+-]{1,256}$")]
"""A name of a unit, an app, an interface, a user, and the like."""
Etc = Annotated[str, pydantic.StringConstraints(pattern=r"^/etc/[^\x00]{1,4000}$")]
Sha256 = Annotated[str, pydantic.StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, pydantic.Field(ge=0, le=2**63)]


class Answer(pydantic.BaseModel):
    """Members that the station acts on; others are kept to be displayed."""

    model_config = pydantic.ConfigDict(extra="allow", strict=True, frozen=True)


class Drift(Answer):
    path: Etc
    action: Literal["write", "remove", "restore"]
    why: Text
    before: Text


class Lately(Answer):
    steps: Count
    overruns: Count


class Sensor(Answer):
    flag: bool
    age_s: float | None
    """None: it was never good, or that is no number."""


class Status(Answer):
    """Of a control task that says how it does."""

    steps: Count
    overruns: Count
    lately: Lately
    sensors: dict[Word, Sensor] = {}


class Problem(Answer):
    """Of one that does not."""

    problem: Text


class Task(Answer):
    ActiveState: Word
    SubState: Word
    NRestarts: Word
    status: Problem | Status | None = None


class App(Answer):
    version: Word | Literal[""]
    listed: Word | Literal[""]
    kept: bool
    drop_in: bool
    up: bool
    files: list[Text]


class Slot(Answer):
    ok: bool
    blob: Text | None
    release: Text | None
    kernel: Text | None


class Slots(Answer):
    A: Slot
    B: Slot


class Release(Answer):
    """What `flotilla-slot show` says."""

    running: Literal["A", "B"] | None
    trial: Literal["A", "B"] | None
    slots: Slots


class State(Answer):
    """What `ansible/library/robot_state.py` finds."""

    drift: list[Drift]
    hostname: Text
    machine: Word
    uarts: list[Word]
    users: list[Word]
    addresses: list[Word]
    firewall_is_loaded: bool
    sysctl: list[Annotated[list[Text], pydantic.Field(min_length=3, max_length=3)]]
    apps: dict[Word, App]
    down: list[Word]
    superfluous_tasks: list[Word]
    failed: list[Text]
    tasks: dict[Word, Task]
    release: Release | None
    data_is_writable: bool
    data_free_bytes: Count


class Told(Answer):
    """What `/usr/lib/flotilla/update.py` says of a release."""

    missing: list[Count]
    """Numbers of chunks."""
    base: Sha256 | Literal[""]
    """Of the content of the running slot."""
    running: bool
    staged: bool
    unchecked: Text = ""
    """Why the expiry was not checked; empty if it was, or if the robot or the bundle has none."""


_Model = TypeVar("_Model", bound=Answer)


def judged(robot: str, answer: object, model: type[_Model]) -> dict[str, Any]:
    """The answer of a robot as the members of `model` and what else it has, all of it fit to be shown.

    Raises UserError that names the robot and the member.
    """
    try:
        tidy = _tidy(answer, _DEPTH)
        model.model_validate(tidy)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part)[:40] for part in first["loc"]) or "it"
        raise UserError(
            f"{robot}: its answer is none of a robot's: {shown(where)}: {first['msg']}; nothing was done with it: look "
            "at the robot, or flash its card"
        ) from error
    assert isinstance(tidy, dict)
    return tidy


def outcome(answer: Mapping[str, object]) -> dict[str, Any]:
    """What a module's answer says of how it went, and nothing else that a robot may have added."""
    found: dict[str, Any] = {name: True for name in ("failed", "unreachable") if answer.get(name)}
    found["changed"] = bool(answer.get("changed"))
    said = [str(answer[name]).strip() for name in ("msg", "module_stderr") if answer.get(name)]
    if found.get("failed") or found.get("unreachable"):
        found["msg"] = shown(": ".join(said))[:_TEXT]
    return found


def _tidy(value: object, depth: int) -> object:
    if not depth:
        return None
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {shown(str(key)): _tidy(each, depth - 1) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_tidy(each, depth - 1) for each in value]
    return value if isinstance(value, bool | int) else None
