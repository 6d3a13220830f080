"""Files of the block `recorder`, or topics of an MCAP file, as a file for other programs: `make convert`.

Every form has each record's time of day beside its fields, and in CSV and MAT the seconds since the recording's first
record. The output is written beside and renamed, and never in the place of a file that is there.
"""

from __future__ import annotations

import contextlib
import csv
import heapq
import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from flotilla.common import durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.signals import CODES
from flotilla.station import mcap_reader, recording, segments
from flotilla.station.recording import Array, Field
from flotilla.station.schema import ENCODING, Schema, identifiers
from flotilla.station.topic import Topic

SECONDS, WALL = "time_s", "wall_ns"
"""Columns before the record's own: since the recording's first record, and since 1970-01-01 UTC."""
MOST_MAT_BYTES = 2**31 - 2**16
"""Of a variable in a MAT-file of version 5, whose lengths have 32 bits, less what describes it."""
_MATLAB_KEYWORDS = (
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if",
    "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
)  # fmt: skip
Chunks = Iterator[tuple[Array, Array]]


class Source(Protocol):
    """A recording, whoever wrote it."""

    @property
    def topic(self) -> str: ...
    @property
    def fields(self) -> tuple[Field, ...]: ...
    @property
    def record_bytes(self) -> int: ...
    @property
    def most(self) -> int: ...
    @property
    def size(self) -> int: ...
    def chunks(self) -> Chunks: ...
    def notes(self) -> list[str]: ...
    def account(self) -> str: ...


Read = Callable[[Source], Chunks]
"""What reads a recording: it shows how far it is."""


def convert(given: Sequence[Path], out: Path, topic: str | None = None) -> list[str]:
    """Write `out`, in the format of its suffix, and return a report, a line each. UserError where that is impossible.

    `given`: files of recorders, or one MCAP file, of which `topic` is one.
    """
    form = _FORMS.get(out.suffix.lower())
    if not form:
        raise UserError(f"OUT={paths.shown(out)}: is no form that is known; let it end in {', '.join(_FORMS)}")
    if out.exists():
        raise UserError(f"{paths.shown(out)} is there already; give another name: OUT=")
    recorded = _sources(given, out, topic)
    total = sum(each.size for each in recorded)
    done = 0
    beside = out.with_name(f"{out.name}.part")
    with progress.step(f"conversion to {out.name}") as step:

        def read(one: Source) -> Chunks:
            nonlocal done
            for records, times_ns in one.chunks():
                yield records, times_ns
                done += len(records) * one.record_bytes
                step.at(done, total)

        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            said = form(recorded, beside, read)
            durable.rename(beside, out)
        except OSError as error:
            raise UserError(f"{paths.shown(out)}: {error.strerror}; make room, or name another place: OUT=") from error
        finally:
            with contextlib.suppress(OSError):  # its folder may be what is wrong
                beside.unlink()
    for each in recorded:
        said += each.notes()
    return [f"{paths.shown(out)}: {progress.size(out.stat().st_size)}", *(each.account() for each in recorded), *said]


def _sources(given: Sequence[Path], out: Path, topic: str | None) -> Sequence[Source]:
    """What to convert: recordings of recorders, or the topics of one MCAP file."""
    files = segments.files(given)
    found: Sequence[Source]
    if len(files) == 1 and files[0].suffix.lower() == ".mcap":
        if out.suffix.lower() == ".mcap":
            raise UserError(f"{paths.shown(files[0])}: is MCAP already; OUT=NAME.csv or NAME.mat")
        damage = mcap_reader.Damage()
        topics = mcap_reader.read(files[0], damage)
        found = [Messages(each, damage.notes(files[0]) if each is topics[0] else []) for each in topics if each.signals]
    else:
        found = segments.find(files)
    if topic is None:
        return found
    if not (chosen := [each for each in found if each.topic == topic]):
        raise UserError(f"TOPIC={topic}: is not there; there are {', '.join(each.topic for each in found)}")
    return chosen


class Messages:
    """A topic of an MCAP file, as a recording of a recorder is."""

    def __init__(self, topic: Topic, notes: list[str]) -> None:
        self.topic, self._notes, self._times_ns = topic.name, notes, topic.times_ns
        kinds = {recording.dtype(name): name for name in CODES}
        self.fields = tuple(
            Field(name, kinds[values.dtype.newbyteorder("<")], values.shape[1] if values.ndim > 1 else 1, 0)
            for name, values in topic.signals.items()
            if values.dtype.newbyteorder("<") in kinds and values.ndim < 3
        )
        kinds_of = [(each.name, recording.dtype(each.type), (each.width,)[: each.width - 1]) for each in self.fields]
        self._records = np.zeros(len(topic.times_ns), kinds_of)
        for each in self.fields:
            self._records[each.name] = topic.signals[each.name].reshape(self._records[each.name].shape)
        self.most, self.size = len(self._records), self._records.nbytes
        self.record_bytes = self._records.dtype.itemsize

    def chunks(self) -> Chunks:
        yield self._records, self._times_ns

    def notes(self) -> list[str]:
        return self._notes

    def account(self) -> str:
        since = np.datetime64(int(self._times_ns[0]), "ns").astype("datetime64[s]")
        return f"{self.topic}: {self.most} messages from {since} UTC on"


