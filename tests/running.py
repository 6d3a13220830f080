"""A task that runs on this computer, by the runtime's real executive, and what it prints."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PATIENCE = 60
"""Seconds, for what takes well under one: the machine may be busy."""

Row = dict[str, Any]
"""What the watched signals are after a step; where all are of one block, by the names of its ports."""


class Task:
    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process

    def rows(self) -> Iterator[Row]:
        """Row after row; it fails when they last for longer than one may wait, or the task ends."""
        assert self.process.stdout
        deadline = time.monotonic() + PATIENCE
        line = "none"
        for line in self.process.stdout:
            assert time.monotonic() < deadline, f"not within {PATIENCE} s; the last row was {line}"
            row = json.loads(line)
            blocks = {name.rpartition(".")[0] for name in row if "." in name}
            yield {name.rpartition(".")[2] if len(blocks) == 1 else name: value for name, value in row.items()}
        raise AssertionError(f"the task ended, status {self.process.wait()}; the last row was {line}")

    def until(self, wanted: Callable[[Row], object]) -> Row:
        """The first row that is as wanted."""
        return next(row for row in self.rows() if wanted(row))

    def end(self) -> int:
        """Ask it to end; its status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.send_signal(signal.SIGCONT)
            self.process.communicate(timeout=PATIENCE)
        return self.process.returncode


@contextmanager
def running(
    command: list[str | Path], task: Path, text: str, environment: Mapping[str, str] | None = None
) -> Iterator[Task]:
    """Write a task and run it by `command`, flotilla-run and options; it ends with the context if it has not before."""
    task.write_text(text)
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
