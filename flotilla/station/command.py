"""What robots tell this station, recorded, served or shown, or all at once: `make record`, `make live`, `make top`."""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.fleet import inventory
from flotilla.fleet.model import STATIONS, Fleet
from flotilla.station import station_keys
from flotilla.station.dialog import Dialog, keyboard
from flotilla.station.live import PORT, Server
from flotilla.station.receiver import Receiver, listen, receive
from flotilla.station.record import Recorder
from flotilla.station.services import Services
from flotilla.station.telemetry import Stream, streams
from flotilla.station.top import Top

TOP_S = 2.0
_FILE = "build/recordings/DATE.mcap, unless named"


def known_to(fleet: Fleet, directory: Path) -> list[Stream]:
    """The streams of the fleet that an inventory describes; there has to be one."""
    known = streams(fleet)
    if not known:
        raise UserError(
            f"{paths.shown(directory)}: no control task sends to a station; "
            f"one does by a message in {paths.shown(paths.TASKS / paths.MESSAGES)} whose receiver is {STATIONS}"
        )
    return known


def run(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    known = streams(fleet) if arguments.ask else known_to(fleet, arguments.inventory)
    sockets = listen((stream.port for stream in known), arguments.address)
    receiver = Receiver(known, station_keys.of_telemetry(fleet))
    doing = []
    seconds = arguments.seconds
    keys = {}
    with contextlib.ExitStack() as during:
        if arguments.live is not None:
            receiver.sinks.append(Server(known, arguments.live_address, arguments.live, arguments.origin))
            doing.append("serving")
        if arguments.record:
            receiver.sinks.append(Recorder(known, arguments.record))
            doing.append("recording")
        if arguments.top:
            services = Services(fleet.robots.values() if arguments.ask else ())
            dialog = Dialog({robot.name: robot for robot in fleet.robots.values()})
            top = Top(receiver, services.states, dialog, notes=services.notes)
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


def record_arguments(parser: argparse.ArgumentParser) -> None:
    record = parser.add_argument(
        "record", nargs="?", type=Path, default=_file(), metavar="FILE", help="(build/recordings/DATE.mcap)"
    )
    variable(record, "OUT")
    _live_option(parser)
    _common(parser)


def live_arguments(parser: argparse.ArgumentParser) -> None:
    port = parser.add_argument("live", nargs="?", type=int, default=PORT, metavar="PORT", help="TCP port (%(default)s)")
    variable(port, "PORT")
    _record_option(parser)
    _common(parser)


def top_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ask", action="store_true", help="also ask robots by ssh whether their control tasks run")
    parser.set_defaults(top=True)
    _record_option(parser)
    _live_option(parser)
    _common(parser)


def _file() -> Path:
    return paths.BUILD / "recordings" / time.strftime("%Y-%m-%dT%H-%M-%S.mcap")


def _record_option(parser: argparse.ArgumentParser) -> None:
    record = parser.add_argument(
        "--record", nargs="?", type=Path, const=_file(), metavar="FILE", help=f"record it, too: {_FILE}"
    )
    variable(record, "OUT")


def _live_option(parser: argparse.ArgumentParser) -> None:
    live = parser.add_argument(
        "--live", nargs="?", type=int, const=PORT, metavar="PORT", help=f"serve it to Foxglove, too ({PORT})"
    )
    variable(live, "PORT")


def _common(parser: argparse.ArgumentParser) -> None:
    live = parser.add_argument("--live-address", default="127.0.0.1", help="this computer's, to serve at (%(default)s)")
    variable(live, "ADDRESS")
    parser.add_argument(
        "--origin", action="append", default=[], help="a web page that may connect, http://localhost:8080 for instance"
    )
    parser.add_argument("--seconds", type=float, help=f"end after so many ({TOP_S:g} for top alone on no terminal)")
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")
    address = parser.add_argument(
        "--address", default="0.0.0.0", help="this computer's, to receive at (%(default)s: any)"
    )
    variable(address, "RECEIVE_ADDRESS")
    if parser.get_default("top") is None:
        parser.set_defaults(top=False, ask=False)
