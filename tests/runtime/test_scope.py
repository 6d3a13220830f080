"""Signals of a running task, watched through its socket, on this computer."""

from __future__ import annotations

import csv
import json
import socket
import subprocess
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.runtime.test_param import SECONDS, Running

MORE = """
  time: {type: integrator, in: {in: 1}}
  saw: {type: gain, in: {in: time.out}, parameters: {factor: 100}}
  pair: {type: join, in: {in0: a.out, in1: saw.out}}
"""
SLOTS = 4

Start = Callable[..., Running]
Scope = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def running(flotilla_run: Path, tmp_path: Path) -> Iterator[Running]:
    running = Running(flotilla_run, tmp_path, more=MORE)
    yield running
    running.process.kill()
    running.process.communicate()


def argv(running: Running, *words: str) -> list[str]:
    return [str(running.program.with_name("flotilla-scope")), "--control", str(running.control), *words]


def scope(running: Running, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(argv(running, *words), capture_output=True, text=True, timeout=SECONDS, check=False)


def rows(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    assert (done.returncode, done.stderr) == (0, "")
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_signals_are_listed(running: Running) -> None:
    lines = scope(running, "task").stdout.splitlines()
    assert "a.out double 1" in lines
    assert "camera.flag boolean 1" in lines
    assert "pair.out double 2" in lines


def test_each_step_has_a_row(running: Running) -> None:
    """Each row is of one step: what the integrator has and its gain agree. Seen to fail with rows taken twice."""
    found = rows(scope(running, "--rows", "50", "task", "time.out", "pair.out", "trigger.on"))
    assert len(found) == 50
    for before, row in pairwise(found):
        assert row["step"] == before["step"] + 1
    for row in found:
        assert row["pair.out"] == [2, 100 * row["time.out"]]
        assert row["lost"] == 0


def test_every_nth_step(running: Running) -> None:
    found = rows(scope(running, "--rows", "5", "--every", "7", "task", "time.out"))
    assert [row["step"] % 7 for row in found] == [0] * 5
    assert [row["step"] - found[0]["step"] for row in found] == [0, 7, 14, 21, 28]


def test_a_table(running: Running) -> None:
    done = scope(running, "--rows", "3", "--csv", "task", "pair.out", "time.out")
    table = list(csv.reader(done.stdout.splitlines()))
    assert table[0] == ["step", "release_ns", "lost", "pair.out[0]", "pair.out[1]", "time.out"]
    assert [len(row) for row in table] == [6] * 4
    assert [float(row[4]) for row in table[1:]] == [100 * float(row[5]) for row in table[1:]]


def test_a_crossing_is_waited_for(running: Running) -> None:
    """The parameter makes it, between two steps. The row of the crossing is the one after those asked for before it."""
    waiting = subprocess.Popen(
        argv(running, "--rows", "20", "--before", "5", "--trigger", "a.out>3", "task", "a.out", "time.out"),
        stdout=subprocess.PIPE,
        text=True,
    )
    await_clients(running, 1)
    enough = running.told()["steps"] + 10
    while running.row()["step"] < enough:
        pass
    running.param("a.factor", "1")  # downwards is none
    done = running.param("a.factor", "4")
    out, _ = waiting.communicate(timeout=SECONDS)
    found = [json.loads(line) for line in out.splitlines()]
    step = int(done.stdout.split("from step ")[1].split()[0])
    assert [row["a.out"] <= 3 for row in found] == [True] * 5 + [False] * 15
    assert found[5]["step"] == step


def test_what_is_past_the_value_already_is_no_crossing(running: Running) -> None:
    """Seen to fail without a look at the row before."""
    waiting = subprocess.Popen(
        argv(running, "--rows", "1", "--trigger", "a.out<3", "task", "time.out"), stdout=subprocess.PIPE, text=True
    )
    await_clients(running, 1)
    running.param("a.factor", "5")
    step = int(running.param("a.factor", "2").stdout.split("from step ")[1].split()[0])
    out, _ = waiting.communicate(timeout=SECONDS)
    assert json.loads(out)["step"] == step


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["b.out"], "b.out: the task has no block b"),
        (["a.in"], "a.in: gain has no output in; it has out"),
        (["pair.out[2]"], "pair.out[2]: its elements are [0] to [1]"),
        (["--every", "0", "a.out"], "every=0: not a whole number from 1 to 4294967295"),
        (["--rows", "many", "a.out"], "rows=many: not a whole number from 0 to 4294967295"),
        (["--trigger", "a.out", "a.out"], "trigger=a.out: not SIGNAL>VALUE or SIGNAL<VALUE"),
        (["--trigger", "a.out>inf", "a.out"], "trigger=a.out>inf: not SIGNAL>VALUE or SIGNAL<VALUE"),
        (["--before", "1", "a.out"], "before: there is no trigger"),
        (["--trigger", "a.out>1", "--rows", "3", "--before", "3", "a.out"], "before=3 leaves no row of 3"),
        (["--trigger", "a.out>1", "--before", "1000000", "a.out"], "before=1000000: at most 32768 rows"),
    ],
)
def test_what_cannot_be_is_refused(running: Running, words: list[str], reason: str) -> None:
    options = words[:-1]
    refused = scope(running, *options, "task", words[-1])
    assert (refused.returncode, refused.stdout) == (1, "")
    assert refused.stderr.startswith(f"flotilla-scope: task task: {reason}")


