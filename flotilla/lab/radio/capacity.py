"""How many robots a cell carries: simulate the described fleet several times over until deadlines end."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from flotilla.lab.radio import load, model
from flotilla.lab.radio.load import MS, Result, Setting
from flotilla.lab.radio.model import Computed
from flotilla.lab.radio.traffic import Chain, Description

MOST_ROBOTS = 250
"""An inventory numbers robots from 1 to 250."""

RUNS = 3
"""Of each size: places, clocks and phases are other ones in each, and may be lucky."""


@dataclass(frozen=True)
class Point:
    """One size."""

    simulated: Result
    computed: Computed
    missed_percent: float
    """Steps that are late or lost, of the chain that misses most."""
    carried: bool
    """That is no more than was permitted."""


@dataclass(frozen=True)
class Curve:
    """One standard at one rate."""

    setting: Setting
    points: tuple[Point, ...]
    """By size, ascending."""

    @property
    def carries(self) -> int:
        """Robots of the largest size all of whose smaller ones are carried, too; 0: not even the fleet itself."""
        most = 0
        for point in self.points:
            if not point.carried:
                break
            most = point.simulated.robots
        return most

    @property
    def ends_at(self) -> int | None:
        """Robots of the smallest size that is not carried; None: there was none."""
        return next((point.simulated.robots for point in self.points if not point.carried), None)


def limit_ns(chain: Chain, limit_ms: float | None) -> int:
    """Until when its last message has to be there: its period, unless somebody gave another limit."""
    return round(limit_ms * MS) if limit_ms else chain.period_ns


def seconds_of(groups: int, seconds: float) -> float:
    """Virtual seconds: of more robots less, since each second has more steps."""
    return max(seconds / groups, min(seconds, 1.0))


def measure(
    described: Description, setting: Setting, groups: int, *, seconds: float, limit_ms: float | None, percent: float
) -> Point:
    each_s = seconds_of(groups, seconds) / RUNS
    simulated = load.merged(
        [
            load.run(described, dataclasses.replace(setting, seed=RUNS * setting.seed + run), groups, each_s)
            for run in range(RUNS)
        ]
    )
    missed = [simulated.chains[chain.name].missed(limit_ns(chain, limit_ms)) for chain in described.chains]
    worst = 100 * max(missed)
    return Point(simulated, model.compute(described, setting, groups), worst, worst <= percent)


def find(
    described: Description, setting: Setting, *, seconds: float, limit_ms: float | None, percent: float,
    done: Callable[[Point], None] = lambda _point: None,
) -> Curve:  # fmt: skip
    """Twice as many each time until deadlines end, then between; at least three sizes. `done`: told of each."""
    most = MOST_ROBOTS // len(described.robots)
    found: dict[int, Point] = {}

    def carried(groups: int) -> bool:
        if groups not in found:
            found[groups] = measure(described, setting, groups, seconds=seconds, limit_ms=limit_ms, percent=percent)
            done(found[groups])
        return found[groups].carried

    good, groups = 0, 1
    while groups <= most and carried(groups):
        good, groups = groups, 2 * groups
    bad = min(groups, most + 1)
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if carried(middle) else (good, middle)
    for groups in range(1, min(3, most) + 1):
        carried(groups)
    return Curve(setting, tuple(point for _, point in sorted(found.items())))
