"""Records what robots tell the station: an MCAP file (mcap.dev) that Foxglove and PlotJuggler open.

What was received a second ago is in the file, whatever happens: it stays readable, and loses at most its index, when
the program is killed or the disk is full.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet.drawings import Drawing
from flotilla.station.recording import Value
from flotilla.station.schema import ENCODING, UNITS, Schema, topics
from flotilla.station.telemetry import Stream


class Recorder:
    """Writes the messages of `known` to `out`, which must not be there; a sink of the receiver."""

    def __init__(self, known: Iterable[Stream], out: Path) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._file = out.open("xb")
        except FileExistsError:
            raise UserError(f"{paths.shown(out)} is there already; give another name: OUT=") from None
        self._out = out
        self._whole_bytes = 0
        """Length of the file after the last flush."""
        self._recorded: Counter[str] = Counter()
        # Of what never is in it, no index either: a reader takes an empty one for a fault.
        indexes = IndexType.CHUNK | IndexType.MESSAGE
        self._writer = Writer(self._file, compression=CompressionType.LZ4, index_types=indexes)
        self._channels: dict[str, dict[str, tuple[int, Schema | Drawing]]] = {}
        """By stream, and by topic of what is made of it."""
        with self._writing():
            self._writer.start(profile="", library="flotilla")
            for stream in known:
                channels = self._channels[stream.topic] = {}
                for topic, schema in topics(stream).items():
                    number = self._writer.register_schema(schema.name, ENCODING, schema.data)
                    metadata = {UNITS: json.dumps(stream.units)} if topic == stream.topic else {}
                    channels[topic] = (self._writer.register_channel(topic, ENCODING, number, metadata), schema)

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        for topic, (channel, schema) in self._channels[stream.topic].items():
            data = schema.encode(values, received_ns)
            with self._writing():
                self._writer.add_message(channel, received_ns, data, received_ns, sequence=self._recorded[topic])
            self._recorded[topic] += 1

    def refresh(self) -> None:
        """What was taken so far is in the file then."""
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._whole_bytes = self._file.tell()

    def end(self) -> str:
        with self._writing():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        return f"{paths.shown(self._out)}: {self._recorded.total()} messages, {progress.size(self._out.stat().st_size)}"

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()
            os.truncate(self._out, self._whole_bytes)  # a chunk that is half there would be in a reader's way
            raise UserError(f"{paths.shown(self._out)}: {error.strerror}; what was recorded before is in it") from error
