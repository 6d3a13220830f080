"""What the programs share by which a station sends to robots: a socket, and the key by which a robot believes it."""

from __future__ import annotations

import errno
import socket

from flotilla.common.errors import UserError
from flotilla.fleet.model import Host, Robot
from flotilla.station import station_keys
from flotilla.station.authentication import Signer

EVERYWHERE = "0.0.0.0"
"""In place of one address of this computer."""


def bound(
    address: str, port: int = 0, remedy: str = "give an address of this computer", interface: str = ""
) -> socket.socket:
    """A socket of UDP that waits for nothing; port 0: any. `remedy`: what to do if somebody has the port, or nobody
    the address. `interface`: what comes by others is not received."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    try:
        if interface:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode() + b"\0")
        made.bind((address, port))
    except OSError as error:
        made.close()
        if error.errno == errno.ENODEV:
            raise UserError(f"{interface}: {error.strerror}; give a network interface of this computer") from error
        raise UserError(f"{address}{f':{port}' if port else ''}: {error.strerror}; {remedy}") from error
    return made


def signer(station: Host, robot: Robot, port: int, what: str) -> Signer:
    """Of a station's messages, `what`, to a port of a robot. UserError without the fleet's secret: no robot would take
    one."""
    keys = station_keys.shared(f"{robot.name} would take no {what}")
    return Signer(keys.between(station, robot), port)
