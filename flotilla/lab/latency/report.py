"""The page `build/reports/latency.html`, and the same figures as `latency.json`: every run there is, side by side."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import jinja2

from flotilla.common.errors import UserError
from flotilla.lab.latency import gate, limits, trace
from flotilla.lab.latency.controls import NO_RT
from flotilla.lab.latency.results import Latency, Outcome, Plan, Results
from flotilla.lab.latency.run import SECONDS, VIRTUAL
from flotilla.lab.latency.scenarios import SCENARIOS

_PLANS = get_args(Plan)
_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 420, 200, 44, 28
"""Of a chart, in pixels; the axes' labels are left and below."""


@dataclass(frozen=True)
class Series:
    """One histogram in a chart."""

    name: str
    colour: int
    """Number of a colour of the page."""
    histogram_us: Mapping[int, int]


@dataclass(frozen=True)
class Line:
    """A series as an SVG path."""

    name: str
    colour: int
    path: str


@dataclass(frozen=True)
class Tick:
    at: float
    text: str


@dataclass(frozen=True)
class Chart:
    """Share of samples (logarithmic, upwards) by latency in µs (logarithmic, to the right)."""

    title: str
    lines: list[Line]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    width: int = _WIDTH
    height: int = _HEIGHT
    left: int = _LEFT
    bottom: int = _BOTTOM


@dataclass(frozen=True)
class Row:
    """A quantity of a scenario, across the runs."""

    name: str
    quantity: str
    title: str
    outcomes: list[Outcome | None]

    @property
    def latencies(self) -> list[Latency | None]:
        return [outcome.latencies.get(self.quantity) if outcome else None for outcome in self.outcomes]


def chart(title: str, series: Sequence[Series], extent_us: tuple[int, int]) -> Chart:
    """Draw histograms into one chart, each as share of its own samples, so that runs of any length compare.

    `extent_us`: the least and the greatest latency that the axis has to show.
    """
    low, high = math.floor(math.log10(extent_us[0])), math.floor(math.log10(extent_us[1])) + 1
    least = min(1 / sum(each.histogram_us.values()) for each in series)
    floor = math.log10(least) - 0.3  # so that a single sample stands above the ground

    def x(latency_us: float) -> float:
        return round(_LEFT + (math.log10(latency_us) - low) / (high - low) * (_WIDTH - _LEFT), 1)

    def y(share: float) -> float:
        return round((_HEIGHT - _BOTTOM) * math.log10(share) / floor, 1)

    def path(histogram: Mapping[int, int]) -> str:
        total, ground = sum(histogram.values()), _HEIGHT - _BOTTOM
        return "".join(
            f"M{x(max(1, at))} {ground}V{y(count / total)}H{max(x(at + 1), x(max(1, at)) + 1)}V{ground}"
            for at, count in sorted(histogram.items())
        )

    return Chart(
        title,
        [Line(each.name, each.colour, path(each.histogram_us)) for each in series],
        [Tick(x(10**power), f"{10**power:,}".replace(",", " ")) for power in range(low, high + 1)],
        [Tick(y(10**power), f"{10 ** (2 + power):g} %") for power in range(math.ceil(floor), 1)],
    )


def write(runs: Sequence[Results], directory: Path) -> Path:
    """Write `latency.html` and `latency.json`; the page's path."""
    directory.mkdir(parents=True, exist_ok=True)
    ordered = sorted(runs, key=lambda run: (run.board, _PLANS.index(run.plan), run.kernel))
    whole = {label(run): run.model_dump(mode="json") for run in ordered}
    (directory / "latency.json").write_text(json.dumps(whole, indent=1, sort_keys=True) + "\n")
    page = directory / "latency.html"
    page.write_text(render(ordered))
    return page


def label(run: Results) -> str:
    """`smartcoret3, debian`; `robot3, real time` of a robot."""
    name = f"{run.board}, {run.kernel}" if run.where == VIRTUAL else run.where
    return name if run.plan == "standard" else f"{name} ({run.plan})"


def render(runs: Sequence[Results]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"zip": zip, "cause": trace.cause}
    return environment.get_template("report.html.j2").render(
        runs=[(label(run), run) for run in runs],
        virtual=any(run.where == VIRTUAL for run in runs),
        robots=sorted({run.where for run in runs if run.where != VIRTUAL}),
        charts=charts(runs),
        rows=rows(runs),
        missed=missed(runs),
        verdicts=limits.judge(runs),
        controls=[_judged(run) for run in runs if run.kernel == NO_RT.kernel],
    )


def _judged(control: Results) -> str:
    """What the gate says, refused or not."""
    try:
        return gate.check_control(control)
    except UserError as error:
        return str(error)


def rows(runs: Sequence[Results]) -> list[Row]:
    """Everything that any run measured."""
    found = {
        (name, quantity): outcome.title
        for run in runs
        for name, outcome in run.scenarios.items()
        for quantity in outcome.latencies
    }
    order = [scenario.name for scenario in SCENARIOS]
    return [
        Row(name, quantity, title, [run.scenarios.get(name) for run in runs])
        for (name, quantity), title in sorted(found.items(), key=lambda item: order.index(item[0][0]))
    ]


def missed(runs: Sequence[Results]) -> list[str]:
    """What has fewer samples than were planned: a line each. Such a period began before the one before had ended."""
    planned = {scenario.name: scenario for scenario in SCENARIOS}
    return [
        f"{label(run)}: {outcome.title}: {quantity}: {latency.samples} of {wanted} samples"
        for run in runs
        for name, outcome in run.scenarios.items()
        for quantity, latency in outcome.latencies.items()
        if latency.samples < (wanted := planned[name].samples(SECONDS[run.plan]))
    ]


def charts(runs: Sequence[Results]) -> list[Chart]:
    """One for each row: the runs against each other, and before them what the first run showed when idle."""
    made = []
    table = rows(runs)
    for row in table:
        series = [
            Series(label(run), number, latency.histogram_us)
            for number, (run, latency) in enumerate(zip(runs, row.latencies, strict=True), 1)
            if latency
        ]
        idle = runs[0].scenarios.get(unloaded(row.name))
        if idle and row.quantity in idle.latencies and row.name != unloaded(row.name):
            series.insert(0, Series(f"{label(runs[0])}, {idle.title}", 0, idle.latencies[row.quantity].histogram_us))
        made.append(chart(f"{row.title}: {row.quantity}", series, _extent_us(table, row.quantity)))
    return made


def _extent_us(table: Sequence[Row], quantity: str) -> tuple[int, int]:
    """One axis for all charts of a quantity, so that they compare by eye."""
    found = [latency for row in table if row.quantity == quantity for latency in row.latencies if latency]
    return max(1, min(latency.min_us for latency in found)), max(latency.max_us for latency in found)


def unloaded(name: str) -> str:
    """The scenario that shows the same without load: `uart-own` for `uart-own-cpu`, `idle` for `cpu`."""
    stems = [scenario.name for scenario in SCENARIOS if f"{name}-".startswith(f"{scenario.name}-")]
    return next((stem for stem in sorted(stems, key=len) if stem != name), name if "-" in name else "idle")
