"""A release for many robots: which of them lack the same of it, and the file that brings it to all of them at once."""

from __future__ import annotations

import hashlib
import socket
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Fleet
from flotilla.robot import release

WAYS = ("", "ssh", "multicast")
"""Values of `by`: "" sends by multicast what two or more robots lack."""


@dataclass(frozen=True)
class Lack:
    """What a robot lacks of a release."""

    bundle: Path
    told: Mapping[str, Any]
    """What the robot's `update.py begin` or `copy` said."""

    @property
    def staged(self) -> bool:
        """The robot runs the release, or its other slot holds it."""
        return bool(self.told["running"] or self.told["staged"])

    @property
    def anything(self) -> bool:
        return bool(self.told["missing"]) and not self.staged


@dataclass(frozen=True)
class Shipment:
    """A file that goes to several robots at once."""

    command: str
    """Of the robot's update.py, which reads the file: `delta` or `write`."""
    file: Path
    robots: tuple[str, ...]


def shipments(lacks: Mapping[str, Lack], by: str, directory: Path | None = None) -> list[Shipment]:
    """What goes out by multicast, by robots' names; files of chunks are written to `directory`.

    Robots with the same release get the same delta. All others of a bundle get the chunks that any of them lacks.
    """
    if by not in WAYS:
        raise UserError(f"by={by}: give ssh or multicast, or leave it out")
    deltas: dict[Path, list[str]] = defaultdict(list)
    chunks: dict[Path, list[str]] = defaultdict(list)
    for name, lack in lacks.items():
        bundle = release.read(lack.bundle)
        if lack.anything and bundle.has(lack.told["missing"]):  # or it fails alone, when it gets its own copy
            delta = bundle.delta(lack.told)
            (deltas[delta] if delta else chunks[lack.bundle]).append(name)
    least = {"": 2, "multicast": 1, "ssh": len(lacks) + 1}[by]
    found = [Shipment("delta", delta, tuple(names)) for delta, names in deltas.items() if len(names) >= least]
    for path, names in chunks.items():
        if len(names) >= least:
            numbers = sorted({number for name in names for number in lacks[name].told["missing"]})
            file = _chunks(release.read(path), numbers, directory or paths.BUNDLES / "shared")
            found.append(Shipment("write", file, tuple(names)))
    return found


def _chunks(bundle: release.Bundle, numbers: list[int], directory: Path) -> Path:
    """A file of these chunks. Its name is that of its content, so a station that starts again goes on with it."""
    name = hashlib.sha256(f"{bundle.header['BLOB']} {numbers}".encode()).hexdigest()[:32]
    file = directory / name
    if not file.exists():
        directory.mkdir(parents=True, exist_ok=True)
        beside = file.with_suffix(".part")
        with beside.open("wb") as out:
            for batch in bundle.chunks(numbers, 1 << 20):
                out.write(batch)
        durable.rename(beside, file)
    return file


def station(fleet: Fleet) -> IPv4Address | None:
    """The address of this computer by which robots know it as a station; None if it is none of the inventory's."""
    return next((each.address for each in fleet.stations if _is_ours(each.address)), None)


def _is_ours(address: IPv4Address) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((str(address), 0))
        except OSError:
            return False
    return True


def listed(names: Iterable[str]) -> str:
    """Names for people: `robot1, robot3`."""
    return ", ".join(sorted(names))
