"""Runs in the guest, or on a robot: the scenarios of a plan one after the other, raw results as one JSON document.

Standard library only; the host gives the plan and makes sense of the outputs.
`python3 measure.py PLAN RESULTS`: RESULTS is a serial port or a file.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import termios
import time
import traceback
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

WARM_UP_S = 1.0
"""From the start of a load to that of a measurement, and after its end: no event says that a load is complete."""

FIRST_STEP = Path("/run/first-step")
"""What `first_step` wrote, where its unit is in the system."""

_END_S = 10.0
"""For a load to end by itself; then it is killed."""


@contextlib.contextmanager
def loaded(loads: list[list[str]]) -> Iterator[None]:
    """Programs that run during the body and are gone after it, with all that they started."""
    running = [
        subprocess.Popen(load, start_new_session=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        for load in loads
    ]
    try:
        time.sleep(WARM_UP_S)
        yield
        ended = [load for load, process in zip(loads, running, strict=True) if process.poll() is not None]
        if ended:
            raise RuntimeError(f"the load ended before the measurement: {ended}")
    finally:
        for number in (signal.SIGTERM, signal.SIGKILL):  # some have to set something right before they end
            for process in running:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_END_S)
        time.sleep(WARM_UP_S)


def counters() -> dict[str, float]:
    """How much the system has done since it started: what a load really does is the difference of two.

    Not the idle time of /proc/stat: it is sampled by the tick, and a thread that wakes in step with it seems to run
    always, or never.
    """
    rows = [line.split() for line in Path("/proc/stat").read_text().splitlines()]
    lines = {name: [int(value) for value in values] for name, *values in rows}
    usage = Path("/sys/fs/cgroup/system.slice/cpu.stat").read_text().split()
    return {
        "services_s": int(usage[usage.index("usage_usec") + 1]) / 1e6,
        "interrupts": lines["intr"][0],
        "context_switches": lines["ctxt"][0],
        "elapsed_s": time.monotonic(),
    }


def scenario(description: dict[str, Any]) -> dict[str, Any]:
    """Run one scenario; what its program said, and what the system did meanwhile."""
    missing = [path for path in description["needs"] if not Path(path).exists()]
    if missing:
        return {"missing": missing}
    output = Path("/run/latency/output")
    output.unlink(missing_ok=True)
    with loaded(description["loads"]):
        before = counters()
        meter = subprocess.run(
            description["meter"], timeout=description["timeout_s"], capture_output=True, text=True, check=False
        )
        after = counters()
    if meter.returncode:
        raise RuntimeError(f"{description['meter']}: status {meter.returncode}: {meter.stdout}{meter.stderr}")
    return {
        "output": output.read_text() if output.exists() else meter.stdout,
        "activity": {name: after[name] - before[name] for name in before},
    }


def boot() -> dict[str, Any]:
    """Wait until everything that starts at boot has started; when that was."""
    subprocess.run(["systemctl", "is-system-running", "--wait"], capture_output=True, check=False)
    shown = subprocess.run(["systemctl", "show"], capture_output=True, text=True, check=True).stdout
    failed = subprocess.run(
        ["systemctl", "list-units", "--failed", "--plain", "--no-legend"], capture_output=True, text=True, check=True
    ).stdout
    stamps = dict(line.split("=", 1) for line in shown.splitlines() if "TimestampMonotonic=" in line)
    step = json.loads(FIRST_STEP.read_text()) if FIRST_STEP.exists() else {}
    return {
        "userspace_us": int(stamps["UserspaceTimestampMonotonic"]),
        "finished_us": int(stamps["FinishTimestampMonotonic"]),
        "before_kernel_us": step.get("power_on_us", 0) - step.get("monotonic_us", 0),
        "first_step_us": step.get("monotonic_us", 0),
        "failed_units": [line.split()[0] for line in failed.splitlines()],
    }


def document(plan: dict[str, Any]) -> dict[str, Any]:
    if not Path("/sys/kernel/tracing/trace").exists():  # nothing on a robot mounts it
        subprocess.run(["mount", "-t", "tracefs", "tracefs", "/sys/kernel/tracing"], capture_output=True, check=False)
    found: dict[str, Any] = {"release": os.uname().release, "version": os.uname().version, "scenarios": {}}
    try:
        found["command_line"] = Path("/proc/cmdline").read_text().split()
        found["boot"] = boot()
        found["commands"] = {
            name: subprocess.run(argv, capture_output=True, text=True, check=True).stdout
            for name, argv in plan.get("commands", {}).items()
        }
        for description in plan["scenarios"]:
            print(f"latency: {description['name']}", file=sys.stderr, flush=True)
            found["scenarios"][description["name"]] = scenario(description)
    except Exception:
        found["error"] = traceback.format_exc()
    return found


def send(path: str, data: bytes) -> None:
    """Length and SHA-256 in a line, then the data, through a serial port with nothing changed on the way."""
    with open(path, "r+b", buffering=0) as out:  # noqa: PTH123 # a device
        terminal = out.isatty()
        if terminal:
            tty.setraw(out.fileno())
        rest = memoryview(f"{len(data)} {hashlib.sha256(data).hexdigest()}\n".encode() + data)
        while rest:
            rest = rest[out.write(rest) :]
        if terminal:
            termios.tcdrain(out.fileno())


if __name__ == "__main__":
    send(sys.argv[2], json.dumps(document(json.loads(Path(sys.argv[1]).read_text()))).encode())
