"""The gate: hop by hop, a flight in virtual time has the latencies that were accepted, each sample of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.lab.latency.gate import differences, keep
from flotilla.lab.latency.results import Latency
from flotilla.lab.scenarios.flight import HOPS, Flight

BASELINE = Path(__file__).with_name("baseline.json")
GATED = ("udp", "air", "dds")
"""Flights by their names: the square by each transport, and over the air that loses nothing."""
ACCEPT = "make scenarios-accept, commit it"
_WHOLE = "four hops"

Latencies = dict[str, dict[str, Latency]]
"""By flight and hop."""


def latencies(flights: Mapping[str, Flight]) -> Latencies:
    return {
        name: {hop: flights[name].hop(index) for index, hop in enumerate(HOPS)} | {_WHOLE: flights[name].latency()}
        for name in GATED
    }


def check(found: Latencies, file: Path = BASELINE) -> None:
    """UserError with all that moved."""
    if not file.exists():
        raise UserError(f"{paths.shown(file)} is missing: nothing to compare with; make it: {ACCEPT}")
    accepted = _read(file)
    moved = [
        f"{flight}: {hop}: {differences(accepted[flight][hop], latency)}"
        for flight, hops in found.items()
        for hop, latency in hops.items()
        if latency != accepted[flight][hop]
    ]
    if moved:
        raise UserError(
            f"hops are not those of {paths.shown(file)}:\n  " + "\n  ".join(moved) + f"\nif this is meant: {ACCEPT}"
        )


def accept(found: Latencies, file: Path = BASELINE) -> None:
    """Make these the ones that later flights are compared with: a line for each histogram."""
    lines = {
        flight: ",\n".join(f'  "{hop}": {json.dumps(latency.histogram_us)}' for hop, latency in hops.items())
        for flight, hops in found.items()
    }
    keep(file, "{\n" + ",\n".join(f'"{flight}": {{\n{hops}\n}}' for flight, hops in lines.items()) + "\n}\n")


def _read(file: Path) -> Latencies:
    return {
        flight: {hop: Latency.of({int(us): count for us, count in counts.items()}) for hop, counts in hops.items()}
        for flight, hops in json.loads(file.read_text()).items()
    }
