"""Reads `ansible/control_tasks/messages.yml` and says everything that is wrong with it, with file and line.

pydantic checks single values (`model.py`); the functions in `_CHECKS` what values have to do with each other. What
becomes of a message: `transport.py` for control tasks, `flotilla/station/telemetry.py` for the station.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count
from math import isclose

from pydantic import BaseModel, ConfigDict, ValidationError

from flotilla.common import paths
from flotilla.common.errors import Problem
from flotilla.common.yaml_file import Entry, Loc, compose, dotted, explained, plain
from flotilla.fleet.drawings import Drawing, DrawingError
from flotilla.fleet.model import MESSAGE_BYTES, STATIONS, Message, TaskName

Messages = Mapping[str, Message]
Finding = tuple[Loc, str, str]
"""A place in a message, such as `("signals", "rate", "unit")`; what is wrong with it, what would be right."""


class _File(BaseModel):
    """The file, or one entry of it."""

    model_config = ConfigDict(extra="forbid")
    messages: dict[TaskName, Message]
    """By name, which is a DDS topic, too, and part of a stream's."""


def task_names() -> list[str]:
    """The control tasks of which there are files."""
    return sorted(path.stem for path in paths.TASKS.glob("*.yml") if path.name != paths.MESSAGES)


def load() -> tuple[dict[str, Message], list[Problem]]:
    """The messages that are right by themselves, and all that is wrong. Without a file there are none."""
    file = paths.TASKS / paths.MESSAGES
    entry = compose(file) if file.exists() else None
    if not isinstance(entry, Entry):
        return {}, [entry] if entry else []
    problems = list(entry.twice(entry.node))
    content = plain(entry.node)
    messages: dict[str, Message] = {}
    found: list[Finding] = []
    # One by one: what is wrong with one message keeps the others from no check.
    for each in [{name: one} for name, one in content.items()] if isinstance(content, dict) else [content]:
        try:
            messages |= _File(messages=each).messages
        except ValidationError as error:
            for detail in error.errors():
                loc = tuple(step for step in detail["loc"] if step != "[key]")
                found.append((loc[1:], *explained(_File, loc, detail)))
    for name, message in messages.items():
        for check in _CHECKS:
            found += [((name, *loc), wrong, remedy) for loc, wrong, remedy in check(name, message, messages)]
    for loc, wrong, remedy in found:
        where, value = entry.locate(loc) or (entry.at(entry.node), "(missing)")
        problems.append(Problem(where, dotted(loc), value, wrong, remedy))
    return messages, problems


# Checks of a message's values against each other, and against the other messages


def _tasks(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    there = task_names()
    for key, task in (("sender", message.sender), ("receiver", message.receiver)):
        if task not in (*there, STATIONS) or (key, task) == ("sender", STATIONS):
            wrong = f"there is no file {paths.shown(paths.TASKS)}/{task}.yml"
            yield (key,), wrong, f"one of {', '.join(there)}{f', or {STATIONS}' if key == 'receiver' else ''}"
    if message.receiver == message.sender:
        yield ("receiver",), "is the sender", "another task, or no message: a task's blocks are wired"


def _ports(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    first = next(other for other, each in messages.items() if each.port == message.port)
    if first != name:
        taken = {each.port for each in messages.values()}
        free = next(port for port in count(message.port) if port not in taken)
        yield ("port",), f"is the port of {first}", f"each port once; the next free one is {free}"


def _rates(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    first = next(other for other, each in messages.items() if each.sender == message.sender)
    if not isclose(message.step_s, messages[first].step_s):
        yield (
            ("rate_hz",),
            f"{message.sender} steps every {1e3 * message.step_s:g} ms by this and `every`, and every "
            f"{1e3 * messages[first].step_s:g} ms by {first}",
            f"{1 / (messages[first].step_s * message.every):g}, or correct {first}",
        )


def _deadlines(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    interval_ms = 1e3 / message.rate_hz
    if message.receiver == STATIONS:
        if message.deadline_ms is not None:
            yield ("deadline_ms",), "no station has a deadline", "remove it"
    elif message.deadline_ms is None:
        yield ("deadline_ms",), "is missing", f"more than {interval_ms:g}, the milliseconds between two messages"
    elif message.deadline_ms <= interval_ms:
        yield (
            ("deadline_ms",),
            f"passes before the next message, which comes after {interval_ms:g} ms",
            f"more than {interval_ms:g}, best for several messages",
        )


def _streams(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    charge = message.signals.get(message.charge or "")
    if message.receiver == STATIONS:
        if not name.removeprefix(f"{message.sender}-") or not name.startswith(f"{message.sender}-"):
            yield (), "is not named after its sender, as streams are", f"such as {message.sender}-report"
        if message.standby:
            yield (
                ("standby",),
                "stations distinguish robots by their addresses, and receive from each robot",
                "remove it",
            )
        if message.charge and (not charge or charge.width > 1 or charge.type not in ("single", "double")):
            yield ("charge",), "is not a signal of one single or double", "one of signals, or remove it"
        for index, counted in enumerate(message.attempts):
            count = message.signals.get(counted)
            if not count or count.width > 1 or "int" not in count.type:
                yield ("attempts", index), "is not a signal of one integer", "one of signals, or remove it"
        return
    for key in ("foxglove", "attempts", "charge"):
        if getattr(message, key):
            yield (key,), f"{message.receiver} has no use for it", f"remove it: it is for receiver: {STATIONS}"


def _drawings(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    for drawing, drawn in message.foxglove.items():
        try:
            Drawing(drawn, message.signals)
        except DrawingError as error:
            yield ("foxglove", drawing, *error.loc), error.wrong, error.remedy


def _signals(name: str, message: Message, messages: Messages) -> Iterator[Finding]:
    if not message.signals:
        yield ("signals",), "there are none", "at least one, such as `step: { type: uint64 }`"
    if message.bytes > MESSAGE_BYTES:
        yield (
            ("signals",),
            f"make a message of {message.bytes} bytes",
            f"at most {MESSAGE_BYTES}, which one Ethernet frame carries: make two messages of it",
        )
    short: dict[str, str] = {}
    for signal, described in message.signals.items():
        if described.type in ("single", "double") and not described.unit:
            yield ("signals", signal, "unit"), "is missing", f'such as m/s; "1" for a {described.type} without one'
        if len(described.unit) not in (0, 1, described.width):
            yield (
                ("signals", signal, "unit"),
                f"has {len(described.unit)} units for {described.width} elements",
                "one for all, or one for each",
            )
        # protobuf's names of fields in JSON lack underscores, and have to differ.
        other = short.setdefault(signal.replace("_", ""), signal)
        if other != signal:
            yield ("signals", signal), f"is the same as {other} to protobuf", "a name that differs in more than _"


_CHECKS = (_tasks, _ports, _rates, _deadlines, _streams, _drawings, _signals)
