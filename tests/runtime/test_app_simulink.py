"""Blocks of the runtime in a Simulink model: what `flotilla-blocks --legacy-code` writes, called as by generated code.

There is no MATLAB here: the script is held against what its manual says of function specifications (test_matlab.py runs
it), the C files are compiled as for a simulation and as for a robot, and run with a model whose code is written as
Embedded Coder writes it.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from flotilla.apps import ert
from flotilla.common import paths
from flotilla.debian import runtime
from flotilla.debian.lock import HOST

INCLUDE = f"-I{paths.PROJECT / 'runtime' / 'include'}"
RTWTYPES = paths.PROJECT / "examples" / "two-rates" / "generated" / "rtwtypes.h"
WARNINGS = ["-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O1"]
ARGUMENT = r"(void \*{1,2}work1|(double|single|boolean|u?int(8|16|32)) [uyp][1-9]\d*(\[\d*\])?|int32 numel\(p\d+\))"
"""Of a function's specification; in the manual of the tool: Declaring Legacy Code Tool Function Specifications."""


def legacy_code(flotilla_run: Path, out: Path, *words: str) -> subprocess.CompletedProcess[str]:
    argv = [flotilla_run.with_name("flotilla-blocks"), "--legacy-code", "--out", out, *words]
    done = subprocess.run(list(map(str, argv)), capture_output=True, text=True, check=False)
    for name in ("rtwtypes.h", "tmwtypes.h"):  # the second is MATLAB's
        shutil.copy(RTWTYPES, out / name)
    return done


def specifications(out: Path, function: str) -> list[str]:
    """Of all blocks in the script."""
    return re.findall(rf"^def\.{function}FcnSpec = '(.*)';$", (out / "flotilla_simulink.m").read_text(), re.MULTILINE)


def test_every_block_that_can_is_written_and_compiles_for_both(flotilla_run: Path, tmp_path: Path) -> None:
    done = legacy_code(flotilla_run, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "clock: left out" not in done.stderr
    steps = specifications(tmp_path, "Output")
    assert len(steps) > 10
    for specification in [*specifications(tmp_path, "Start"), *steps, *specifications(tmp_path, "Terminate")]:
        assert re.fullmatch(rf"void flotilla_\w+\({ARGUMENT}(, {ARGUMENT})*\)", specification)
    for options in ([], ["-DMATLAB_MEX_FILE"]):
        argv = ["cc", *WARNINGS, *options, "-c", INCLUDE, "flotilla_simulink.c", "-o", "made.o"]
        subprocess.run(argv, cwd=tmp_path, check=True)
        needed = subprocess.run(["nm", "-u", "made.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        assert ("fl_inner_step" in needed) == (not options), "a simulation needs nothing of the runtime"


def test_the_script_declares_what_the_header_does(flotilla_run: Path, tmp_path: Path) -> None:
    """Seen to fail with an argument left out of one of the two."""
    legacy_code(flotilla_run, tmp_path, "pid", "dsp3000", "ir104-pbf", "channels=[1, 2]")
    header = (tmp_path / "flotilla_simulink.h").read_text()
    declared = re.findall(r"^void (\w+)\((.*)\);$", header, re.MULTILINE)
    specified = [
        re.match(r"void (\w+)\((.*)\)$", each)
        for each in (*specifications(tmp_path, "Start"), *specifications(tmp_path, "Output"))
    ]
    assert len(specified) == 6
    types = {"double": "real_T", "boolean": "boolean_T", "uint32": "uint32_T", "uint8": "uint8_T", "int32": "int32_T"}
    for match in specified:
        assert match
        wanted = []
        for argument in match[2].split(", "):
            kind, name = argument.split(" ", 1)
            pointed = "[" in name
            const = "const " if pointed and name[0] != "y" else ""
            plain = re.sub(r"numel\(p(\d+)\)", r"n\1", name.partition("[")[0])
            wanted.append(f"{const}{types.get(kind, kind)} {'*' if pointed else ''}{plain}")
        assert (match[1], ", ".join(wanted)) in declared


def test_a_simulation_does_nothing(flotilla_run: Path, tmp_path: Path) -> None:
    legacy_code(flotilla_run, tmp_path, "ir104-pbf", "channels=[1, 2]")
    (tmp_path / "main.c").write_text(
        """
#include "flotilla_simulink.h"
#include <string.h>

int main(void)
{
    void *work = &work;
    boolean_T command[2] = {1, 1}, flag = 1, y1[20], y2 = 7, y3 = 7, y4[2];
    memset(y1, 7, sizeof y1);
    memset(y4, 7, sizeof y4);
    flotilla_ir104_pbf_start(&work, 0);
    flotilla_ir104_pbf_step(work, command, &flag, y1, &y2, &y3, y4);
    flotilla_ir104_pbf_terminate(work);
    return work || y1[0] || y1[19] || y2 || y3 || y4[1];
}
"""
    )
    argv = ["cc", *WARNINGS, "-DMATLAB_MEX_FILE", "main.c", "flotilla_simulink.c", "-o", "simulation"]
    subprocess.run(argv, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "simulation"], check=False).returncode == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["gian"], "there is no block gian; the nearest is gain"),
        (["pid", "kq=1"], "pid: parameters: block pid: pid has no parameter kq; it has kp"),
        (["constant"], "constant: value is an empty list; write PARAMETER=VALUE behind the block"),
        (["udp-receive"], "udp-receive: parameter port cannot be left to Simulink; write port=VALUE behind the block"),
        (["gain", "factor=two"], "parameter factor: two is not a number"),
    ],
)
def test_what_the_tool_cannot_have_is_said(flotilla_run: Path, tmp_path: Path, words: list[str], said: str) -> None:
    done = legacy_code(flotilla_run, tmp_path, *words)
    assert done.returncode == 2
    assert said in done.stderr
    assert not list(tmp_path.glob("flotilla_simulink.*"))


