"""Reads recordings of `make record`, and others' MCAP files whose messages are protobuf, by the schemas in the file."""

from __future__ import annotations

import dataclasses
import json
import mmap
import os
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from lz4.frame import LZ4FrameDecompressor
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.station.schema import ENCODING, UNITS
from flotilla.station.topic import Topic


@dataclass
class _Rows:
    names: list[str]
    units: dict[str, tuple[str, ...]]
    times_ns: list[int] = field(default_factory=list)
    values: list[list[Any]] = field(default_factory=list)


_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
"""Of each record: what it is, and bytes of its content."""
_LENGTH = struct.Struct("<Q")
_READ: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: records.Header.read, Opcode.FOOTER: records.Footer.read, Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read, Opcode.CHUNK: Chunk.read, Opcode.MESSAGE_INDEX: records.MessageIndex.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read, Opcode.ATTACHMENT: records.Attachment.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read, Opcode.STATISTICS: records.Statistics.read,
    Opcode.METADATA: records.Metadata.read, Opcode.METADATA_INDEX: records.MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset.read, Opcode.DATA_END: records.DataEnd.read,
}  # fmt: skip
"""By what a record is; a message alone has to be told its length."""
_CHUNK = re.compile(rb"\x06.{8}.{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)", re.DOTALL)
"""How a chunk begins; with the length of its content it is one with near certainty."""
_CHUNK_BYTES = 64 << 20
"""Of a chunk, without compression; `make record` writes 1 MiB."""
_WRONG = (McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, RuntimeError, MemoryError, OverflowError)
"""What readers of damaged records raise."""


@dataclass
class Damage:
    """Bytes of a file that were left out, from and to; it grows while the file is read."""

    bytes: list[tuple[int, int]] = field(default_factory=list)

    def notes(self, file: Path) -> list[str]:
        """Where what is missing was, a line each for the first ones."""
        said = [f"{paths.shown(file)}: bytes {begin} to {end} are damaged, and left out" for begin, end in self.bytes]
        return [*said[:10], *([f"{paths.shown(file)}: {len(said) - 10} more places are damaged"] if said[10:] else [])]


def read(file: Path, damage: Damage) -> list[Topic]:
    """All topics with messages. What is damaged, or was not written to its end, is left out.

    UserError where the file cannot be read, or is no such recording.
    """
    try:
        with file.open("rb") as opened:
            found = _read(opened, damage)
    except OSError as error:
        raise UserError(f"{paths.shown(file)}: {error.strerror}; record one: make record OUT=FILE") from error
    except (*_WRONG, DecodeError, TypeError) as error:
        raise UserError(
            f"{paths.shown(file)}: is no MCAP file of protobuf messages: {error!r}; record one: make record OUT=FILE"
        ) from error
    if not found and damage.bytes:
        raise UserError(f"{damage.notes(file)[0]}; nothing else is in it")
    if not found:
        raise UserError(f"{paths.shown(file)}: holds no message; did robots send any? make top shows it")
    return found


def _read(opened: IO[bytes], damage: Damage) -> list[Topic]:
    kinds: dict[int, type[Any]] = {}
    topics: dict[str, _Rows] = {}
    for schema, channel, data, time_ns in messages(opened, damage):
        if schema.id not in kinds:
            kinds[schema.id] = message_class(schema)
        message = kinds[schema.id].FromString(data)
        names = [each.name for each in message.DESCRIPTOR.fields if _is_number(each)]
        rows = topics.setdefault(channel.topic, _Rows(names, _units(channel)))
        rows.times_ns.append(time_ns)
        rows.values.append([getattr(message, name) for name in rows.names])
    return [
        Topic(
            name,
            np.array(rows.times_ns),
            {signal: np.array([row[at] for row in rows.values]) for at, signal in enumerate(rows.names)},
            rows.units,
        )
        for name, rows in sorted(topics.items())
    ]


