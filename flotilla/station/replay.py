"""Replays a recording of `make record` or of the station's page to sinks of the receiver, as if it came now."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.station import mcap_reader, schema
from flotilla.station.receiver import Receiver
from flotilla.station.recording import Field, Value
from flotilla.station.telemetry import Stream

LONGEST_BYTES = 1 << 29
"""Of a file: all of it is in memory."""
_AT_ONCE = 5000
"""Messages in one go: where more are due, the replay is slower than it should be."""
_BEFORE_NS = 60_000_000_000
"""What is shown again after a jump, so that paths and counts have a past."""
_TYPES = {
    FieldDescriptor.TYPE_BOOL: "boolean", FieldDescriptor.TYPE_FLOAT: "single", FieldDescriptor.TYPE_DOUBLE: "double",
    FieldDescriptor.TYPE_INT64: "int64", FieldDescriptor.TYPE_UINT64: "uint64", FieldDescriptor.TYPE_INT32: "int32",
    FieldDescriptor.TYPE_UINT32: "uint32",
}  # fmt: skip


@dataclass(frozen=True)
class _Message:
    time_ns: int
    topic: str
    data: bytes


class Replay:
    """A clock of its own, which stands until `play`. UserError where the file is no recording."""

    def __init__(self, file: Path, known: Iterable[Stream]) -> None:
        self.name = file.name
        damage = mcap_reader.Damage()
        self._messages, kinds = _load(file, damage)
        self.notes = damage.notes(file)
        """What of the file was left out."""
        described = {stream.topic: stream for stream in known}
        self._streams: dict[str, Stream] = {}
        self._kinds: dict[str, Any] = {}
        for topic, kind in kinds.items():
            of_topic = [each for each in self._messages if each.topic == topic]
            stream = described.get(topic) or _stream(topic, kind, of_topic)
            if stream and _fits(stream, kind):
                self._streams[topic], self._kinds[topic] = stream, kind
        if not self._streams:
            raise UserError(
                f"{paths.shown(file)}: holds no topic /ROBOT/TASK/NAME with signals; record one: make record OUT=FILE"
            )
        self._messages = [each for each in self._messages if each.topic in self._streams]
        self._times = [each.time_ns for each in self._messages]
        self.begin_ns, self.end_ns = self._times[0], self._times[-1]
        self.position_ns = self.begin_ns
        self.speed = 1.0
        self.playing = False
        self._next = 0
        self._advanced_ns = 0
        """By the clock that never jumps."""

    @property
    def streams(self) -> list[Stream]:
        return list(self._streams.values())

    def clock(self) -> int:
        """Where it is; ns since 1970-01-01 UTC."""
        return self.position_ns

    def play(self, on: bool) -> None:
        if on and self.position_ns >= self.end_ns:
            self.position_ns, self._next = self.begin_ns, 0
        self._advanced_ns = time.monotonic_ns()
        self.playing = on

    def seek(self, at_s: float, receiver: Receiver) -> None:
        """To so many seconds after its begin. Sinks have to begin anew first; they get the minute before it again."""
        self.position_ns = min(self.end_ns, self.begin_ns + round(1e9 * at_s))
        self._next = bisect_left(self._times, self.position_ns - _BEFORE_NS)
        end = bisect_left(self._times, self.position_ns + 1)
        self._next = max(self._next, end - 4 * _AT_ONCE)
        for count in receiver.counts.values():
            count.received = 0
        self._hand(receiver, end)
        self._advanced_ns = time.monotonic_ns()

    def advance(self, receiver: Receiver) -> None:
        """Hand over what is due by now."""
        if not self.playing:
            return
        now_ns = time.monotonic_ns()
        self.position_ns += round((now_ns - self._advanced_ns) * self.speed)
        self._advanced_ns = now_ns
        end = bisect_left(self._times, self.position_ns + 1)
        if end - self._next > _AT_ONCE:
            end = self._next + _AT_ONCE
            self.position_ns = self._times[end - 1]
        self._hand(receiver, end)
        if self.position_ns >= self.end_ns:
            self.position_ns, self.playing = self.end_ns, False

    def _hand(self, receiver: Receiver, end: int) -> None:
        for message in self._messages[self._next : end]:
            values = _values(self._streams[message.topic], self._kinds[message.topic].FromString(message.data))
            receiver.hand(self._streams[message.topic], values, message.time_ns)
        self._next = end


def _load(file: Path, damage: mcap_reader.Damage) -> tuple[list[_Message], dict[str, Any]]:
    """Messages by time, and classes of what may be streams by topic."""
    messages: list[_Message] = []
    kinds: dict[str, Any] = {}
    try:
        if (size := file.stat().st_size) > LONGEST_BYTES:
            raise UserError(
                f"{paths.shown(file)}: {progress.size(size)} are more than {progress.size(LONGEST_BYTES)}, which is "
                "the most that is replayed; record in parts, or open it in Foxglove"
            )
        with file.open("rb") as opened:
            for described, channel, data, time_ns in mcap_reader.messages(opened, damage):
                if channel.topic not in kinds:
                    kinds[channel.topic] = mcap_reader.message_class(described)
                messages.append(_Message(time_ns, channel.topic, data))
    except OSError as error:
        raise UserError(f"{paths.shown(file)}: {error.strerror}; record one: make record OUT=FILE") from error
    except (McapError, DecodeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{paths.shown(file)}: is no MCAP file of protobuf messages: {error!r}; record one: make record OUT=FILE"
        ) from error
    messages.sort(key=lambda message: message.time_ns)
    return messages, kinds


def _stream(topic: str, kind: Any, messages: list[_Message]) -> Stream | None:
    """As the recording tells it, of a fleet that is not the inventory's: its rate is that of the messages."""
    parts = topic.strip("/").split("/")
    members = [each for each in kind.DESCRIPTOR.fields if each.type in _TYPES]
    if len(parts) != 3 or len(members) != len(kind.DESCRIPTOR.fields) or not members:
        return None
    robot, task, name = parts
    gaps = [after.time_ns - before.time_ns for before, after in pairwise(messages)]
    step_s = max(1e-3, median(gaps) / 1e9) if gaps else 1.0
    first = kind.FromString(messages[0].data)
    widths = {each.name: len(getattr(first, each.name)) if each.is_repeated else 1 for each in members}
    fields = tuple(Field(each.name, _TYPES[each.type], widths[each.name], 0) for each in members)
    return Stream(robot, task, name, address=topic, port=0, fields=fields, step_s=step_s, every=1)


def _fits(stream: Stream, kind: Any) -> bool:
    """Whether the recording has all signals of a stream: the inventory may have changed since."""
    members = {each.name for each in kind.DESCRIPTOR.fields}
    return members.issuperset(schema.identifiers(each.name for each in stream.fields).values())


def _values(stream: Stream, message: Any) -> Mapping[str, Value]:
    found: dict[str, Value] = {}
    for name, member in schema.identifiers(each.name for each in stream.fields).items():
        value = getattr(message, member)
        found[name] = value if isinstance(value, bool | int | float) else tuple(value)
    return found