def test_a_place_that_cannot_be_written_is_said(flotilla_run: Path, tmp_path: Path) -> None:
    program = str(flotilla_run.with_name("flotilla-blocks"))
    argv = [program, "--legacy-code", "--out", str(tmp_path / "missing"), "gain"]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert (done.returncode, "flotilla_simulink.m: cannot be written: No such file" in done.stderr) == (2, True)


MODEL_H = """
#ifndef RTW_HEADER_loop_h_
#define RTW_HEADER_loop_h_
#include "rtwtypes.h"
#include "flotilla_simulink.h"
typedef struct { void *pid_PWORK; void *gain_PWORK; void *constant_PWORK; } DW_loop_T;
typedef struct { real_T wanted; real_T measured; } ExtU_loop_T;
typedef struct { real_T command; boolean_T saturated; real_T doubled; real_T three[3]; } ExtY_loop_T;
typedef struct { real_T Kp; real_T Period; uint8_T AntiWindup[8]; } P_loop_T;
typedef struct { const char_T *errorStatus; P_loop_T *defaultParam; DW_loop_T *dwork; } RT_MODEL_loop_T;
extern P_loop_T loop_P;
extern void loop_initialize(RT_MODEL_loop_T *const loop_M);
extern void loop_step(RT_MODEL_loop_T *const loop_M, ExtU_loop_T *loop_U, ExtY_loop_T *loop_Y);
extern void loop_terminate(RT_MODEL_loop_T *const loop_M);
#endif
"""
MODEL_DATA_C = """
#include "loop.h"
P_loop_T loop_P = { 2.0, 0.0, { 99U, 108U, 97U, 109U, 112U, 105U, 110U, 103U } };
"""
MODEL_C = """
#include "loop.h"

void loop_step(RT_MODEL_loop_T *const loop_M, ExtU_loop_T *loop_U, ExtY_loop_T *loop_Y)
{
    const real_T none = 0.0;
    const boolean_T reset = 0U;
    P_loop_T *loop_P = loop_M->defaultParam;
    flotilla_pid_step(loop_M->dwork->pid_PWORK, &loop_U->wanted, &loop_U->measured, &none, &reset,
                      &loop_Y->command, &loop_Y->saturated, loop_P->Kp, 3.0, 0.1, 0.02);
    flotilla_gain_step(loop_M->dwork->gain_PWORK, &loop_U->wanted, &loop_Y->doubled);
    flotilla_constant_step(loop_M->dwork->constant_PWORK, &loop_Y->three[0]);
}

void loop_initialize(RT_MODEL_loop_T *const loop_M)
{
    P_loop_T *loop_P = loop_M->defaultParam;
    flotilla_pid_start(&loop_M->dwork->pid_PWORK, loop_P->Period, 17.0, 3.0, 0.1, 0.02, &loop_P->AntiWindup[0], 8,
                       1.0, 0.0);
    flotilla_gain_start(&loop_M->dwork->gain_PWORK, 0.01);
    flotilla_constant_start(&loop_M->dwork->constant_PWORK, 0.0);
}

void loop_terminate(RT_MODEL_loop_T *const loop_M)
{
    flotilla_pid_terminate(loop_M->dwork->pid_PWORK);
    flotilla_gain_terminate(loop_M->dwork->gain_PWORK);
    flotilla_constant_terminate(loop_M->dwork->constant_PWORK);
}
"""
TASK = """
period: 10 ms
priority: 0
blocks:
  time: {{type: clock}}
  wanted: {{type: gain, in: {{in: time.time}}, parameters: {{factor: 30}}}}
  half: {{type: gain, in: {{in: wanted.out}}, parameters: {{factor: 0.5}}}}
  plain:
    type: pid
    in: {{set_point: wanted.out, measurement: half.out}}
    parameters: {{kp: 2, ki: 3, kd: 0.1, filter: 0.02, min: -4, max: 4}}
  model:
    type: loop
    in: {{wanted: wanted.out, measured: half.out}}
    parameters: {{{parameters}}}
"""