def messages(opened: IO[bytes], damage: Damage) -> Iterator[tuple[Schema, Channel, bytes, int]]:
    """In the order of the file. What says how to read a channel may lie behind its messages, where it is there twice
    and its first place is damaged: these wait for it."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    waiting: list[Message] = []

    def known(message: Message) -> Iterator[tuple[Schema, Channel, bytes, int]]:
        channel = channels[message.channel_id]
        schema = schemas.get(channel.schema_id)
        if schema and schema.encoding == channel.message_encoding == ENCODING:
            yield schema, channel, message.data, message.log_time

    for record in _records(opened, damage):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            if record.channel_id in channels and channels[record.channel_id].schema_id in {0, *schemas}:
                yield from known(record)
            else:
                waiting.append(record)
    for message in waiting:
        if message.channel_id in channels:
            yield from known(message)


def _records(opened: IO[bytes], damage: Damage) -> Iterator[McapRecord]:
    """All good records, also those in chunks. After a bad one it continues with the next chunk."""
    if not os.fstat(opened.fileno()).st_size:
        return
    with closing(mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)) as data:
        at = len(_MAGIC)
        if data[:at] != _MAGIC and not _CHUNK.search(data):
            raise ValueError("it does not begin as one")
        if data[:at] != _MAGIC:
            damage.bytes.append((0, at))
        while at < len(data):
            found = _record(data, at)
            if not found:
                following = _next_chunk(data, at + 1)
                damage.bytes.append((at, following))
                at = following
                continue
            record, end = found
            try:
                yield from breakup_chunk(_plain(record), validate_crc=True) if isinstance(record, Chunk) else [record]
            except _WRONG:
                damage.bytes.append((at, end))
            at = end
            if data[at:] == _MAGIC:
                return


def _plain(chunk: Chunk) -> Chunk:
    """The chunk without compression. ValueError where it has more than it says, or than fits the memory easily."""
    size = chunk.uncompressed_size
    if size > _CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes")
    if chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=_CHUNK_BYTES).stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    else:
        data = chunk.data
    if len(data) != size:
        raise ValueError("a chunk of another size than its header specifies")
    return dataclasses.replace(chunk, compression="", data=data)


def _record(data: mmap.mmap, at: int) -> tuple[McapRecord, int] | None:
    """The record there and where it ends; None where its content is not as long as it says."""
    if len(data) - at < _HEAD.size:
        return None
    kind, length = _HEAD.unpack_from(data, at)
    end = at + _HEAD.size + length
    if end > len(data) or (kind not in _READ and kind != Opcode.MESSAGE):
        return None
    stream = ReadDataStream(BytesIO(data[at + _HEAD.size : end]))
    try:
        record: McapRecord = Message.read(stream, length) if kind == Opcode.MESSAGE else _READ[kind](stream)
    except _WRONG:
        return None
    return (record, end) if stream.count == length else None


def _next_chunk(data: mmap.mmap, at: int) -> int:
    """Where one begins, from there on; the end of the file where none does."""
    for found in _CHUNK.finditer(data, at):
        _, length = _HEAD.unpack_from(data, found.start())
        fixed = found.end() - found.start() - _HEAD.size + _LENGTH.size
        if found.end() + _LENGTH.size <= len(data) and length == fixed + _LENGTH.unpack_from(data, found.end())[0]:
            return found.start()
    return len(data)


def _units(channel: Channel) -> dict[str, tuple[str, ...]]:
    """As `make record` writes them; nothing where another program recorded."""
    try:
        return {name: tuple(map(str, each)) for name, each in json.loads(channel.metadata.get(UNITS, "{}")).items()}
    except (ValueError, AttributeError, TypeError):
        return {}


def message_class(schema: Schema) -> type[Any]:
    pool = descriptor_pool.DescriptorPool()
    for each in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(each)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def _is_number(described: FieldDescriptor) -> bool:
    return described.cpp_type not in (FieldDescriptor.CPPTYPE_STRING, FieldDescriptor.CPPTYPE_MESSAGE)
