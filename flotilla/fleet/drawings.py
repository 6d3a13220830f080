"""What viewers draw: messages of Foxglove (docs.foxglove.dev, schemas) that are made of a message's signals.

`foxglove:` of an entry in `messages.yml` says which; recordings and live streams have them beside the message itself.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from math import cos, isfinite, nan, sin
from typing import Any

import foxglove.messages
from google.protobuf import descriptor, descriptor_pb2, descriptor_pool, json_format, message_factory

from flotilla.fleet.model import Drawn, Signal

Elements = tuple[Any, ...]
_Field = descriptor.FieldDescriptor
_NUMBERS = {_Field.CPPTYPE_DOUBLE, _Field.CPPTYPE_FLOAT}
_UNSIGNED = ("boolean", "uint8", "uint16", "uint32")
_INTEGERS = {
    _Field.CPPTYPE_INT32: ("boolean", "int8", "int16", "int32", "uint8", "uint16"),
    _Field.CPPTYPE_INT64: ("int8", "int16", "int32", "int64", *_UNSIGNED),
    _Field.CPPTYPE_UINT32: _UNSIGNED,
    _Field.CPPTYPE_UINT64: (*_UNSIGNED, "uint64"),
}
"""Types of signals of which every value fits."""


class DrawingError(Exception):
    """What is wrong with an entry, and where in it."""

    def __init__(self, loc: tuple[str, ...], wrong: str, remedy: str) -> None:
        super().__init__(wrong)
        self.loc, self.wrong, self.remedy = loc, wrong, remedy


@functools.cache
def schemas() -> dict[str, Any]:
    """Foxglove's schemas by name, without `foxglove.`."""
    found = {name: getattr(foxglove.messages, name) for name in foxglove.messages.__all__}
    return {name: kind.get_schema() for name, kind in found.items() if hasattr(kind, "encode")}


class Drawing:
    """Makes messages of one schema."""

    def __init__(self, drawn: Drawn, signals: Mapping[str, Signal]) -> None:
        """DrawingError where the schema lacks a member, or the message a signal."""
        if drawn.type not in schemas():
            raise DrawingError(
                ("type",), "is no schema of Foxglove", "such as CompressedImage, Grid, LaserScan or PoseInFrame"
            )
        self.drawn = drawn
        schema = schemas()[drawn.type]
        self.name: str = schema.name
        self.data: bytes = schema.data
        """A FileDescriptorSet."""
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(self.data).file:
            pool.Add(file)
        self._constant = message_factory.GetMessageClass(pool.FindMessageTypeByName(self.name))()
        try:
            json_format.ParseDict(drawn.constants, self._constant)
        except (json_format.ParseError, TypeError, ValueError, AttributeError) as error:
            raise DrawingError(("constants",), f"does not fit: {error}", "what the schema has, as JSON") from error
        self._sources = [_source(self._constant, path, text, signals) for path, text in drawn.signals.items()]
        self._stamped = "timestamp" in self._constant.DESCRIPTOR.fields_by_name and "timestamp" not in drawn.signals

    def encode(self, values: Mapping[str, Any], received_ns: int) -> bytes:
        """A message of these values, by signal. The timestamp is the reception's where no signal is."""
        message: Any = type(self._constant)()
        message.CopyFrom(self._constant)
        if self._stamped:
            _set_timestamp(message.timestamp, (received_ns,))
        for path, put, signal, element in self._sources:
            value = values[signal]
            elements = value if isinstance(value, tuple) else (value,)
            put(functools.reduce(getattr, path, message), elements if element is None else (elements[element],))
        encoded: bytes = message.SerializeToString()
        return encoded


_Source = tuple[list[str], Callable[[Any, Elements], None], str, int | None]
"""Members that lead to the one that is set, how it is, by which signal, by which element of it."""


def _source(message: Any, path: str, text: str, signals: Mapping[str, Signal]) -> _Source:
    """Where the values of a member come from."""
    place = ("signals", path)
    reference = re.fullmatch(r"([\w-]+)(?:\[(\d+)\])?", text)
    signal = signals.get(reference[1]) if reference else None
    if not reference or not signal:
        raise DrawingError(
            place, "is not a signal of this message", f"one of {', '.join(signals)}, or an element, x[0]"
        )
    element = int(reference[2]) if reference[2] else None
    if element is not None and element >= signal.width:
        raise DrawingError(place, f"{reference[1]} has {signal.width} elements", f"[0] to [{signal.width - 1}]")
    *above, last = path.split(".")
    described = message.DESCRIPTOR
    for name in above:
        field = described.fields_by_name.get(name)
        described = field.message_type if field and not field.is_repeated else None
        if not described:
            break
    field = described.fields_by_name.get(last) if described else None
    if not field:
        raise DrawingError(place, "the schema has no such member", "a path such as pose.position.x")
    count = signal.width if element is None else 1
    put, needs = _setter(field, signal.type, count)
    if not put:
        raise DrawingError(place, f"takes {needs}, not {count} of {signal.type}", "another signal, or an element of it")
    leads = [*above, last] if field.message_type else above
    return leads, put, reference[1], element


def _setter(field: Any, type_: str, count: int) -> tuple[Callable[[Any, Elements], None] | None, str]:
    """What sets a member by so many elements of that type, if anything does; what it needs."""
    name = field.name

    def extend(message: Any, elements: Elements) -> None:
        getattr(message, name).extend(elements)

    def put(message: Any, elements: Elements) -> None:
        setattr(message, name, elements[0])

    def put_bytes(message: Any, elements: Elements) -> None:
        setattr(message, name, bytes(elements))

    kind = field.message_type.full_name if field.message_type else ""
    if field.type == _Field.TYPE_BYTES:
        return (put_bytes if type_ == "uint8" else None), "uint8"
    if field.cpp_type in _NUMBERS and field.is_repeated:
        return extend, "numbers"
    if field.cpp_type in _NUMBERS:
        return (put if count == 1 else None), "one number"
    if field.cpp_type in _INTEGERS and not field.is_repeated:
        fitting = _INTEGERS[field.cpp_type]
        return (put if count == 1 and type_ in fitting else None), f"one of {', '.join(fitting)}"
    if kind == "foxglove.Quaternion" and not field.is_repeated:
        return (_set_heading if count == 1 else None), "one heading in rad"
    if kind == "google.protobuf.Timestamp":
        return (_set_timestamp if count == 1 and type_ == "int64" else None), "one int64 in ns"
    return None, "no signal"


def _set_heading(quaternion: Any, elements: Elements) -> None:
    """About z, counter-clockwise."""
    half = elements[0] / 2 if isfinite(elements[0]) else nan
    quaternion.z, quaternion.w = sin(half), cos(half)


def _set_timestamp(timestamp: Any, elements: Elements) -> None:
    timestamp.seconds, timestamp.nanos = divmod(elements[0], 10**9)
