"""A task that runs on this computer or on a robot, by the runtime's real executive, and what it prints."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flotilla.lab.qemu.ssh import Ssh

PATIENCE = 300
"""Seconds, for what takes well under one: the machine may be slow and busy, and a guest on it slower still."""

DDS_ON_LOOPBACK = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>4</MaxAutoParticipantIndex>
    <Peers><Peer Address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
"""Cyclone DDS's configuration without multicast."""

Row = dict[str, Any]
"""What the watched signals are after a step; where all are of one block, by the names of its ports."""


def free_port() -> int:
    """A port of UDP that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as somebody:
        somebody.bind(("127.0.0.1", 0))
        port: int = somebody.getsockname()[1]
        return port


def watching(signals: str) -> list[str]:
    """Options of flotilla-run."""
    return ["--watch", signals] if signals else []


class Task:
    """On this computer."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        """Until it has ended; its status."""
        return self.process.wait(PATIENCE)

    def rows(self) -> Iterator[Row]:
        """Row after row; it fails when they last for longer than one may wait, or the task ends."""
        assert self.process.stdout
        deadline = time.monotonic() + PATIENCE
        line = "none"
        for line in self.process.stdout:
            if not line.endswith("\n"):  # the output ended within the row
                break
            assert time.monotonic() < deadline, f"not within {PATIENCE} s; the last row was {line}"
            row = json.loads(line)
            blocks = {name.rpartition(".")[0] for name in row if "." in name}
            yield {name.rpartition(".")[2] if len(blocks) == 1 else name: value for name, value in row.items()}
        raise AssertionError(f"the task ended, status {self.wait()}; the last row was {line}")

    def until(self, wanted: Callable[[Row], object]) -> Row:
        """The first row that is as wanted."""
        return next(row for row in self.rows() if wanted(row))

    def end(self) -> int:
        """Ask it to end; its status."""
        if self.process.poll() is None:
            self.signal(signal.SIGTERM)
            self.signal(signal.SIGCONT)
            self.process.communicate(timeout=PATIENCE)
        return self.process.returncode


def judged_by_outcomes(text: str) -> str:
    """The task, which late steps do not end unless it says so itself: whether a computer keeps up is not its test.

    Virtual time judges that. Seen to be needed with half of a processor: ten steps in a row ended late.
    """
    return text if re.search(r"^overruns?:", text, re.MULTILINE) else f"{text.rstrip()}\noverruns: 0\n"


@contextmanager
def running(
    command: list[str | Path], task: Path, text: str, environment: Mapping[str, str] | None = None
) -> Iterator[Task]:
    """Write a task and run it by `command`, flotilla-run and options; it ends with the context if it has not before."""
    task.write_text(judged_by_outcomes(text))
    with subprocess.Popen(
        [*command, task], stdout=subprocess.PIPE, text=True, env={**os.environ, **(environment or {})}
    ) as process:
        try:
            yield Task(process)
        finally:
            try:
                Task(process).end()
            finally:
                process.kill()


# Keeps what it is told on its input: names of signals; its end asks the task to end. The task is alone on the output.
_THERE = """
printf '%s' "$1" >"$2"
shift 2
exec 3<&0
"$@" & task=$!
{
    while read -r name; do kill -"$name" $task; done
    kill -TERM $task; kill -CONT $task
} <&3 >/dev/null 2>&1 & reader=$!
wait $task
status=$?
kill $reader 2>/dev/null
exit $status
"""

_AS_ROOT = ("sudo", "--preserve-env=CYCLONEDDS_URI")  # which a robot's services have, too


class TaskThere(Task):
    """On a robot, as root."""

    def signal(self, number: signal.Signals) -> None:
        assert self.process.stdin
        self.process.stdin.write(f"{number.name.removeprefix('SIG')}\n")
        self.process.stdin.flush()

    def end(self) -> int:
        self.process.communicate(timeout=PATIENCE)  # its input ends
        return self.process.returncode


@contextmanager
def running_there(
    shell: Ssh, name: str, text: str, *options: str, environment: Mapping[str, str] | None = None
) -> Iterator[Task]:
    """The same on a robot, by its own flotilla-run."""
    path = f"/tmp/{name}.yml"
    command = ["env", *(f"{key}={value}" for key, value in (environment or {}).items()), "flotilla-run", *options]
    argv = [*_AS_ROOT, "sh", "-c", _THERE, "sh", judged_by_outcomes(text), path, *command, path]
    with shell.start(argv) as process:
        limit = threading.Timer(2 * PATIENCE, process.kill)  # a guest that is gone says nothing
        limit.start()
        try:
            yield (task := TaskThere(process))
            task.end()
        finally:
            limit.cancel()
            process.kill()
