"""What robots tell this station, recorded, served or shown, or all at once: `make record`, `make live`, `make top`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from images.builder import inventory, paths, progress
from images.builder.errors import UserError, exit_status
from runtime.station.live import PORT, Server
from runtime.station.receiver import Receiver, Sink, listen, receive
from runtime.station.record import Recorder
from runtime.station.telemetry import Stream, streams


def known_to(directory: Path) -> list[Stream]:
    """The streams of the fleet that an inventory describes; there has to be one."""
    known = streams(inventory.load_fleet(directory))
    if not known:
        raise UserError(
            f"{paths.shown(directory)}: no control task sends to a station; "
            "one does by a block pack and a block udp-send to the station's address"
        )
    return known


def run(arguments: argparse.Namespace) -> None:
    known = known_to(arguments.inventory)
    sockets = listen((stream.port for stream in known), arguments.address)
    sinks: list[Sink] = []
    doing = []
    if arguments.live is not None:
        sinks.append(Server(known, arguments.live_address, arguments.live))
        doing.append("serving")
    if arguments.record:
        sinks.append(Recorder(known, arguments.record))
        doing.append("recording")
    receiver = Receiver(known, sinks)
    with progress.step(" and ".join(doing)) as step:
        receive(receiver, sockets, arguments.seconds, step.note)
    ends = [sink.end() for sink in sinks]
    print("\n".join([*receiver.summary, *ends]))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m runtime.station", description="What robots tell this station.")
    file = paths.BUILD / "recordings" / time.strftime("%Y-%m-%dT%H-%M-%S.mcap")
    parser.add_argument(
        "--record", nargs="?", type=Path, const=file, metavar="FILE", help="record it (build/recordings/DATE.mcap)"
    )
    parser.add_argument(
        "--live",
        nargs="?",
        type=int,
        const=PORT,
        metavar="PORT",
        help=f"serve it to Foxglove at a TCP port ({PORT})",
    )
    parser.add_argument("--live-address", default="127.0.0.1", help="this computer's, to serve at (%(default)s)")
    parser.add_argument("--seconds", type=float, help="end after so many")
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")
    parser.add_argument("--address", default="0.0.0.0", help="this computer's, to receive at (%(default)s: any)")
    arguments = parser.parse_args()
    if arguments.live is None and not arguments.record:
        parser.error("say what to do with it: --record, --live")
    return exit_status(lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
