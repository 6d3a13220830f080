"""Validates what a robot answers to `make accept`: an attacker may control a robot.

`on_robot.py` describes the parts. Its lines and those of `flotilla-run` are bounded in size, number and type before a
check reads them, so that a check needs no care of its own.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from typing import IO, Annotated, Any

import pydantic

from flotilla.common.errors import UserError
from flotilla.robot.answers import Answer, Count, State, Text, judged

_LINE = 1 << 22
"""Characters of an answer."""
_LINES = 1 << 16
_LARGEST = 1e15

Finite = Annotated[float, pydantic.Field(ge=-_LARGEST, le=_LARGEST, allow_inf_nan=False)]


class Computer(Answer):
    vendor: Text
    product: Text
    processor: Text
    release: Text
    version: Text
    memory_mib: Finite
    clock_source: Text
    clock_sources: list[Text]
    battery_clock_off_s: Finite | None
    messages: list[Text]


class Watchdog(Answer):
    device: Text
    is_there: bool
    timeout: Text
    fed_s_ago: Finite | None


class Connector(Answer):
    uart: Text
    irq: Text
    users: list[Text] = pydantic.Field(default=[])
    came: bool = False
    error: Text = ""
    interrupts: Count = 0

    @pydantic.model_validator(mode="after")
    def _counted(self) -> Connector:
        if self.came and "interrupts" not in self.model_fields_set:
            raise ValueError("came without the number of interrupts")
        return self


class _Errors(Answer):
    """Counters by their names, of one direction."""

    __pydantic_extra__: dict[str, Count]


class _Counters(Answer):
    rx: _Errors
    tx: _Errors


class _CanState(Answer):
    state: Text | None = None


class _LinkInfo(Answer):
    info_data: _CanState = _CanState()


class Interface(Answer):
    """As `ip` shows it, or the reason why it is missing."""

    missing: Text = ""
    flags: list[Text] = pydantic.Field(default=[])
    stats64: _Counters = _Counters.model_validate({"rx": {}, "tx": {}})
    linkinfo: _LinkInfo = _LinkInfo()

    @pydantic.model_validator(mode="after")
    def _whole(self) -> Interface:
        if "missing" not in self.model_fields_set and not self.model_fields_set >= {"flags", "stats64"}:
            raise ValueError("neither missing nor flags and counters")
        return self


class SlotContent(Answer):
    """SHA-256 by the slot's header and of its content, or why that could not be read."""

    error: Text = ""
    header: Text = ""
    content: Text = ""

    @pydantic.model_validator(mode="after")
    def _whole(self) -> SlotContent:
        if "error" not in self.model_fields_set and not self.model_fields_set >= {"header", "content"}:
            raise ValueError("neither an error nor header and content")
        return self


class Card(Answer):
    read_mb_s: Finite
    written_mb_s: Finite
    slots: dict[str, SlotContent]
    disk_bytes: Count
    data_end_bytes: Count
    data_bytes: Annotated[int, pydantic.Field(gt=0, le=2**63)]
    data_free_bytes: Count
    file_system_errors: Count


class RealTime(Answer):
    faster_us: Finite
    slower_us: Finite
    switch_us: Finite
    switch_mean_us: Finite


class HardwareLatency(Answer):
    longest_us: Finite


class Watched(Answer):
    """A line of `flotilla-run --watch` for a relay."""

    mismatch: Annotated[float | bool, pydantic.Field(alias="relay.mismatch")]


FACTS: dict[str, Any] = {
    "computer": Computer,
    "temperatures": dict[str, Finite],
    "watchdog": Watchdog,
    "serial": dict[str, Connector],
    "network": dict[str, Interface],
    "card": Card,
    "real_time": RealTime,
    "hardware_latency": HardwareLatency,
}
"""By part of `on_robot.py`."""


class _Part(Answer):
    part: str


class _Failed(Answer):
    error: Text


def part(robot: str, line: object, ports: Collection[str]) -> dict[str, Any]:
    """A line of `on_robot.py`: `part` with `facts` or `error`. `ports`: the connectors of the robot's board.

    UserError that names the robot where it is anything else.
    """
    found = judged(robot, line, _Part)
    name = found["part"]
    if name not in FACTS:
        raise UserError(f"{robot}: it answered for {name[:40]!r}, which is no part of the test; flash its card")
    if "error" in found:
        return {"part": name, "error": judged(robot, found, _Failed)["error"]}
    facts = judged(robot, found, pydantic.create_model("Facts", __base__=Answer, facts=(FACTS[name], ...)))["facts"]
    if name == "serial" and (unknown := [each for each in facts if each not in ports]):
        raise UserError(f"{robot}: it answered for connector {unknown[0][:40]!r}, which its board does not have")
    return {"part": name, "facts": facts}


def state(robot: str, text: str) -> dict[str, Any]:
    """The answer of `library/robot_state.py`."""
    said = judged(robot, parsed(robot, text), Answer)
    if "state" not in said:
        raise UserError(f"{robot}: cannot be compared with its description: {said.get('msg', said)}"[:2000])
    return judged(robot, said["state"], State)


def lines(robot: str, stream: IO[str]) -> Iterator[Any]:
    """The JSON of each line; UserError for a line without JSON, and for too many lines."""
    for _ in range(_LINES):
        if not (text := stream.readline(_LINE)):
            return
        yield parsed(robot, text)
    raise UserError(f"{robot}: answers more than {_LINES} lines; look at the robot, or flash its card")


def parsed(robot: str, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{robot}: its answer is no JSON; look at the robot, or flash its card") from error
