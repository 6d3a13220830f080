"""Models by Embedded Coder as blocks: the sample that `make new-app` makes, and what cannot become a block.

Everything runs on this computer and with its compiler; tests/provisioning/test_deploy.py takes it to a robot.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from flotilla.apps import ert, scaffold
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian.lock import HOST


@pytest.fixture
def generated(local_compiler: None, tmp_path: Path) -> Path:
    """The sample's code, model `sample`."""
    scaffold.create("ert", "sample", tmp_path)
    return tmp_path / "sample" / "generated"


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def read(generated: Path, times_s: list[float] | None = None) -> ert.Model:
    out = generated.parent / "read"
    code = ert.collect(generated, "sample", out)
    return ert.read("sample", ert.preprocess(out, "sample", code, HOST), code, times_s or [])


def test_ports_parameters_and_rates_are_the_models(generated: Path) -> None:
    model = read(generated)
    assert [(s.name, s.type, s.width) for s in model.inputs] == [
        ("error", "double", 1), ("rates", "double", 2), ("enable", "boolean", 1)
    ]  # fmt: skip
    assert [(s.name, s.type, s.width) for s in model.outputs] == [("command", "double", 1), ("updates", "uint32", 1)]
    assert [(p.name, p.type, p.width, p.value) for p in model.parameters] == [
        ("Kp", "double", 1, 2.5), ("Ki", "double", 1, 0.5), ("Limit", "double", 1, 10), ("Weights", "double", 2, None),
        ("Integral", "boolean", 1, 1),
    ]  # fmt: skip
    assert [(step.function, step.every) for step in model.steps] == [("sample_step0", 1), ("sample_step1", 5)]
    assert model.period_s == 0.01


def test_all_in_the_models_structure_and_one_rate(generated: Path) -> None:
    """Another setting of the coder: inputs and outputs are part of the model's data structure, one step function."""
    header, source = generated / "sample.h", generated / "sample.c"
    header.write_text(
        """
#include "sample_types.h"
#include <math.h>
typedef struct { real32_T In1[3]; } ExtU_sample_T;
typedef struct { my_speed Out1; } ExtY_sample_T;
struct tag_RTM_sample_T { const char_T *errorStatus; ExtU_sample_T *inputs; ExtY_sample_T *outputs; };
extern void sample_initialize(RT_MODEL_sample_T *const sample_M);
extern void sample_step(RT_MODEL_sample_T *const sample_M);
"""
    )
    change(generated / "sample_types.h", "typedef struct P_", "typedef int16_T my_speed;\ntypedef struct P_")
    (generated / "sample_data.c").unlink()
    source.write_text("")
    model = read(generated)
    assert [(s.name, s.type, s.width) for s in model.inputs] == [("In1", "single", 3)]
    assert [(s.name, s.type, s.width) for s in model.outputs] == [("Out1", "int16", 1)]
    assert model.packed == {"inputs": "inputs", "outputs": "outputs"}
    assert [step.arguments for step in model.steps] == ["&instance->model"]
    assert (model.period_s, model.terminate, model.parameters) == (None, None, [])
    assert "sample_step(&instance->model);" in ert.render(model, "sample")


