"""Record what robots tell the station: an MCAP file (mcap.dev) that Foxglove and PlotJuggler open, `make record`.

Messages are protobuf, with schemas made from the tasks that send them. A datagram of the wrong length, or from
somewhere else, is counted and left out. What was received a second ago is in the file, whatever happens: it stays
readable, and loses at most its index, when the program is killed or the disk is full.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import CompressionType, Writer

from images.builder import inventory, paths, progress
from images.builder.errors import UserError, exit_status
from runtime.station.telemetry import Stream, streams

FLUSH_S = 1.0
_LONGEST = 65536
_KINDS = {
    "boolean": "BOOL", "single": "FLOAT", "double": "DOUBLE", "int64": "INT64", "uint64": "UINT64",
    **dict.fromkeys(("int8", "int16", "int32"), "INT32"), **dict.fromkeys(("uint8", "uint16", "uint32"), "UINT32"),
}  # fmt: skip
"""Types of protobuf by those of signals."""


@dataclass
class Count:
    """Of a stream."""

    recorded: int = 0
    refused: int = 0
    """Of the wrong length."""


def schema(stream: Stream) -> tuple[str, bytes, type[Any]]:
    """Name of the stream's message, its FileDescriptorSet, and its class."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{stream.topic[1:]}.proto", package="flotilla", syntax="proto3")
    name = "".join(word.capitalize() for word in f"{stream.task}-{stream.block}".replace("_", "-").split("-"))
    message = file.message_type.add(name=name)
    for number, field in enumerate(stream.fields, 1):
        described = message.field.add(name=field.name.replace("-", "_"), number=number)
        described.type = getattr(descriptor_pb2.FieldDescriptorProto, f"TYPE_{_KINDS[field.type]}")
        described.label = (
            descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED if field.width > 1
            else descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL
        )  # fmt: skip
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"flotilla.{name}"))
    return f"flotilla.{name}", descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), kind


class Recorder:
    """Writes the datagrams of streams to a file; `end` completes it."""

    def __init__(self, known: Iterable[Stream], out: IO[bytes]) -> None:
        self.known = {(stream.address, stream.port): stream for stream in known}
        self.counts = {stream.topic: Count() for stream in self.known.values()}
        self.strangers = 0
        """Datagrams from addresses that are no robot's of a stream."""
        self.whole_bytes = 0
        """Length of the file after the last flush."""
        self._out = out
        self._writer = Writer(out, compression=CompressionType.LZ4)
        self._writer.start(profile="", library="flotilla")
        self._channels: dict[str, tuple[int, type[Any]]] = {}
        for stream in self.known.values():
            name, descriptor, kind = schema(stream)
            number = self._writer.register_schema(name, "protobuf", descriptor)
            self._channels[stream.topic] = (self._writer.register_channel(stream.topic, "protobuf", number), kind)

    def take(self, datagram: bytes, address: str, port: int, received_ns: int) -> None:
        """`received_ns`: since 1970-01-01 UTC."""
        stream = self.known.get((address, port))
        if not stream:
            self.strangers += 1
            return
        count = self.counts[stream.topic]
        if len(datagram) != stream.length:
            count.refused += 1
            return
        channel, kind = self._channels[stream.topic]
        values = {name.replace("-", "_"): value for name, value in stream.unpack(datagram).items()}
        self._writer.add_message(
            channel, received_ns, kind(**values).SerializeToString(), received_ns, sequence=count.recorded
        )
        count.recorded += 1

    def flush(self) -> None:
        """What was taken so far is in the file then."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.whole_bytes = self._out.tell()

    def end(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._out.flush()


def listen(ports: Iterable[int], address: str) -> list[socket.socket]:
    """A socket for each port."""
    opened = []
    for port in sorted(set(ports)):
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        one.setblocking(False)
        try:
            one.bind((address, port))
        except OSError as error:
            remedy = "end what receives there, or give this computer the address"
            raise UserError(f"UDP port {port} of {address}: {error.strerror}; {remedy}") from error
        opened.append(one)
    return opened


def record(recorder: Recorder, sockets: list[socket.socket], seconds: float | None) -> None:
    """Until SIGINT or SIGTERM, or for so many seconds."""
    wake, waker = socket.socketpair()
    waker.setblocking(False)
    signal.set_wakeup_fd(waker.fileno())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    flushed = time.monotonic()
    with progress.step("recording") as step:
        while (now := time.monotonic()) < end:
            ready, _, _ = select.select([wake, *sockets], [], [], min(end - now, FLUSH_S))
            if wake in ready:
                break
            for one in ready:
                port = one.getsockname()[1]
                while received := _receive(one):
                    recorder.take(*received, port, time.time_ns())
            if time.monotonic() - flushed >= FLUSH_S:
                recorder.flush()
                flushed = time.monotonic()
                step.note(f"{sum(count.recorded for count in recorder.counts.values())} messages")


def _receive(one: socket.socket) -> tuple[bytes, str] | None:
    try:
        datagram, (address, _) = one.recvfrom(_LONGEST)
    except BlockingIOError:
        return None
    return datagram, address


def known_to(directory: Path) -> list[Stream]:
    """The streams of the fleet that an inventory describes; there has to be one."""
    known = streams(inventory.load_fleet(directory))
    if not known:
        raise UserError(
            f"{paths.shown(directory)}: no control task sends to a station; "
            "one does by a block pack and a block udp-send to the station's address"
        )
    return known


def run(known: list[Stream], out: Path, address: str, seconds: float | None) -> None:
    """Record `known` to `out`, which must not be there."""
    sockets = listen((stream.port for stream in known), address)
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = out.open("xb")
    except FileExistsError:
        raise UserError(f"{paths.shown(out)} is there already; give another name: OUT=") from None
    recorder = Recorder(known, file)
    try:
        record(recorder, sockets, seconds)
        recorder.end()
        file.close()
    except OSError as error:
        with contextlib.suppress(OSError):
            file.close()
        os.truncate(out, recorder.whole_bytes)  # a chunk that is half there would be in a reader's way
        raise UserError(f"{paths.shown(out)}: {error.strerror}; what was recorded before is in it") from error
    for topic, count in recorder.counts.items():
        print(f"{topic}: {count.recorded} recorded, {count.refused} of a wrong length left out")
    print(f"{recorder.strangers} datagrams of strangers left out")
    print(f"{paths.shown(out)}: {progress.size(out.stat().st_size)}")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m runtime.station.record", description="Record what robots tell.")
    parser.add_argument("out", nargs="?", type=Path, help="the file (build/recordings/DATE.mcap)")
    parser.add_argument("--seconds", type=float, help="end after so many")
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")
    parser.add_argument("--address", default="0.0.0.0", help="this computer's, to receive at (%(default)s: any)")
    arguments = parser.parse_args()
    out = arguments.out or paths.BUILD / "recordings" / time.strftime("%Y-%m-%dT%H-%M-%S.mcap")
    return exit_status(lambda: run(known_to(arguments.inventory), out, arguments.address, arguments.seconds))


if __name__ == "__main__":
    sys.exit(main())
