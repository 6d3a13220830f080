"""What the station's page shows of streams: a sink of the receiver, asked for the present state ten times a second.

Poses and scans are those that `foxglove:` of a message in `messages.yml` draws as PoseInFrame and LaserScan.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from math import cos, hypot, isfinite, sin
from typing import Any

from flotilla.station.receiver import Receiver
from flotilla.station.recording import Value
from flotilla.station.telemetry import Stream
from flotilla.station.top import HEALTH, StreamStats

_PATH_POINTS = 2000
"""Of each robot, the newest."""
_PATH_STEP_M = 0.02
"""A robot that moved less has not moved."""
_WIDEST = 16
"""Elements of a signal that is shown as numbers."""
_ROW_NS = 10_000_000
"""Between two rows of signals of a stream: a screen shows no more."""
_POSE = ("pose.position.x", "pose.position.y", "pose.orientation")

_POSES = ("estimated", "pose")
"""Signals that are x, y in m and heading in rad, where a recording of another fleet says no more."""

Json = dict[str, Any]
Row = list[Any]
"""Time in s, then an element of each signal; None where it is not a number."""


@dataclass
class _Drawn:
    """How a stream is drawn."""

    pose: list[Callable[[Mapping[str, Value]], float]] = field(default_factory=list)
    """x, y in m and heading in rad; empty: it has none."""
    ranges: str = ""
    """The signal that is a scan, in m; empty: it has none."""
    first_rad: float = 0
    increment_rad: float = 0
    ahead_m: float = 0
    """The scanner's place before the robot's origin."""


@dataclass
class _Path:
    points: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_PATH_POINTS))
    pose: tuple[float, float, float] | None = None
    topic: str = ""
    """Whose last message it is from."""


@dataclass(frozen=True)
class Follower:
    """Wants rows of a stream's signals."""

    signals: tuple[Callable[[Mapping[str, Value]], Any], ...]
    take: Callable[[Row], None]
    last_ns: list[int] = field(default_factory=lambda: [0])


class View:
    """`clock`: ns since 1970-01-01 UTC, as `received_ns` is."""

    def __init__(self, receiver: Receiver, clock: Callable[[], int]) -> None:
        self._receiver = receiver
        self._clock = clock
        self._known = sorted(receiver.known.values(), key=lambda stream: stream.topic)
        self._drawn = {stream.topic: _drawn(stream) for stream in self._known}
        self._followers: dict[str, list[Follower]] = {stream.topic: [] for stream in self._known}
        self.by_topic = {stream.topic: stream for stream in self._known}
        self.begin()

    def begin(self) -> None:
        """As if nothing had come yet."""
        self._stats = {stream.topic: StreamStats(stream, self._clock()) for stream in self._known}
        self._last: dict[str, Mapping[str, Value]] = {}
        self._paths: dict[str, _Path] = {}
        self._scans: dict[str, Json] = {}
        """New ones, by robot."""

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        topic, drawn = stream.topic, self._drawn[stream.topic]
        self._stats[topic].take(values, received_ns)
        self._last[topic] = values
        if drawn.pose:
            self._move(topic, stream.robot, [of(values) for of in drawn.pose])
        if drawn.ranges:
            self._scans[stream.robot] = self._scan(stream.robot, drawn, values[drawn.ranges])
        for follower in self._followers[topic]:
            if abs(received_ns - follower.last_ns[0]) >= _ROW_NS:
                follower.last_ns[0] = received_ns
                follower.take([received_ns / 1e9, *(_json(of(values)) for of in follower.signals)])

    def refresh(self) -> None:
        """It is asked instead."""

    def end(self) -> str:
        return ""

    def follow(self, topic: str, signals: Iterable[str], take: Callable[[Row], None]) -> Follower:
        """Rows of signals, `name` or `name[2]`, from now on. KeyError with a name that there is not."""
        stream = self.by_topic[topic]
        follower = Follower(tuple(_source(stream, signal) for signal in signals), take)
        self._followers[topic].append(follower)
        return follower

    def task_stream(self, robot: str, task: str, signals: Iterable[str]) -> Stream | None:
        """Of a task's streams, the one with all of these signals."""
        wanted = set(signals)
        for stream in self._known:
            if (stream.robot, stream.task) == (robot, task) and wanted <= {each.name for each in stream.fields}:
                return stream
        return None

    def leave(self, follower: Follower) -> None:
        """It wants no more."""
        for followers in self._followers.values():
            if follower in followers:
                followers.remove(follower)

    def described(self) -> list[Json]:
        """What streams there are, and their signals."""
        return [
            {
                "topic": stream.topic, "robot": stream.robot, "task": stream.task, "name": stream.name,
                "hz": stream.rate_hz, "step_ms": 1000 * stream.step_s, "charge": stream.charge,
                "signals": [{"name": each.name, "type": each.type, "width": each.width} for each in stream.fields],
            }
            for stream in self._known
        ]  # fmt: skip

    def state(self) -> Json:
        """Of every stream, and where robots are."""
        now_ns = self._clock()
        return {
            "now": now_ns / 1e9,
            "streams": {stream.topic: self._stream(stream, now_ns) for stream in self._known},
            "poses": {robot: path.pose for robot, path in self._paths.items()},
            "old": sorted(self._old(now_ns)),
            "strangers": self._receiver.strangers,
        }

    def _old(self, now_ns: int) -> set[str]:
        """Robots whose pose or scan is not current any more."""
        drawn = {(path.topic, robot) for robot, path in self._paths.items()}
        drawn |= {(topic, self.by_topic[topic].robot) for topic in self._last if self._drawn[topic].ranges}
        return {robot for topic, robot in drawn if self._stats[topic].row(now_ns).silent(self.by_topic[topic])}

    def scans(self) -> dict[str, Json]:
        """By robot, those that came since this was asked before."""
        new, self._scans = self._scans, {}
        return new

    def paths(self) -> dict[str, list[tuple[float, float]]]:
        """Where robots were, by robot."""
        return {robot: list(path.points) for robot, path in self._paths.items()}

    def _stream(self, stream: Stream, now_ns: int) -> Json:
        row, count = self._stats[stream.topic].row(now_ns), self._receiver.counts[stream.topic]
        values = self._last.get(stream.topic, {})
        return {
            "hz": round(row.rate_hz, 1), "lost": row.lost, "link": row.link, "age": row.age_s, "charge": row.charge,
            "silent": row.silent(stream), "came": count.received, "refused": count.bad,
            "bad": [name for name, share in row.flags.items() if name.endswith(HEALTH) and share < 1],
            "refusals": row.refusals, "attempts": count.attempts,
            "values": {
                each.name: _json(values[each.name])
                for each in stream.fields
                if each.name in values and each.width <= _WIDEST
            },
        }  # fmt: skip

    def _move(self, topic: str, robot: str, pose: list[float]) -> None:
        if not all(map(isfinite, pose)):
            return
        path = self._paths.setdefault(robot, _Path())
        x, y, heading = pose
        path.topic = topic
        path.pose = (round(x, 4), round(y, 4), round(heading, 4))
        if not path.points or hypot(x - path.points[-1][0], y - path.points[-1][1]) >= _PATH_STEP_M:
            path.points.append(path.pose[:2])

    def _scan(self, robot: str, drawn: _Drawn, ranges: Value) -> Json:
        """Points in the robot's axes, in mm: x, y, x, y …"""
        path = self._paths.get(robot)
        points: list[int] = []
        for number, range_m in enumerate(ranges if isinstance(ranges, tuple) else (ranges,)):
            if isfinite(range_m):
                angle = drawn.first_rad + number * drawn.increment_rad
                points += [round(1000 * (drawn.ahead_m + range_m * cos(angle))), round(1000 * range_m * sin(angle))]
        return {"pose": path.pose if path else None, "points": points}