@pytest.fixture
def app(flotilla_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model that calls three blocks, with this computer's compiler in place of the locked one."""

    def command(work: Path, _: str, argv: Sequence[str], *_run: object) -> None:
        subprocess.run([word.replace("/out", str(work)) for word in argv], check=True)

    monkeypatch.setattr(runtime, "command", command)
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    generated = tmp_path / "loop" / ert.GENERATED
    generated.mkdir(parents=True)
    words = ["pid", "min=-4", "max=4", "gain", "factor=2", "constant", "value=[1, -2.5, 3]"]
    done = legacy_code(flotilla_run, generated, *words)
    assert done.returncode == 0, done.stderr
    (generated / "tmwtypes.h").unlink()
    (generated / "loop.h").write_text(MODEL_H)
    (generated / "loop.c").write_text(MODEL_C)
    (generated / "loop_data.c").write_text(MODEL_DATA_C)
    return tmp_path / "loop"


def run(
    flotilla_run: Path, app: Path, *, parameters: str = "", steps: int = 50, task: str = TASK
) -> subprocess.CompletedProcess[str]:
    """The app as `make deploy` makes it, in a task with the same controller outside of the model."""
    out, blocks = app / "source", app / "blocks"
    ert.block(app, "loop", "loop", [], out, HOST)
    blocks.mkdir()
    argv = ["cc", "-std=c11", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC", INCLUDE, "-o"]
    subprocess.run([*argv, blocks / "loop.so", *sorted(out.glob("*.c"))], check=True)
    file = app / "run.yml"
    file.write_text(task.format(parameters=parameters))
    watch = "plain.out,plain.saturated,wanted.out,model.command,model.saturated,model.doubled,model.three[1]"
    options = ["--blocks", str(blocks), "--steps", str(steps), "--no-wait", "--watch", watch]
    return subprocess.run(
        [str(flotilla_run), *options, str(file)], capture_output=True, text=True, timeout=60, check=False
    )


def test_a_model_that_calls_blocks_does_what_the_task_does_with_them(flotilla_run: Path, app: Path) -> None:
    """Its gain is another one when it starts. Seen to fail without fl_inner_tune, and with another period."""
    done = run(flotilla_run, app)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["plain.saturated"] for row in rows} == {0, 1}, "the controller does not reach its limit"
    for row in rows:
        assert row["model.command"] == row["plain.out"]
        assert row["model.saturated"] == row["plain.saturated"]
        assert row["model.doubled"] == 2 * row["wanted.out"]
        assert row["model.three[1]"] == -2.5


def test_the_models_parameters_tune_its_blocks(flotilla_run: Path, app: Path) -> None:
    done = run(flotilla_run, app, parameters="Kp: 0.5")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert rows[1]["model.command"] < rows[1]["plain.out"], done.stderr


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ("Period: 0.015", "inner pid: its period of 0.015 s is not a multiple of the block's, 0.01 s"),
        ("AntiWindup: [1, 2, 3, 4, 5, 6, 7, 8]", "inner pid: parameters: block model: parameter anti_windup: "),
    ],
)
def test_what_fails_in_an_inner_block_ends_the_task(flotilla_run: Path, app: Path, parameters: str, said: str) -> None:
    done = run(flotilla_run, app, parameters=parameters)
    assert (done.returncode, f"model: {said}" in done.stderr) == (4, True), done.stderr


