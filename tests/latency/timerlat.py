"""Runs in the guest: the kernel's own measurement of timer latency (Documentation/trace/timerlat-tracer.rst).

`python3 timerlat.py SAMPLES` prints histograms of two latencies in the shape of `cyclictest --json`: until the timer's
interrupt, and until the thread; and the trace around the worst sample, which names what stood in between.
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
_LATENCY = re.compile(r"context\s+(irq|thread) timer_latency\s+(\d+) ns")


def summary(lines: Iterable[str], samples: int) -> dict[str, Any]:
    """Histograms of the first `samples` of each kind, and the lines that led to the latest thread."""
    histograms: dict[str, Counter[int]] = {"irq": Counter(), "thread": Counter()}
    since_last: list[str] = []
    worst, worst_ns = list[str](), -1
    for line in lines:
        if line.startswith("#"):
            continue
        since_last.append(line.strip())
        if not (match := _LATENCY.search(line)):
            continue
        kind, latency_ns = match[1], int(match[2])
        if histograms[kind].total() < samples:
            histograms[kind][latency_ns // 1000] += 1
            if kind == "thread" and latency_ns > worst_ns:
                worst, worst_ns = since_last, latency_ns
        if kind == "thread":
            since_last = []
    return {
        "thread": {
            kind: {"cycles": histogram.total(), "histogram": histogram} for kind, histogram in histograms.items()
        },
        "trace": worst,
    }


def main(samples: int) -> None:
    def write(name: str, value: object) -> None:
        (_TRACING / name).write_text(f"{value}\n")

    write("tracing_on", 0)
    write("buffer_size_kb", 64 + samples // 2)  # some 200 bytes a sample with its events
    write("osnoise/timerlat_period_us", _PERIOD_US)
    write("events/osnoise/enable", 1)
    write("current_tracer", "timerlat")
    write("trace", "")
    write("tracing_on", 1)
    time.sleep((samples + 10) * _PERIOD_US / 1e6)
    write("tracing_on", 0)
    with (_TRACING / "trace").open() as trace:
        print(json.dumps(summary(trace, samples)))
    write("current_tracer", "nop")  # which empties the trace
    write("events/osnoise/enable", 0)


if __name__ == "__main__":
    main(int(sys.argv[1]))
