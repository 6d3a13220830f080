"""What the page may ask of the station: JSON with the member `do`, checked here before anything else sees it."""

from __future__ import annotations

import contextlib
import json
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

LONGEST = 4096
"""Bytes of a request."""

Name = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,62}$")]
"""Of a robot or a task."""
Signal = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_.-]{0,126}(\[\d{1,5}\])?$")]
Parameter = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_.-]{0,126}$")]
Printable = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]*$", max_length=1000)]
Id = Annotated[int, Field(ge=0, lt=1 << 31)]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class _Asked(_Request):
    id: Id
    """Of the answer."""


class _OfTask(_Asked):
    robot: Name
    task: Name


class Parameters(_OfTask):
    """All parameters of a task that runs."""

    do: Literal["parameters"]


class SetParameter(_OfTask):
    do: Literal["set"]
    parameter: Parameter
    value: Printable
    confirm: Annotated[str, StringConstraints(pattern=r"^[^\s]{1,40}$")] | None = None
    """What a limit of safety is now."""


class Signals(_OfTask):
    """All signals of a task that runs."""

    do: Literal["signals"]


class Watch(_OfTask):
    """Rows of signals of a task that runs, under this id until `unwatch` says so or another watch has it."""

    do: Literal["watch"]
    signals: Annotated[list[Signal], Field(min_length=1, max_length=16)]
    every: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Steps from one row to the next, if more than the station takes by itself."""
    trigger: Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w.\[\]-]{0,126}[<>]-?[\d.e+-]{1,24}$")] | None = (
        None
    )
    """`gyro.rate>0.1`: `rows` rows around this moment."""
    before: Annotated[int, Field(ge=0, le=1000)] = 0
    rows: Annotated[int, Field(ge=1, le=2000)] = 1000


class Follow(_Asked):
    """Rows of signals of a stream."""

    do: Literal["follow"]
    topic: Annotated[str, StringConstraints(pattern=r"^/[a-z0-9_/-]{1,190}$")]
    signals: Annotated[list[Signal], Field(min_length=1, max_length=16)]


class Unwatch(_Request):
    do: Literal["unwatch"]
    id: Id


class Service(_OfTask):
    """Start or stop a task."""

    do: Literal["service"]
    action: Literal["start", "stop"]


class StopAll(_Request):
    """Stop all tasks of all robots."""

    do: Literal["stop-all"]


class Record(_Asked):
    do: Literal["record"]
    on: bool


class Play(_Request):
    """Of a replay."""

    do: Literal["play"]
    on: bool | None = None
    at_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """Since the recording's begin."""
    speed: Annotated[float, Field(ge=0.1, le=50)] | None = None


class Driving(_Request):
    """Who drives a robot: `take` it if nobody does, `ask` who does for it, `offer` it to another browser, `accept` what
    is offered, `release` it."""

    do: Literal["take", "ask", "offer", "accept", "release"]
    robot: Name
    to: Id | None = None
    """The browser that is offered it."""


class Drive(_Request):
    """A command, from the browser that holds the robot."""

    do: Literal["drive"]
    robot: Name
    v: Annotated[float, Field(ge=-10, le=10)]
    """m/s."""
    omega: Annotated[float, Field(ge=-20, le=20)]
    """rad/s, anticlockwise."""
    boom: Annotated[float, Field(ge=0, le=10)]
    """m."""
    enable: bool


Request = (
    Parameters | SetParameter | Signals | Watch | Follow | Unwatch | Service | StopAll | Record | Play | Driving | Drive
)
_ADAPTER: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="do")])


class NoRequestError(Exception):
    """What came is none; says why, in a line."""

    def __init__(self, text: str, number: int | None = None) -> None:
        super().__init__(text)
        self.number = number
        """The `id` of the answer that its sender waits for, if it has one."""


def read(text: str | bytes) -> Request:
    """What a browser sent."""
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise NoRequestError(f"{place}: {first['msg']}" if place else first["msg"], _number(text)) from error
    except (ValueError, RecursionError) as error:
        raise NoRequestError(f"{error}"[:200]) from error


def _number(text: str | bytes) -> int | None:
    with contextlib.suppress(ValueError, RecursionError):
        found = json.loads(text)
        if isinstance(found, dict) and type(found.get("id")) is int and 0 <= found["id"] < 1 << 31:
            return int(found["id"])
    return None
