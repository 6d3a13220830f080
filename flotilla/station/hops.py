"""How long a step takes on its way through tasks, by the moments that messages carry."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flotilla.station.recording import Array
from flotilla.station.topic import Topic

STAMP = "_ns"
"""What moments end in: when a step's message released each task, in fleet time."""
_NO_STAMPS = ("now_ns", "offset_ns")
PERCENTILES = (50, 99, 99.9, 100)


@dataclass(frozen=True)
class Hop:
    """The way from one task to the next, or all of them."""

    name: str
    times_ns: Array
    """Of the messages."""
    us: Array

    @property
    def percentiles_us(self) -> list[float]:
        return [float(each) for each in np.percentile(self.us, PERCENTILES)]

    @property
    def histogram_us(self) -> Counter[int]:
        return Counter(int(each) for each in self.us)


def hops(topic: Topic) -> list[Hop]:
    """Between the moments that a message carries, in their order, and the whole way last; of messages that have all.

    A message that a recorder saw several times counts once.
    """
    names = [name for name in topic.signals if name.endswith(STAMP) and name not in _NO_STAMPS]
    stamps = {name.removesuffix(STAMP): topic.signals[name] for name in names}
    there = topic.first_seen & np.all([signal > 0 for signal in stamps.values()], axis=0)
    if len(stamps) < 2 or not there.any():
        return []
    first, *_, last = stamps
    found = [(f"{before} → {after}", stamps[after] - stamps[before]) for before, after in pairwise(stamps)]
    found.append(("all", stamps[last] - stamps[first]))
    return [Hop(name, topic.times_ns[there], lasted_ns[there] / 1e3) for name, lasted_ns in found]
