"""What the long run has to show of our kernel: limits in virtual time, and by how much it has to beat Debian's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flotilla.common.errors import UserError
from flotilla.lab.latency.results import Results
from flotilla.lab.latency.run import VIRTUAL
from flotilla.lab.latency.scenarios import CYCLICTEST, IN_STEP, SCENARIOS, UART_OWN, UART_SHARED

OURS, DEBIANS = "lean", "debian"
HALF = "what six minutes of building a kernel of one's own have to buy"
SHARE = 0.5
"""Of the latest with Debian's kernel, in the same scenarios on the same machine."""


@dataclass(frozen=True)
class Limit:
    """Of the latest in any of some scenarios."""

    title: str
    scenarios: tuple[str, ...]
    at_most_us: int
    reason: str
    quantity: str = "wake-up"
    """What its meter's histogram is of."""

    def worst(self, run: Results) -> tuple[int, str]:
        """The latest in µs, and its scenario."""
        return max((run.scenarios[name].latencies[self.quantity].max_us, name) for name in self.measured(run))

    def measured(self, run: Results) -> list[str]:
        """Scenarios of it that the run has: the short one has a few, and boards lack devices."""
        return [name for name in self.scenarios if name in run.scenarios and run.scenarios[name].latencies]


_WAKE_UPS = [each for each in SCENARIOS if each.meter is CYCLICTEST and not each.limit_us]
IDLE = Limit(
    "idle",
    tuple(each.name for each in _WAKE_UPS if not each.loads),
    40,
    "a twenty-fifth of a period of 1 ms, 5000 instructions",
)
LOADED = Limit(
    "under any load",
    tuple(each.name for each in _WAKE_UPS if each.loads),
    60,
    "half as much again, for what a load may keep switched off while the timer expires",
)
TICK = Limit(
    "in step with the tick",
    tuple(each.name for each in SCENARIOS if each.meter is IN_STEP),
    75,
    "the tick comes first, with what it wakes",
)
BYTES = Limit(
    "bytes of serial ports",
    tuple(each.name for each in SCENARIOS if each.meter in (UART_OWN, UART_SHARED)),
    200,
    "a fiftieth of a period of 10 ms, of which a byte is on the wire for 87 µs at 115200 Bd",
    "byte",
)
LIMITS = (IDLE, LOADED, TICK, BYTES)


@dataclass(frozen=True)
class Verdict:
    """One limit, and what was measured."""

    what: str
    found: str
    holds: bool
    reason: str

    def __str__(self) -> str:
        return f"{self.what}: {self.found}: {'holds' if self.holds else 'DOES NOT HOLD'}"


def judge(runs: Sequence[Results]) -> list[Verdict]:
    """Every limit that long runs in virtual time say something about, board by board."""
    long = [run for run in runs if run.plan == "standard" and run.where == VIRTUAL]
    verdicts = []
    for board in sorted({run.board for run in long}):
        by_kernel = {run.kernel: run for run in long if run.board == board}
        for limit in LIMITS:
            verdicts += _verdicts(limit, board, by_kernel)
    return verdicts


def _verdicts(limit: Limit, board: str, runs: Mapping[str, Results]) -> list[Verdict]:
    runs = {kernel: run for kernel, run in runs.items() if limit.measured(run)}
    if OURS not in runs:
        return []
    late_us, where = limit.worst(runs[OURS])
    named = f"{board}, {OURS}, {limit.title}"
    verdicts = [
        Verdict(
            f"{named}: at most {limit.at_most_us} µs",
            f"{late_us} µs ({where})",
            late_us <= limit.at_most_us,
            limit.reason,
        )
    ]
    if DEBIANS in runs:
        other_us, other = limit.worst(runs[DEBIANS])
        differing = _differing(runs[OURS], runs[DEBIANS])
        text = f"{late_us} µs ({where}) to {other_us} µs ({other})"
        if differing:
            text += f", but measured with another {', '.join(differing)}: measure both again"
        what = f"{named}: at most {SHARE:g} of {DEBIANS}'s"
        verdicts.append(Verdict(what, text, not differing and late_us <= SHARE * other_us, HALF))
    return verdicts


def _differing(one: Results, other: Results) -> list[str]:
    """Figures of two machines are not compared."""
    return [
        name for name in ("machine", "qemu", "firmware") if getattr(one.binding, name) != getattr(other.binding, name)
    ]


def check(runs: Sequence[Results]) -> str:
    """The verdicts in lines; as a UserError when one does not hold."""
    verdicts = judge(runs)
    text = "\n".join(map(str, verdicts)) or f"no limits: they are for the kernel {OURS}"
    if all(verdict.holds for verdict in verdicts):
        return text
    raise UserError(f"{text}\nlimits and their reasons are in flotilla/lab/latency/limits.py")
