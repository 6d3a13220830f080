"""The driver against the emulator, in the runtime on this computer. From the directory of Flotilla:

build/venv/bin/python -m pytest examples/range-finder
"""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths

HERE = Path(__file__).parent
OUTPUTS = ("range_m", "limit", "flag", "age", "sequence")
DEADLINE_S = 60
"""For all of a test, which takes a few seconds: the computer may be busy."""

Row = dict[str, Any]


class Rig:
    """The emulator, and a task that reads it."""

    def __init__(self, emulator: subprocess.Popen[str], task: subprocess.Popen[str]) -> None:
        self._emulator, self._task = emulator, task

    def send(self, command: str) -> None:
        """Change what the emulator sends: emulator.py lists the commands."""
        assert self._emulator.stdin
        self._emulator.stdin.write(f"{command}\n")
        self._emulator.stdin.flush()

    def until(self, condition: Callable[[Row], bool]) -> list[Row]:
        """The outputs of all steps from now on until `condition` is met by those of one; it is the last."""
        assert self._task.stdout
        rows: list[Row] = []
        for line in self._task.stdout:
            rows.append({name.partition(".")[2]: value for name, value in json.loads(line).items()})
            if condition(rows[-1]):
                return rows
        raise AssertionError(f"the task ended, or took longer than {DEADLINE_S} s; its last outputs: {rows[-1:]}")


@contextmanager
def started(argv: list[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A program, which is killed at the end of the block."""
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="session")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the app's plug-in."""
    subprocess.run(["make", "-s", "-C", paths.PROJECT, "runtime"], check=True, stdout=subprocess.DEVNULL)
    plugin = tmp_path_factory.mktemp("blocks") / "app.so"
    command = ["cc", "-std=c11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-O2"]
    command += [f"-I{paths.PROJECT / 'runtime' / 'include'}", "-o", str(plugin)]
    subprocess.run([*command, *map(str, HERE.glob("*.c"))], check=True)
    return plugin.parent


@pytest.fixture
def rig(blocks: Path, tmp_path: Path) -> Iterator[Rig]:
    with started([sys.executable, str(HERE / "emulator.py")], stdin=subprocess.PIPE) as emulator:
        assert emulator.stdout
        port = emulator.stdout.readline().strip()
        text = (HERE / "task.yml").read_text().replace("/dev/robot/range_finder", port)
        # Without real-time priority, and however late its steps are.
        (tmp_path / "task.yml").write_text(text.replace("priority: 64", "priority: 0\noverruns: 0"))
        watch = ",".join(f"sensor.{name}" for name in OUTPUTS)
        argv = [str(paths.BUILD / "runtime" / "flotilla-run"), "--blocks", str(blocks), "--watch", watch]
        with started([*argv, str(tmp_path / "task.yml")]) as task:
            timer = threading.Timer(DEADLINE_S, task.kill)
            timer.start()
            yield Rig(emulator, task)
            timer.cancel()


def good(range_m: float) -> Callable[[Row], bool]:
    return lambda row: row["flag"] == 1 and row["range_m"] == range_m


def test_ranges_arrive(rig: Rig) -> None:
    first = rig.until(good(1))[-1]
    assert first["sequence"] >= 1
    assert first["limit"] == 0
    rig.send("4.321")
    rows = rig.until(good(4.321))
    assert {row["range_m"] for row in rows} <= {1, 4.321}
    assert rows[-1]["sequence"] > first["sequence"]


def test_silence_makes_the_flag_0_and_ranges_make_it_1_again(rig: Rig) -> None:
    rig.until(good(1))
    rig.send("silence")
    last = rig.until(lambda row: row["flag"] == 0)[-1]
    assert last["range_m"] == 1, "the last good value stays"
    assert last["age"] > 0.5, "the timeout"
    rig.send("2")
    assert rig.until(good(2))[-1]["sequence"] == last["sequence"] + 1


def test_garbage_is_no_range(rig: Rig) -> None:
    rig.until(good(1))
    rig.send("garbage")
    rows = rig.until(lambda row: row["flag"] == 0)  # by the timeout
    rig.send("garbage 2")  # a whole frame right after one that broke off
    rows += rig.until(good(2))
    assert {row["range_m"] for row in rows} == {1, 2}
    assert {row["limit"] for row in rows} == {0}


@pytest.mark.parametrize(("command", "limit"), [("near", -1), ("none", 1)])
def test_a_limit_is_no_range(rig: Rig, command: str, limit: int) -> None:
    before = rig.until(good(1))[-1]
    rig.send(command)
    last = rig.until(lambda row: row["limit"] == limit)[-1]
    assert (last["flag"], last["range_m"]) == (0, 1)
    assert last["sequence"] >= before["sequence"]
    rig.send("2")
    assert rig.until(good(2))[-1]["limit"] == 0
