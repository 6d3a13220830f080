"""The page of an acceptance: what holds, what fails, its latencies, and how it compares with those of its board."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import jinja2

from flotilla.common import durable
from flotilla.lab.acceptance import outcome
from flotilla.lab.acceptance.checks import BY_HAND
from flotilla.lab.acceptance.outcome import Acceptance, Outcome
from flotilla.station import figures

_MOST_BESIDE = 8
"""Of the board's other acceptances: the latest."""


@dataclass(frozen=True)
class Row:
    """A figure of several acceptances."""

    name: str
    values: list[float | None]


def write(made: Acceptance, others: Sequence[Acceptance]) -> Path:
    """`ROBOT-TIME.html` beside the signed file."""
    page = outcome.directory() / f"{made.name}.html"
    return durable.write(page, render(made, others))


def render(made: Acceptance, others: Sequence[Acceptance]) -> str:
    """`others`: of the same board, the oldest first."""
    compared = [*others[-_MOST_BESIDE:], made]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined, autoescape=True,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    before = [each for each in others if each.robot == made.robot]
    return environment.get_template("report.html.j2").render(
        made=made,
        parts=[(part, list(found)) for part, found in groupby(_in_parts(made.outcomes), key=lambda each: each.part)],
        compared=compared,
        rows=rows(compared),
        pictures=list(pictures(made, before[-1] if before else None)),
        by_hand=BY_HAND,
        signature=outcome.signature_of(Path(f"{made.name}.json")).name,
        namespace=outcome.NAMESPACE,
    )


def _in_parts(outcomes: Sequence[Outcome]) -> list[Outcome]:
    order = list(dict.fromkeys(each.part for each in outcomes))
    return sorted(outcomes, key=lambda each: order.index(each.part))


def rows(compared: Sequence[Acceptance]) -> list[Row]:
    names = dict.fromkeys(name for each in compared for name in each.figures)
    return [Row(name, [each.figures.get(name) for each in compared]) for name in names]


def pictures(made: Acceptance, before: Acceptance | None) -> list[str]:
    """A histogram of each latency, over the robot's last one in grey."""
    return [
        _histogram(title, found, before.histograms_us.get(title, {}) if before else {})
        for title, found in made.histograms_us.items()
    ]


def _histogram(title: str, found: Mapping[int, int], before: Mapping[int, int]) -> str:
    figure, axes = figures.new(height=2.4)
    extent = max((*found, *before), default=1)
    edges = [10 ** (step / 20) for step in range(math.ceil(20 * math.log10(max(extent, 10))) + 2)]
    for histogram, label, color, filled in (
        (before, "before", figures.GREY, False),
        (found, "now", figures.BLUE, True),
    ):
        if not histogram:
            continue
        total = sum(histogram.values())
        counts = [0.0] * (len(edges) - 1)
        for latency_us, count in histogram.items():
            counts[math.floor(20 * math.log10(max(latency_us, 1)))] += 100 * count / total
        axes.stairs(counts, edges, color=color, fill=filled, label=label)
    axes.set(title=title, xlabel="latency, µs", ylabel="% of samples", xscale="log", yscale="log")
    axes.legend(loc="upper right")
    return figures.svg(figure)
