"""Exact comparison of a run with the accepted one: what virtual time makes possible.

Figures alone decide. Kernel, root, measurement, machine, QEMU and firmware are what they depend on: when figures moved,
those that differ are named as causes; when no figure moved, a new root is none.
"""

from __future__ import annotations

from pathlib import Path

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board
from flotilla.lab.latency import run, trace
from flotilla.lab.latency.limits import OURS
from flotilla.lab.latency.results import Latency, Outcome, Plan, Results, read
from flotilla.lab.latency.scenarios import SCENARIOS

BASELINES = Path(__file__).parent / "baselines"
ACCEPT = "make latency-accept"
TIMES = 3
"""How much later than the accepted run a fault has to be. Debian's kernel, which is real time too, is twice as late."""
_REAL_TIME = "PREEMPT_RT"
"""What such a kernel calls itself, in `uname -v`."""
_MEANING = {
    "kernel": "another kernel",
    "root": "another root file system",
    "measurement": "the measurement itself was changed",
    "machine": "another QEMU command line",
    "qemu": "another QEMU",
    "firmware": "another BIOS (package seabios)",
}


def baseline(board: Board, plan: Plan) -> Path:
    """Where the accepted run is kept."""
    return BASELINES / f"{run.name(board.name, board.kernel, plan)}.json"


def baseline_of_control(found: Results) -> Path:
    """That of the kernel which the control's deviates from."""
    return BASELINES / f"{run.name(found.board, OURS, found.plan)}.json"


def compare(found: Results, baseline: Results) -> list[str]:
    """What moved, one line each; empty when every figure is the same."""
    moved = [
        f"boot: {name} {before} → {after}"
        for name, after in found.boot.model_dump().items()
        if (before := baseline.boot.model_dump()[name]) != after
    ]
    for name in sorted(found.scenarios.keys() | baseline.scenarios.keys()):
        before, after = baseline.scenarios.get(name), found.scenarios.get(name)
        if before is None or after is None:
            moved.append(f"{name}: {'new' if before is None else 'not measured any more'}")
        else:
            moved += [f"{name}: {text}" for text in _moved(before, after)]
    return moved


def causes(found: Results, baseline: Results) -> list[str]:
    """What the two runs differ in besides their figures."""
    before, after = baseline.binding.model_dump(), found.binding.model_dump()
    differing = [
        f"{name}: {_short(before[name])} → {_short(after[name])} ({meaning})"
        for name, meaning in _MEANING.items()
        if before[name] != after[name]
    ]
    if (was := f"{baseline.release} {baseline.version}") != (now := f"{found.release} {found.version}"):
        differing.append(f"uname: {was} → {now}")
    if _REAL_TIME in baseline.version and _REAL_TIME not in found.version:
        differing.append(f"the kernel is without {_REAL_TIME}: what it does for one process, no other one interrupts")
    return differing


def traced(found: Results, baseline: Results) -> list[str]:
    """What the kernel's trace says of the latest samples, where that is not what it said before."""
    texts = {name: trace.cause(outcome.trace) for name, outcome in found.scenarios.items()}
    before = {name: trace.cause(outcome.trace) for name, outcome in baseline.scenarios.items()}
    return [f"{name}: {text}" for name, text in texts.items() if text and text != before.get(name)]


def check(found: Results, file: Path) -> str:
    """A sentence when the run equals the accepted one in `file`; otherwise everything that moved, as a UserError."""
    if found.plan == "disk":
        return _check_bounds(found)
    baseline = accepted(file)
    if refused := refusal(found, baseline):
        raise UserError(
            f"latency is not that of {paths.shown(file)}:\n  {refused}\n"
            f"`make latency` shows the distributions; if this is meant: {ACCEPT}"
        )
    differing = causes(found, baseline)
    aside = f", although there is\n  {_lines(differing)}" if differing else ""
    return f"every figure is that of {paths.shown(file)}{aside}"