def test_a_value_out_of_range_ends_the_task_in_the_step_that_has_it(flotilla_run: Path, app: Path) -> None:
    source = app / ert.GENERATED / "loop.c"
    text = source.read_text()
    source.write_text(
        text.replace("loop_P->Kp, 3.0, 0.1, 0.02", "loop_P->Kp, 3.0, 0.1, loop_U->wanted > 6 ? -1 : 0.02")
    )
    assert text != source.read_text()
    done = run(flotilla_run, app)
    assert (done.returncode, "model: inner pid: parameter filter: -1 is not allowed" in done.stderr) == (1, True)
    assert len(done.stdout.splitlines()) == 21


def test_ports_that_are_others_than_the_codes_end_the_task(flotilla_run: Path, app: Path) -> None:
    source = app / ert.GENERATED / "flotilla_simulink.c"
    text = source.read_text()
    source.write_text(text.replace('"> double[3]"', '"> double[4]"'))
    assert text != source.read_text()
    done = run(flotilla_run, app)
    assert "inner constant: its ports are > double[3], and the code was made for > double[4]" in done.stderr
    assert done.returncode == 4


ACTUATOR_C = """
#include <flotilla/block.h>
#include <stdio.h>

static int step(struct fl_block *block)
{
    return block->step == 3 ? fl_fail(block, "the valve is stuck") : FL_OK;
}

static void safe(struct fl_block *block)
{
    (void)block;
    fputs("valve closed\\n", stderr);
}

static void terminate(struct fl_block *block)
{
    (void)block;
    fputs("valve left\\n", stderr);
}

FL_BLOCK(valve) = {.abi = FL_ABI, .name = "valve", .step = step, .safe = safe, .terminate = terminate};
"""


def test_an_inner_actuator_fails_and_is_reset_with_the_task(flotilla_run: Path, app: Path) -> None:
    """Also by flotilla-run --safe, which follows a task that was killed, and when a block that starts before it fails.
    Seen to fail without each `fl_inner_safe` of the template, and without fl_inner_end: the model's terminate function
    knows nothing of the valve."""
    generated, blocks = app / ert.GENERATED, app / "blocks"
    blocks.mkdir()
    (app / "valve.c").write_text(ACTUATOR_C)
    argv = ["cc", *WARNINGS, "-shared", "-fPIC", INCLUDE, "-o", str(blocks / "valve.so"), str(app / "valve.c")]
    subprocess.run(argv, check=True)
    model = (generated / "loop.c").read_text()
    calls = [
        ("flotilla_gain_start(&loop_M->dwork->gain_PWORK, 0.01);",
         "flotilla_valve_start(&loop_M->dwork->gain_PWORK, 0);"),
        ("flotilla_gain_step(loop_M->dwork->gain_PWORK, &loop_U->wanted, &loop_Y->doubled);",
         "flotilla_valve_step(loop_M->dwork->gain_PWORK);"),
        ("flotilla_gain_terminate(loop_M->dwork->gain_PWORK);", ""),
    ]  # fmt: skip
    for old, new in calls:
        assert old in model
        model = model.replace(old, new)
    (generated / "loop.c").write_text(model)
    words = ["--blocks", str(blocks), "pid", "min=-4", "max=4", "valve", "constant", "value=[1, -2.5, 3]"]
    assert legacy_code(flotilla_run, generated, *words).returncode == 0
    (generated / "tmwtypes.h").unlink()
    out = app / "source"
    ert.block(app, "loop", "loop", [], out, HOST)
    argv = ["cc", "-std=c11", "-O2", "-shared", "-fPIC", INCLUDE, "-o", str(blocks / "loop.so")]
    subprocess.run([*argv, *map(str, sorted(out.glob("*.c")))], check=True)
    file = app / "run.yml"
    file.write_text(TASK.format(parameters=""))
    argv = [str(flotilla_run), "--blocks", str(blocks), str(file)]
    done = subprocess.run([*argv, "--steps", "9", "--no-wait"], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, "model: inner valve: the valve is stuck" in done.stderr) == (1, True), done.stderr
    assert done.stderr.index("valve closed\n") < done.stderr.index("valve left\n")
    safe = subprocess.run([*argv, "--safe"], capture_output=True, text=True, timeout=60, check=False)
    assert (safe.returncode, safe.stderr) == (0, "valve closed\nvalve left\n")
    file.write_text(TASK.format(parameters="AntiWindup: [1, 2, 3, 4, 5, 6, 7, 8]"))
    broken = subprocess.run([*argv, "--safe"], capture_output=True, text=True, timeout=60, check=False)
    assert broken.returncode == 4
    said = "valve closed\nvalve left\nmodel: inner pid: parameters: "
    assert broken.stderr.startswith(said), "another block stops the reset"
