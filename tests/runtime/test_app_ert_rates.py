"""A model of three rates in three threads: what it computes, on time and late, and which code keeps one thread."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flotilla.apps import ert
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.debian.lock import HOST
from tests.fixtures import ert_rates

TASK = """\
period: 10 ms
priority: {priority}
overrun: {overrun}
overruns: 0
blocks:
  time: {{type: clock}}
  fast: {{type: gain, in: {{in: time.time}}, parameters: {{factor: 8}}}}
  middle: {{type: gain, in: {{in: time.time}}, parameters: {{factor: -3}}}}
  model: {{type: three, in: {{fast: fast.out, middle: middle.out}}}}
"""
WATCHED = "fast.out,middle.out,model.command,model.filtered,model.updates,model.least"


@dataclass
class Run:
    status: int
    said: str
    rows: list[dict[str, float]]
    rates: list[dict[str, Any]]
    overruns: int

    @property
    def in_real_time(self) -> bool:
        """Whether this computer let the task have its priority; else its rates ran in turn."""
        return "SCHED_FIFO 70 is refused" not in self.said


class Bench:
    def __init__(self, flotilla_run: Path, work: Path) -> None:
        self.flotilla_run, self.work = flotilla_run, work

    @property
    def generated(self) -> Path:
        return self.work / "app" / ert.GENERATED

    def block(self, tasking: str | None = None) -> None:
        ert.block(self.work / "app", "three", "three", [], self.work / "source", HOST, tasking)

    def run(
        self, *options: str, busy: int = 0, priority: int = 0, overrun: str = "skip", tasking: str | None = None,
        steps: int = 25,
    ) -> Run:  # fmt: skip
        ert_rates.write(self.generated, busy)
        self.block(tasking)
        argv = ["cc", "-std=c11", "-O1", "-g", "-Wall", "-Werror", "-shared", "-fPIC", "-o"]
        blocks = self.work / "blocks"
        blocks.mkdir()
        argv += [str(blocks / "three.so"), f"-I{runtime.SOURCE / 'include'}"]
        subprocess.run([*argv, *map(str, sorted((self.work / "source").glob("*.c")))], check=True)
        file, statistics = self.work / "task.yml", self.work / "statistics.json"
        file.write_text(TASK.format(priority=priority, overrun=overrun))
        argv = [str(self.flotilla_run), "--blocks", str(blocks), "--steps", str(steps), "--watch", WATCHED]
        argv += ["--statistics", str(statistics), *options, str(file)]
        done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)
        found = json.loads(statistics.read_text())
        rows = [json.loads(line) for line in done.stdout.splitlines()]
        rates = found["blocks"]["model"].get("rates", [])
        return Run(done.returncode, done.stderr, rows, rates, found["overruns"])


@pytest.fixture
def bench(flotilla_run: Path, local_compiler: None, tmp_path: Path) -> Bench:
    return Bench(flotilla_run, tmp_path)


def judge(run: Run) -> None:
    assert run.status == 0, run.said
    wanted = ert_rates.expected([row["fast.out"] for row in run.rows], [row["middle.out"] for row in run.rows])
    for port, values in zip(("command", "filtered", "updates"), zip(*wanted, strict=True), strict=True):
        assert [row[f"model.{port}"] for row in run.rows] == pytest.approx(values), port
        assert any(values)


def test_three_rates_by_a_clock_that_counts(bench: Bench) -> None:
    """Seen to fail with inputs latched and outputs published in each step, and with the slowest rate released first."""
    run = bench.run("--no-wait")
    judge(run)
    assert [(rate["name"], rate["every"], rate["count"], rate["overruns"]) for rate in run.rates] == [
        ("three_step1", 2, 13, 0), ("three_step2", 6, 5, 0)
    ]  # fmt: skip


@pytest.mark.clock
def test_the_fastest_rate_runs_while_the_slowest_computes_for_three_of_its_periods(bench: Bench) -> None:
    """Values are those of one thread. Seen to fail where each step waited for the rates."""
    run = bench.run(busy=3, priority=70, steps=24)  # the last one releases no rate, and lets all end
    judge(run)
    assert [rate["overruns"] for rate in run.rates] == [0, 0]
    assert [rate["count"] for rate in run.rates] == [12, 4]
    least = min(row["model.least"] for row in run.rows if row["model.updates"])
    assert least >= 3 if run.in_real_time else least == 0


@pytest.mark.clock
def test_an_overrun_of_a_slower_rate_is_counted_or_ends_the_task(bench: Bench, tmp_path: Path) -> None:
    """The slowest rate computes for 8 of its 6 steps. Where no priority is to be had it is awaited instead, and the
    steps that it delays are the overruns."""
    run = bench.run(busy=8, priority=70, steps=20)
    assert run.status == 0, run.said
    assert run.overruns > 0
    if run.in_real_time:
        assert run.rates[1]["overruns"] >= 1
    other = Bench(bench.flotilla_run, tmp_path / "other")
    ended = other.run(busy=8, priority=70, steps=20, overrun="stop-safe")
    assert (ended.status, len(ended.rows) < 20) == (1, True), ended.said
    if ended.in_real_time:
        assert re.search(r"model: three_step2 still ran when it was due again, 1 times in a row", ended.said)


def test_in_one_thread(bench: Bench) -> None:
    """What the key `tasking: single` asks for: outputs of slower rates come in the step itself."""
    run = bench.run("--no-wait", tasking="single")
    assert (run.status, run.rates) == (0, []), run.said
    assert [row["model.updates"] for row in run.rows] == [1 + step // 6 for step in range(25)]
    wanted = ert_rates.expected([row["fast.out"] for row in run.rows], [row["middle.out"] for row in run.rows])
    assert [row["model.command"] for row in run.rows] == pytest.approx([command for command, _, _ in wanted])


def test_a_root_port_of_two_rates_is_refused(bench: Bench) -> None:
    """One thread may use it."""
    ert_rates.write(bench.generated)
    source = bench.generated / "three.c"
    text = source.read_text()
    source.write_text(text.replace("three_DW.steps++;", "three_DW.steps++;\n  three_Y.command += three_U.middle;"))
    assert text != source.read_text()
    said = r"the root port middle is used in every 1\. and every 2\. step of the block; give the port one sample time,"
    with pytest.raises(UserError, match=said):
        bench.block()
    subprocess.run(["rm", "-r", str(bench.work / "source")], check=True)
    bench.block("single")


def test_threads_that_the_code_does_not_permit_are_refused(bench: Bench) -> None:
    """Without the key such code runs in one thread."""
    ert_rates.write(bench.generated)
    for name in ("three.h", "three.c"):
        text = (bench.generated / name).read_text()
        text = re.sub(r"(extern )?void three_step([12])\(void\)", r"static void rate_\2(void)", text)
        text = text.replace("three_step0(void)", "three_step(int tid)").replace("static void rate_1(void);\n", "")
        text = text.replace("static void rate_2(void);\n", "")
        if name == "three.c":
            text += "void three_others(int tid)\n{\n  if (tid == 1)\n    rate_1();\n  else\n    rate_2();\n}\n"
        (bench.generated / name).write_text(text)
    code = ert.collect(bench.generated, "three", out := bench.work / "read")
    model = ert.read("three", ert.preprocess(out, "three", code, HOST), code, [0.01, 0.02, 0.06])
    assert [step.number for step in model.steps] == [0, 1, 2]
    with pytest.raises(UserError, match=r"three\.c: tasking: threads: has no function three_step0; one function for"):
        ert.separate(model, code, wanted=True)
    ert.separate(model, code, wanted=False)
    assert not model.threads
