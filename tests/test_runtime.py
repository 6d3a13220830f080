"""The executive on this computer: tasks that are wrong, blocks that misbehave, ends of every kind.

`runtime/tests/plugin/misbehave.c` is what misbehaves; it is built here as a stranger would build a plug-in.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from images.builder import identity, paths
from images.builder.inventory import load_fleet
from tests.running import PATIENCE, free_port
from tests.scenarios import virtual

pytestmark = pytest.mark.alone

PLUGIN = paths.PROJECT / "runtime" / "tests" / "plugin"
HEADERS = paths.PROJECT / "runtime" / "include"


@pytest.fixture(scope="module")
def plugins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the misbehaving plug-in."""
    directory = tmp_path_factory.mktemp("blocks")
    compile_shared(PLUGIN / "misbehave.c", directory / "misbehave.so", f"-I{HEADERS}")
    return directory


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


@pytest.fixture
def tasks(flotilla_run: Path, plugins: Path, tmp_path: Path) -> Tasks:
    return Tasks(flotilla_run, plugins, tmp_path)


def task(blocks: str, head: str = "period: 1 ms") -> str:
    return f"{head}\nblocks:\n" + "".join(f"  {line}\n" for line in blocks.strip().splitlines())


REFUSED = {
    "no YAML": ("period: [", "2: did not find expected node content"),
    "empty": ("", "it is empty"),
    "no period": ("blocks:\n  a: {type: gain, in: {in: 1}}", "task: period is missing: the time between two steps"),
    "period 0": (task("a: {type: gain, in: {in: 1}}", "period: 0 ms"), "1: period: 0 ms is not from 50 us"),
    "period without unit": (task("a: {type: gain, in: {in: 1}}", "period: 10"), "10 is not a time such as 10 ms"),
    "period twice": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nperiod: 2 ms"), "2: task: period is there"),
    "unknown key": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nrate: 1"), "2: task: unknown key rate; there"),
    "phase": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nphase: 1 ms"),
        "1: task: phase is not below the period",
    ),
    "phase without unit": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nphase: 0"), "2: phase: 0 is not a time"),
    "trigger": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\ntrigger: b"), "2: trigger: there is no block b"),
    "trigger that waits for nothing": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\ntrigger: a"),
        "2: trigger: a, a gain, waits for nothing; one that does is udp-receive",
    ),
    "trigger with a phase": (
        task("a: {type: udp-receive, parameters: {port: 9, length: 1}}", "period: 2 ms\nphase: 1 ms\ntrigger: a"),
        "3: trigger: a step that is due when something comes has no phase",
    ),
    "trigger now and then": (
        task("a: {type: udp-receive, every: 2, parameters: {port: 9, length: 1}}", "period: 1 ms\ntrigger: a"),
        "4: block a: the trigger runs in every step",
    ),
    "priority": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\npriority: 99"), "2: priority: 99 is not a whole"),
    "priority 1": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\npriority: 1"), "priority: 1 leaves none below"),
    "policy": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\noverrun: ignore"), "2: overrun: ignore is none of"),
    "no blocks": ("period: 1 ms\nblocks: {}", "2: blocks: there is none"),
    "no type": (task("a: {in: {in: 1}}"), "3: block a: type is missing"),
    "unknown block": (task("a: {type: gian, in: {in: 1}}"), "3: block a: there is no block gian, the nearest is gain;"),
    "block's name": (task("a.b: {type: gain, in: {in: 1}}"), "3: block a.b: a name begins with a letter"),
    "every 0": (task("a: {type: gain, every: 0, in: {in: 1}}"), "3: every: 0 is not a whole number from 1"),
    "offset": (task("a: {type: gain, every: 2, offset: 2, in: {in: 1}}"), "3: block a: offset 2 is not below every 2"),
    "unknown parameter": (
        task("a: {type: gain, in: {in: 1}, parameters: {faktor: 2}}"),
        "3: block a: gain has no parameter faktor; it has",
    ),
    "value": (task("a: {type: gain, in: {in: 1}, parameters: {factor: two}}"), "parameter factor: two is not a number"),
    "list": (
        task("a: {type: gain, in: {in: 1}, parameters: {factor: [1]}}"),
        "the list beginning with 1 is not a number",
    ),
    "mapping": (task("a: {type: gain, in: {in: 1}, parameters: {factor: {b: 1}}}"), "factor is a mapping, not a value"),
    "missing parameter": (task("a: {type: trace}"), "3: block a: parameter device of trace is missing"),
    "relative device": (task("a: {type: trace, parameters: {device: gyro}}"), "gyro is not a device's path"),
    "choice": (task("a: {type: misbehave, parameters: {manner: sulk}}"), "sulk is none of fail|hang|late|allocate"),
    "no wire": (task("a: {type: gain}"), "3: block a: input in has no wire: any signal"),
    "unknown input": (task("a: {type: gain, in: {in: 1, on: 2}}"), "3: block a: gain has no input on; it has in"),
    "unknown source": (
        task("a: {type: gain, in: {in: b.out}}"),
        "3: block a: input in: b.out: the task has no block b",
    ),
    "unknown output": (task("a: {type: gain, in: {in: a.aut}}"), "a.aut: gain has no output aut; it has out"),
    "no port": (task("a: {type: gain, in: {in: b}}"), "b is neither a wire (block.port) nor a number"),
    "element": (
        task("a: {type: gain, in: {in: 'b.out[1]'}}\nb: {type: gain, in: {in: 1}}"),
        "its elements are [0] to [0]",
    ),
    "wrong type": (
        task("a: {type: gain, in: {in: b.step}}\nb: {type: clock}"),
        "input in takes double[1], b.step is uint64[1]",
    ),
    "wrong width": (
        task("a: {type: gain, in: {in: b.out}}\nb: {type: constant, parameters: {value: [1, 2]}}"),
        "input in takes double[1], b.out is double[2]",
    ),
    "too many constants": (task("a: {type: gain, in: {in: [1, 2]}}"), "input in has 1 elements, not 2"),
    "cycle": (
        task("a: {type: gain, in: {in: b.out}}\nb: {type: gain, in: {in: a.out}}"),
        "3: cycle without delay: a → b → a; put a block delay into one of its wires",
    ),
    "a frame twice": (
        task("a: {type: can-send, in: {data: 1, age: 0}, parameters: {id: 9, length: 1}}\n" * 2).replace("a:", "b:", 1),
        '4: block a: interface "can0", id 9, extended false is block b\'s; a device serves one block',
    ),
    "a device twice": (
        task("a: {type: trace, parameters: {device: /dev/x}}\nb: {type: trace, parameters: {device: /dev/x}}"),
        '4: block b: device "/dev/x" is block a\'s; a device serves one block',
    ),
    "a board twice": (
        task("a: {type: ir104-pbf}\nb: {type: ir104-pbf, parameters: {base: 0x300}}"),
        "4: block b: base 0x300 is block a's; a device serves one block",
    ),
}


