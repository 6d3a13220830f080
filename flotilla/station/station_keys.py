"""Keys that this computer, as one of the fleet's stations, shares with its robots."""

from __future__ import annotations

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import message_keys
from flotilla.fleet.message_keys import MessageKeys
from flotilla.fleet.model import Fleet
from flotilla.station.receiver import KeyOf
from flotilla.station.telemetry import Stream


def shared(otherwise: str) -> MessageKeys:
    """The fleet's. UserError where its secret is elsewhere: a new one would be no robot's. `otherwise`: what is so
    without it."""
    secret = message_keys.secret_file()
    if not secret.exists():
        raise UserError(
            f"{paths.shown(secret)}: is missing, so {otherwise}; bring it from where the robots' cards were made, by "
            "`make backup-keys` and `make restore-keys`, or name the folder: KEYS="
        )
    return message_keys.read()


def of_telemetry(fleet: Fleet) -> KeyOf:
    """Keys of what robots tell the fleet's stations."""
    keys = shared("reports of robots cannot be authenticated")
    robots = {robot.name: robot for robot in fleet.robots.values()}
    stations = {str(station.address): station for station in fleet.stations}

    def key_of(stream: Stream, address: str) -> str | None:
        return keys.between(robots[stream.robot], stations[address]) if address in stations else None

    return key_of
