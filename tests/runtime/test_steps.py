"""Steps of the executive on this computer: when they are due, what they take, what they may not do."""

from __future__ import annotations

import itertools
import os
import subprocess
import time
from pathlib import Path

import pytest

from tests.runtime.tasks import PLUGIN, Tasks, compile_shared, task

pytestmark = pytest.mark.clock

UNPRIVILEGED = ["setpriv", "--inh-caps=-all", "--ambient-caps=-all", "--bounding-set=-all"]


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


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("every", [1, 3])
def test_an_integrator_takes_input_and_reset_from_one_source(tasks: Tasks, every: int, sign: int) -> None:
    """It is reset at the end of the ramp, or at its begin. Seen to fail: "cycle without delay: sum → ramp → signed →
    high → sum", though `in` of the step before closes no loop."""
    text = task(
        f"""
sum: {{type: integrator, every: {every}, in: {{in: ramp.out, reset: high.on}}, parameters: {{initial: 5}}}}
ramp: {{type: sum, in: {{in0: before.out, in1: 1}}, parameters: {{signs: "++"}}}}
before: {{type: delay, in: {{in: ramp.out}}}}
signed: {{type: gain, in: {{in: ramp.out}}, parameters: {{factor: {sign}}}}}
high: {{type: schmitt-trigger, in: {{in: signed.out}}, parameters: {{on: {sign * 6.5}, off: {sign * 6.5}}}}}
"""
    )
    ended = tasks.run(text, "--steps", "20", "--no-wait", "--watch", "ramp.out,high.on,sum.out")
    assert ended.status == 0, ended.err
    assert [row["ramp.out"] for row in ended.rows] == list(range(1, 21))
    expected = [5.0]
    for row in ended.rows[every::every]:
        before = row["ramp.out"] - 1  # the source's value of the task's step before
        expected.append(5.0 if row["high.on"] else expected[-1] + 0.001 * every * before)
    assert [row["sum.out"] for row in ended.rows[::every]] == pytest.approx(expected, abs=1e-12)
    dot = subprocess.run(tasks.argv(text, "--dot"), capture_output=True, text=True, timeout=60, check=True).stdout
    assert '"ramp" -> "sum" [label="out → in", style=dashed]' in dot


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
    assert (counted["last_overrun"] is None) == (counted["overruns"] == 0)
    assert 0 <= counted["step"]["min_ns"] <= counted["step"]["mean_ns"] <= counted["step"]["max_ns"]


def test_what_a_block_took_is_in_nanoseconds(tasks: Tasks) -> None:
    """It is counted in ticks of another clock. Seen to fail with those printed."""
    late = (
        "quick: {type: gain, in: {in: 1}}\nbad: {type: misbehave, parameters: {manner: late, late_s: 0.035, until: 5}}"
    )
    counted = tasks.run(task(late, "period: 10 ms\noverruns: 0"), "--steps", "5").statistics
    bad, quick, step = counted["blocks"]["bad"], counted["blocks"]["quick"], counted["step"]
    assert counted["last_overrun"]["step"] == 4
    assert counted["last_overrun"]["late_ns"] >= 25e6
    assert 35e6 <= bad["mean_ns"] <= bad["max_ns"]
    assert bad["mean_ns"] + quick["mean_ns"] <= 1.001 * step["mean_ns"]
    assert max(bad["max_ns"], quick["max_ns"]) <= 1.001 * step["max_ns"]


def test_overruns_are_left_out_or_caught_up_with(tasks: Tasks) -> None:
    """A computer that stands still for half a second does not change it: ten periods can be caught up with."""
    late = "bad: {type: misbehave, parameters: {manner: late, from: 3, until: 5, late_s: 0.25}}"
    began_ns = time.monotonic_ns()
    skipping = tasks.run(task(late, "period: 100 ms\noverruns: 0"), "--steps", "12").statistics
    assert began_ns < skipping["last_overrun"]["at_ns"] < time.monotonic_ns()
    assert skipping["overruns"] >= 2
    assert skipping["skipped"] >= 4
    catching_up = tasks.run(task(late, "period: 100 ms\noverrun: catch-up\noverruns: 0"), "--steps", "12").statistics
    assert catching_up["overruns"] >= 4
    assert catching_up["skipped"] == 0


def test_one_stall_is_one_overrun_in_a_row_for_a_task_that_catches_up(tasks: Tasks) -> None:
    """Seen to fail: "step 12 ended … after the next was due, 10 in a row", as each step that made up for it counted."""
    stall = "bad: {type: misbehave, parameters: {manner: late, from: 3, until: 4, late_s: 1.05}}"
    ended = tasks.run(task(stall, "period: 100 ms\noverrun: catch-up"), "--steps", "20")
    assert (ended.status, ended.statistics["steps"]) == (0, 20), ended.err
    assert ended.statistics["overruns"] >= 1


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


def test_all_threads_keep_to_the_tasks_processor(tasks: Tasks) -> None:
    """Seen to fail where the processor is taken after the threads have been started."""
    cpu = max(os.sched_getaffinity(0))
    text = task("a: {type: gain, in: {in: 1}}", f"period: 10 ms\ncpu: {cpu}")
    with subprocess.Popen(tasks.argv(text, "--control", str(tasks.directory / "control")), text=True) as running:
        try:
            threads: dict[str, str] = {}
            until = time.monotonic() + 60
            while "guard" not in threads and time.monotonic() < until:
                threads = {
                    (each / "comm").read_text().strip(): (each / "status").read_text()
                    for each in Path(f"/proc/{running.pid}/task").iterdir()
                }
            assert {"task", "guard"} <= threads.keys()
            for name in ("task", "guard"):
                assert f"Cpus_allowed_list:\t{cpu}\n" in threads[name], f"{name}: {threads[name]}"
        finally:
            running.terminate()


def test_a_processor_that_is_not_there_ends_the_task(tasks: Tasks) -> None:
    ended = tasks.run(task("a: {type: gain, in: {in: 1}}", "period: 10 ms\ncpu: 1023"))
    assert ended.status != 0
    assert "cpu: 1023: the task cannot run there (Invalid argument); this computer has processors 0 to " in ended.err


def test_a_low_limit_of_locked_memory_ends_no_task(tasks: Tasks) -> None:
    """8 MB, as an ordinary user of Debian 12 has; a driver needs a thread.

    Seen to fail: "out: cannot start the driver's thread: Resource temporarily unavailable".
    """
    text = task(
        "a: {type: dsp3000, parameters: {device: /dev/none}}\nb: {type: dsp3000, parameters: {device: /dev/no}}"
    )
    done = subprocess.run(
        ["prlimit", "--memlock=8388608", *UNPRIVILEGED, *tasks.argv(text, "--steps", "3")],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "this user may lock 8192 kB of memory, so that later memory is not locked (CAP_IPC_LOCK or " in done.stderr


def test_privileges_that_are_missing_are_named(tasks: Tasks) -> None:
    text = task("a: {type: gain, in: {in: 1}}", "period: 1 ms\npriority: 50")
    done = subprocess.run(
        ["prlimit", "--rtprio=0", "--memlock=0", *UNPRIVILEGED, *tasks.argv(text, "--steps", "3")],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "SCHED_FIFO 50 is refused" in done.stderr
    assert "CAP_SYS_NICE or LimitRTPRIO=" in done.stderr
    assert "memory cannot be locked" in done.stderr
