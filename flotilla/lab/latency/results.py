"""What a run found: typed, and the same bytes for the same run. Latencies are whole microseconds, rounded down."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.lab.latency.scenarios import Scenario

PERCENTILES = (50.0, 90.0, 99.0, 99.9, 99.99, 100.0)


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Latency(_Model):
    """A distribution. Everything but the histogram follows from it."""

    samples: int
    min_us: int
    mean_us: float
    max_us: int
    percentiles_us: dict[str, int]
    """By percentage, nearest rank: the least latency that so many percent of the samples do not exceed."""
    histogram_us: dict[int, int]
    """Samples by latency."""

    @classmethod
    def of(cls, histogram_us: Mapping[int, int]) -> Latency:
        counted = {latency: count for latency, count in sorted(histogram_us.items()) if count}
        samples = sum(counted.values())
        if not samples:
            raise ValueError("a histogram without samples")
        return cls(
            samples=samples,
            min_us=min(counted),
            mean_us=round(sum(latency * count for latency, count in counted.items()) / samples, 3),
            max_us=max(counted),
            percentiles_us={f"{percent:g}": percentile(counted, percent) for percent in PERCENTILES},
            histogram_us=counted,
        )


def percentile(histogram: Mapping[int, int], percent: float) -> int:
    """The least value that `percent` of the samples do not exceed (nearest rank)."""
    rank = math.ceil(round(sum(histogram.values()) * percent / 100, 6))
    for value in sorted(histogram):
        rank -= histogram[value]
        if rank <= 0:
            return value
    raise ValueError(f"no {percent} % of {sum(histogram.values())} samples")


class Activity(_Model):
    """What the whole system did while the scenario was measured: shows that a load was one."""

    busy_percent: float
    """Processor time of all services, the measurement and its loads among them; threads of the kernel not counted."""
    interrupts_per_s: float
    context_switches_per_s: float


class Outcome(_Model):
    """What a scenario found."""

    title: str
    missing: list[str] = []
    """Paths that this kernel or board lacks, and the scenario needs; then there is nothing else."""
    latencies: dict[str, Latency] = {}
    """By quantity: `wake-up`, `byte`, `interrupt`."""
    activity: Activity | None = None
    trace: list[str] = []
    """The kernel's trace around the worst sample, where the meter has one."""


class Boot(_Model):
    """Virtual time since the kernel's clock started."""

    before_kernel_us: int
    """Before that clock: BIOS, and the kernel that unpacks itself."""
    userspace_us: int
    """systemd runs."""
    first_step_us: int
    """A service that is ordered as early as a control task had its first period as a SCHED_FIFO thread."""
    finished_us: int
    """Everything that starts at boot has started."""
    failed_units: list[str]


class Binding(_Model):
    """Everything that may change the figures: a difference in them has its cause in one of these."""

    kernel: str
    """SHA-256 of the kernel."""
    root: str
    """SHA-256 of the root file system."""
    measurement: str
    """SHA-256 of all else in the initramfs: identity, plan and programs of the measurement."""
    machine: str
    """QEMU's command line, without paths."""
    qemu: str
    """Version of QEMU, package revision included."""
    firmware: str
    """Version of the BIOS."""


Plan = Literal["standard", "quick", "disk"]
"""Which scenarios, and for how long."""


class Results(_Model):
    format: Literal[1] = 1
    board: str
    kernel: str
    """`debian` or `lean`, or a control's."""
    plan: Plan
    where: str
    """`virtual time`, or the robot."""
    release: str
    """Of the kernel, as `uname -r`."""
    version: str
    """Of the kernel, as `uname -v`."""
    binding: Binding
    boot: Boot
    scenarios: dict[str, Outcome]

    def text(self) -> str:
        return json.dumps(self.model_dump(mode="json"), indent=1, sort_keys=True) + "\n"


def read(path: Path) -> Results:
    try:
        return Results.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise UserError(f"{paths.shown(path)}: {where}: {first['msg']}; measure again: make latency") from error


def received(data: bytes) -> dict[str, Any]:
    """The document in what came over the serial port."""
    head, _, body = data.partition(b"\n")
    try:
        length, digest = head.split()
        whole = len(body) == int(length) and hashlib.sha256(body).hexdigest() == digest.decode()
    except ValueError:
        whole = False
    if not whole:
        raise UserError(f"the guest's results arrived damaged: {len(body)} bytes after {head[:100]!r}")
    document: dict[str, Any] = json.loads(body)
    if "error" in document:
        raise UserError(f"the measurement failed in the guest:\n{document['error'].strip()}")
    return document


def outcome(scenario: Scenario, raw: Mapping[str, Any], samples: int, *, misses: bool = False) -> Outcome:
    """Make sense of a scenario's raw output. `misses`: periods may have been missed, so there may be fewer samples."""
    if "missing" in raw:
        return Outcome(title=scenario.title, missing=raw["missing"])
    try:
        found = json.loads(raw["output"])
    except json.JSONDecodeError as error:
        raise UserError(f"{scenario.name}: the meter's output is no JSON: {raw['output'][:200]!r}") from error
    latencies = {}
    for name, quantity in scenario.meter.quantities.items():
        thread = found["thread"][name]
        if thread["cycles"] != samples and not (misses and 0 < thread["cycles"] < samples):
            raise UserError(f"{scenario.name}: {quantity}: {thread['cycles']} samples instead of {samples}")
        histogram = {int(latency): count for latency, count in thread["histogram"].items()}
        # What is later than the meter's histogram reaches counts as the latest: never better than it was.
        if beyond := thread["cycles"] - sum(histogram.values()):
            histogram[thread["max"]] = histogram.get(thread["max"], 0) + beyond
        latencies[quantity] = Latency.of(histogram)
    activity = raw["activity"]
    elapsed_s = activity["elapsed_s"]
    return Outcome(
        title=scenario.title,
        latencies=latencies,
        activity=Activity(
            busy_percent=round(100 * activity["services_s"] / elapsed_s, 1),
            interrupts_per_s=round(activity["interrupts"] / elapsed_s, 1),
            context_switches_per_s=round(activity["context_switches"] / elapsed_s, 1),
        ),
        trace=found.get("trace", []),
    )
