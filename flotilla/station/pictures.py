"""What a report draws of topics, chosen by what signals they have, whoever recorded them.

| signals | picture |
|---|---|
| `pose`, `estimated` (x and y in m, then a heading in rad) | map; `wanted` beside them is where the robot should be |
| `motion` and `wanted`, equally wide (m/s, rad/s) | speeds, commanded and driven |
| `..._ns`, moments of one step on its way through tasks | latency of each hop |
| booleans | when each is 1 |
| `alive`, `good`, `seeing`, `limited` | shaded in pictures of their topic while they say that something is wrong |
| all others | against time; elements of one unit share axes, more than 16 are an image |
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from matplotlib.axes import Axes

from flotilla.station import figures, hops
from flotilla.station.figures import BLUE, COLOURS, GREY
from flotilla.station.recording import Array
from flotilla.station.topic import COUNTERS, Topic

PLACES = ("estimated", "pose")
COMMANDED, DRIVEN = "wanted", "motion"
_UNITS = {
    "pose": ("m", "m", "rad"), "estimated": ("m", "m", "rad", "m/s", "m/s", "rad/s"), "motion": ("m/s", "rad/s"),
    "velocity": ("m/s", "m/s", "rad/s"), "wrench": ("N", "N", "N·m"),
}  # fmt: skip
"""Of signals that have so many elements, where the recording tells no units: files of a recorder do not."""
_STATES = (("alive", False, "#d62728"), ("good", False, "#d62728"), ("seeing", False, "#7f5fbf"),
           ("limited", True, "#e8a33d"))  # fmt: skip
"""Flags, what they are when something is wrong, and the colour of that time."""
_ARROWS = 16
_MOST_LINES = 16
"""Elements of one unit that are lines. More, such as a scan's ranges, are an image: time across, elements up."""
_MOST_SPANS = 300
"""That a picture shades: nearer ones become one."""


@dataclass(frozen=True)
class State:
    """How long something was wrong."""

    name: str
    color: str
    spans_s: list[tuple[float, float]]

    @property
    def seconds(self) -> float:
        return sum(end - begin for begin, end in self.spans_s)

    @property
    def longest_s(self) -> float:
        return max(end - begin for begin, end in self.spans_s)


def states(topic: Topic, seconds: Array) -> list[State]:
    """Those that there were; `seconds`: times of the messages. A flag holds until the next message."""
    found = []
    for name, wrong, color in _STATES:
        flags = topic.signals.get(name)
        if flags is not None and flags.dtype == np.bool_ and flags.ndim == 1 and (flags == wrong).any():
            edges = np.diff(np.concatenate([[0], (flags == wrong).astype(np.int8), [0]]))
            ends = np.append(seconds, seconds[-1])
            spans = zip(ends[np.flatnonzero(edges == 1)], ends[np.flatnonzero(edges == -1)], strict=True)
            found.append(State(name if wrong else f"not {name}", color, [(float(b), float(e)) for b, e in spans]))
    return found


def units(topic: Topic, name: str) -> tuple[str, ...]:
    """Of each element of a signal; an empty one where nobody knows."""
    signal = topic.signals[name]
    width = signal.shape[1] if signal.ndim == 2 else 1
    for known in (topic.units.get(name), _UNITS.get(name)):
        if known and len(known) in (1, width):
            return tuple("" if each == "1" else each for each in (known if len(known) == width else known * width))
    return ("",) * width


def robot(topic: Topic) -> str:
    """Whose topic it is: `robot3` of `/robot3/control/report`; empty for one without folders."""
    return topic.name[1:].split("/")[0] if topic.name.count("/") > 1 else ""


def of_robots(topics: Sequence[Topic], begin_ns: int) -> Iterator[str]:
    """Maps, how far robots were from where they should be, and latency."""
    for name, own in groupby(sorted(topics, key=robot), robot):
        yield from _maps(f"{name}: " if name else "", list(own), begin_ns)
    for topic in topics:
        if found := hops.hops(topic):
            yield _histogram(topic, found)
            yield _latency(topic, found[-1], begin_ns)


def of_topic(topic: Topic, begin_ns: int) -> Iterator[str]:
    """All its signals that change."""
    seconds = (topic.times_ns - begin_ns) / 1e9
    shown = states(topic, seconds)
    if _commands_speeds(topic):
        yield _speeds(topic, seconds, shown)
    left = [name for name in topic.signals if _is_drawn(topic, name)]
    single = [name for name in left if topic.signals[name].dtype == np.bool_ and topic.signals[name].ndim == 1]
    if single:
        rows = [(name, topic.signals[name]) for name in reversed(single)]
        yield _flags(f"{topic.name}: flags", seconds, rows, len(rows))
    for name in left:
        signal = topic.signals[name]
        if signal.dtype == np.bool_ and signal.ndim == 2:
            rows = [(f"{name}[{at}]", signal[:, at]) for at in reversed(range(signal.shape[1]))]
            yield _flags(f"{topic.name}: {name}", seconds, rows, len(rows))
        elif signal.dtype != np.bool_ and not (_commands_speeds(topic) and name in (COMMANDED, DRIVEN)):
            yield _lines(topic, name, seconds, shown)


