"""A stream of messages in memory, wherever it was recorded: what reports are drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from flotilla.station.recording import Array

COUNTERS = ("number", "step", "sequence")
"""Signals that count what was sent, the best one first: a recorder on the way counts its own steps as `step`, and has
the sender's as `number`."""


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

    @cached_property
    def counter(self) -> Array | None:
        """What numbers the messages; None: nothing does."""
        found = next((self.signals[name] for name in COUNTERS if name in self.signals), None)
        return None if found is None else found.astype(np.int64)

    @cached_property
    def came(self) -> Array:
        """Which rows hold a message: a receiver is recorded before the first one, too, and its counter is 0 then."""
        every = np.ones(len(self.times_ns), bool)
        if self.counter is not None and self.counter.any():
            zeros = int(np.flatnonzero(self.counter)[0])
            every[:zeros] = zeros == 1  # a single one is the sender's first message
        return every

    @cached_property
    def first_seen(self) -> Array:
        """Which of these rows are not the same message again."""
        if self.counter is None:
            return self.came
        again = np.concatenate([[False], self.counter[1:] == self.counter[:-1]])
        first: Array = self.came & ~again
        return first
