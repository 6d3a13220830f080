"""Runs in the guest: the kernel's own measurement of timer latency (Documentation/trace/timerlat-tracer.rst).

`python3 timerlat.py SAMPLES` prints histograms of two latencies in the shape of `cyclictest --json`: until the timer's
interrupt, and until the thread; and the trace around the worst sample, which names what stood in between.

Where that one was late, a second pass also has the functions that the timer's interrupt found running. Gathering them
takes that interrupt up to 0.3 ms, so the first pass's figures are what counts.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_TRACING = Path("/sys/kernel/tracing")
_PERIOD_US = 1000
_LATE_US = 200
"""From this latency on, the functions are worth their second pass."""
_NAMED = 1000
"""Samples of the second pass at most: its trace takes long to read."""
_INTERRUPT = re.compile(r"irq_noise: +local_timer:.* duration (\d+) ns")
_LATENCY = re.compile(r"context\s+(irq|thread) timer_latency\s+(\d+) ns")


def summary(lines: Iterable[str], samples: int, *, functions: bool = False) -> dict[str, Any]:
    """Histograms of the first `samples` of each kind, and the lines that led to the latest thread.

    `functions`: they were gathered; then the latest is judged without the interrupt that did so.
    """
    histograms: dict[str, Counter[int]] = {"irq": Counter(), "thread": Counter()}
    since_last: list[str] = []
    worst, worst_ns = list[str](), -1
    sample: list[str] = []
    for line in lines:
        if line.startswith("#"):
            continue
        if line.startswith(" => ") or line.rstrip().endswith("<stack trace>"):
            sample.append(line.strip())  # of the sample before
            continue
        since_last.append(line.strip())
        if not (match := _LATENCY.search(line)):
            continue
        kind, latency_ns = match[1], int(match[2])
        if histograms[kind].total() < samples:
            histograms[kind][latency_ns // 1000] += 1
            if functions:
                latency_ns -= sum(int(found[1]) for noise in since_last if (found := _INTERRUPT.search(noise)))
            if kind == "thread" and latency_ns > worst_ns:
                worst, worst_ns = since_last, latency_ns
        if kind == "thread":
            sample, since_last = since_last, []
    return {
        "thread": {
            kind: {"cycles": histogram.total(), "histogram": histogram} for kind, histogram in histograms.items()
        },
        "trace": worst,
    }


def _write(name: str, value: object) -> None:
    (_TRACING / name).write_text(f"{value}\n")


def traced(samples: int, *, functions: bool = False) -> dict[str, Any]:
    """Let the tracer run for so many samples."""
    _write("tracing_on", 0)
    _write("buffer_size_kb", 64 + samples)  # some 200 bytes a sample with its events, and as much for its functions
    _write("osnoise/timerlat_period_us", _PERIOD_US)
    _write("osnoise/print_stack", _LATE_US if functions else 0)
    _write("events/osnoise/enable", 1)
    _write("current_tracer", "timerlat")
    _write("trace", "")
    _write("tracing_on", 1)
    # The tracer's thread is an ordinary one until it runs for the first time: under load that took 0.2 s.
    with (_TRACING / "trace_pipe").open() as beginning:
        beginning.readline()
    time.sleep((samples + 10) * _PERIOD_US / 1e6)
    _write("tracing_on", 0)
    with (_TRACING / "trace").open() as trace:
        found = summary(trace, samples, functions=functions)
    _write("current_tracer", "nop")  # which empties the trace
    _write("events/osnoise/enable", 0)
    return found


def main(samples: int) -> None:
    found = traced(samples)
    if max(found["thread"]["thread"]["histogram"]) >= _LATE_US:
        found["trace"] = traced(min(samples, _NAMED), functions=True)["trace"]
    print(json.dumps(found))


if __name__ == "__main__":
    main(int(sys.argv[1]))