def constants(topic: Topic) -> dict[str, str]:
    """Signals that never change, and so are not drawn."""
    fixed = [name for name in topic.signals if name not in COUNTERS and not _changes(topic.signals[name])]
    return {name: ", ".join(f"{each:g}" for each in np.atleast_1d(topic.signals[name][0])) for name in fixed}


def _changes(signal: Array) -> bool:
    return bool((signal[1:] != signal[:-1]).any())


def _is_drawn(topic: Topic, name: str) -> bool:
    return name not in COUNTERS and not name.endswith(hops.STAMP) and _changes(topic.signals[name])


def _commands_speeds(topic: Topic) -> bool:
    driven, commanded = topic.signals.get(DRIVEN), topic.signals.get(COMMANDED)
    return driven is not None and commanded is not None and driven.ndim == 2 and driven.shape == commanded.shape


def _places(topic: Topic) -> dict[str, Array]:
    """Signals that are where the robot is, and where it should be while it is told to be anywhere."""
    found = {}
    for name in (*PLACES, COMMANDED):
        signal = topic.signals.get(name)
        if signal is not None and signal.ndim == 2 and not (name == COMMANDED and _commands_speeds(topic)):
            found[name] = signal
    return found if found.keys() - {COMMANDED} else {}


def _commanded(topic: Topic) -> Array:
    """The messages in which it is told to be anywhere: all, without a flag that says when."""
    flying = topic.signals.get("flying")
    use = topic.came & flying if flying is not None and flying.dtype == np.bool_ else topic.came
    return np.flatnonzero(use if use.any() else topic.came)


def _maps(title: str, topics: Sequence[Topic], begin_ns: int) -> Iterator[str]:
    places = {(topic.name, name): signal for topic in topics for name, signal in _places(topic).items()}
    if not places:
        return
    figure, axes = figures.new()
    by_name = {topic.name: topic for topic in topics}
    labels = {key: f"{key[1]}, {key[0]}" if len({name for name, _ in places}) > 1 else key[1] for key in places}
    colours = iter(COLOURS * len(places))
    for key, signal in places.items():
        topic = by_name[key[0]]
        if key[1] == COMMANDED:
            rows = figures.thinned(_commanded(topic))
            axes.plot(
                *signal[rows, :2].T, color=GREY, linewidth=3, alpha=0.7, label=f"commanded: {labels[key]}", zorder=1
            )
        else:
            _path(axes, signal[topic.came], next(colours), labels[key])
    axes.set(title=f"{title}path", xlabel="x, m", ylabel="y, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best")
    yield figures.svg(figure)
    yield from _distances(title, by_name, places, labels, begin_ns)


def _path(axes: Axes, signal: Array, color: str, label: str) -> None:
    """Whose begin is a ring and whose end a square; arrows are headings."""
    rows = figures.thinned(np.arange(len(signal)))
    axes.plot(*signal[rows, :2].T, color=color, linewidth=1, label=label)
    axes.plot(*signal[0, :2], marker="o", color=color, markerfacecolor="white", markersize=6)
    axes.plot(*signal[-1, :2], marker="s", color=color, markersize=5)
    if signal.shape[1] > 2 and np.ptp(signal[:, :2], axis=0).max():
        # At equal distances, so that a robot that waits has one.
        way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(signal[:, :2], axis=0).T))])
        rows = np.searchsorted(way, np.linspace(0, way[-1], _ARROWS + 2)[1:-1])
        x, y, heading = signal[rows, :3].T
        axes.quiver(x, y, np.cos(heading), np.sin(heading), color=color, angles="xy", width=0.004, scale=20, alpha=0.8)


def _distances(
    title: str, topics: Mapping[str, Topic], places: Mapping[tuple[str, str], Array],
    labels: Mapping[tuple[str, str], str], begin_ns: int,
) -> Iterator[str]:  # fmt: skip
    """From where robots should be, at the times of these commands."""
    for commanded in [key for key in places if key[1] == COMMANDED]:
        told = topics[commanded[0]]
        rows = _commanded(told)
        if len(rows) < 2:
            continue
        times = told.times_ns[rows]
        figure, axes = figures.new()
        measured = [key for key in places if key[1] != COMMANDED]
        for key, color in zip(measured, COLOURS * len(measured), strict=False):
            topic = topics[key[0]]
            order = np.flatnonzero(topic.came)
            at = [np.interp(times, topic.times_ns[order], places[key][order, axis]) for axis in (0, 1)]
            mm = 1000 * np.hypot(at[0] - places[commanded][rows, 0], at[1] - places[commanded][rows, 1])
            label = f"{labels[key]}: rms {np.sqrt((mm**2).mean()):.1f} mm, max {mm.max():.1f} mm"
            figures.line(axes, (times - begin_ns) / 1e9, mm, color=color, label=label)
        axes.set(title=f"{title}distance from commanded", xlabel="time, s", ylabel="distance, mm", ylim=(0, None))
        axes.legend(loc="best")
        yield figures.svg(figure)


