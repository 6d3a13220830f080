"""A page of flights, and its figures as JSON: what each was to do, and did."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jinja2
from matplotlib.axes import Axes

from flotilla.lab.scenarios.crowd import Crowd
from flotilla.lab.scenarios.flight import HOPS, LIMIT_US, Flight
from flotilla.station import figures
from flotilla.station.figures import BLUE, GREY, RED

_SECOND_NS = 1e9

VIRTUAL = (
    "It is an 802.11 ad hoc cell. All computers are namespaces of one guest in virtual time, which boots the system as "
    "it is shipped, so a flight repeats to the byte; on its one processor of 125 million instructions a second they "
    "delay each other as real ones would not."
)


def write(flights: Mapping[str, Flight], directory: Path, name: str = "scenarios", how: str = VIRTUAL) -> Path:
    """`flights` by title, `how` they were flown; the path of the page, which is called `name`.

    Beside it lie the figures as JSON and, where a path was flown, the picture of the first one's trajectory:
    docs/flight.svg is one."""
    directory.mkdir(parents=True, exist_ok=True)
    found = {title: summary(flight) for title, flight in flights.items()}
    (directory / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n")
    page = directory / f"{name}.html"
    pictures = {title: _pictures(flight) for title, flight in flights.items()}
    if trajectories := [pictures[title][0] for title, flight in flights.items() if flight.completed]:
        picture = trajectories[0].replace("<svg ", '<svg style="background: #ffffff" ', 1)  # pages may be dark
        (directory / f"{name}.svg").write_text(picture)
    hops = {
        title: {name: flight.hop(index) for index, name in enumerate(HOPS)} if flight.one_clock else {}
        for title, flight in flights.items()
    }
    page.write_text(
        _environment()
        .get_template("report.html.j2")
        .render(figures=found, pictures=pictures, hops=hops, how=how, degrees=math.degrees, limit_us=LIMIT_US)
    )
    return page


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip


CROWD = (
    "Each loop's control is spread over four robots, or over two, 100 Hz; all robots are in one 802.11 ad hoc cell, "
    "namespaces of one guest in virtual time, whose one processor executes 1000 million instructions a second. The "
    "simulated radio has neither air time nor collisions: the curve is what computers and network software cost, which "
    "share that processor here and have one each in the field, and not what a busy channel costs."
)


def write_crowds(crowds: Sequence[Crowd], directory: Path) -> Path:
    """Latency and loss by the number of robots; the path of the page."""
    directory.mkdir(parents=True, exist_ok=True)
    found = [
        {"robots": crowd.robots, "loops": crowd.loops, "steps": crowd.steps, "lost": crowd.lost,
         "latency_us": crowd.latency.model_dump(mode="json")} for crowd in crowds
    ]  # fmt: skip
    (directory / "robots.json").write_text(json.dumps(found, indent=1) + "\n")
    page = directory / "robots.html"
    page.write_text(
        _environment().get_template("crowd.html.j2").render(crowds=found, picture=_curve(crowds), how=CROWD)
    )
    return page


def _curve(crowds: Sequence[Crowd]) -> str:
    figure, axes = figures.new()
    robots = [crowd.robots for crowd in crowds]
    for name, percent, color in (("median", "50", BLUE), ("99.9 %", "99.9", "black"), ("max", "100", GREY)):
        values = [crowd.latency.percentiles_us[percent] / 1000 for crowd in crowds]
        axes.plot(robots, values, color=color, marker="o", markersize=3, linewidth=0.8, label=name)
    axes.axhline(10, color=RED, linewidth=0.8)
    axes.set(title="Four hops: the line is the period", xlabel="robots", ylabel="ms", xticks=robots, ylim=(0, None))
    axes.legend(loc="upper left")
    lost = axes.twinx()
    lost.plot(robots, [100 * crowd.lost / crowd.steps for crowd in crowds], color=RED, marker="x", linewidth=0)
    lost.set(ylabel="lost, % (×)", ylim=(0, None))
    return figures.svg(figure)


def summary(flight: Flight) -> dict[str, object]:
    """The figures of a flight; those of the path only where one was flown."""
    latency = flight.latency()
    found: dict[str, object] = {
        "steps": len(flight.in_flight) + flight.lost(),
        "lost": flight.lost(),
        "late": flight.late(),
        "latency_us": latency.model_dump(mode="json"),
        "start_up_us": flight.start_up_us,
    }
    if flight.statistics:
        jitters = [each["jitter"]["max_ns"] for each in flight.statistics.values() if "jitter" in each]
        if len(jitters) == len(flight.statistics):  # a service of the image counts steps, and measures no jitter
            found["jitter_max_us"] = max(jitters) / 1000
        found["overruns"] = sum(flight.overruns(task) for task in flight.statistics)
    if flight.completed:
        error, thrusters = flight.error(), flight.thrusters()
        found |= {
            "rms_m": error.rms_m,
            "max_m": error.max_m,
            "max_heading_rad": error.max_heading_rad,
            "on_time_s": thrusters.on_time_s,
            "firings": thrusters.firings,
        }
    return found


def _pictures(flight: Flight) -> list[str]:
    drawn: tuple[Callable[[Flight, Axes], None], ...] = (_heading, _valves, _latency)
    if flight.completed:
        drawn = (_trajectory, *drawn)
    return [_svg(flight, draw) for draw in drawn]


def _svg(flight: Flight, draw: Callable[[Flight, Axes], None]) -> str:
    figure, axes = figures.new()
    draw(flight, axes)
    return figures.svg(figure)


def _seconds(flight: Flight, time_ns: int) -> float:
    """From the plant's first record."""
    return float(time_ns - flight.flown[0]["time_ns"]) / _SECOND_NS