STEP1 = "extern void sample_step1(RT_MODEL_sample_T *const sample_M, "
RTM = "DW_sample_T *dwork;"
REFUSED = {
    "exported functions": ("sample.h", "sample_step", "sample_tick", "has no function sample_step (it has: sample_in"),
    "a direction": ("sample.h", STEP1, f"{STEP1}real_T *arg_speed, ", "whether the argument arg_speed is an input"),
    "names twice": (
        "sample.h",
        "real_T error; ",
        "real_T error; struct { real_T a; } error_b; real_T error_b_a; ",
        "has 2 inputs named error_b_a",
    ),
    "text": (
        "sample.h",
        "real_T error; ",
        "char *error; ",
        "has a root port error of type char; root ports are numbers",
    ),
    "a bus by pointer": (
        "sample.h",
        STEP1,
        f"{STEP1}struct bus *sample_U_bus, ",
        "has a root port bus of type bus; root",
    ),
    "an allocation": (
        "sample.h",
        STEP1,
        f"extern RT_MODEL_sample_T *sample(void);\n{STEP1}",
        "allocates its structures",
    ),
    "a pointer": (
        "sample.h",
        RTM,
        f"{RTM} void *updates;",
        "uses updates of its real-time model, a pointer that nothing",
    ),
    "no values": (
        "sample_data.c",
        "P_sample_T sample_P = {",
        "double other[] = {",
        "nothing here has their values; sample_",
    ),
    "no rates": ("sample.c", "[0.05s, 0.0s] */\n{", "*/\n{", "has 2 step functions, and 1 sample times are known"),
    "no multiple": ("sample.c", "[0.05s, 0.0s] */\n{", "[0.035s, 0.0s] */\n{", "a step1 each 0.035 s, which is no"),
    "C++": ("sample.h", "typedef struct {", "class sample {", "generated/sample is C++, and the locked compiler for"),
    "no C": ("sample.h", "typedef struct {", "typedef strukt {", "sample.h: sample.h:"),
}