def _histogram(topic: Topic, found: Sequence[hops.Hop]) -> str:
    figure, axes = figures.new()
    for hop, color in zip(found, COLOURS * len(found), strict=False):
        whole = hop is found[-1]
        counts, edges = figures.latency_bins(hop.histogram_us)
        axes.stairs(counts, edges, label=hop.name, color="black" if whole else color, linewidth=1.4 if whole else 1)
    figures.latency_axes(axes, f"{topic.name}: latency", None)
    return figures.svg(figure)


def _latency(topic: Topic, whole: hops.Hop, begin_ns: int) -> str:
    figure, axes = figures.new()
    figures.line(axes, (whole.times_ns - begin_ns) / 1e9, whole.us / 1e3, color="black", label=None)
    axes.set(title=f"{topic.name}: latency of all hops", xlabel="time, s", ylabel="latency, ms", ylim=(0, None))
    return figures.svg(figure)


def _speeds(topic: Topic, seconds: Array, shown: Sequence[State]) -> str:
    commanded, driven = topic.signals[COMMANDED], topic.signals[DRIVEN]
    figure, panels = figures.panels(driven.shape[1])
    for at, (axes, unit) in enumerate(zip(panels, units(topic, DRIVEN), strict=True)):
        figures.line(axes, seconds, commanded[:, at], color=GREY, label="commanded", width=2.5)
        figures.line(axes, seconds, driven[:, at], color=BLUE, label="driven")
        axes.set(ylabel=f"{DRIVEN}[{at}]{f', {unit}' if unit else ''}")
        _shade(axes, shown)
    panels[0].set(title=f"{topic.name}: speeds, commanded and driven")
    panels[-1].set(xlabel="time, s")
    figures.legend_above(panels[0])
    return figures.svg(figure)


def _shade(axes: Axes, shown: Sequence[State]) -> None:
    """With one entry a state in the legend."""
    for level, state in enumerate(shown):
        spans = figures.merged(state.spans_s, _MOST_SPANS)
        # Above each other, so that one does not hide another.
        low, high = level / len(shown), (level + 1) / len(shown)
        for number, (begin, end) in enumerate(spans):
            label = state.name if number == 0 else None
            axes.axvspan(begin, end, low, high, color=state.color, alpha=0.22, linewidth=0, label=label, zorder=0)


def _flags(title: str, seconds: Array, rows: Sequence[tuple[str, Array]], count: int) -> str:
    """A row a flag. Where messages are too many to show each, the height is the share of the time that it is 1."""
    figure, axes = figures.new(height=min(max(1.2 + 0.28 * count, 1.8), 12))
    for at, (_, flags) in enumerate(rows):
        times, shares = figures.shares(seconds, flags)
        axes.fill_between(times, at - 0.4, at - 0.4 + 0.8 * shares, step="post", color=BLUE, linewidth=0)
        axes.axhline(at - 0.4, color=GREY, linewidth=0.4)
    axes.set(title=title, xlabel="time, s", yticks=range(len(rows)), ylim=(-0.6, len(rows) - 0.4))
    axes.set_yticklabels([name for name, _ in rows])
    if seconds[-1] > seconds[0]:
        axes.set_xlim(seconds[0], seconds[-1])
    return figures.svg(figure)


def _lines(topic: Topic, name: str, seconds: Array, shown: Sequence[State]) -> str:
    columns = topic.signals[name].reshape(len(seconds), -1)
    known = units(topic, name)
    order = list(dict.fromkeys(known))
    figure, panels = figures.panels(len(order))
    for axes, unit in zip(panels, order, strict=True):
        own = [at for at, each in enumerate(known) if each == unit]
        if len(own) > _MOST_LINES:
            figures.image(figure, axes, seconds, columns[:, own], label=f"{name}, {unit}" if unit else name)
            axes.set(ylabel="element")
            continue
        for at, color in zip(own, COLOURS * len(own), strict=False):
            label = f"{name}[{at}]" if columns.shape[1] > 1 else name
            figures.line(axes, seconds, columns[:, at], color=color, label=label)
        axes.set(ylabel=f"{name}, {unit}" if unit else name)
        if axes is not panels[0] and len(own) > 1:
            axes.legend(loc="best")
        _shade(axes, shown)
    panels[0].set(title=f"{topic.name}: {name}")
    panels[-1].set(xlabel="time, s")
    if columns.shape[1] <= _MOST_LINES and (columns.shape[1] > 1 or shown):
        figures.legend_above(panels[0])
    return figures.svg(figure)