@pytest.mark.parametrize(("text", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_a_wrong_task_is_refused_with_file_line_and_remedy(tasks: Tasks, text: str, said: str) -> None:
    (line,) = tasks.refusal(text)
    assert said in line


def test_all_errors_at_once(tasks: Tasks) -> None:
    text = task("a: {type: gain}\nb: {type: gain, in: {in: x.y}, parameters: {factor: z}}", "period: 1 ms\npriority: x")
    assert len(tasks.refusal(text)) == 4


def test_signals_follow_the_wires_at_their_rates(tasks: Tasks) -> None:
    text = task(
        """
last: {type: gain, in: {in: slow.out}}
slow: {type: gain, every: 3, offset: 1, in: {in: ramp.out}}
ramp: {type: sum, in: {in0: before.out, in1: 1}, parameters: {signs: "++"}}
before: {type: delay, in: {in: ramp.out}}
"""
    )
    ended = tasks.run(text, "--steps", "8", "--no-wait", "--watch", "ramp.out,last.out,slow.out")
    assert ended.status == 0, ended.err
    assert [row["ramp.out"] for row in ended.rows] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [row["slow.out"] for row in ended.rows] == [0, 2, 2, 2, 5, 5, 5, 8]
    assert [row["last.out"] for row in ended.rows] == [row["slow.out"] for row in ended.rows]
    releases = [row["release_ns"] for row in ended.rows]
    assert {after - before for before, after in itertools.pairwise(releases)} == {1_000_000}


def test_steps_are_due_at_the_phase(tasks: Tasks) -> None:
    text = task("a: {type: gain, in: {in: 1}}", "period: 4 ms\nphase: 1500 us")
    ended = tasks.run(text, "--steps", "3", "--watch", "a.out")
    assert {row["release_ns"] % 4_000_000 for row in ended.rows} == {1_500_000}


@pytest.mark.parametrize(
    ("text", "period_ns", "phase_ns"),
    [
        ("period: 4 ms", 4_000_000, 500_000),
        ("period: 4 ms\nphase: 0 ms", 4_000_000, 0),
        ("period: 500 us", 500_000, 0),
    ],
)
def test_steps_are_due_between_two_ticks(tasks: Tasks, text: str, period_ns: int, phase_ns: int) -> None:
    """The kernel's are at whole milliseconds of the same clock. Seen to fail with each release at such a time."""
    ended = tasks.run(task("a: {type: gain, in: {in: 1}}", text), "--steps", "3", "--watch", "a.out")
    assert {row["release_ns"] % period_ns for row in ended.rows} == {phase_ns}


def test_steps_are_counted_and_timed(tasks: Tasks) -> None:
    ended = tasks.run(
        task("a: {type: gain, in: {in: 1}}\nb: {type: gain, every: 4, in: {in: a.out}}"), "--steps", "100"
    )
    assert ended.status == 0, ended.err
    counted = ended.statistics
    assert counted["steps"] == 100 == counted["step"]["count"] == counted["jitter"]["count"]
    assert (counted["blocks"]["a"]["count"], counted["blocks"]["b"]["count"]) == (100, 25)
    assert 0 <= counted["step"]["min_ns"] <= counted["step"]["mean_ns"] <= counted["step"]["max_ns"]


def test_what_a_block_took_is_in_nanoseconds(tasks: Tasks) -> None:
    """It is counted in ticks of another clock. Seen to fail with those printed."""
    late = (
        "quick: {type: gain, in: {in: 1}}\nbad: {type: misbehave, parameters: {manner: late, late_s: 0.035, until: 5}}"
    )
    counted = tasks.run(task(late, "period: 10 ms\noverruns: 0"), "--steps", "5").statistics
    bad, quick, step = counted["blocks"]["bad"], counted["blocks"]["quick"], counted["step"]
    assert 35e6 <= bad["mean_ns"] <= bad["max_ns"]
    assert bad["mean_ns"] + quick["mean_ns"] <= 1.001 * step["mean_ns"]
    assert max(bad["max_ns"], quick["max_ns"]) <= 1.001 * step["max_ns"]


PATIENT = "period: 1 ms\noverruns: 0"  # on a busy computer, too
TRACE = "out: {{type: trace, parameters: {{device: {file}}}}}\n"


@dataclass(frozen=True)
class Bad:
    """A manner of misbehaviour and what must follow."""

    manner: str
    head: str
    said: str


BAD = [
    Bad("manner: fail, from: 3", "period: 1 ms", "bad: failed as asked in step 3"),
    Bad("manner: start-fail", "period: 1 ms", "bad: the device is on fire"),
    Bad("manner: hang, from: 3", "period: 1 ms", "s, after step 3; outputs are in their reset state"),
    Bad("manner: late, from: 3", "period: 10 ms\noverrun: stop-safe", "us after the next was due, 1 in a row"),
    Bad("manner: late, from: 3", "period: 10 ms\noverruns: 4", "us after the next was due, 4 in a row"),
    Bad("manner: late, from: 3", "period: 10 ms\noverrun: catch-up\noverruns: 4", "4 in a row"),
]


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: f"{bad.manner}, {bad.head}".replace("\n", ", "))
def test_what_a_block_does_wrong_ends_with_outputs_reset(tasks: Tasks, tmp_path: Path, bad: Bad) -> None:
    """Seen to fail without the call of `safe` after the loop, and the hang without the supervision's time limit."""
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + f"bad: {{type: misbehave, parameters: {{{bad.manner}}}}}", bad.head)
    ended = tasks.run(text)
    assert ended.status == 1
    assert bad.said in ended.err
    assert "outputs are in their reset state" in ended.err
    words = device.read_text().split()
    assert words.count("on") == (0 if "start" in bad.manner else words.index("safe"))
    assert words[-1] == ("safe" if "hang" in bad.manner else "terminated")


