"""What `make radio-capacity` found: as text, as a page with curves, and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from flotilla.lab.radio import phy
from flotilla.lab.radio.capacity import Curve, Point, limit_ns
from flotilla.lab.radio.load import MS, Setting
from flotilla.lab.radio.phy import Phy
from flotilla.lab.radio.traffic import Chain, Description
from flotilla.station import figures
from flotilla.station.figures import BLUE, GREY, RED

NAME = "radio-capacity"


@dataclass(frozen=True)
class Terms:
    """What was asked."""

    inventory: str
    limit_ms: float | None
    percent: float
    """Of steps that a carried chain may miss."""


def rates(standard: Phy) -> str:
    return ", ".join(f"{rate / 1e6:g}M" for rate in standard.rates_bit_s)


def title(setting: Setting) -> str:
    return f"802.11{setting.standard.name}, {setting.rate_bit_s / 1e6:g} Mbit/s"


def assumptions(setting: Setting) -> str:
    """What a reader has to know to believe the numbers."""
    phases = (
        f"all robots step at once, within {setting.clock_us:g} µs" if setting.aligned else "each robot steps by itself"
    )
    return (
        f"{phases}; {setting.compute_us:g} µs of each hop are the computer's; members stand on a square of "
        f"{setting.area_m:g} m; path loss exponent {setting.air.exponent:g}, {setting.air.transmit_dbm:g} dBm; "
        f"{'an update goes on by multicast; ' if setting.update else ''}seed {setting.seed}"
    )


def answer(curve: Curve) -> str:
    """In a sentence."""
    found = f"carries {curve.carries} robots" if curve.carries else "does not carry the fleet as it is described"
    if curve.ends_at is None:
        return f"{title(curve.setting)}: {found}, the most that an inventory numbers"
    ended = next(point for point in curve.points if point.simulated.robots == curve.ends_at)
    return (
        f"{title(curve.setting)}: {found}; with {curve.ends_at}, {ended.missed_percent:.1f} % of steps are late or lost"
    )


def row(point: Point, chain: Chain, terms: Terms) -> dict[str, Any]:
    """What a table has of a size and a chain."""
    met = point.simulated.chains[chain.name]
    limit = limit_ns(chain, terms.limit_ms)
    return {
        "robots": point.simulated.robots,
        "frames_s": round(point.simulated.frames_s),
        "air_percent": round(100 * point.computed.air, 1),
        "busy_percent": round(100 * point.simulated.busy, 1),
        "utilisation_percent": round(100 * point.computed.utilisation, 1),
        "steps": met.sent,
        "median_ms": met.percentile_ms(50),
        "p99_ms": met.percentile_ms(99),
        "max_ms": met.percentile_ms(100),
        "computed_ms": point.computed.chain_ms[chain.name],
        "late": met.late(limit),
        "lost": met.lost(),
        "missed_percent": round(100 * met.missed(limit), 2),
        "carried": point.carried,
    }


def messages(described: Description, point: Point, setting: Setting) -> list[dict[str, Any]]:
    """The fleet's own messages, at the size that is described."""
    flows = {flow.name: flow for task in described.tasks for flow in task.flows}
    flows |= {flow.name: flow for flow, _ in described.positions}
    standard, rate = setting.standard, setting.rate_bit_s
    found = []
    for name, met in point.simulated.messages.items():
        flow = flows.get(name)
        size = flow.packet + phy.LLC_BYTES + phy.MAC_BYTES if flow else 0
        found.append(
            {
                "name": name,
                "frames": met.sent,
                "bytes": size,
                "air_us": standard.exchange_ns(size, rate) / 1000 if flow else None,
                "median_ms": met.percentile_ms(50),
                "p99_ms": met.percentile_ms(99),
                "lost": met.lost(),
                "silence_ms": point.simulated.silence_ms.get(name),
                "deadline_ms": flow.deadline_ms if flow else None,
            }
        )
    return found


