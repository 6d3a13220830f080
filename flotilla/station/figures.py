"""How figures are drawn: as SVG, the same bytes for the same data."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, GREY, RED = "#1a6bb5", "#999999", "#c8501e"
SIZE = (5.4, 3.6)

# Text stays text, and the same picture is the same file.
mpl.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "flotilla", "font.size": 8, "font.family": "sans-serif"}


def new() -> tuple[Figure, Axes]:
    figure = Figure(SIZE, layout="constrained")
    return figure, figure.add_subplot()


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
    axes.set(title=title, xlabel="ms", ylabel="steps", xscale="log", yscale="log")
    axes.legend(loc="upper right")