def test_a_hang_ends_within_the_shortest_time_out_of_the_actuators(tasks: Tasks, tmp_path: Path) -> None:
    """A second thread counts the second that a hang lasted on at least. Seen to fail: `second` before `safe`."""
    device = tmp_path / "device"
    ended = tasks.run(
        task(
            f"""
witness: {{type: witness, parameters: {{file: {device}, from: 3}}}}
slow: {{type: trace, parameters: {{device: {tmp_path / "slow"}, timeout: 60}}}}
quick: {{type: trace, parameters: {{device: {device}, timeout: 0.1}}}}
bad: {{type: misbehave, parameters: {{manner: hang, from: 3}}}}
""",
            "period: 10 ms\noverruns: 0",
        )
    )
    assert ended.status == 1
    assert device.read_text().split() == ["on"] * 4 + ["safe"]
    assert (tmp_path / "slow").read_text().split() == ["on"] * 4 + ["safe"]


def test_a_time_out_shorter_than_some_periods_allows_late_steps(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail with the time-out alone as the limit."""
    device = tmp_path / "device"
    out = f"out: {{type: trace, parameters: {{device: {device}, timeout: 0.001}}}}\n"
    late = "bad: {type: misbehave, parameters: {manner: late, from: 1, until: 2, late_s: 1}}"
    ended = tasks.run(task(out + late, "period: 500 ms"), "--steps", "3")
    assert ended.status == 0, ended.err
    assert device.read_text().split() == ["on"] * 3 + ["safe", "terminated"]


def test_an_actuators_time_out_is_a_number(tasks: Tasks, tmp_path: Path) -> None:
    source = (PLUGIN / "misbehave.c").read_text().replace("    double timeout;", "    int64_t timeout;")
    (tmp_path / "wrong.c").write_text(source)
    compile_shared(tmp_path / "wrong.c", tmp_path / "wrong.so", f"-I{HEADERS}")
    lines = Tasks(tasks.program, tmp_path, tmp_path).refusal(task("a: {type: trace, parameters: {device: /dev/x}}"))
    assert "block trace: an actuator's time-out is no double" in lines[0]


def test_overruns_are_left_out_or_caught_up_with(tasks: Tasks) -> None:
    """A computer that stands still for half a second does not change it: ten periods can be caught up with."""
    late = "bad: {type: misbehave, parameters: {manner: late, from: 3, until: 5, late_s: 0.25}}"
    skipping = tasks.run(task(late, "period: 100 ms\noverruns: 0"), "--steps", "12").statistics
    assert skipping["overruns"] >= 2
    assert skipping["skipped"] >= 4
    catching_up = tasks.run(task(late, "period: 100 ms\noverrun: catch-up\noverruns: 0"), "--steps", "12").statistics
    assert catching_up["overruns"] >= 4
    assert catching_up["skipped"] == 0


def test_what_integrates_goes_by_time_where_steps_are_left_out(tasks: Tasks) -> None:
    """However slow the host: what lies between two steps of a block counts, up to ten of its periods."""
    blocks = """one: {type: constant, parameters: {value: 1}}
often: {type: integrator, in: {in: one.out}}
rare: {type: integrator, every: 3, in: {in: one.out}}
bad: {type: misbehave, parameters: {manner: late, from: 2, late_s: 0.025}}"""
    ended = tasks.run(task(blocks, "period: 10 ms\noverruns: 0"), "--steps", "40", "--watch", "often.out,rare.out")
    assert ended.statistics["skipped"] >= 70
    for name, every in (("often.out", 1), ("rare.out", 3)):
        turns = ended.rows[::every]
        passed = [after["release_ns"] - row["release_ns"] for row, after in itertools.pairwise(turns)]
        expected = list(itertools.accumulate((min(ns, every * 100_000_000) / 1e9 for ns in passed), initial=0.0))
        assert [row[name] for row in turns] == pytest.approx(expected, abs=1e-9)
        assert expected[-1] > 2 * 0.01 * every * len(passed)


@pytest.fixture
def running(tasks: Tasks, tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start a task and wait for its first step."""
    started = []

    def start(text: str) -> subprocess.Popen[str]:
        argv = tasks.argv(text, "--watch", "a.out")
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout
        assert process.stdout.readline(), process.stderr and process.stderr.read()
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def check_reset(device: Path) -> None:
    """No step has commanded the actuator after it was made safe."""
    words = device.read_text().split()
    assert set(words[words.index("safe") :]) <= {"safe", "terminated"}


ASKING = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP}
FATAL = {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS, signal.SIGTRAP}
HARMLESS = {signal.SIGPIPE, signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH}
SIGNALS = {number for number in signal.valid_signals() if number < signal.SIGRTMIN} | {
    signal.SIGRTMIN, signal.SIGRTMIN + 1, signal.SIGRTMAX,
}  # fmt: skip


