"""Runs in a guest: two tasks, one of which sends to the other, and the processor time that they take.

Standard library and what the image has. `python3 -m flotilla.lab.scenarios.exchange` reads what message_cost.py wrote,
in the current directory, and prints as JSON for each exchange what its processes took in some seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from flotilla.lab.scenarios import fly

SECONDS = 5
_PERIODS_PER_S = 100
_SETTLED_S = 2
_KNOWN_S = 60
"""Until two programs have proven by DDS who they are."""


def processor_ns(process: int) -> int:
    """What a process has taken, all its threads; 0 where it has ended. Clock numbers: Linux, posix-timers_types.h."""
    try:
        return time.clock_gettime_ns(~process << 3 | 2)
    except OSError:
        return 0


def whole_ns() -> int:
    """What all processes and kernel threads have taken that are there."""
    return sum(processor_ns(int(each.name)) for each in Path("/proc").iterdir() if each.name.isdigit())


@contextmanager
def running(task: dict[str, Any], *options: str) -> Iterator[subprocess.Popen[bytes]]:
    directory = task["directory"]
    environment = os.environ | {"CREDENTIALS_DIRECTORY": directory, "CYCLONEDDS_URI": task["cyclonedds"]}
    argv = ["ip", "netns", "exec", task["computer"], "flotilla-run", "--control", control(task)]
    argv += [*options, f"{directory}/{task['name']}.yml"]
    with (
        (Path(directory) / "log").open("wb") as log,
        subprocess.Popen(argv, env=environment, stdout=log, stderr=log) as process,
    ):
        try:
            yield process
        finally:
            process.terminate()


def control(task: dict[str, Any]) -> str:
    return f"{task['directory']}/control"


def outputs(task: dict[str, Any], *names: str) -> dict[str, int]:
    """As they are now."""
    argv = ["flotilla-scope", "--control", control(task), "--rows", "1", task["name"], *names]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{done.stderr}{(Path(task['directory']) / 'log').read_text()}")
    row = json.loads(done.stdout.splitlines()[-1])
    return {name: int(row[name]) for name in names}


def taken(task: dict[str, Any]) -> int:
    """Messages so far."""
    return outputs(task, "in.sequence")["in.sequence"]


def exchange(described: dict[str, Any]) -> dict[str, int]:
    sends, takes = described["tasks"]
    with ExitStack() as stack:
        processes = [stack.enter_context(running(task)) for task in (takes, sends)]
        end = time.monotonic() + _KNOWN_S
        time.sleep(_SETTLED_S)
        while described["messages"] and not taken(takes):
            if time.monotonic() > end:
                raise RuntimeError(f"{described['name']}: no message came")
            time.sleep(1)
        time.sleep(_SETTLED_S)
        begun = taken(takes) if described["messages"] else 0
        before = [*map(processor_ns, (process.pid for process in processes)), whole_ns()]
        time.sleep(SECONDS)
        after = [*map(processor_ns, (process.pid for process in processes)), whole_ns()]
        came = taken(takes) - begun if described["messages"] else 0
    receiver, sender, whole = (later - earlier for earlier, later in zip(before, after, strict=True))
    periods = SECONDS * _PERIODS_PER_S
    return {"sender_ns": sender, "receiver_ns": receiver, "whole_ns": whole, "taken": came, "periods": periods}


def join() -> None:
    """The computers of the session, as namespaces with a radio each, are in the cell."""
    session = json.loads(Path("session.json").read_text())
    for link, target in session["links"].items():
        Path(link).unlink(missing_ok=True)
        Path(link).symlink_to(target)
    fly.join_cell(session["computers"])


def main() -> dict[str, Any]:
    join()
    return {each["name"]: exchange(each) for each in json.loads(Path("exchanges.json").read_text())}


if __name__ == "__main__":
    print(json.dumps(main()))
