"""What a station's chrony needs so that robots believe its time: `make station-time`.

Robots ask each other and the stations, and take only answers that a shared key authenticates (NTP's symmetric keys, RFC
5905). A station that has its time from elsewhere so leads the fleet.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flotilla.common import paths
from flotilla.fleet import inventory, message_keys
from flotilla.fleet.model import Fleet, Host

_KEYS = Path("/etc/chrony/flotilla.keys")
_CONFIGURATION = Path("/etc/chrony/conf.d/flotilla.conf")


def files(fleet: Fleet, station: Host) -> dict[Path, str]:
    """What to put where on the station."""
    shared = message_keys.read()
    keys = "".join(f"{shared.time(station, robot)}\n" for robot in fleet.robots.values())
    lines = [
        f"# Robots of {fleet.name} ask this computer for the time.",
        f"keyfile {_KEYS}",
        f"allow {fleet.network.subnet}",
    ]
    return {_CONFIGURATION: "\n".join(lines) + "\n", _KEYS: keys}


def run(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    station = inventory.station(fleet, arguments.station, arguments.inventory)
    directory = paths.BUILD / "station-time" / station.name
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    commands = []
    for there, text in files(fleet, station).items():
        file = directory / there.name
        file.touch(mode=0o600)
        file.write_text(text)
        mode = "-m 640 -g _chrony" if there == _KEYS else "-m 644"
        commands.append(f"sudo install {mode} {paths.shown(file)} {there}")
    print("\n".join([*commands, "sudo systemctl restart chrony"]))
