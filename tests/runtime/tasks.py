"""Tasks that tests of the executive run on this computer, and what is seen of them."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flotilla.common import paths

PLUGIN = paths.PROJECT / "runtime" / "tests" / "plugin"
HEADERS = paths.PROJECT / "runtime" / "include"
PATIENT = "period: 1 ms\noverruns: 0"  # on a busy computer, too
TRACE = "out: {{type: trace, parameters: {{device: {file}}}}}\n"


def compile_shared(source: Path, out: Path, *options: str) -> None:
    command = ["cc", "-std=c11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-O1", *options]
    subprocess.run([*command, "-o", str(out), str(source)], check=True)


@dataclass(frozen=True)
class Ended:
    """A run of flotilla-run that ended."""

    status: int
    err: str
    rows: list[dict[str, Any]]
    statistics: dict[str, Any]


class Tasks:
    """Runs tasks."""

    def __init__(self, program: Path, plugins: Path, directory: Path) -> None:
        self.program, self.plugins, self.directory = program, plugins, directory

    def write(self, text: str) -> Path:
        file = self.directory / "task.yml"
        file.write_text(text)
        return file

    def argv(self, text: str, *options: str) -> list[str]:
        return [str(self.program), "--blocks", str(self.plugins), *options, str(self.write(text))]

    def run(self, text: str, *options: str, environment: dict[str, str] | None = None) -> Ended:
        """Run to its end, within a minute."""
        statistics = self.directory / "statistics.json"
        argv = self.argv(text, "--statistics", str(statistics), *options)
        done = subprocess.run(argv, capture_output=True, text=True, timeout=60, env=environment, check=False)
        rows = [json.loads(line) for line in done.stdout.splitlines()] if "--watch" in options else []
        return Ended(
            done.returncode, done.stderr, rows, json.loads(statistics.read_text()) if statistics.exists() else {}
        )

    def refusal(self, text: str) -> list[str]:
        """What `--check` says, line by line, without the file's name."""
        done = subprocess.run(self.argv(text, "--check"), capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2, done.stderr
        return [line.replace(f"{self.directory}/task.yml:", "") for line in done.stderr.splitlines()]


def task(blocks: str, head: str = "period: 1 ms") -> str:
    return f"{head}\nblocks:\n" + "".join(f"  {line}\n" for line in blocks.strip().splitlines())


def check_reset(device: Path) -> None:
    """No step has commanded the actuator after it was made safe."""
    words = device.read_text().split()
    assert set(words[words.index("safe") :]) <= {"safe", "terminated"}
