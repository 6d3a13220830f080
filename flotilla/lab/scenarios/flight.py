"""What came of a flight: from the recordings of station and plant to the figures by which it is judged."""

from __future__ import annotations

import bisect
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from flotilla.lab.latency.results import Latency
from flotilla.station import recording

HOPS = ("sensors → navigation", "navigation → control", "control → thruster mapping", "thruster mapping → valves")
_STAMPS = ("sensed_ns", "navigation_ns", "control_ns", "mapping_ns", "valves_ns")
"""When a step's message was sent by the first task, and arrived at each of the others."""

LIMIT_US = 10_000
"""Of the four hops of a flight that nothing disturbs: the period, within which the published laboratory had them."""

Record = dict[str, Any]


@dataclass(frozen=True)
class Error:
    """Of the flight against what was commanded."""

    rms_m: float
    max_m: float
    max_heading_rad: float


@dataclass(frozen=True)
class Thrusters:
    """What the valves did while the path was flown: latency shows here before it shows in the error."""

    on_time_s: float
    """Of all together."""
    firings: int


@dataclass
class Flight:
    """All `time_ns` are of one clock. Not to be changed once a figure was asked for."""

    flown: list[Record]
    """Of the plant: pose, velocity, on-times and switches of the valves."""
    steps: list[Record]
    """What the valves reported of each step."""
    controls: list[Record]
    """What the controller reported of each tenth step."""
    statistics: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What tasks wrote at their end, by name; empty where they were not asked to."""
    events_ns: list[int] = field(default_factory=list)
    """When the events of the plan had happened."""
    second_station: list[Record] = field(default_factory=list)
    """What a second station received of the steps; empty where there was none."""
    one_clock: bool = True
    """Whether stamps of different computers may be compared, as in virtual time."""
    refused: dict[str, dict[str, dict[str, int]]] = field(default_factory=dict)
    """What tasks had refused at their end, by task, block and kind; empty where they were not asked."""

    @classmethod
    def read(cls, directory: Path) -> Flight:
        """What `virtual.fly` returned."""
        return cls(
            records(directory / "plant", "flown"),
            records(directory / "station", "steps"),
            records(directory / "station", "controls"),
            {path.parent.name: json.loads(path.read_text()) for path in sorted(directory.glob("*/statistics.json"))},
            json.loads((directory / "events.json").read_text()),
            records(directory / "second", "steps") if (directory / "second").exists() else [],
            refused={
                path.parent.name: json.loads(path.read_text())["refused"] for path in directory.glob("*/status.json")
            },
        )

    @cached_property
    def _flown_ns(self) -> list[int]:
        return [record["time_ns"] for record in self.flown]

    def pose_at(self, time_ns: int) -> tuple[float, float, float]:
        """x, y in m and heading in rad, between the plant's records."""
        after = min(max(bisect.bisect(self._flown_ns, time_ns), 1), len(self.flown) - 1)
        (x0, y0, a0), (x1, y1, a1) = self.flown[after - 1]["pose"], self.flown[after]["pose"]
        begin, end = self._flown_ns[after - 1], self._flown_ns[after]
        share = (time_ns - begin) / (end - begin)
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0), a0 + share * (a1 - a0)

    def since(self, time_ns: int) -> list[Record]:
        """The plant's records from then on."""
        return self.flown[bisect.bisect_left(self._flown_ns, time_ns) :]

    @cached_property
    def arrived(self) -> list[Record]:
        """The first record of each of the robot's steps whose command reached the valves."""
        seen: dict[int, Record] = {}
        for record in self.steps:
            if record["sequence"] and record["sensed_ns"]:
                seen.setdefault(record["number"], record)
        return [seen[number] for number in sorted(seen)]

    @cached_property
    def in_flight(self) -> list[Record]:
        """Of these, the ones from when the path is flown; all, where none is. Before that programs start, find each
        other and ask for each other's hardware addresses, and the robot is not moved."""
        begin = self.commanded[0]["number"] if self.commanded else 0
        return [step for step in self.arrived if step["number"] >= begin]

    @cached_property
    def commanded(self) -> list[Record]:
        """While the path is flown."""
        return [record for record in self.controls if record["flying"] and not record["done"]]

    @property
    def completed(self) -> bool:
        """The path was commanded to its end."""
        return any(record["done"] for record in self.controls)

    def error(self) -> Error:
        errors = []
        headings = []
        for record in self.commanded:
            x, y, heading = self.pose_at(record["time_ns"])
            errors.append(math.hypot(record["wanted"][0] - x, record["wanted"][1] - y))
            headings.append(abs(heading))
        rms = math.sqrt(sum(error * error for error in errors) / len(errors))
        return Error(rms, max(errors), max(headings))

    def thrusters(self) -> Thrusters:
        begin, end = (self.since(self.commanded[index]["time_ns"])[0] for index in (0, -1))
        return Thrusters(
            sum(end["on_time"]) - sum(begin["on_time"]), (sum(end["switches"]) - sum(begin["switches"])) // 2
        )

    def hop(self, index: int) -> Latency:
        """From one task's release to the next one's, in which the former's step lies."""
        return _latency([step[_STAMPS[index + 1]] - step[_STAMPS[index]] for step in self.in_flight])

    def latency(self) -> Latency:
        """From when the sensors' step was due until the valves are switched: four hops."""
        return _latency([_four_hops_ns(step) for step in self.in_flight])

    @property
    def start_up_us(self) -> int:
        """The longest that four hops took before the path was flown; 0 where there were none."""
        return max((_four_hops_ns(step) // 1000 for step in self.arrived[: -len(self.in_flight)]), default=0)

    def late(self) -> int:
        """Steps whose command arrived, after `LIMIT_US`."""
        return sum(count for us, count in self.latency().histogram_us.items() if us >= LIMIT_US)

    def faults(self, *, disturbed: bool) -> list[str]:
        """What no flight in virtual time may show; of an undisturbed one also what took longer than the limit."""
        if not self.one_clock:
            return []
        found = []
        for index, name in enumerate(HOPS):
            hop = self.hop(index)
            before = sum(count for us, count in hop.histogram_us.items() if us < 0)
            if before:
                found.append(
                    f"{name}: {before} of {hop.samples} messages arrived before they were sent, {hop.min_us} µs"
                )
        if self.late() and not disturbed:
            whole = self.latency()
            late = f"{self.late()} of {whole.samples} steps took {LIMIT_US} µs or more"
            found.append(f"four hops: {late}, {whole.max_us} µs at most")
        return found

    def overruns(self, task: str) -> int:
        """Of a task. Those before the path is flown, while programs start, are left out where it had none since."""
        found = self.statistics[task]
        last = found.get("last_overrun")
        begin_ns = self.commanded[0]["time_ns"] if self.commanded else 0
        counted: int = found["overruns"]
        return 0 if last and last["at_ns"] < begin_ns else counted

    def lost(self) -> int:
        """Of the robot's steps in flight, from the first whose command arrived to the last: those whose did not."""
        numbers: list[int] = [step["number"] for step in self.in_flight]
        return numbers[-1] - numbers[0] + 1 - len(numbers)


def records(directory: Path, name: str) -> list[Record]:
    """All that a recorder of a task wrote."""
    files = sorted(directory.glob(f"{name}-*.rec"))
    if not files:
        raise FileNotFoundError(f"{directory} has no recording {name}")
    return [record for file in files for record in recording.read(file).records]


def _four_hops_ns(step: Record) -> int:
    """From when the sensors' step was due until the valves were switched."""
    latency_ns: int = step["now_ns"] + step["offset_ns"] - step["sensed_ns"]
    return latency_ns


def _latency(nanoseconds: Sequence[int]) -> Latency:
    histogram: dict[int, int] = {}
    for each in nanoseconds:
        histogram[each // 1000] = histogram.get(each // 1000, 0) + 1
    return Latency.of(histogram)
