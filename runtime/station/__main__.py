"""What robots tell this station, recorded, served or shown, or all at once: `make record`, `make live`, `make top`."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from pathlib import Path

from images.builder import inventory, paths, progress
from images.builder.errors import UserError, exit_status
from images.builder.fleet import Fleet
from runtime.station.dialog import Dialog, keyboard
from runtime.station.live import PORT, Server
from runtime.station.receiver import Receiver, listen, receive
from runtime.station.record import Recorder
from runtime.station.services import Services
from runtime.station.telemetry import Stream, streams
from runtime.station.top import Top

TOP_S = 2.0


def known_to(fleet: Fleet, directory: Path) -> list[Stream]:
    """The streams of the fleet that an inventory describes; there has to be one."""
    known = streams(fleet)
    if not known:
        raise UserError(
            f"{paths.shown(directory)}: no control task sends to a station; "
            "one does by a block pack and a block udp-send to the station's address"
        )
    return known


def run(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    known = streams(fleet) if arguments.ask else known_to(fleet, arguments.inventory)
    sockets = listen((stream.port for stream in known), arguments.address)
    receiver = Receiver(known)
    doing = []
    seconds = arguments.seconds
    keys = {}
    with contextlib.ExitStack() as during:
        if arguments.live is not None:
            receiver.sinks.append(Server(known, arguments.live_address, arguments.live))
            doing.append("serving")
        if arguments.record:
            receiver.sinks.append(Recorder(known, arguments.record))
            doing.append("recording")
        if arguments.top:
            states = Services(fleet.robots.values()).states if arguments.ask else {}
            top = Top(receiver, states, Dialog({robot.name: robot for robot in fleet.robots.values()}))
            receiver.sinks.append(top)
            if not doing and not top.console.is_terminal:
                seconds = seconds or TOP_S
            # The keyboard first: what is typed before it listens is lost, and the screen says which keys there are.
            keys = during.enter_context(keyboard(top.press)) if top.console.is_terminal else {}
            during.enter_context(top.screen())
            note = None
        else:
            note = during.enter_context(progress.step(" and ".join(doing))).note
        receive(receiver, sockets, seconds, note, keys)
    ends = [sink.end() for sink in receiver.sinks]
    print("\n".join([*(receiver.summary if doing else []), *ends]))


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
    parser.add_argument("--top", action="store_true", help="show on this terminal how it comes; once when it is none")
    parser.add_argument("--ask", action="store_true", help="with --top: ask robots whether their control tasks run")
    parser.add_argument("--seconds", type=float, help=f"end after so many ({TOP_S:g} for --top alone on no terminal)")
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")
    parser.add_argument("--address", default="0.0.0.0", help="this computer's, to receive at (%(default)s: any)")
    arguments = parser.parse_args()
    if arguments.live is None and not arguments.record and not arguments.top:
        parser.error("say what to do with it: --record, --live, --top")
    if arguments.ask and not arguments.top:
        parser.error("--ask: only --top shows it")
    return exit_status(lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