def _drawn(stream: Stream) -> _Drawn:
    found = _Drawn()
    for each in stream.fields:
        if each.name in _POSES and each.width >= len(_POSE):
            found.pose = [_source(stream, f"{each.name}[{element}]") for element in range(len(_POSE))]
    for drawing in stream.drawings.values():
        drawn = drawing.drawn
        if drawn.type == "PoseInFrame" and all(member in drawn.signals for member in _POSE):
            found.pose = [_source(stream, drawn.signals[member]) for member in _POSE]
        if drawn.type == "LaserScan" and "ranges" in drawn.signals and "[" not in drawn.signals["ranges"]:
            found.ranges = drawn.signals["ranges"]
            width = next(each.width for each in stream.fields if each.name == found.ranges)
            begin, end = (float(drawn.constants.get(name, 0)) for name in ("start_angle", "end_angle"))
            found.first_rad, found.increment_rad = begin, (end - begin) / max(1, width - 1)
            found.ahead_m = float(drawn.constants.get("pose", {}).get("position", {}).get("x", 0))
    return found


def _source(stream: Stream, signal: str) -> Callable[[Mapping[str, Value]], Any]:
    """What takes a signal's value, or an element of it; KeyError: the stream lacks it."""
    parts = re.fullmatch(r"([\w-]+)(?:\[(\d+)\])?", signal)
    field = next((each for each in stream.fields if parts and each.name == parts[1]), None)
    if not parts or not field or (parts[2] and int(parts[2]) >= field.width):
        raise KeyError(signal)
    name = field.name
    if not parts[2]:
        return lambda values: values[name]
    element = int(parts[2])

    def take(values: Mapping[str, Value]) -> Any:
        value = values[name]
        return value[element] if isinstance(value, tuple) else value

    return take


def _json(value: Value) -> Any:
    """Numbers short enough for a screen; None for what is not finite."""
    if isinstance(value, tuple):
        return [_json(each) for each in islice(value, _WIDEST)]
    if isinstance(value, float):
        return float(f"{value:.6g}") if isfinite(value) else None
    return value