@pytest.mark.parametrize(("file", "old", "new", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_what_cannot_become_a_block_is_said(generated: Path, file: str, old: str, new: str, said: str) -> None:
    for each in generated.glob(file):
        change(each, old, new)
    with pytest.raises(UserError) as refused:
        read(generated)
    assert said in str(refused.value)


def test_a_header_that_is_missing_is_named(generated: Path) -> None:
    """The coder leaves it in a folder of files that models share."""
    (generated / "rtwtypes.h").unlink()
    said = r"rtwtypes\.h is missing: it is part of the generated code, such as the files in slprj/ert/_sharedutils"
    with pytest.raises(UserError, match=said):
        read(generated)


def test_two_files_of_one_name_are_refused_unless_they_are_the_same(generated: Path) -> None:
    shared = generated / "slprj" / "rtwtypes.h"
    shared.parent.mkdir()
    shared.write_text((generated / "rtwtypes.h").read_text())
    assert read(generated).steps
    shutil.rmtree(generated.parent / "read")
    shared.write_text("")
    with pytest.raises(
        UserError, match=r"generated/: two files are named rtwtypes\.h, and differ; leave the model's own"
    ):
        read(generated)


def test_the_period_of_a_single_rate_is_that_of_the_coders_main_program(generated: Path) -> None:
    for old, new in (("_step0", "_step"), ("_step1", "_other")):
        for name in ("sample.h", "sample.c"):
            change(generated / name, f"sample{old}", f"sample{new}")
    said = "* period 0.02 seconds (base rate of the model) here.\n"
    (generated / "ert_main.c").write_text(
        f"/* Attach rt_OneStep to a timer or interrupt service routine with\n {said} */"
    )
    assert read(generated).period_s == 0.02


def test_rates_that_the_code_does_not_tell(generated: Path) -> None:
    change(generated / "sample.c", "Sample time:", "Time:")
    assert [step.every for step in read(generated, [0.002, 0.006]).steps] == [1, 3]


def test_files_that_are_missing(generated: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"generated/other\.h is missing; generated/ holds what Embedded Coder made"):
        ert.block(generated.parent, "other", "sample", [], tmp_path / "out", HOST)


def run(
    flotilla_run: Path,
    generated: Path,
    task: str,
    steps: int,
    watch: str,
    tasking: str | None = None,
    err: list[str] | None = None,
) -> list[dict[str, float]]:
    """The values of signals in each step of a task that uses the block `sample`."""
    out = generated.parent / "source"
    ert.block(generated.parent, "sample", "sample", [], out, HOST, tasking)
    (generated.parent / "blocks").mkdir()
    warnings = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-O2"]
    argv = ["cc", *warnings, "-shared", "-fPIC", f"-I{paths.PROJECT / 'runtime' / 'include'}", "-o"]
    argv += [str(generated.parent / "blocks" / "sample.so"), *map(str, sorted(out.glob("*.c")))]
    subprocess.run(argv, check=True)
    file = generated.parent / "run.yml"
    file.write_text(task)
    argv = [str(flotilla_run), "--blocks", str(generated.parent / "blocks"), "--steps", str(steps), "--no-wait"]
    done = subprocess.run([*argv, "--watch", watch, str(file)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    if err is not None:
        err.append(done.stderr)
    return [json.loads(line) for line in done.stdout.splitlines()]


TASK = """\
period: 10 ms
priority: 0
blocks:
  time: {type: clock}
  ramp: {type: gain, in: {in: time.time}}
  plain: {type: sample, in: {error: ramp.out, rates: [1, 2], enable: 1}}
  tuned:
    type: sample
    in: {error: ramp.out, rates: [1, 2], enable: 1}
    parameters: {Kp: 1, Ki: 100, Limit: 0.03, Weights: [0, 1]}
"""


def controller(errors: list[float], kp: float, ki: float, limit: float, weighted: float) -> list[float]:
    """What the sample's header says its model does: the fast rate sees the integral one slow period later."""
    commands, integral, handed = [], 0.0, 0.0
    for step, error in enumerate(errors):
        if step % 5 == 0:
            handed, integral = integral, max(-limit, min(limit, integral + 0.05 * ki * error))
        commands.append(kp * error - weighted + handed)
    return commands


def test_the_block_does_what_the_model_does_twice_in_a_task(flotilla_run: Path, generated: Path) -> None:
    """Seen to fail with `every` left out of the rates, and with one structure of parameters for both blocks."""
    rows = run(flotilla_run, generated, TASK, 23, "ramp.out,plain.command,tuned.command,plain.updates")
    errors = [row["ramp.out"] for row in rows]
    assert errors[-1] > errors[0], "the ramp does not rise"
    plain = controller(errors, 2.5, 0.5, 10, 0.25 * 1 - 0.25 * 2)
    tuned = controller(errors, 1, 100, 0.03, 2)
    assert [row["plain.command"] for row in rows] == pytest.approx(plain)
    assert [row["tuned.command"] for row in rows] == pytest.approx(tuned)
    assert [row["plain.updates"] for row in rows] == [step // 5 for step in range(23)], "not those of the last release"


def test_in_one_thread_the_outputs_are_those_of_the_step(flotilla_run: Path, generated: Path) -> None:
    rows = run(flotilla_run, generated, TASK, 23, "ramp.out,plain.command,plain.updates", "single")
    expected = controller([row["ramp.out"] for row in rows], 2.5, 0.5, 10, 0.25 * 1 - 0.25 * 2)
    assert [row["plain.command"] for row in rows] == pytest.approx(expected)
    assert [row["plain.updates"] for row in rows] == [1 + step // 5 for step in range(23)]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("10 ms", "5 ms", "the model was generated for a period of 10.0 ms, and runs each 5 ms"),
        ("[0, 1]", "[0, 1, 2]", "parameter Weights has 2 numbers, not 3"),
    ],
)
def test_a_task_that_does_not_fit_the_model_is_refused(
    flotilla_run: Path, generated: Path, old: str, new: str, said: str
) -> None:
    with pytest.raises(AssertionError, match=said):
        run(flotilla_run, generated, TASK.replace(old, new), 1, "plain.command")


def test_a_model_may_ask_for_its_end(flotilla_run: Path, generated: Path) -> None:
    """By a block Stop Simulation, or by the stop time of code of grt.tlc. Seen to fail: the former ran on, the latter
    ended as failed."""
    change(generated / "sample.h", "    } Timing;", "        boolean_T stopRequestedFlag;\n    } Timing;")
    source = generated / "sample.c"
    begin = re.search(r"void sample_step0\([^)]*\)[^{]*\{", source.read_text())
    assert begin
    code = source.read_text()
    source.write_text(code.replace(begin[0], f"static int steps;\n{begin[0]}\n  if (++steps == 6) STOP;\n", 1))
    stopping = source.read_text()
    for how, said in (
        ("sample_M->Timing.stopRequestedFlag = 1", "the model has come to its end, as it asks to (Stop Simulation)"),
        ('sample_M->errorStatus = "Simulation finished"', "the model has come to the stop time that it was generated"),
    ):
        source.write_text(stopping.replace("STOP", how))
        for left in ("source", "blocks"):
            shutil.rmtree(generated.parent / left, ignore_errors=True)
        out: list[str] = []
        rows = run(flotilla_run, generated, SINGLE, 23, "plain.updates", err=out)
        assert (len(rows), said in out[0]) == (5, True), out


SINGLE = """\
period: 10 ms
priority: 0
blocks:
  plain: {type: sample, in: {error: 1, rates: [1, 2], enable: 1}}
"""


def test_macros_of_the_coders_build_are_defined(generated: Path) -> None:
    """In defines.txt, as packNGo leaves them. Seen to fail with 3 where the code has 30."""
    (generated / "defines.txt").write_text("MODEL=sample\nGAIN=10\n-DRT\n")
    header = generated / "sample.h"
    change(
        header,
        "typedef struct {",
        "#if GAIN == 10 && defined(RT)\n#define WIDE 30\n#else\n#define WIDE 3\n#endif\ntypedef struct {",
    )
    change(header, "real_T error;", "real_T error[WIDE];")
    assert read(generated).inputs[0].width == 30
    options = ert.block(generated.parent, "sample", "sample", [], generated.parent / "source", HOST)
    assert options == ["-DMODEL=sample", "-DGAIN=10", "-DRT"]
    for text, said in (("a b\n", "line 1: a b: is no macro; a line is NAME or"), ("X=1\nX=2\n", "X=1 and X=2; leave")):
        (generated / "defines.txt").write_text(text)
        shutil.rmtree(generated.parent / "read")
        with pytest.raises(UserError, match=said):
            read(generated)


MAIN = """\
  /* Attach rt_OneStep to a timer or interrupt service routine with
   * period 0.02 seconds (base rate of the model) here.
   */
"""
"""What the coder's main programs of R2015a to R2023b say, but for the words in parentheses."""


def test_a_model_of_one_rate_is_held_to_the_period_that_its_main_program_says(
    flotilla_run: Path, generated: Path, tmp_path: Path
) -> None:
    """Seen to fail where only step functions with numbers say their rates: the model ran at twice its rate."""
    for file in (generated / "sample.h", generated / "sample.c"):
        text = re.sub(r"^extern void sample_step1\(.*?;\n", "", file.read_text(), flags=re.MULTILINE | re.DOTALL)
        file.write_text(text.replace("sample_step0", "sample_step"))
    (generated / "ert_main.c").write_text(MAIN)
    with pytest.raises(AssertionError, match=r"generated for a period of 20\.0 ms, and runs each 10 ms"):
        run(flotilla_run, generated, TASK, 1, "plain.command")
    code = ert.collect(generated, "sample", out := tmp_path / "collected")
    read_by = ert.preprocess(out, "sample", code, HOST)
    said = "sample_times: 0.01: is not what the code was generated for: its main program has 0.02; leave the key out"
    with pytest.raises(UserError, match=said):
        ert.read("sample", read_by, code, [0.01])
    counted = replace(code, sources=f"{code.sources}\nsample_M->Timing.stepSize0 = 0.04;\n")
    assert ert.read("sample", read_by, counted, []).period_s == 0.04
    with pytest.raises(UserError, match=r"generated for: Timing\.stepSize0 has 0\.04; leave the key out"):
        ert.read("sample", read_by, counted, [0.02])