def test_too_many_bytes_are_refused(flotilla_run: Path, tmp_path: Path) -> None:
    wide = "  wide: {type: constant, parameters: {value: [" + ", ".join(["1"] * 200) + "]}}"
    running = Running(flotilla_run, tmp_path, more=wide)
    try:
        refused = scope(running, "task", "wide.out")
        assert refused.returncode == 1
        assert "these signals have 1624 bytes, at most 1024 are copied after a step" in refused.stderr
        assert rows(scope(running, "--rows", "1", "task", "wide.out[199]"))[0]["wide.out[199]"] == 1
    finally:
        running.process.kill()
        running.process.communicate()


def await_clients(running: Running, count: int) -> None:
    """Until so many watch: each has a thread of that name."""
    tasks = Path(f"/proc/{running.process.pid}/task")
    while sum((path / "comm").read_text() == "scope\n" for path in tasks.iterdir()) < count:
        assert running.process.poll() is None


def watching(running: Running) -> socket.socket:
    client = running.connected()
    client.sendall(b"watch time.out\n")
    return client


def test_clients_have_a_limit_and_leave_room(running: Running) -> None:
    clients = [watching(running) for _ in range(SLOTS)]
    for client in clients:
        assert client.recv(3) == b"ok\n"
    refused = scope(running, "--rows", "1", "task", "time.out")
    assert refused.stderr == "flotilla-scope: task task: 4 others watch this task, which are all that may\n"
    clients[0].close()
    while scope(running, "--rows", "1", "task", "time.out").returncode:
        assert running.process.poll() is None
    for client in clients:
        client.close()


def test_a_client_that_does_not_read_delays_nobody(running: Running) -> None:
    """Its rows are lost, and it is sent away. Steps go on, others are served, and the end comes when asked for."""
    with watching(running):
        assert running.param("a.factor", "4").returncode == 0
        while running.row()["a.out"] != 4:
            pass
        assert len(rows(scope(running, "--rows", "3", "task", "a.out"))) == 3
        running.end()


def test_the_last_rows_are_sent_when_the_task_ends(flotilla_run: Path, tmp_path: Path) -> None:
    """Seen to fail where the stream ends at once."""
    running = Running(flotilla_run, tmp_path, "--steps", "200", more=MORE)
    done = scope(running, "task", "time.out")
    running.process.communicate(timeout=SECONDS)
    assert (done.returncode, done.stderr) == (1, "flotilla-scope: task task has ended\n")
    assert json.loads(done.stdout.splitlines()[-1])["step"] == 199
