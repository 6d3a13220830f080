"""Recorder files in the order in which they were written: a recording is many, and some tasks have several."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.station import recording
from flotilla.station.recording import Array, Field, Found, Header, RecordingError
from flotilla.station.topic import Topic

SUFFIX = ".rec"
_NUMBER = re.compile(rf"-(\d+)\{SUFFIX}$")
_OWN = ("time_ns", "lost")
"""Fields that a recorder adds, and that are no signals; `step` counts as one."""


class _Damaged(UserError):
    """A file whose beginning is not a recording's, or is gone."""


@dataclass(frozen=True)
class Segment:
    """A file of a recording."""

    file: Path
    header: Header
    first: tuple[int, int] | None
    """`time_ns` and `step` of its first good record; None: it has no record."""
    last: tuple[int, int] | None

    @property
    def number(self) -> int:
        match = _NUMBER.search(self.file.name)
        return int(match[1]) if match else 0


@dataclass
class Recorded:
    """What one recorder wrote."""

    topic: str
    """`/log`; with folders before it where several recordings have one name: `/robot3/heading/log`."""
    segments: list[Segment]
    walls_ns: list[int]
    """For each segment, what to add to `time_ns` for nanoseconds since 1970-01-01 UTC."""
    left_out: list[str] = field(default_factory=list)
    """Files beside it that are no recordings any more, and why."""
    found: dict[Path, Found] = field(default_factory=dict)
    """Of each file that was read."""

    @property
    def fields(self) -> tuple[Field, ...]:
        return self.segments[0].header.fields

    @property
    def record_bytes(self) -> int:
        return self.segments[0].header.bytes_of_record

    @property
    def most(self) -> int:
        """Records at most."""
        return sum(segment.file.stat().st_size // self.record_bytes for segment in self.segments)

    def account(self) -> str:
        """What was read so far, in a line."""
        count = sum(found.records for found in self.found.values())
        first = self.segments[0].first
        since = first and np.datetime64(first[0] + self.walls_ns[0], "ns").astype("datetime64[s]")
        begin = f" from {since} UTC on" if since is not None else ""
        files = len(self.segments)
        return f"{self.topic}: {count} records of {files} file{'s' * (files > 1)}{begin}"

    @property
    def size(self) -> int:
        """Bytes of its files."""
        return sum(segment.file.stat().st_size for segment in self.segments)

    def chunks(self) -> Iterator[tuple[Array, Array]]:
        """All good records in order, some at a time, with when each was due: nanoseconds since 1970-01-01 UTC."""
        for segment, wall_ns in zip(self.segments, self.walls_ns, strict=True):
            found = self.found[segment.file] = Found()
            for records in recording.chunks(segment.file, found):
                yield records, records["time_ns"].astype(np.int64) + wall_ns

    def whole(self) -> Topic:
        """In memory, as a report needs it."""
        chunks = [chunk for chunk in self.chunks() if len(chunk[0])]
        records = np.concatenate([records for records, _ in chunks])
        signals = {each.name: records[each.name] for each in self.fields if each.name not in _OWN}
        return Topic(self.topic, np.concatenate([times for _, times in chunks]), signals)

    def notes(self) -> list[str]:
        """What is missing, by what was read so far."""
        said = list(self.left_out)
        for before, after in pairwise(self.segments):
            if before.number and after.number > before.number + 1:
                said.append(f"{paths.shown(after.file)}: the files between {before.file.name} and it are missing")
        for file, found in self.found.items():
            if found.damaged:
                place = f"the first one at byte {found.first_damaged}"
                said.append(f"{paths.shown(file)}: {found.damaged} damaged records left out, {place}")
            if found.rest:
                said.append(f"{paths.shown(file)}: half a record at its end left out, {found.rest} bytes")
        return said


def files(given: Sequence[Path]) -> list[Path]:
    """What a user named, each once: folders stand for the recorder files in them, `*` and `?` for any characters."""
    found: dict[Path, Path] = {}
    for each in given:
        if each.is_dir():
            there = sorted(each.rglob(f"*{SUFFIX}"))
            if not there:
                raise UserError(f"{paths.shown(each)}: has no file *{SUFFIX}; name a folder that recordings are in")
        elif not each.exists() and set("*?[") & set(str(each)):
            there = sorted(Path(each.anchor).glob(str(each.relative_to(each.anchor))))
            if not there:
                raise UserError(f"{paths.shown(each)}: matches no file; look at the names with ls")
        else:
            there = [each]
        found |= {file.resolve(): file for file in there}
    return list(found.values())


def find(given: Sequence[Path]) -> list[Recorded]:
    """The recordings that these files are, by topic. UserError where none is one, or one does not fit the others."""
    wrong: list[_Damaged] = []
    groups: dict[tuple[Path, str], list[Segment]] = {}
    for file in given:
        try:
            segment = _segment(file)
        except _Damaged as error:
            wrong.append(error)
            continue
        groups.setdefault((file.resolve().parent, segment.header.name), []).append(segment)
    if not groups:
        raise wrong[0]
    topics = _topics(list(groups))
    found = []
    for key, segments in groups.items():
        segments.sort(key=lambda each: (each.number, each.header.wall_less_monotonic_ns, each.first or (0, 0)))
        _check_fields(segments)
        if any(segment.first for segment in segments):
            found.append(Recorded(topics[key], segments, _walls_ns(segments)))
    if not found:
        named = ", ".join(paths.shown(file) for file in given)
        raise UserError(f"{named}: no record in it; the recorder writes the first ones when its task has run a moment")
    found.sort(key=lambda recorded: recorded.topic)
    found[0].left_out = [f"left out: {error}" for error in wrong]
    return found


def _segment(file: Path) -> Segment:
    try:
        if file.stat().st_size == 0:
            raise _Damaged(
                f"{paths.shown(file)}: is empty, as after a loss of power; leave it out, the others are whole"
            )
        header = recording.read_header(file)
        first, last = recording.ends(file)
    except OSError as error:
        raise UserError(
            f"{paths.shown(file)}: {error.strerror}; name files of a recorder: make fetch brings them from a robot"
        ) from error
    except RecordingError as error:
        raise _Damaged(f"{paths.shown(file)}: {error}; leave it out, or fetch it again") from error
    return Segment(file, header, first, last)


def _topics(keys: Sequence[tuple[Path, str]]) -> dict[tuple[Path, str], str]:
    """As short as differs."""
    depth = 0
    while True:
        named = {key: "/".join(["", *key[0].parts[1:][len(key[0].parts) - 1 - depth :], key[1]]) for key in keys}
        if len(set(named.values())) == len(keys):
            return named
        depth += 1


def _check_fields(segments: Sequence[Segment]) -> None:
    first = segments[0]
    for other in segments[1:]:
        if other.header.fields != first.header.fields:
            mine, theirs = ({each.name: each for each in s.header.fields} for s in (first, other))
            differ = sorted(name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name))
            raise UserError(
                f"{paths.shown(other.file)}: {', '.join(differ)}: other signals than in {first.file.name}, of "
                "another version of the task; name the files of each version on their own"
            )


def _walls_ns(segments: Sequence[Segment]) -> list[int]:
    """Of one run the newest file's: the computer's clock may have been set after the run's first file was begun."""
    walls = [segment.header.wall_less_monotonic_ns for segment in segments]
    for at in range(len(segments) - 1, 0, -1):
        before, after = segments[at - 1].last, segments[at].first
        if before and after and before[0] < after[0] and before[1] < after[1]:
            walls[at - 1] = walls[at]
    return walls
