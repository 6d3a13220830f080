"""Nothing acts by itself: after a start of a task's service, an actuator waits for a command that was off."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.running import PATIENCE, Task
from tests.runtime.tasks import HEADERS, PLUGIN, compile_shared

HELD = """\
period: 1 ms
overruns: 0
{more}
blocks:
  valve: {{type: held, parameters: {{device: {place}/valve, command: {place}/command}}}}
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    compile_shared(PLUGIN / "held.c", tmp_path / "held.so", f"-I{HEADERS}")
    return tmp_path


def command(place: Path, word: str) -> None:
    (place / "new").write_text(word)
    (place / "new").rename(place / "command")


@contextmanager
def started(flotilla_run: Path, place: Path, more: str = "", *, service: bool = True) -> Iterator[Task]:
    file = place / "task.yml"
    file.write_text(HELD.format(place=place, more=more))
    argv: list[str | Path] = [
        flotilla_run,
        "--blocks",
        place,
        "--watch",
        "valve.out",
        "--control",
        place / "control",
        file,
    ]
    environment = os.environ | ({"RUNTIME_DIRECTORY": str(place)} if service else {})
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            yield Task(process)
        finally:
            process.kill()


def acts(task: Task, steps: int = 50) -> set[int]:
    """What the actuator does in so many steps."""
    rows = task.rows()
    return {next(rows)["out"] for _ in range(steps)}


def waiting(flotilla_run: Path, place: Path) -> list[str]:
    argv: list[str | Path] = [
        flotilla_run.with_name("flotilla-param"),
        "--control",
        place / "control",
        "--status=json",
        "task",
    ]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=PATIENCE, check=True)
    found: list[str] = json.loads(done.stdout)["waiting"]
    return found


def test_an_actuator_waits_until_a_command_was_off(flotilla_run: Path, place: Path) -> None:
    """Held on by somebody over the task's end by SIGKILL. Seen to fail where a start
    requires nothing of an actuator: it acted in the first step."""
    command(place, "1")
    for _ in range(2):
        with started(flotilla_run, place) as task:
            assert acts(task) == {0}
            assert waiting(flotilla_run, place) == ["valve"]
            command(place, " ")  # no command is not one to rest
            assert acts(task, 500) == {0}
            command(place, "1")
            assert acts(task, 500) == {0}
            command(place, "0")
            rows = task.rows()
            while waiting(flotilla_run, place):
                next(rows)
            command(place, "1")
            while not next(rows)["out"]:
                pass
            task.signal(signal.SIGKILL)
            task.process.wait(PATIENCE)


@pytest.mark.parametrize(("more", "service"), [("restart: resume", True), ("", False)])
def test_a_task_that_resumes_and_one_started_by_hand_act_at_once(
    flotilla_run: Path, place: Path, more: str, service: bool
) -> None:
    command(place, "1")
    with started(flotilla_run, place, more, service=service) as task:
        assert acts(task) == {1}
        assert waiting(flotilla_run, place) == []
