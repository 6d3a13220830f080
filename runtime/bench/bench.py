"""What a block costs: chains of gains in our executive and in LinuxCNC's HAL, in one run. `make bench-runtime`.

Both call each function of a chain by a pointer, time it by the processor's time stamp counter, and keep its longest
time, in a thread at 1 kHz; ours also adds the times up. What is compared is the processor time of whole processes as
the kernel counts it (/proc/PID/task/TID/schedstat), divided by steps; a block costs what a longer chain adds to a step,
by chains of the same lengths. Other load of the computer moves the figures: so both take turns, several times, and
medians are printed with the least and the greatest.
"""

from __future__ import annotations

import argparse
import functools
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median

_NULL = subprocess.DEVNULL
_PATIENCE_S = 60
COUNTS = (10, 100, 400, 1000)
HAL_COUNTS = (10, 100, 400)
"""Its shared memory has no room for a thousand."""
SLOPE = (100, 400)
"""Chains whose difference is what a block costs."""
PERIOD_NS = 1_000_000
IDLE_BLOCKS = 100
"""Of the task that shall leave a core idle."""


@dataclass(frozen=True)
class Cost:
    """Of one chain."""

    blocks: int
    step_ns: float
    """Processor time of a step."""
    memory_kib: int
    """Resident set."""

    @property
    def busy_percent(self) -> float:
        """Of one processor."""
        return 100 * self.step_ns / PERIOD_NS


def processor_ns(pid: int) -> int:
    """Processor time of all threads of a process so far."""
    return sum(int(path.read_text().split()[0]) for path in Path(f"/proc/{pid}/task").glob("*/schedstat"))


def resident_kib(pid: int) -> int:
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(fields["VmRSS"].split()[0])


def observe(pid: int, blocks: int, seconds: float) -> Cost:
    """Watch a process that runs steps for some seconds, after one second to settle."""
    time.sleep(1)  # nothing says that caches are warm
    before_ns, begun_ns = processor_ns(pid), time.monotonic_ns()
    time.sleep(seconds)
    spent_ns, elapsed_ns = processor_ns(pid) - before_ns, time.monotonic_ns() - begun_ns
    return Cost(blocks, spent_ns / (elapsed_ns / PERIOD_NS), resident_kib(pid))


@contextmanager
def flotilla(blocks: int, directory: Path, program: Path) -> Iterator[int]:
    """Our executive with a chain of gains; its process."""
    chain = ["  b0: {type: gain, in: {in: 1}}"]
    chain += [
        f"  b{i}: {{type: gain, in: {{in: b{i - 1}.out}}, parameters: {{factor: 1.0001}}}}" for i in range(1, blocks)
    ]
    task = directory / f"chain{blocks}.yml"
    task.write_text("\n".join([f"period: {PERIOD_NS // 1000} us", "overruns: 0", "blocks:", *chain, ""]))
    process = subprocess.Popen([program, task], stderr=subprocess.DEVNULL)
    try:
        yield process.pid
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10)


@contextmanager
def hal(blocks: int, directory: Path) -> Iterator[int]:
    """LinuxCNC's HAL with a chain of `scale`; the process that runs its threads."""
    lines = [f"loadrt threads name1=t period1={PERIOD_NS}", f"loadrt scale count={blocks}", "setp scale.0.in 1"]
    for i in range(blocks):
        lines += [f"setp scale.{i}.gain 1.0001", f"addf scale.{i} t"]
        lines += [f"net s{i} scale.{i - 1}.out => scale.{i}.in"] if i else []
    script = directory / f"chain{blocks}.hal"
    script.write_text("\n".join([*lines, "start", ""]))
    directory.chmod(0o777)  # it will not run for root without the name of another user, who makes a socket there
    environment = os.environ | {"RTAPI_UID": str(os.getuid() or 65534), "RTAPI_FIFO_PATH": str(directory / "fifo")}
    with subprocess.Popen(
        ["halrun", "-I", "-f", script], env=environment, stdin=subprocess.PIPE, stdout=_NULL, stderr=_NULL
    ) as process:
        assert process.stdin
        try:
            pid = _started(process)
            listed = subprocess.run(
                ["halcmd", "show", "funct"], capture_output=True, text=True, env=environment, check=True
            )
            if listed.stdout.count(" scale.") != blocks:
                raise SystemExit(f"HAL has loaded {listed.stdout.count(' scale.')} of {blocks} functions")
            yield pid
        finally:
            process.stdin.close()  # it undoes all it has loaded, and ends


