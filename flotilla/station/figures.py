"""How figures are drawn: as SVG, the same bytes for the same data."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flotilla.station.recording import Array

BLUE, GREY, RED = "#1a6bb5", "#999999", "#c8501e"
COLOURS = [BLUE, RED, "#2e8540", "#7b4fa3", "#b8860b", "#2a9d9d", "#c2558d", "#555555"]
SIZE = (5.4, 3.6)

# Text stays text, and the same picture is the same file.
mpl.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "flotilla", "font.size": 8, "font.family": "sans-serif"}


_MOST = 1000
"""Points across a picture: more are not seen, and make the page large."""
_GAP = 20
"""Usual distances of messages that a line does not bridge."""


def new(height: float = SIZE[1]) -> tuple[Figure, Axes]:
    figure = Figure((SIZE[0], height), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    return figure, axes


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """Axes above each other, against one time."""
    figure = Figure((SIZE[0], max(SIZE[1], 1.0 + 1.3 * count)), layout="constrained")
    found = list(figure.subplots(count, sharex=True, squeeze=False)[:, 0])
    for axes in found:
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.set_axisbelow(True)
    return figure, found


def legend_above(axes: Axes) -> None:
    """Where it hides nothing."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=4, frameon=False, borderaxespad=0.2)
    axes.set_title(axes.get_title(), pad=8 + 12 * math.ceil(len(labels) / 4))


def line(axes: Axes, seconds: Array, values: Array, *, color: str, label: str | None, width: float = 1) -> None:
    """Against time: the least and the greatest value of each part where there are many, and none across gaps."""
    seconds, values = seconds.astype(float), values.astype(float)
    if len(seconds) > 2 * _MOST:
        parts = np.array_split(np.arange(len(seconds)), _MOST)
        rows = np.unique([part[pick(values[part])] for part in parts for pick in (np.argmin, np.argmax)])
        seconds, values = seconds[rows], values[rows]
    distances = np.diff(seconds)
    usual = np.median(distances) if len(distances) else 0
    gaps = np.flatnonzero(distances > _GAP * usual) + 1
    axes.plot(
        np.insert(seconds, gaps, np.nan), np.insert(values, gaps, np.nan), color=color, linewidth=width, label=label
    )


def image(figure: Figure, axes: Axes, seconds: Array, columns: Array, *, label: str) -> None:
    """Values as colours: time across, elements up. Of many rows, some are shown; what is not finite has no colour."""
    rows = np.unique(np.linspace(0, len(seconds) - 1, min(len(seconds), _MOST)).astype(int))
    values = np.ma.masked_invalid(columns[rows].T.astype(float))
    edges = np.append(seconds[rows], seconds[rows[-1]] + (seconds[-1] - seconds[0]) / max(len(rows) - 1, 1))
    mesh = axes.pcolormesh(edges, np.arange(columns.shape[1] + 1) - 0.5, values, cmap="viridis", rasterized=True)
    figure.colorbar(mesh, ax=axes, label=label)


def thinned(rows: Array) -> Array:
    """Of these rows, as many as a picture shows, the first and the last among them."""
    found: Array = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), 4 * _MOST)).astype(int))]
    return found


def shares(seconds: Array, flags: Array) -> tuple[Array, Array]:
    """Times, and how much of the time from each to the next a flag is 1."""
    if len(flags) <= 2 * _MOST:
        return seconds, flags.astype(float)
    begins = np.array([part[0] for part in np.array_split(np.arange(len(flags)), _MOST)])
    return seconds[begins], np.add.reduceat(flags.astype(float), begins) / np.diff(np.append(begins, len(flags)))


def merged(spans: Sequence[tuple[float, float]], most: int) -> list[tuple[float, float]]:
    """Those with the least distances as one, until there are no more than `most`."""
    if len(spans) <= most:
        return list(spans)
    distances = sorted((after[0] - before[1] for before, after in pairwise(spans)), reverse=True)
    found: list[tuple[float, float]] = [spans[0]]
    for begin, end in spans[1:]:
        if begin - found[-1][1] > distances[most - 1]:
            found.append((begin, end))
        else:
            found[-1] = (found[-1][0], end)
    return found


def svg(figure: Figure) -> str:
    """The picture as an element of a page."""
    out = io.StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None}, transparent=True)
    return re.sub(r"(?s)^.*?(?=<svg)", "", out.getvalue())


def latency_bins(histogram_us: Mapping[int, int]) -> tuple[list[int], list[float]]:
    """Counts and their edges in ms, twenty a decade from 0.1 ms to 100 ms."""
    edges = [10 ** (step / 20 - 1) for step in range(61)]
    counts = [0] * 60
    for us, count in histogram_us.items():
        step = math.floor((math.log10(max(us, 1) / 1000) + 1) * 20)
        counts[min(max(step, 0), 59)] += count
    return counts, edges


def latency_axes(axes: Axes, title: str, limit_ms: float | None) -> None:
    """Of a histogram of `latency_bins`; `limit_ms`: a line."""
    if limit_ms is not None:
        axes.axvline(limit_ms, color=RED, linewidth=0.8)
    axes.set(title=title, xlabel="latency, ms", ylabel="messages", xscale="log", yscale="log")
    axes.legend(loc="upper right")
