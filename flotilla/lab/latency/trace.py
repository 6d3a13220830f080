"""What the tracer's lines around the latest sample say in words."""

from __future__ import annotations

import re
from collections.abc import Sequence

_SAMPLE = re.compile(r"(?P<task>.+)-\d+ +\[\d+\].* context +(?P<kind>irq|thread) timer_latency +(?P<ns>\d+) ns")
_NOISE = re.compile(r"(?P<kind>irq|softirq|thread)_noise: +(?P<name>\S+?):\d+ start [\d.]+ duration (?P<ns>\d+) ns")
_TIMER = "local_timer"
_FUNCTION = "=> "
_ENTRY = re.compile("interrupt|handle_exception")
"""In the names of what runs from the interrupt on; what it interrupted follows."""
_SHOWN = 8
"""Functions: without frame pointers, some of those found on the stack are of calls that are over."""


def cause(lines: Sequence[str]) -> str:
    """What stood between the timer and the thread that it was to wake: `… late; the timer found … in …`."""
    samples = [match for line in lines if (match := _SAMPLE.match(line))]
    if not samples:
        return ""
    late_ns = int(samples[-1]["ns"])
    noises = [match for line in lines if (match := _NOISE.search(line))]
    functions = [line.removeprefix(_FUNCTION) for line in lines if line.startswith(_FUNCTION)]
    if functions:  # gathered by the timer's interrupt, which takes longer by it
        late_ns -= sum(int(match["ns"]) for match in noises if match["name"] == _TIMER)
        noises = [match for match in noises if match["name"] != _TIMER]
    facts = [f"{late_ns // 1000} µs late"]
    entries = [at for at, name in enumerate(functions) if _ENTRY.search(name)]
    running = functions[entries[-1] + 1 :] if entries else functions
    interrupted = [match["task"].strip() for match in samples if match["kind"] == "irq"]
    if interrupted:
        where = f" in {' < '.join(running[:_SHOWN])}" if running else ""
        facts.append(f"the timer found {interrupted[-1]}{where}")
    if noises:
        longest = max(noises, key=lambda match: int(match["ns"]))
        facts.append(f"longest before the thread: {longest['kind']} {longest['name']}, {int(longest['ns']) // 1000} µs")
    return "; ".join(facts)
