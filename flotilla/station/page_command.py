"""The station's page: `make station`."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import sys
import time
from ipaddress import ip_address
from pathlib import Path

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.station import station_keys
from flotilla.station.desk import Desk
from flotilla.station.driving import Driving
from flotilla.station.receiver import REFRESH_S, Receiver, drain, listen
from flotilla.station.replay import Replay
from flotilla.station.services import Services
from flotilla.station.telemetry import streams
from flotilla.station.view import View
from flotilla.station.web import Web

PORT = 8080
STATE_S = 0.1
"""From one state that browsers get to the next."""


def run(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    address = _address(arguments.page_address)
    known = streams(fleet)
    replay = Replay(arguments.replay, known) if arguments.replay else None
    receiver = Receiver(replay.streams) if replay else Receiver(known, station_keys.of_telemetry(fleet))
    with Driving(fleet, arguments.address) as driving:
        asyncio.run(_serve(arguments, fleet, receiver, replay, driving, address))


async def _serve(
    arguments: argparse.Namespace,
    fleet: Fleet,
    receiver: Receiver,
    replay: Replay | None,
    driving: Driving,
    address: str,
) -> None:
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    view = View(receiver, replay.clock if replay else time.time_ns)
    receiver.sinks.append(view)
    services, trouble = (Services(()), "") if replay else _services(fleet)
    desk = Desk(fleet, receiver, view, services.states, services.notes, services.way, replay, driving)
    receiver.sinks.append(desk.recording)
    sockets = [] if replay else listen((stream.port for stream in receiver.known.values()), arguments.address)
    for one in sockets:
        loop.add_reader(one, drain, one, receiver)
    if arguments.record:
        desk.recording.begin(arguments.record)
    web = Web(desk, address, arguments.port)
    url = await web.begin()
    try:
        sys.stderr.write(f"the station's page: {url}\n")
        sys.stderr.flush()
        if trouble:
            desk.note(trouble)
        if replay:
            for said in replay.notes:
                desk.note(said)
            replay.play(True)
        await _until(ended, arguments.seconds, desk, receiver, replay)
    finally:
        for one in sockets:
            loop.remove_reader(one)
        await desk.end()
        await web.end()
    if not replay:
        print("\n".join(receiver.summary))


async def _until(
    ended: asyncio.Event, seconds: float | None, desk: Desk, receiver: Receiver, replay: Replay | None
) -> None:
    """Show the state ten times a second until then, or for so long."""
    loop = asyncio.get_running_loop()
    end = loop.time() + (seconds if seconds is not None else float("inf"))
    refreshed = loop.time()
    while not ended.is_set() and loop.time() < end:
        if replay:
            replay.advance(receiver)
        desk.show()
        if loop.time() - refreshed >= REFRESH_S:
            refreshed = loop.time()
            receiver.refresh()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(ended.wait(), STATE_S)


def _services(fleet: Fleet) -> tuple[Services, str]:
    """Of the robots, asked by ssh, and why they are not asked, if they are not."""
    try:
        return Services(fleet.robots.values()), ""
    except UserError as error:
        return Services(()), f"tasks are not asked: {error}"


def _address(text: str) -> str:
    try:
        return str(ip_address(text))
    except ValueError as error:
        raise UserError(f"ADDRESS={text}: is no address of this computer; such as 127.0.0.1") from error


def page_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=int, default=PORT, help="TCP port of the page (%(default)s)")
    page = parser.add_argument("--page-address", default="127.0.0.1", help="this computer's, to serve at (%(default)s)")
    variable(page, "ADDRESS")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="show a recording instead of robots")
    variable(parser.add_argument("--record", type=Path, metavar="FILE", help="record from the start"), "OUT")
    parser.add_argument("--seconds", type=float, help="end after so many")
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")
    address = parser.add_argument(
        "--address", default="0.0.0.0", help="this computer's, to receive at (%(default)s: any)"
    )
    variable(address, "RECEIVE_ADDRESS")
