"""The page of keys of YAML files, from the pydantic models that check them."""

from __future__ import annotations

import json
import types
from collections.abc import Iterator
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flotilla.apps import app
from flotilla.debian import kernel, lock
from flotilla.fleet.model import Board, Check, Fleet, Host, Message, Robot
from flotilla.images import card
from flotilla.reference.markdown import MADE, code, table

_PLAIN = {
    Any: "anything", bool: "boolean", int: "integer", float: "number", str: "string", IPv4Address: "IPv4 address",
    IPv4Network: "IPv4 network",
}  # fmt: skip


@dataclass(frozen=True)
class Section:
    """A mapping in a file, whose keys are a model's fields."""

    title: str
    about: str
    model: type[BaseModel]
    below: str = ""
    """Keys above the mapping."""
    without: frozenset[str] = frozenset()
    """Fields that are no keys here."""


SECTIONS = (
    Section(
        "The whole fleet", "`ansible/inventory/group_vars/all.yml`.", Fleet,
        without=frozenset({"boards", "robots", "stations", "messages"}),
    ),
    Section(
        "Boards", "`ansible/inventory/group_vars/board_NAME.yml`, a file for each kind of computer.", Board, "board.",
        frozenset({"name"}),
    ),
    Section(
        "Robots", "`ansible/inventory/robots.yml`, below each host of a group `board_NAME`. The host's name is the "
        "robot's.", Robot, without=frozenset({"name", "board"}),
    ),
    Section(
        "Stations", "`ansible/inventory/robots.yml`, below each host of the group `stations`.", Host,
        without=frozenset({"name"}),
    ),
    Section(
        "Messages", "`ansible/control_tasks/messages.yml`. The message's name, here `MESSAGE`, is its topic by DDS. "
        "The name of a message to the stations begins with its sender's. A message has at most 1472 bytes: one "
        "Ethernet frame. Signals lie in it in their order, little-endian and without gaps.", Message, "MESSAGE.",
    ),
    *(
        Section(f"Apps of kind {kind}", f"`app.yml` in the app's directory. {model.__doc__}", model)
        for kind, model in app.MODELS.items()
    ),
    Section("Layout of the card", "`images/boot/card.yml`.", card.Layout),
    Section("Kernels of our own", "`kernel/NAME.yml`.", kernel.Recipe),
    Section("Locks", "`images/packages/locks.yml`.", lock.File),
)  # fmt: skip
_RENAMED: dict[tuple[type[BaseModel], str], str] = {(Fleet, "name"): "fleet_name"}
"""Fields whose keys have other names."""


@dataclass(frozen=True)
class Value:
    """What a key may have."""

    text: str
    unit: str = ""
    model: type[BaseModel] | None = None
    """Of the mapping that it is, or of those that it contains."""
    step: str = ""
    """Name of a key between: of a mapping by name, or of a list."""


def fields(section: Section) -> Iterator[tuple[str, FieldInfo, Value]]:
    """Keys of a section, with those of mappings within."""
    yield from _fields(section.model, section.below, section.without)


def _fields(
    model: type[BaseModel], below: str, without: frozenset[str] = frozenset()
) -> Iterator[tuple[str, FieldInfo, Value]]:
    hints = get_type_hints(model, include_extras=True)
    for name, field in model.model_fields.items():
        if name not in without:
            key, value = below + _RENAMED.get((model, name), name), _value(hints[name])
            yield key, field, value
            if value.model:
                yield from _fields(value.model, f"{key}.{value.step}")


def _value(hint: Any) -> Value:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        value = _value(arguments[0])
        checks = [each for each in arguments[1:] if isinstance(each, Check)]
        rules = "; ".join(check.right for check in checks)
        unit = next((check.unit for check in checks if check.unit), "")
        return Value(f"{value.text}: {rules}", unit) if checks else value
    if origin in (Union, types.UnionType):
        return _value(next(each for each in arguments if each is not types.NoneType))
    if origin is Literal:
        return Value(" or ".join(map(code, arguments)))
    if origin is dict:
        inner = _value(arguments[1])
        names = _value(arguments[0]).text.removeprefix("string").removeprefix(": ")
        return Value(f"mapping by name{names and f': {names}'}", model=inner.model, step="NAME.")
    if origin in (list, tuple):
        inner = _value(arguments[0])
        return Value(f"list, each {inner.text}", inner.unit)
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return Value("mapping", model=hint)
    return Value(_PLAIN[hint])


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if isinstance(field.default, BaseModel):
        return "as below"
    if field.default is None or field.default == "":
        return "none"
    return code(json.dumps(field.default))


def page() -> str:
    parts = [
        f"{MADE}\n\n# Keys of YAML files\n\n`NAME` stands for a name that the file chooses. `make check-fleet` checks "
        "the inventory and the messages.\n"
    ]
    for section in SECTIONS:
        rows = [
            (code(key), value.text, value.unit, _default(field), field.description or "")
            for key, field, value in fields(section)
        ]
        parts.append(f"## {section.title}\n\n{section.about}\n")
        parts.append(table(("key", "value", "unit", "default", "meaning"), rows))
    return "\n".join(parts)
