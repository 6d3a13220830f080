"""A page of a recording: paths, commands, hops and latency, and every other signal against time. `make report`.

What is drawn how is told by signals' names, as `ansible/control_tasks/messages.yml` gives them: `_PATHS` are positions,
`..._ns` are moments of one step on its way through the tasks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import jinja2
import numpy as np

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.station import figures, mcap_reader
from flotilla.station.figures import BLUE, GREY
from flotilla.station.recording import Array
from flotilla.station.topic import Topic

_PATHS = ("estimated", "pose")
"""Signals whose first two elements are where the robot is, in m."""
_COMMANDED = "wanted"
"""Where it should be, when it comes with `estimated`."""
_STAMP = "_ns"
_NO_STAMPS = ("now_ns", "offset_ns")
_COUNTERS = ("step", "number", "sequence")
"""They show loss, and are not drawn."""
_PERCENTILES = (50, 99, 99.9, 100)


@dataclass(frozen=True)
class Hop:
    """The way from one task to the next, or all of them."""

    name: str
    us: Array

    @property
    def percentiles_us(self) -> list[float]:
        return [float(each) for each in np.percentile(self.us, _PERCENTILES)]

    @property
    def histogram_us(self) -> Counter[int]:
        return Counter(int(each) for each in self.us)


@dataclass(frozen=True)
class Account:
    """Of a topic's messages."""

    name: str
    count: int
    rate_hz: float
    longest_gap_s: float
    lost: int | None
    """Steps without a message, as far as the messages before and after tell; None: the steps are not numbered."""


def write(file: Path, page: Path) -> Path:
    """The page of the recording in `file`. UserError where that cannot be read, or the page not be written."""
    topics = mcap_reader.read(file)
    begin_ns = min(int(topic.times_ns[0]) for topic in topics)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined, autoescape=True,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    text = environment.get_template("report.html.j2").render(
        name=file.name,
        seconds=(max(int(topic.times_ns[-1]) for topic in topics) - begin_ns) / 1e9,
        begin=np.datetime64(begin_ns, "ns").astype("datetime64[s]"),
        accounts=[account(topic) for topic in topics],
        hops={topic.name: found for topic in topics if (found := hops(topic))},
        percentiles=_PERCENTILES,
        pictures=[picture for topic in topics for picture in _pictures(topic, begin_ns)],
    )
    beside = page.with_name(f"{page.name}.part")
    try:
        page.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text)
        beside.replace(page)
    except OSError as error:
        raise UserError(f"{paths.shown(page)}: {error.strerror}; name another file: OUT=") from error
    return page


def account(topic: Topic) -> Account:
    span_s = float(topic.times_ns[-1] - topic.times_ns[0]) / 1e9
    gaps = np.diff(topic.times_ns)
    steps = next((topic.signals[name] for name in _COUNTERS if name in topic.signals), None)
    return Account(
        topic.name,
        len(topic.times_ns),
        (len(topic.times_ns) - 1) / span_s if span_s else 0.0,
        float(gaps.max()) / 1e9 if len(gaps) else 0.0,
        None if steps is None else _lost(steps),
    )


def _lost(steps: Array) -> int:
    """A message comes each so many steps as most do. Where numbers start again, nothing is known to be lost."""
    ahead = np.diff(steps.astype(np.int64))
    ahead = ahead[ahead > 0]
    every = int(np.median(ahead)) if len(ahead) else 1
    return int((ahead // every - 1).sum())


def hops(topic: Topic) -> list[Hop]:
    """Between the moments that a message carries, in their order, and the whole way last; of messages that have all."""
    names = [name for name in topic.signals if name.endswith(_STAMP) and name not in _NO_STAMPS]
    stamps = {name.removesuffix(_STAMP): topic.signals[name] for name in names}
    there = np.all([signal > 0 for signal in stamps.values()], axis=0)
    if len(stamps) < 2 or not there.any():
        return []
    first, *_, last = stamps
    found = [Hop(f"{before} → {after}", stamps[after] - stamps[before]) for before, after in pairwise(stamps)]
    found.append(Hop("all", stamps[last] - stamps[first]))
    return [Hop(hop.name, hop.us[there] / 1e3) for hop in found]


def _pictures(topic: Topic, begin_ns: int) -> Iterator[str]:
    seconds = (topic.times_ns - begin_ns) / 1e9
    for name, signal in topic.signals.items():
        if name in _PATHS and signal.ndim == 2:
            yield _path(topic, signal)
    if found := hops(topic):
        yield _latency(topic, found)
    for name, signal in topic.signals.items():
        if name not in _COUNTERS and not name.endswith(_STAMP):
            yield _lines(f"{topic.name} {name}", seconds, signal)


def _path(topic: Topic, where: Array) -> str:
    figure, axes = figures.new()
    commanded = topic.signals.get(_COMMANDED)
    if "estimated" in topic.signals and commanded is not None and commanded.ndim == 2:
        axes.plot(commanded[:, 0], commanded[:, 1], color=GREY, linewidth=2, label="commanded")
    axes.plot(where[:, 0], where[:, 1], color=BLUE, linewidth=0.8, label="measured")
    axes.set(title=f"{topic.name}: path", xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.legend(loc="best")
    return figures.svg(figure)


def _latency(topic: Topic, found: list[Hop]) -> str:
    figure, axes = figures.new()
    for hop in found:
        whole = hop is found[-1]
        counts, edges = figures.latency_bins(hop.histogram_us)
        axes.stairs(counts, edges, label=hop.name, color="black" if whole else None, linewidth=1.2 if whole else 0.8)
    figures.latency_axes(axes, f"{topic.name}: latency", None)
    return figures.svg(figure)


def _lines(title: str, seconds: Array, signal: Array) -> str:
    figure, axes = figures.new()
    columns = signal.reshape(len(signal), -1)
    steps = signal.dtype == np.bool_
    for at in range(columns.shape[1]):
        # Booleans lie above each other.
        values = columns[:, at] * 0.8 + at if steps else columns[:, at]
        axes.plot(
            seconds, values, linewidth=0.8, drawstyle="steps-post" if steps else "default",
            label=f"[{at}]" if columns.shape[1] > 1 else None,
        )  # fmt: skip
    axes.set(title=title, xlabel="s")
    if columns.shape[1] > 1:
        axes.legend(loc="best", ncols=2)
    return figures.svg(figure)
