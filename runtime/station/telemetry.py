"""What robots tell the station: found in their control tasks, so that it is described nowhere else.

A stream is a block `udp-send` to a station's address whose data come from a block `pack`: that one's names, types and
widths are the datagram.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from images.builder import identity
from images.builder.errors import UserError
from images.builder.fleet import Fleet
from runtime.station.recording import Field, Value

_BYTE_ORDERS = {"little": "<", "big": ">"}
_CHARGE = {"oceanserver": "charge"}
"""Ports that are a battery's state of charge, by type of block."""
_SECONDS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}


@dataclass(frozen=True)
class Stream:
    """Datagrams of one robot's task."""

    robot: str
    task: str
    block: str
    """Which packs them."""
    address: str
    """They come from."""
    port: int
    """UDP port of the station."""
    fields: tuple[Field, ...]
    byte_order: str
    """Of struct(3): `<` or `>`."""
    step_s: float
    """The task's period."""
    every: int
    """Steps of the task from one datagram to the next."""
    charge: str | None = None
    """The field that is a battery's state of charge, 0 to 1."""

    @property
    def length(self) -> int:
        """Bytes of a datagram."""
        return self.fields[-1].end

    @property
    def rate_hz(self) -> float:
        """Datagrams in a second when nothing is late or lost."""
        return 1 / (self.step_s * self.every)

    @property
    def topic(self) -> str:
        """`/robot1/valves/report`."""
        return f"/{self.robot}/{self.task}/{self.block}"

    def unpack(self, datagram: bytes) -> dict[str, Value]:
        """Its values by name; the length has to be right."""
        return {field.name: field.of(datagram, self.byte_order) for field in self.fields}


def streams(fleet: Fleet) -> list[Stream]:
    """All that reach a station of the fleet; no two may look alike to it."""
    stations = {str(station.address) for station in fleet.stations}
    found: dict[tuple[str, int], Stream] = {}
    for robot in fleet.robots.values():
        for name, task in identity.control_tasks(fleet, robot).items():
            parsed = yaml.load(task, yaml.BaseLoader)
            for stream in of_task(robot.name, str(robot.address), name, parsed, stations):
                other = found.setdefault((stream.address, stream.port), stream)
                if other != stream:
                    both = f"{stream.topic} and {other.topic}"
                    raise UserError(f"{both}: both go to UDP port {stream.port} of the station; give each its own")
    return list(found.values())


def of_task(robot: str, address: str, name: str, task: dict[str, Any], stations: set[str]) -> Iterator[Stream]:
    """The streams of one control task, all of whose values are texts."""
    blocks: dict[str, Any] = task["blocks"]
    for sender in blocks.values():
        parameters = sender.get("parameters", {})
        if sender["type"] != "udp-send" or stations.isdisjoint(_listed(parameters["address"])):
            continue
        packer = sender["in"]["data"].partition(".")[0]
        if blocks.get(packer, {}).get("type") != "pack":
            continue
        layout = blocks[packer]["parameters"]
        types = layout["types"]
        names = layout.get("names") or [f"in{index}" for index in range(len(types))]
        widths = [int(width) for width in layout.get("widths") or ["1"] * len(types)]
        fields = tuple(_fields(names, types, widths, int(layout.get("alignment", 1))))
        byte_order = _BYTE_ORDERS[layout.get("byte_order", "little")]
        yield Stream(
            robot,
            name,
            packer,
            address,
            int(parameters["port"]),
            fields,
            byte_order,
            step_s=duration_s(task["period"]),
            every=int(sender.get("every", 1)),
            charge=next(
                (name for name, wire in blocks[packer].get("in", {}).items() if _is_charge(blocks, wire)), None
            ),
        )


def _listed(value: str | list[str]) -> list[str]:
    """A parameter that may be a list or one value."""
    return value if isinstance(value, list) else [value]


def _is_charge(blocks: dict[str, Any], wire: Any) -> bool:
    block, _, port = wire.partition(".") if isinstance(wire, str) else ("", "", "")
    return block in blocks and _CHARGE.get(blocks[block]["type"]) == port


def duration_s(text: str) -> float:
    """Of a task file's `10 ms`, which the runtime has checked."""
    number = text.rstrip("nuµms ")
    return float(number) * _SECONDS[text[len(number) :].strip()]


def _fields(names: Sequence[str], types: Sequence[str], widths: Sequence[int], alignment: int) -> Iterator[Field]:
    end = 0
    for name, kind, width in zip(names, types, widths, strict=True):
        field = Field(name, kind, width, offset=-(-end // alignment) * alignment)
        yield field
        end = field.end
