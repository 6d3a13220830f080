"""What streams are to viewers: protobuf messages, with schemas made from their descriptions in messages.yml."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from flotilla.fleet.drawings import Drawing
from flotilla.station.recording import Field, Value
from flotilla.station.telemetry import Stream

ENCODING = "protobuf"
"""Of messages and schemas, as MCAP and Foxglove call it."""
UNITS = "units"
"""Of a channel's metadata in MCAP: units of a signal's elements, as JSON; one alone is that of all."""
_TYPES = {
    "boolean": "BOOL", "single": "FLOAT", "double": "DOUBLE", "int64": "INT64", "uint64": "UINT64",
    **dict.fromkeys(("int8", "int16", "int32"), "INT32"), **dict.fromkeys(("uint8", "uint16", "uint32"), "UINT32"),
}  # fmt: skip
"""Types of protobuf by those of signals."""


_MOST = 63
"""Characters of an identifier: MATLAB's namelengthmax."""


class Schema:
    """Of a topic's messages; `name` is the message's, without its package."""

    def __init__(self, topic: str, name: str, fields: Sequence[Field]) -> None:
        file = descriptor_pb2.FileDescriptorProto(name=f"{topic[1:]}.proto", package="flotilla", syntax="proto3")
        name = "".join(word.capitalize() for word in re.split("[-_/]", name))
        message = file.message_type.add(name=name)
        self.names = identifiers(field.name for field in fields)
        """What signals are called in messages, by their own names."""
        for number, field in enumerate(fields, 1):
            described = message.field.add(name=self.names[field.name], number=number)
            described.type = getattr(descriptor_pb2.FieldDescriptorProto, f"TYPE_{_TYPES[field.type]}")
            described.label = (
                descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED if field.width > 1
                else descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL
            )  # fmt: skip
        pool = descriptor_pool.DescriptorPool()
        pool.Add(file)
        self.name = f"flotilla.{name}"
        self.data: bytes = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
        """A FileDescriptorSet."""
        self._message: type[Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(self.name))

    @classmethod
    def of(cls, stream: Stream) -> Schema:
        return cls(stream.topic, f"{stream.task}-{stream.name}", stream.fields)

    def encode(self, values: Mapping[str, Value], received_ns: int) -> bytes:
        """A message of these values, which `Stream.unpack` gave."""
        message = self._message(**{self.names[name]: value for name, value in values.items()})
        encoded: bytes = message.SerializeToString()
        return encoded


def topics(stream: Stream) -> dict[str, Schema | Drawing]:
    """What recordings and viewers have of a stream: itself, and what they draw of it."""
    drawings = {f"{stream.topic}/{name}": drawing for name, drawing in stream.drawings.items()}
    return {stream.topic: Schema.of(stream), **drawings}


def identifiers(names: Iterable[str], reserved: Collection[str] = ()) -> dict[str, str]:
    """What each name is in protobuf and MATLAB: a letter, then letters, digits and `_`. No two are the same."""
    found: dict[str, str] = {}
    for name in names:
        stem = re.sub("[^A-Za-z0-9_]", "_", name)
        stem = (stem if stem[:1].isalpha() else f"x{stem}")[:_MOST]
        taken, number, each = {*found.values(), *reserved}, 1, stem
        while each in taken:
            number += 1
            each = f"{stem[: _MOST - 1 - len(str(number))]}_{number}"
        found[name] = each
    return found