def _events(flight: Flight, axes: Axes) -> None:
    for time_ns in flight.events_ns:
        axes.axvline(_seconds(flight, time_ns), color=RED, linewidth=0.8)


def _trajectory(flight: Flight, axes: Axes) -> None:
    wanted = [record["wanted"] for record in flight.commanded]
    axes.plot(*zip(*wanted, strict=True), color=GREY, linewidth=2, label="commanded")
    flown = [record["pose"][:2] for record in flight.flown]
    axes.plot(*zip(*flown, strict=True), color=BLUE, linewidth=0.8, label="flown")
    axes.set(title="Trajectory", xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.legend(loc="center")


def _heading(flight: Flight, axes: Axes) -> None:
    times = [_seconds(flight, record["time_ns"]) for record in flight.flown]
    axes.plot(times, [math.degrees(record["pose"][2]) for record in flight.flown], color=BLUE, linewidth=0.8)
    _events(flight, axes)
    axes.set(title="Heading", xlabel="s", ylabel="°")


def _valves(flight: Flight, axes: Axes) -> None:
    """Each valve's on-time grows where it is open."""
    opened: list[list[tuple[float, float]]] = [[] for _ in flight.flown[0]["on_time"]]
    for before, after in zip(flight.flown, flight.flown[1:], strict=False):
        for valve, (was, now) in enumerate(zip(before["on_time"], after["on_time"], strict=True)):
            if now > was:
                opened[valve].append((_seconds(flight, after["time_ns"]) - (now - was), now - was))
    for valve, spans in enumerate(opened):
        axes.broken_barh(spans, (valve + 0.6, 0.8), facecolors=BLUE, edgecolors=BLUE, linewidth=0.5)
    _events(flight, axes)
    axes.set(title="Valves open", xlabel="s", ylabel="thruster", yticks=range(1, len(opened) + 1))
    axes.set_xlim(0, _seconds(flight, flight.flown[-1]["time_ns"]))


def _latency(flight: Flight, axes: Axes) -> None:
    for index, name in enumerate(HOPS if flight.one_clock else ()):
        axes.stairs(*figures.latency_bins(flight.hop(index).histogram_us), label=name, linewidth=0.8)
    axes.stairs(*figures.latency_bins(flight.latency().histogram_us), label="all four", color="black", linewidth=1.2)
    figures.latency_axes(axes, "Latency: the line is the period", 10)
