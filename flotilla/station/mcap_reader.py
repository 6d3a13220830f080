"""Reads recordings of `make record`, and others' MCAP files whose messages are protobuf, by the schemas in the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import NonSeekingReader
from mcap.records import Schema

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.station.schema import ENCODING

Array = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Topic:
    """Messages of a topic, in the order in which they were recorded."""

    name: str
    times_ns: Array
    """When each was received, nanoseconds since 1970-01-01 UTC."""
    signals: dict[str, Array]
    """Numbers by name, in the order of the schema: a row a message, of several elements where it has them."""


@dataclass
class _Rows:
    names: list[str]
    times_ns: list[int] = field(default_factory=list)
    values: list[list[Any]] = field(default_factory=list)


def read(file: Path) -> list[Topic]:
    """All topics with messages. What was not written to its end is read as far as it goes.

    UserError where the file cannot be read, or is no such recording.
    """
    try:
        with file.open("rb") as opened:
            found = _read(opened)
    except OSError as error:
        raise UserError(f"{paths.shown(file)}: {error.strerror}; record one: make record OUT=FILE") from error
    except (McapError, DecodeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{paths.shown(file)}: is no MCAP file of protobuf messages: {error!r}; record one: make record OUT=FILE"
        ) from error
    if not found:
        raise UserError(f"{paths.shown(file)}: holds no message; did robots send any? make top shows it")
    return found


def _read(opened: IO[bytes]) -> list[Topic]:
    kinds: dict[int, type[Any]] = {}
    topics: dict[str, _Rows] = {}
    for schema, topic, data, time_ns in messages(opened):
        if schema.id not in kinds:
            kinds[schema.id] = message_class(schema)
        message = kinds[schema.id].FromString(data)
        names = [each.name for each in message.DESCRIPTOR.fields if _is_number(each)]
        rows = topics.setdefault(topic, _Rows(names))
        rows.times_ns.append(time_ns)
        rows.values.append([getattr(message, name) for name in rows.names])
    return [
        Topic(
            name,
            np.array(rows.times_ns),
            {signal: np.array([row[at] for row in rows.values]) for at, signal in enumerate(rows.names)},
        )
        for name, rows in sorted(topics.items())
    ]


def messages(opened: IO[bytes]) -> Iterator[tuple[Schema, str, bytes, int]]:
    with suppress(EndOfFile):  # whoever recorded it was killed, or records still
        for schema, channel, message in NonSeekingReader(opened).iter_messages(log_time_order=False):
            if schema and schema.encoding == channel.message_encoding == ENCODING:
                yield schema, channel.topic, message.data, message.log_time


def message_class(schema: Schema) -> type[Any]:
    pool = descriptor_pool.DescriptorPool()
    for each in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(each)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def _is_number(described: FieldDescriptor) -> bool:
    return described.cpp_type not in (FieldDescriptor.CPPTYPE_STRING, FieldDescriptor.CPPTYPE_MESSAGE)