@pytest.mark.parametrize("number", sorted(SIGNALS - {signal.SIGKILL, signal.SIGSTOP} - HARMLESS))
def test_each_signal_that_ends_it_does_so_with_outputs_reset(
    running: Callable[[str], subprocess.Popen[str]], tmp_path: Path, number: int
) -> None:
    """SIGKILL and SIGSTOP cannot be caught. Seen to fail for all but TERM, INT and HUP: outputs stayed on."""
    device = tmp_path / "device"
    process = running(task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT))
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    check_reset(device)
    if number in FATAL | {signal.SIGRTMIN}:  # its status says so, and a core is left where one is wanted
        assert process.returncode == -number
    elif number in ASKING:
        assert process.returncode == 0
    else:
        assert (process.returncode, f"signal {number}" in err) == (1, True)


def test_other_signals_do_not_end_it(running: Callable[[str], subprocess.Popen[str]], tmp_path: Path) -> None:
    """A reader that is gone is noticed where something is printed for it, below."""
    device = tmp_path / "device"
    process = running(task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT))
    for number in HARMLESS:
        process.send_signal(number)
    assert process.stdout
    before = json.loads(process.stdout.readline())["step"]
    while json.loads(process.stdout.readline())["step"] < before + 100:
        assert process.poll() is None
    assert set(device.read_text().split()) == {"on"}


