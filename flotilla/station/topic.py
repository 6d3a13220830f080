"""A stream of messages in memory, wherever it was recorded: what reports are drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from flotilla.station.recording import Array


@dataclass(frozen=True)
class Topic:
    """Messages of a topic, in the order in which they were recorded."""

    name: str
    times_ns: Array
    """When each was received, or its step was due: nanoseconds since 1970-01-01 UTC."""
    signals: dict[str, Array]
    """Numbers by name, in the order of the schema: a row a message, of several elements where it has them."""
    units: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Of a signal's elements, where the recording tells them."""