def check_control(found: Results) -> str:
    """What the gate says of a system with a fault, when it refuses that; a UserError when it does not.

    Any other kernel moves figures: one with a fault has to be so much later that it cannot be taken for another cause.
    """
    baseline = accepted(baseline_of_control(found))
    later = [name for name in found.scenarios if _latest_us(found, name) > TIMES * _latest_us(baseline, name)]
    if later:
        refused = refusal(found, baseline)
        return f"{found.board}, {found.kernel}: refused, as it has to be, for {', '.join(later)}:\n  {refused}"
    raise UserError(
        f"{found.board}, {found.kernel}: the negative control passes: no wake-up is more than {TIMES} times as late as "
        "that of the baseline, so the measurement detects nothing"
    )


def _latest_us(run: Results, name: str) -> int:
    """The latest wake-up in a scenario; 0 where none was measured."""
    outcome = run.scenarios.get(name)
    return outcome.latencies["wake-up"].max_us if outcome and "wake-up" in outcome.latencies else 0


def accepted(file: Path) -> Results:
    """The run in a file that has to be there."""
    if not file.exists():
        raise UserError(f"{paths.shown(file)} is missing: nothing to compare with; make it from this run: {ACCEPT}")
    return read(file)


def refusal(found: Results, baseline: Results) -> str:
    """What moved, and why, as far as the two runs tell; empty when every figure is the same."""
    moved = compare(found, baseline)
    if not moved:
        return ""
    differing = causes(found, baseline)
    likely = f"likely cause:\n  {_lines(differing)}" if differing else (
        "kernel, root, measurement, machine, QEMU and BIOS are the same: the run did not repeat, which is a defect"
    )  # fmt: skip
    if named := traced(found, baseline):
        likely += f"\nthe kernel's trace of the latest sample:\n  {_lines(named)}"
    return f"{_lines(moved)}\n{likely}"


def _check_bounds(found: Results) -> str:
    """For what does not repeat."""
    exceeded = [
        f"{scenario.name}: {quantity}: max {latency.max_us} µs, and {scenario.limit_us} µs is the bound"
        for scenario in SCENARIOS
        if scenario.limit_us and scenario.name in found.scenarios
        for quantity, latency in found.scenarios[scenario.name].latencies.items()
        if latency.max_us > scenario.limit_us
    ]
    if exceeded:
        raise UserError(f"latency with a disk:\n  {_lines(exceeded)}\nbounds are in flotilla/lab/latency/scenarios.py")
    return "every latency with a disk is within its bound"


def accept(found: Results, file: Path) -> None:
    """Make this run the one that later runs are compared with."""
    keep(file, found.text())


def keep(file: Path, text: str) -> None:
    """Write a baseline; the one before stays until it is whole."""
    file.parent.mkdir(parents=True, exist_ok=True)
    durable.write(file, text)


def _moved(before: Outcome, after: Outcome) -> list[str]:
    texts = []
    if before.missing != after.missing:
        texts.append(f"missing {before.missing or 'nothing'} → {after.missing or 'nothing'}")
    for quantity in sorted(before.latencies.keys() | after.latencies.keys()):
        old, new = before.latencies.get(quantity), after.latencies.get(quantity)
        if old is None or new is None:
            texts.append(f"{quantity}: {'new' if old is None else 'not measured any more'}")
        elif old != new:
            texts.append(f"{quantity}: {differences(old, new)}")
    if not texts and before != after:
        names = [name for name in Outcome.model_fields if getattr(before, name) != getattr(after, name)]
        texts.append(f"{', '.join(names)} moved, no latency did")
    return texts


def differences(old: Latency, new: Latency) -> str:
    """In words, of two distributions."""
    before, after = (
        {"samples": each.samples, "min": each.min_us, "mean": each.mean_us}
        | {f"{percent} %": us for percent, us in each.percentiles_us.items()}
        for each in (old, new)
    )
    shown = [f"{name} {before.get(name)} → {figure}" for name, figure in after.items() if before.get(name) != figure]
    buckets = old.histogram_us.keys() | new.histogram_us.keys()
    elsewhere = sum(abs(old.histogram_us.get(at, 0) - new.histogram_us.get(at, 0)) for at in buckets) / 2
    return f"{', '.join(shown)}{' µs; ' if shown else ''}{elsewhere:g} samples elsewhere in the histogram"


def _short(value: str) -> str:
    """Hashes by their beginning, versions whole."""
    return f"{value[:12]}…" if len(value) == 64 and value.isalnum() else value


def _lines(texts: list[str]) -> str:
    return "\n  ".join(texts)
