"""Files of the block `recorder` as one that other programs open: MCAP, CSV or MAT. `make convert`.

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
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from flotilla.common import durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.station import recording, segments
from flotilla.station.recording import Array
from flotilla.station.schema import ENCODING, Schema, identifiers
from flotilla.station.segments import Recorded

SECONDS, WALL = "time_s", "wall_ns"
"""Columns before the record's own: since the recording's first record, and since 1970-01-01 UTC."""
MOST_MAT_BYTES = 2**31 - 2**16
"""Of a variable in a MAT-file of version 5, whose lengths have 32 bits, less what describes it."""
_MATLAB_KEYWORDS = (
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if",
    "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
)  # fmt: skip
Chunks = Iterator[tuple[Array, Array]]
Read = Callable[[Recorded], Chunks]
"""What reads a recording: it shows how far it is."""


def convert(given: Sequence[Path], out: Path) -> list[str]:
    """Write `out`, whose name tells the form; what came of it, a line each. UserError where that cannot be."""
    form = _FORMS.get(out.suffix.lower())
    if not form:
        raise UserError(f"OUT={paths.shown(out)}: is no form that is known; let it end in {', '.join(_FORMS)}")
    if out.exists():
        raise UserError(f"{paths.shown(out)} is there already; give another name: OUT=")
    recorded = segments.find(segments.files(given))
    total = sum(each.size for each in recorded)
    done = 0
    beside = out.with_name(f"{out.name}.part")
    with progress.step(f"conversion to {out.name}") as step:

        def read(one: Recorded) -> Chunks:
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
    return [f"{paths.shown(out)}: {progress.size(out.stat().st_size)}", *(_account(each) for each in recorded), *said]


def _account(recorded: Recorded) -> str:
    count = sum(found.records for found in recorded.found.values())
    first = recorded.segments[0].first
    since = first and np.datetime64(first[0] + recorded.walls_ns[0], "ns").astype("datetime64[s]")
    begin = f" from {since} UTC on" if since is not None else ""
    files = len(recorded.segments)
    return f"{recorded.topic}: {count} records of {files} file{'s' * (files > 1)}{begin}"


def _renamed(topic: str, found: Mapping[str, str]) -> list[str]:
    """Signals whose names the form does not take."""
    return [f"{topic}: {name} is {named} there" for name, named in found.items() if name != named]


def _write_mcap(recorded: Sequence[Recorded], out: Path, read: Read) -> list[str]:
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


def _messages(at: int, recorded: Recorded, read: Read) -> Iterator[tuple[int, int, int, dict[str, Any]]]:
    """Each with the number `at` of its recording and its own, which also say which of two at one time is first."""
    numbers = itertools.count()
    names = [field.name for field in recorded.fields]
    for records, times_ns in read(recorded):
        columns = [records[name].tolist() for name in names]
        for time_ns, *values in zip(times_ns.tolist(), *columns, strict=True):
            yield time_ns, at, next(numbers), dict(zip(names, values, strict=True))


def _write_csv(recorded: Sequence[Recorded], out: Path, read: Read) -> list[str]:
    """A row a record; a signal of several elements has as many columns. Booleans are 0 and 1."""
    if len(recorded) > 1:
        topics = ", ".join(one.topic for one in recorded)
        raise UserError(f"{topics}: are {len(recorded)} recordings, and CSV holds one; name its files, or OUT=run.mcap")
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


def _write_mat(recorded: Sequence[Recorded], out: Path, read: Read) -> list[str]:
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


def _columns(recorded: Recorded, read: Read, place: Path) -> dict[str, Array]:
    """By name, a row a record, in files that begin with `place`."""
    most = sum(segment.file.stat().st_size // recorded.record_bytes for segment in recorded.segments)
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