def test_a_reader_that_is_gone_ends_it_with_outputs_reset(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: SIGPIPE left the outputs on, status -13."""
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT)
    argv = tasks.argv(text, "--watch", "a.out")
    with subprocess.Popen(argv, stdout=subprocess.PIPE) as process:
        head = subprocess.run(["head", "-3"], stdin=process.stdout, capture_output=True, text=True, check=True)
        assert process.stdout
        process.stdout.close()
        assert process.wait(60) == 0
    assert [json.loads(line)["step"] for line in head.stdout.splitlines()] == [0, 1, 2]
    check_reset(device)


CRASHES = {
    "fault": -signal.SIGSEGV, "abort": -signal.SIGABRT, "exit": 1, "overflow": -signal.SIGSEGV,
    "thread-fault": -signal.SIGSEGV, "thread-exit": 1, "safe-fault": -signal.SIGSEGV, "safe-hang": 1,
}  # fmt: skip


@pytest.mark.parametrize(("manner", "status"), CRASHES.items())
def test_a_block_that_ends_the_process_leaves_outputs_reset(
    tasks: Tasks, tmp_path: Path, manner: str, status: int
) -> None:
    """`safe` runs from the last block to the first. One that crashes there keeps no other block from its own, one that
    hangs no process alive. Seen to fail in all cases: outputs stayed on."""
    device = tmp_path / "device"
    bad = f"bad: {{type: misbehave, parameters: {{manner: {manner}, from: 3}}}}\n"
    blocks = (bad + TRACE.format(file=device)) if manner == "safe-hang" else (TRACE.format(file=device) + bad)
    ended = tasks.run(task(blocks, PATIENT))
    assert ended.status == status, ended.err
    check_reset(device)
    assert ("a block has called exit()" in ended.err) == manner.endswith("exit")


def test_no_step_follows_when_a_late_one_was_given_up(tasks: Tasks, tmp_path: Path) -> None:
    """Nobody reads stderr, and the step ends after all. Seen to fail: `on` after `safe`, and the process lived on."""
    device = tmp_path / "device"
    bad = "bad: {type: misbehave, parameters: {manner: late, from: 3, until: 4, late_s: 5}}\n"
    text = task(bad + TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT)
    unread, full = os.pipe()
    with subprocess.Popen(tasks.argv(text, "--watch", "a.out"), stdout=subprocess.PIPE, stderr=full) as process:
        assert process.stdout
        assert process.stdout.readline()
        flags = fcntl.fcntl(full, fcntl.F_GETFL)
        fcntl.fcntl(full, fcntl.F_SETFL, flags | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(full, bytes(1))
        fcntl.fcntl(full, fcntl.F_SETFL, flags)
        try:
            assert process.wait(60) == 1
        finally:
            process.kill()
            os.close(unread)
            os.close(full)
    check_reset(device)


HEARD = "heard: {{type: udp-receive, parameters: {{port: {port}, length: 1, timeout: 3600}}}}"


def test_a_task_that_waits_for_hours_ends_when_it_is_asked_to(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail where the thread sleeps until its next step: the service manager's patience is two seconds."""
    device = tmp_path / "device"
    waiting = {
        "a step": task(TRACE.format(file=device), "period: 3600 s"),
        "a trigger": task(
            TRACE.format(file=device) + HEARD.format(port=free_port()),
            "period: 3000 s\ntrigger: heard",
        ),
    }
    for text in waiting.values():
        with listening(tmp_path / "notify") as told:
            process = subprocess.Popen(tasks.argv(text), env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")})
            try:
                while b"READY=1" not in told.recv(4096):
                    pass
                process.send_signal(signal.SIGTERM)
                assert process.wait(PATIENCE) == 0
            finally:
                process.kill()
                process.wait()
        assert device.read_text().split()[-2:] == ["safe", "terminated"]
        assert "on" not in device.read_text().split()


def test_a_task_says_that_it_is_alive_for_as_long_as_its_next_step_may_take(tasks: Tasks, tmp_path: Path) -> None:
    """A step comes 1.75 periods after another when the trigger is silent, and the first one after up to three.

    Seen to fail where a task is alive for one period after its last step: then there are 40 words at most.
    """
    argv = tasks.argv(task(HEARD.format(port=free_port()), "period: 500 ms\ntrigger: heard"), "--watch", "heard.flag")
    environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "50000"}
    with listening(tmp_path / "notify") as told, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as rows:
        rows.connect(str(tmp_path / "notify"))  # rows and words in one order: one thread says both
        process = subprocess.Popen(argv, env=environment, stdout=rows.fileno())
        try:
            deadline, words = time.monotonic() + PATIENCE, 0
            while words <= 45:  # one every 12.5 ms; a busy computer's many steps have one that is long enough
                assert time.monotonic() < deadline, "it is silent before its next step"
                said = told.recv(4096)
                words = words + said.count(b"WATCHDOG=1") if b"heard.flag" not in said else 0
        finally:
            process.kill()
            process.wait()


@contextmanager
def listening(path: Path) -> Iterator[socket.socket]:
    """Where a task says how it is, as to the service manager."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(path))
        told.settimeout(PATIENCE)
        yield told
    path.unlink()


def test_a_second_start_is_refused_and_a_killed_one_leaves_no_lock(
    tasks: Tasks, running: Callable[[str], subprocess.Popen[str]]
) -> None:
    text = task("a: {type: gain, in: {in: 1}}")
    first = running(text)
    again = tasks.run(text, "--steps", "1")
    assert again.status == 3
    assert f"runs already, as process {first.pid}; end that first" in again.err
    first.kill()
    first.wait()
    assert tasks.run(text, "--steps", "1").status == 0


def test_outputs_are_reset_after_a_task_was_killed(
    tasks: Tasks, running: Callable[[str], subprocess.Popen[str]], tmp_path: Path
) -> None:
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}")
    process = running(text)
    process.kill()
    process.wait()
    assert device.read_text().split()[-1] == "on"
    assert tasks.run(text, "--safe").status == 0
    assert device.read_text().split()[-2:] == ["safe", "terminated"]


def test_one_task_moves_an_actuator(
    tasks: Tasks, running: Callable[[str], subprocess.Popen[str]], tmp_path: Path
) -> None:
    """Neither another task nor `--safe` touches it meanwhile; a task that was killed holds nothing. Seen to fail: both
    did."""
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT)
    first = running(text)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "link").symlink_to(device)
    other = Tasks(tasks.program, tasks.plugins, tmp_path / "other")
    held = f"held by process {first.pid} ({tasks.program} --blocks"
    for path in (device, tmp_path / "other" / "link"):
        for options in ([], ["--safe"]):
            ended = other.run(task(TRACE.format(file=path)), *options)
            assert ended.status == 1
            assert f'device "{path}" is {held}' in ended.err
    assert set(device.read_text().split()) == {"on"}
    first.kill()
    first.wait()
    assert other.run(task(TRACE.format(file=device)), "--safe").status == 0
    assert other.run(task(TRACE.format(file=device)), "--steps", "1").status == 0
    assert device.read_text().split()[-5:] == ["safe", "terminated", "on", "safe", "terminated"]


def test_outputs_are_reset_where_nobody_hears_of_a_failure(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: the first message ended the process (SIGPIPE), and the second block stayed as it was."""
    device = tmp_path / "device"
    bad = "bad: {type: misbehave, parameters: {manner: start-fail}}\n"
    unread, broken = os.pipe()
    os.close(unread)
    argv = tasks.argv(task(bad + TRACE.format(file=device)), "--safe")
    status = subprocess.run(argv, stderr=broken, timeout=60, check=False).returncode
    os.close(broken)
    assert (status, device.read_text().split()) == (1, ["safe", "terminated"])


def test_steps_allocate_nothing(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: with the plug-in's block that allocates, below."""
    preload = tmp_path / "no_allocation.so"
    compile_shared(PLUGIN / "no_allocation.c", preload)
    environment = {"LD_PRELOAD": str(preload), "NO_ALLOCATION_IN": "task"}
    pid = "b: {type: pid, in: {set_point: 1, measurement: a.out}, parameters: {min: -1, max: 1}}"
    good = task(f"clock: {{type: clock}}\na: {{type: gain, in: {{in: 1}}}}\n{pid}")
    ended = tasks.run(good, "--steps", "20", "--watch", "a.out,b.out", environment=environment)
    assert (ended.status, len(ended.rows)) == (0, 20), ended.err
    bad = tasks.run(task("a: {type: misbehave, parameters: {manner: allocate}}"), environment=environment)
    assert bad.status == 99
    assert "allocation in a control step" in bad.err


def test_a_plugin_of_another_interface_is_refused(tasks: Tasks, tmp_path: Path) -> None:
    compile_shared(PLUGIN / "misbehave.c", tmp_path / "old.so", f"-I{HEADERS}", "-DMISBEHAVE_ABI=999")
    older = Tasks(tasks.program, tmp_path, tmp_path)
    lines = older.refusal(task("a: {type: misbehave, parameters: {manner: fail}}"))
    assert "made for interface 999 of blocks, this is 3; build it anew" in lines[0]
    assert "there is no block misbehave" in lines[-1]


def test_plugins_come_from_several_directories_where_one_may_be_missing(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail when only the first directory is read."""
    own = tmp_path / "own"
    own.mkdir()
    compile_shared(PLUGIN / "loopback.c", own / "loopback.so", f"-I{HEADERS}")
    file = tasks.write(task("bad: {type: misbehave, parameters: {manner: fail}}"))
    for directories in (f"{own}:{tasks.plugins}", f"{tmp_path / 'missing'}:{tasks.plugins}:{own}"):
        argv = [str(tasks.program), "--check", "--blocks", directories, str(file)]
        done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stderr) == (0, "")


def test_the_graph_names_blocks_and_wires(tasks: Tasks) -> None:
    text = task("a: {type: gain, every: 2, in: {in: 1}}\nb: {type: gain, in: {in: a.out}}")
    drawn = subprocess.run(tasks.argv(text, "--dot"), capture_output=True, text=True, check=True).stdout
    assert '"a" -> "b" [label="out → in"]' in drawn
    assert "every 2" in drawn


def test_privileges_that_are_missing_are_named(tasks: Tasks) -> None:
    text = task("a: {type: gain, in: {in: 1}}", "period: 1 ms\npriority: 50")
    argv = ["setpriv", "--inh-caps=-all", "--ambient-caps=-all", "--bounding-set=-all"]
    done = subprocess.run(
        ["prlimit", "--rtprio=0", "--memlock=0", *argv, *tasks.argv(text, "--steps", "3")],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "SCHED_FIFO 50 is refused" in done.stderr
    assert "CAP_SYS_NICE or LimitRTPRIO=" in done.stderr
    assert "memory cannot be locked" in done.stderr


def test_a_leak_of_an_app_is_its_own(flotilla_run: Path) -> None:
    """Sessions of sshd have an adjustment of 0. Seen to fail: apps had -900, all memory and all of it locked."""

    def unit(name: str) -> dict[str, str]:
        lines = flotilla_run.with_name(f"flotilla-{name}@.service").read_text().splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))

    app, control = unit("app"), unit("task")
    assert int(app["OOMScoreAdjust"]) > 0 > int(control["OOMScoreAdjust"])
    assert app["LimitMEMLOCK"] != "infinity"
    assert int(app["TasksMax"]) <= int(control["TasksMax"])
    shares = [int(each["MemoryMax"].removesuffix("%")) for each in (app, control)]
    assert shares[0] < shares[1] < 75, "what kills one process leaves the robot enough"
    assert app["MemorySwapMax"] == control["MemorySwapMax"] == "0"


def test_blocks_are_listed_with_ports_units_and_source(flotilla_run: Path) -> None:
    program = str(flotilla_run.with_name("flotilla-blocks"))
    listed = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert "\ngain " in listed
    detailed = subprocess.run([program, "gain"], capture_output=True, text=True, check=True).stdout
    assert "default 1; tunable" in detailed
    wrong = subprocess.run([program, "gian"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert "the nearest is gain" in wrong.stderr


def test_the_worked_example_is_a_block(tasks: Tasks, tmp_path: Path) -> None:
    """What docs/blocks.md shows compiles without a warning and does what it says."""
    source = tmp_path / "deadband.c"
    source.write_text((paths.PROJECT / "docs" / "blocks.md").read_text().split("```c\n")[1].split("```")[0])
    compile_shared(source, tmp_path / "deadband.so", f"-I{HEADERS}")
    made = Tasks(tasks.program, tmp_path, tmp_path)
    text = task(
        "small: {type: deadband, in: {in: 0.5}, parameters: {width: 1}}\n"
        "large: {type: deadband, in: {in: -1.5}, parameters: {width: 1}}"
    )
    ended = made.run(text, "--steps", "1", "--watch", "small.out,large.out")
    assert [(row["small.out"], row["large.out"]) for row in ended.rows] == [(0, -1.5)]


def test_the_example_tasks_are_right(tasks: Tasks) -> None:
    """As robots get them. Those that talk to others are of the scenarios' fleet."""
    alone = load_fleet()
    single = alone.robots[1].model_copy(update={"control_tasks": ["heading", "heartbeat"]})
    several = virtual.fleet("udp")
    seen = set()
    for fleet, robot in [(alone, single), *((several, robot) for robot in several.robots.values())]:
        for name, content in identity.control_tasks(fleet, robot).items():
            argv = tasks.argv(content.decode(), "--check")
            done = subprocess.run(argv, capture_output=True, text=True, check=False)
            assert (done.returncode, done.stderr) == (0, ""), name
            seen.add(name)
    assert seen == {file.stem for file in paths.TASKS.glob("*.yml")}


def test_what_threads_share_under_thread_sanitizer(flotilla_run: Path) -> None:
    """Seen to fail: rings, triple buffers and changes with relaxed stores are reported as races."""
    directory = flotilla_run.parent.with_name("runtime-threads")
    meson = [str(Path(sys.executable).with_name("meson"))]
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    options = ["-Dtests=true", "-Db_sanitize=thread", "-Dbuildtype=debugoptimized"]
    programs = [f"test_core_{name}" for name in ("change", "ring", "serial")]
    for argv in (
        [*meson, "setup", *(["--reconfigure"] if directory.exists() else []), str(directory), "runtime", *options],
        [*meson, "compile", "-C", str(directory), *programs],
        *([str(directory / "tests" / program)] for program in programs),
    ):
        done = subprocess.run(argv, cwd=paths.PROJECT, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{argv}\n{done.stdout}{done.stderr}"
        assert "WARNING: ThreadSanitizer" not in done.stderr