def _started(halrun: subprocess.Popen[bytes]) -> int:
    """The process of the threads, once they run: it says nothing through a pipe, so its processor time tells."""
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline and halrun.poll() is None:
        found = subprocess.run(["pgrep", "-n", "-x", "rtapi_app"], capture_output=True, text=True, check=False).stdout
        with suppress(FileNotFoundError):  # it was one that ended just now
            if found and any(thread.name != found.strip() for thread in Path(f"/proc/{found.strip()}/task").iterdir()):
                before_ns = processor_ns(int(found))
                time.sleep(0.2)
                if processor_ns(int(found)) > before_ns:
                    return int(found)
        time.sleep(0.05)
    raise SystemExit(f"halrun has started no thread within {_PATIENCE_S} s")


def slope_ns(costs: Mapping[int, Cost]) -> float:
    """What a further block adds to a step, from one round's chains."""
    shorter, longer = SLOPE
    return (costs[longer].step_ns - costs[shorter].step_ns) / (longer - shorter)


def measure(
    run: Callable[[int, Path], AbstractContextManager[int]], counts: Sequence[int], seconds: float
) -> dict[int, Cost]:
    """One round: each chain once."""
    costs = {}
    for blocks in counts:
        with tempfile.TemporaryDirectory() as directory, run(blocks, Path(directory)) as pid:
            costs[blocks] = observe(pid, blocks, seconds)
    return costs


def report(name: str, rounds: Sequence[Mapping[int, Cost]]) -> str:
    slopes = [slope_ns(costs) for costs in rounds]
    lines = [f"{name}: {median(slopes):.1f} ns a block ({min(slopes):.1f} to {max(slopes):.1f})"]
    for blocks in rounds[0]:
        steps_us = [costs[blocks].step_ns / 1000 for costs in rounds]
        busy_percent = median(costs[blocks].busy_percent for costs in rounds)
        lines.append(
            f"  {blocks:5} blocks: {median(steps_us):8.2f} us a step ({min(steps_us):.2f} to {max(steps_us):.2f}), "
            f"{busy_percent:5.2f} % of a processor, {rounds[0][blocks].memory_kib} KiB"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m runtime.bench.bench", description=__doc__)
    parser.add_argument("program", type=Path, help="flotilla-run")
    parser.add_argument("--seconds", type=float, default=2, help="for each chain (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each (%(default)s)")
    options = parser.parse_args()
    compared = shutil.which("halcmd") is not None
    ours, theirs = [], []
    for _ in range(options.rounds):
        ours.append(measure(functools.partial(flotilla, program=options.program), COUNTS, options.seconds))
        if compared:
            theirs.append(measure(hal, HAL_COUNTS, options.seconds))
    print(f"medians of {options.rounds} rounds of {options.seconds:g} s (least to greatest)")
    print(report("flotilla-run", ours))
    if compared:
        print(report("LinuxCNC HAL", theirs))
        ratio = median(map(slope_ns, ours)) / median(map(slope_ns, theirs))
        print(f"ratio: {ratio:.2f} a block")
    idle_percent = 100 - median(costs[IDLE_BLOCKS].busy_percent for costs in ours)
    print(f"a task of {IDLE_BLOCKS} blocks at 1 kHz leaves {idle_percent:.1f} % of a processor idle")


if __name__ == "__main__":
    main()
