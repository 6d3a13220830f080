"""What `make radio-capacity` does."""

from __future__ import annotations

import argparse
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.lab.radio import capacity, phy, report, traffic
from flotilla.lab.radio.capacity import Curve
from flotilla.lab.radio.load import Setting
from flotilla.lab.radio.phy import Air, Phy

PUBLISHED = Path(__file__).parents[1] / "scenarios" / "inventory"
"""The published laboratory's four robots."""
_USUAL = ("b", "g")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--inventory", type=Path, default=PUBLISHED, help="fleet; by default the four-robot demo fleet")
    parser.add_argument("--standard", help=f"{', '.join(phy.STANDARDS)}; by default {' and '.join(_USUAL)}")
    parser.add_argument("--rate", help="of frames to one station, such as 11M; by default the standard's highest")
    parser.add_argument("--area", default="10", help="side of the square on which robots stand, in m")
    parser.add_argument("--phases", default="aligned", help="aligned: all robots step at once; random: each by itself")
    parser.add_argument("--update", action="store_true", help="a station sends an update by multicast meanwhile")
    parser.add_argument("--limit", help="until when a chain's last hop has to be there, in ms; by default its period")
    parser.add_argument("--missed", default="1", help="steps that may be late or lost, in percent")
    parser.add_argument("--compute", default="400", help="of each hop, what the computer takes, in µs")
    parser.add_argument("--seconds", default="6", help="simulated, of the fleet as it is")
    parser.add_argument("--seed", default="1", help="of all chance")


def _number(key: str, text: str, low: float, high: float, unit: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not low <= number <= high:
        raise UserError(f"{key}={text}: is out of range; give {low:g} to {high:g} {unit}")
    return number


def chosen(standard: str | None, rate: str | None) -> list[tuple[Phy, int]]:
    """Standards with their rates; UserError for what there is none of."""
    if standard is not None and standard not in phy.STANDARDS:
        raise UserError(f"STANDARD={standard}: is not known; take one of {', '.join(phy.STANDARDS)}")
    if standard is None and rate is not None:
        usual = [phy.STANDARDS[name] for name in _USUAL]
        fitting = [each for each in usual if rate.removesuffix("M") in {f"{r / 1e6:g}" for r in each.rates_bit_s}]
        if not fitting:
            there = "; ".join(f"802.11{each.name}: {report.rates(each)}" for each in usual)
            raise UserError(f"RATE={rate}: neither standard has it; take one of {there}")
        return [(each, phy.rate_bit_s(rate, each)) for each in fitting]
    standards = [phy.STANDARDS[name] for name in ([standard] if standard else _USUAL)]
    return [(each, phy.rate_bit_s(rate, each) if rate else each.rates_bit_s[-1]) for each in standards]


def setting(given: argparse.Namespace, standard: Phy, rate_bit_s: int) -> Setting:
    if given.phases not in ("aligned", "random"):
        raise UserError(f"PHASES={given.phases}: is not known; take aligned or random")
    seed = _number("SEED", given.seed, 0, 2**31, "")
    if seed != int(seed):
        raise UserError(f"SEED={given.seed}: is no whole number; give one from 0 on")
    return Setting(
        standard, rate_bit_s, Air(), _number("AREA", given.area, 1, 100_000, "m"), given.phases == "aligned",
        compute_us=_number("COMPUTE", given.compute, 0, 1e6, "µs"), update=given.update, seed=int(seed),
    )  # fmt: skip


def run(given: argparse.Namespace) -> None:
    directory: Path = given.inventory
    if not directory.is_dir():
        raise UserError(f"INVENTORY={directory}: there is no such directory; give one with robots.yml and group_vars/")
    settings = [setting(given, standard, rate) for standard, rate in chosen(given.standard, given.rate)]
    limit_ms = _number("LIMIT", given.limit, 0.1, 60_000, "ms") if given.limit else None
    percent = _number("MISSED", given.missed, 0, 100, "%")
    seconds = _number("SECONDS", given.seconds, 0.5, 600, "s")
    fleet = inventory.load_fleet(directory)
    described = traffic.describe(fleet)
    if given.update and not fleet.stations:
        raise UserError(f"UPDATE=1: no station of {paths.shown(directory)} could send one; add it to stations")
    curves: list[Curve] = []
    with progress.step("radio capacity") as step:
        for each in settings:
            name = report.title(each)
            step.at(0, 0, part=name)
            curves.append(
                capacity.find(
                    described, each, seconds=seconds, limit_ms=limit_ms, percent=percent,
                    done=lambda point: step.note(f"{point.simulated.robots} robots done"),
                )
            )  # fmt: skip
    terms = report.Terms(paths.shown(directory), limit_ms, percent)
    print(report.text(described, curves, terms))
    page = report.write(described, curves, terms, paths.BUILD / "reports")
    print(f"\n{paths.shown(page)}")
