"""What streams are to viewers: protobuf messages, with schemas made from their descriptions in messages.yml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from flotilla.fleet.drawings import Drawing
from flotilla.station.recording import Value
from flotilla.station.telemetry import Stream

ENCODING = "protobuf"
"""Of messages and schemas, as MCAP and Foxglove call it."""
_TYPES = {
    "boolean": "BOOL", "single": "FLOAT", "double": "DOUBLE", "int64": "INT64", "uint64": "UINT64",
    **dict.fromkeys(("int8", "int16", "int32"), "INT32"), **dict.fromkeys(("uint8", "uint16", "uint32"), "UINT32"),
}  # fmt: skip
"""Types of protobuf by those of signals."""


class Schema:
    """Of a stream's messages."""

    def __init__(self, stream: Stream) -> None:
        file = descriptor_pb2.FileDescriptorProto(name=f"{stream.topic[1:]}.proto", package="flotilla", syntax="proto3")
        name = "".join(word.capitalize() for word in f"{stream.task}-{stream.name}".replace("_", "-").split("-"))
        message = file.message_type.add(name=name)
        for number, field in enumerate(stream.fields, 1):
            described = message.field.add(name=identifier(field.name), number=number)
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

    def encode(self, values: Mapping[str, Value], received_ns: int) -> bytes:
        """A message of these values, which `Stream.unpack` gave."""
        message = self._message(**{identifier(name): value for name, value in values.items()})
        encoded: bytes = message.SerializeToString()
        return encoded


def topics(stream: Stream) -> dict[str, Schema | Drawing]:
    """What recordings and viewers have of a stream: itself, and what they draw of it."""
    drawings = {f"{stream.topic}/{name}": drawing for name, drawing in stream.drawings.items()}
    return {stream.topic: Schema(stream), **drawings}


def identifier(name: str) -> str:
    """A signal's name, as protobuf has it."""
    return name.replace("-", "_")
