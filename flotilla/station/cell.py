"""This computer in the robots' ad hoc cell: `make station-join`, `make station-leave`."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.station import adapter

_PROGRAMS = {"ip": "iproute2", "iw": "iw"}
"""By the Debian package that has them."""


def join(arguments: argparse.Namespace) -> None:
    fleet = inventory.load_fleet(arguments.inventory)
    station = inventory.station(fleet, arguments.station, arguments.inventory)
    ibss = fleet.network.ibss
    if not ibss:
        raise UserError(
            f"{paths.shown(arguments.inventory)}: network.ibss is missing; give ssid, frequency_mhz and bssid"
        )
    wanted = {
        "interface": arguments.adapter,
        "ssid": ibss.ssid,
        "frequency_mhz": ibss.frequency_mhz,
        "bssid": ibss.bssid,
        "address": f"{station.address}/{fleet.network.subnet.prefixlen}",
    }
    name = _as_root("join", json.dumps(wanted))
    print(f"{name}: in the cell {ibss.ssid} as {station.name}, {station.address}; make station-leave puts it back")


def leave(arguments: argparse.Namespace) -> None:
    name = _as_root("leave", *([arguments.adapter] if arguments.adapter else []))
    print(f"{name}: as it was before")


def _as_root(*words: str) -> str:
    """What the program says that changes the adapter. UserError with its reason."""
    search = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    if missing := [package for program, package in _PROGRAMS.items() if not shutil.which(program, path=search)]:
        raise UserError(f"missing on this computer; install it: sudo apt-get install {' '.join(missing)}")
    sudo = [] if os.geteuid() == 0 else ["sudo"]
    argv = [*sudo, sys.executable, "-I", str(adapter.__file__), *words]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(done.stderr.strip() or f"{' '.join(argv[:-1])}: status {done.returncode}")
    return done.stdout.strip()


def join_arguments(parser: argparse.ArgumentParser) -> None:
    _adapter(parser)
    station_arguments(parser)


def station_arguments(parser: argparse.ArgumentParser) -> None:
    """Which station this computer is."""
    parser.add_argument("--station", metavar="NAME", help="of the inventory, which this computer is (the only one)")
    parser.add_argument("--inventory", type=Path, default=paths.INVENTORY, help="the fleet's description (%(default)s)")


def leave_arguments(parser: argparse.ArgumentParser) -> None:
    _adapter(parser)


def _adapter(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("adapter", nargs="?", help="802.11 interface of this computer, such as wlan0 (the only one)")