def _renamed(topic: str, found: Mapping[str, str]) -> list[str]:
    """Signals whose names the form does not take."""
    return [f"{topic}: {name} is {named} there" for name, named in found.items() if name != named]


def _write_mcap(recorded: Sequence[Source], out: Path, read: Read) -> list[str]:
    """A topic a recording. Messages of all are in the order of their times, as viewers like them."""
    schemas = [Schema(one.topic, one.topic[1:], one.fields) for one in recorded]
    with out.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4, index_types=IndexType.CHUNK | IndexType.MESSAGE)
        writer.start(profile="", library="flotilla")
        channels = [
            writer.register_channel(
                one.topic, ENCODING, writer.register_schema(schema.name, ENCODING, schema.data)
            )
            for one, schema in zip(recorded, schemas, strict=True)
        ]  # fmt: skip
        streams = [_messages(at, one, read) for at, one in enumerate(recorded)]
        for time_ns, at, sequence, values in heapq.merge(*streams):
            data = schemas[at].encode(values, time_ns)
            writer.add_message(channels[at], time_ns, data, time_ns, sequence=sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    return [note for one, schema in zip(recorded, schemas, strict=True) for note in _renamed(one.topic, schema.names)]


def _messages(at: int, recorded: Source, read: Read) -> Iterator[tuple[int, int, int, dict[str, Any]]]:
    """Each with the number `at` of its recording and its own, which also say which of two at one time is first."""
    numbers = itertools.count()
    names = [field.name for field in recorded.fields]
    for records, times_ns in read(recorded):
        columns = [records[name].tolist() for name in names]
        for time_ns, *values in zip(times_ns.tolist(), *columns, strict=True):
            yield time_ns, at, next(numbers), dict(zip(names, values, strict=True))


def _write_csv(recorded: Sequence[Source], out: Path, read: Read) -> list[str]:
    """A row a record; a signal of several elements has as many columns. Booleans are 0 and 1."""
    if len(recorded) > 1:
        topics = ", ".join(one.topic for one in recorded)
        raise UserError(
            f"{topics}: are {len(recorded)} recordings, and CSV holds one; say TOPIC={recorded[0].topic}, name "
            "the files of one, or OUT=run.mat"
        )
    (one,) = recorded
    begin_ns = None
    with out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([SECONDS, WALL, *(title for field in one.fields for title in field.titles)])
        for records, times_ns in read(one):
            if not len(records):
                continue
            begin_ns = int(times_ns[0]) if begin_ns is None else begin_ns
            columns = [((times_ns - begin_ns) / 1e9).tolist(), times_ns.tolist()]
            for field in one.fields:
                values = records[field.name].reshape(len(records), -1)
                columns += (values.astype(np.uint8) if values.dtype == np.bool_ else values).T.tolist()
            writer.writerows(zip(*columns, strict=True))
    return []


def _write_mat(recorded: Sequence[Source], out: Path, read: Read) -> list[str]:
    """A struct a recording, with a column vector a signal, or a matrix with a row a record."""
    import scipy.io

    structs = identifiers((one.topic[1:] for one in recorded), _MATLAB_KEYWORDS)
    said = []
    # In files, as a recording may be larger than memory.
    with tempfile.TemporaryDirectory(prefix=f"{out.name}-", dir=out.parent) as place:
        content = {}
        for one in recorded:
            struct = structs[one.topic[1:]]
            names = identifiers([SECONDS, WALL, *(_own(field.name) for field in one.fields)], _MATLAB_KEYWORDS)
            said += _renamed(one.topic, {field.name: names[_own(field.name)] for field in one.fields})
            content[struct] = {names[name]: rows for name, rows in _columns(one, read, Path(place) / struct).items()}
            if (size := sum(rows.nbytes for rows in content[struct].values())) > MOST_MAT_BYTES:
                raise UserError(
                    f"{one.topic}: takes {progress.size(size)}, and a MAT-file holds {progress.size(MOST_MAT_BYTES)} "
                    "of a recording; name fewer of its files, or OUT=run.mcap"
                )
        scipy.io.savemat(out, content, appendmat=False, long_field_names=True)
    return _renamed("struct", structs) + said


def _own(name: str) -> str:
    """Of a signal, where it must differ from the two columns before."""
    return f"{name}_" if name in (SECONDS, WALL) else name


def _columns(recorded: Source, read: Read, place: Path) -> dict[str, Array]:
    """By name, a row a record, in files that begin with `place`."""
    most = recorded.most
    kinds = {SECONDS: (np.dtype("f8"), 1), WALL: (np.dtype("i8"), 1)}
    kinds |= {_own(field.name): (recording.dtype(field.type), field.width) for field in recorded.fields}
    columns: dict[str, Array] = {
        name: np.memmap(f"{place}-{at}", kind, "w+", shape=(most, width), order="F")
        for at, (name, (kind, width)) in enumerate(kinds.items())
    }
    done = 0
    for records, times_ns in read(recorded):
        end = done + len(records)
        columns[WALL][done:end, 0] = times_ns
        for field in recorded.fields:
            columns[_own(field.name)][done:end] = records[field.name].reshape(len(records), -1)
        done = end
    walls_ns = columns[WALL][:done]
    columns[SECONDS][:done] = (walls_ns - walls_ns[0]) / 1e9
    return {name: rows[:done] for name, rows in columns.items()}


_FORMS = {".mcap": _write_mcap, ".csv": _write_csv, ".mat": _write_mat}