def _ms(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _table(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if n == 0 else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in rows
    )


def text(described: Description, curves: Sequence[Curve], terms: Terms) -> str:
    """For a terminal."""
    parts = [f"{described.name} ({terms.inventory}): {assumptions(curves[0].setting)}"]
    for curve in curves:
        parts.append("\n" + answer(curve))
        for chain in described.chains:
            limit_ms = limit_ns(chain, terms.limit_ms) / MS
            parts.append(f"{chain.name}, within {limit_ms:g} ms:")
            rows = [
                ["robots", "frames/s", "air %", "busy %", "median ms", "99 % ms", "max ms", "computed ms", "missed %"]
            ]
            for point in curve.points:
                of = row(point, chain, terms)
                rows.append(
                    [
                        f"{of['robots']}{'' if of['carried'] else ' *'}", str(of["frames_s"]), str(of["air_percent"]),
                        str(of["busy_percent"]), _ms(of["median_ms"]), _ms(of["p99_ms"]), _ms(of["max_ms"]),
                        _ms(of["computed_ms"]), str(of["missed_percent"]),
                    ]
                )  # fmt: skip
            parts.append(_table(rows))
    curve = curves[0]
    parts.append(f"\nmessages of the fleet as described, {title(curve.setting)}:")
    rows = [["message", "bytes", "air µs", "median ms", "99 % ms", "lost", "silence ms", "deadline ms"]]
    for each in messages(described, curve.points[0], curve.setting):
        rows.append(
            [
                each["name"], str(each["bytes"] or "-"), "-" if each["air_us"] is None else f"{each['air_us']:.0f}",
                _ms(each["median_ms"]), _ms(each["p99_ms"]), str(each["lost"]), _ms(each["silence_ms"]),
                str(each["deadline_ms"] or "-"),
            ]
        )  # fmt: skip
    parts.append(_table(rows))
    parts.append(
        "\n* more than "
        f"{terms.percent:g} % of steps late or lost. air: offered, if no frame collided; busy: simulated; computed: "
        "mean, of Bianchi's and an M/D/1 queue's formulas. bytes: with all headers; air µs: with SIFS and ACK"
    )
    return "\n".join(parts)


def _latencies(described: Description, curve: Curve, chain: Chain, terms: Terms) -> str:
    figure, axes = figures.new()
    rows = [row(point, chain, terms) for point in curve.points]
    robots = [each["robots"] for each in rows]
    for key, label, color in (("median_ms", "median", BLUE), ("p99_ms", "99 %", "black"), ("max_ms", "max", GREY)):
        axes.plot(
            robots, [each[key] for each in rows], color=color, marker="o", markersize=3, linewidth=0.8, label=label
        )
    finite = [(each["robots"], each["computed_ms"]) for each in rows if math.isfinite(each["computed_ms"])]
    if finite:
        axes.plot(*zip(*finite, strict=True), color=BLUE, linestyle="--", linewidth=0.8, label="computed mean")
    axes.axhline(limit_ns(chain, terms.limit_ms) / MS, color=RED, linewidth=0.8)
    axes.plot([robots[0]], [rows[0]["median_ms"]], marker="s", markersize=7, color="none", markeredgecolor=RED)
    axes.annotate(f"{described.name} as described", (robots[0], rows[0]["median_ms"]), xytext=(8, -10),
                  textcoords="offset points", color=RED)  # fmt: skip
    axes.set(title=f"{title(curve.setting)}: {chain.name}", xlabel="robots", ylabel="ms", yscale="log", xticks=robots)
    axes.set_ylim(bottom=0.6 * rows[0]["median_ms"])
    axes.legend(loc="upper left")
    return figures.svg(figure)


def _channel(curve: Curve, chain: Chain, terms: Terms) -> str:
    figure, axes = figures.new()
    rows = [row(point, chain, terms) for point in curve.points]
    robots = [each["robots"] for each in rows]
    for key, label, color, style in (
        ("busy_percent", "busy, simulated", BLUE, "-"),
        ("air_percent", "air offered, computed", BLUE, "--"),
        ("utilisation_percent", "of a saturated cell, computed", GREY, "--"),
        ("missed_percent", "steps late or lost", RED, "-"),
    ):
        axes.plot(robots, [each[key] for each in rows], color=color, linestyle=style, marker="o", markersize=3,
                  linewidth=0.8, label=label)  # fmt: skip
    axes.set(title="Channel", xlabel="robots", ylabel="%", ylim=(0, 125), xticks=robots)
    axes.legend(loc="upper left")
    return figures.svg(figure)


def write(described: Description, curves: Sequence[Curve], terms: Terms, directory: Path) -> Path:
    """The page; JSON of the same name lies beside it."""
    directory.mkdir(parents=True, exist_ok=True)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["ms"] = _ms
    found: list[dict[str, Any]] = []
    for curve in curves:
        chains = [
            {
                "name": chain.name,
                "limit_ms": limit_ns(chain, terms.limit_ms) / MS,
                "sizes": [row(point, chain, terms) for point in curve.points],
                "pictures": [_latencies(described, curve, chain, terms), _channel(curve, chain, terms)],
            }
            for chain in described.chains
        ]
        found.append(
            {
                "title": title(curve.setting),
                "answer": answer(curve),
                "assumptions": assumptions(curve.setting),
                "carries": curve.carries,
                "ends_at": curve.ends_at,
                "chains": chains,
                "messages": messages(described, curve.points[0], curve.setting),
            }
        )
    page = directory / f"{NAME}.html"
    page.write_text(environment.get_template("report.html.j2").render(curves=found, terms=terms, fleet=described.name))
    for each in found:
        for chain in each["chains"]:
            del chain["pictures"]
    (directory / f"{NAME}.json").write_text(json.dumps(_plain(found), indent=1) + "\n")
    return page


def _plain(value: Any) -> Any:
    """JSON has no infinity."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
