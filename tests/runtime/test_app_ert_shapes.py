"""Every shape of `tests/fixtures/ert_shapes.py` as a block: response, parameters from the task file and while it runs.

All is compiled by this computer's compiler but for the last test, which takes the locked ones.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
from pathlib import Path

import pytest

from flotilla.apps import app, builder, ert
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.debian.lock import HOST
from flotilla.fleet.model import Fleet
from tests.fixtures.ert_shapes import SHAPES, Shape, write
from tests.running import running

REFUSED = {
    "class": "is C++, and the locked compiler for robots is one for C only; generate C",
    "c++": "is C++, and the locked compiler for robots is one for C only; generate C",
    "solver": "generated/rtw_continuous.h is missing: it is a header of MATLAB's own, which the model's options need;",
    "cmsis": "generated/arm_math.h is missing: it is CMSIS, the library of ARM processors, and robots have none;",
    "custom-code": "generated/pigpio.h is missing: it is neither the coder's nor the C library's, but of code that",
    "board": "generated/MW_gpio.h is missing: it is of a hardware support package, and drives a board; generate for no",
}
ACCEPTED = {name: shape for name, shape in SHAPES.items() if name not in REFUSED}
SILENT = {
    "main": Shape("as r2017b-main, with the model's names", reusable=True, parameters="main"),
    "global": Shape("as global, with the model's names", reusable=True, parameters="global"),
}
"""Were taken once, and had other parameters than generated, set or tuned."""
USED = ACCEPTED | {f"silent-{name}": shape for name, shape in SILENT.items()}
OWN = {"Kp": 1.5, "Limit": 2.0, "Weights": [0.5, 1.0]}
GENERATED = {"Kp": 2.5, "Limit": 10.0, "Weights": [0.25, -0.25]}
BLOCK = "{name}: {{type: model, in: {{error: ramp.out, rates: [1, 2], enable: 1{inputs}}}{more}}}"
TASK = (
    "period: 10 ms\npriority: 0\nblocks:\n  time: {{type: clock}}\n  ramp: {{type: gain, in: {{in: time.time}}}}\n{}\n"
)
STEPS = 23


def test_there_are_as_many_as_were_found_and_most_are_accepted() -> None:
    assert (len(SHAPES), len(ACCEPTED)) == (45, 39)


@pytest.fixture
def work(local_compiler: None, tmp_path: Path) -> Path:
    return tmp_path


def build(shape: Shape, work: Path) -> Path:
    """The directory of the plug-in."""
    write(shape, work / "app" / ert.GENERATED)
    return compiled(shape, work)


def compiled(shape: Shape, work: Path) -> Path:
    """The same, of code that was written."""
    out, blocks = work / "source", work / "blocks"
    ert.block(work / "app", shape.model, "model", [], out, HOST)
    blocks.mkdir()
    options = [
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-Wno-unused-parameter",
        "-fvisibility=hidden",
        "-shared",
        "-fPIC",
    ]
    argv = ["cc", *options, f"-I{runtime.SOURCE / 'include'}", "-o", str(blocks / "model.so")]
    done = subprocess.run([*argv, *map(str, sorted(out.glob("*.c")))], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return blocks


def run(flotilla_run: Path, blocks: Path, task: str, watch: str, *options: str) -> subprocess.CompletedProcess[str]:
    file = blocks.parent / "task.yml"
    file.write_text(task)
    argv = [str(flotilla_run), "--blocks", str(blocks), "--steps", str(STEPS), "--no-wait", "--watch", watch, *options]
    return subprocess.run([*argv, str(file)], capture_output=True, text=True, timeout=60, check=False)


def written(name: str, parameters: dict[str, object] | None = None, shape: Shape | None = None) -> str:
    inputs = ", measurements_current: [0, 0, 0]" if shape and shape.bus else ""
    inputs += ", spare: 0" if shape and shape.signal else ""
    more = f", parameters: {json.dumps(parameters)}" if parameters else ""
    return "  " + BLOCK.format(name=name, inputs=inputs, more=more)


def response(errors: list[float], every: int, parameters: dict[str, object]) -> list[float]:
    """What the shapes' model does."""
    weights, limit, gain = parameters["Weights"], parameters["Limit"], parameters["Kp"]
    assert isinstance(weights, list)
    assert isinstance(limit, float)
    assert isinstance(gain, float)
    commands, total = [], 0.0
    for step, error in enumerate(errors):
        commands.append(max(-limit, min(limit, gain * error - (weights[0] * 1 + weights[1] * 2) + total)))
        if step % every == 0:
            total += 0.5 * error
    return commands


@pytest.mark.parametrize("shape", USED.values(), ids=USED.keys())
def test_a_shape_does_what_the_model_does(flotilla_run: Path, work: Path, shape: Shape) -> None:
    """As generated, and with parameters of the task file; two in one task, or the reason why not."""
    blocks = build(shape, work)
    generated = GENERATED | ({"Limit": math.inf} if shape.infinite else {})
    variants = {"plain": generated} | ({"tuned": OWN} if shape.tunable else {"other": generated})
    texts = [written(name, OWN if name == "tuned" else None, shape) for name in variants]
    command = "out" if shape.io == "custom" else "command"
    groups = [[0], [1]] if shape.once else [[0, 1]]
    for group in groups:
        names = [list(variants)[i] for i in group]
        watch = ",".join(["ramp.out", *(f"{name}.{command},{name}.count" for name in names)])
        done = run(flotilla_run, blocks, TASK.format("\n".join(texts[i] for i in group)), watch)
        assert done.returncode == 0, done.stderr
        rows = [json.loads(line) for line in done.stdout.splitlines()]
        errors = [row["ramp.out"] for row in rows]
        assert len(rows) == STEPS
        for name in names:
            expected = response(errors, shape.every, variants[name])
            assert [row[f"{name}.{command}"] for row in rows] == pytest.approx(expected)
            first = 1 if shape.every == 1 else 0  # a slower rate's outputs come at its next release
            assert [row[f"{name}.count"] for row in rows] == [first + step // shape.every for step in range(STEPS)]
    if shape.once:
        done = run(flotilla_run, blocks, TASK.format("\n".join(texts)), "ramp.out", "--check")
        said = r"the model has global variables \(.+\), so a task can have it once, and block plain is it; generate"
        assert (done.returncode, bool(re.search(said, done.stderr))) == (2, True), done.stderr
    if not shape.tunable:
        done = run(flotilla_run, blocks, TASK.format(written("plain", OWN, shape)), "ramp.out", "--check")
        assert (done.returncode, "Kp" in done.stderr) == (2, True), done.stderr


TUNABLE = {name: shape for name, shape in USED.items() if shape.tunable}


@pytest.mark.parametrize("shape", TUNABLE.values(), ids=TUNABLE.keys())
def test_a_shape_is_tuned_while_it_runs(flotilla_run: Path, work: Path, shape: Shape) -> None:
    blocks, control = build(shape, work), work / "control"
    argv: list[str | Path] = [flotilla_run, "--blocks", blocks, "--control", control, "--watch", "model.command"]
    block = written("model", {"Weights": [-3, 0]}, shape).replace("ramp.out", "0").replace("[1, 2]", "[1, 0]")
    with running(argv, work / "run.yml", TASK.format(block)) as task:
        task.until(lambda row: row["command"] == 3)
        param: list[str | Path] = [
            flotilla_run.with_name("flotilla-param"),
            "--control",
            control,
            "run",
            "model.Limit",
            "2",
        ]
        done = subprocess.run(param, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        task.until(lambda row: row["command"] == 2)


def test_what_a_model_begins_with_is_shown_and_a_task_file_may_set_what_was_generated(
    flotilla_run: Path, work: Path
) -> None:
    """Seen to fail with each parameter written back in each step: 0, as generated, where the model has infinity."""
    blocks, control = build(SHAPES["infinite"], work), work / "control"
    argv: list[str | Path] = [flotilla_run, "--blocks", blocks, "--control", control, "--watch", "model.count"]
    block = "  model: {type: model, in: {error: 4, rates: [0, 0], enable: 1}}"
    with running(argv, work / "run.yml", TASK.format(block)) as task:
        task.until(lambda row: row["count"] > 1)
        param: list[str | Path] = [flotilla_run.with_name("flotilla-param"), "--control", control, "run"]
        listed = subprocess.run(param, capture_output=True, text=True, timeout=60, check=True).stdout
        assert "model.Kp: 2.5, tunable\nmodel.Limit: inf, tunable\n" in listed
    limited = block.replace("enable: 1}", "enable: 1}, parameters: {Limit: 0}")
    for text, command in ((block, 10.0), (limited, 0.0)):
        done = run(flotilla_run, blocks, TASK.format(text), "model.command")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout.splitlines()[0])["model.command"] == command


def test_a_signal_that_its_user_exports_is_an_output(flotilla_run: Path, work: Path) -> None:
    """Seen to fail as a root port that is neither input nor output."""
    done = run(flotilla_run, build(SHAPES["signal"], work), TASK.format(written("model", None, SHAPES["signal"])),
               "ramp.out,model.plant_Sum_1")  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    sums = [0.5 * sum(row["ramp.out"] for row in rows[:step]) for step in range(STEPS)]
    assert [row["model.plant_Sum_1"] for row in rows] == pytest.approx(sums)


@pytest.mark.parametrize(("name", "said"), REFUSED.items(), ids=REFUSED.keys())
def test_a_shape_that_cannot_be_a_block_is_refused_with_the_reason(work: Path, name: str, said: str) -> None:
    with pytest.raises(UserError) as refused:
        build(SHAPES[name], work)
    assert said in str(refused.value)


@pytest.mark.parametrize("name", ["r2024a", "r2014a-nested"])
def test_a_model_that_reports_an_error_ends_the_task(flotilla_run: Path, work: Path, name: str) -> None:
    shape = SHAPES[name]
    write(shape, work / "app" / ert.GENERATED)
    source = work / "app" / ert.GENERATED / "plant.c"
    text = source.read_text()
    failing = text.replace(
        "  /* Outport: '<Root>/count' */", '  if (count_of_steps++ == 3) plant_M->errorStatus = "lost";'
    )
    assert failing != text
    source.write_text(f"static int count_of_steps;\n{failing}")
    done = run(flotilla_run, compiled(shape, work), TASK.format(written("plain")), "plain.command")
    assert (done.returncode, "plain: lost" in done.stderr) == (1, True), done.stderr
    assert len(done.stdout.splitlines()) == 3


def test_types_of_another_size_than_their_names_say_are_refused(work: Path) -> None:
    """As generated for another processor, without the coder's own check."""
    write(SHAPES["r2024a"], work / "app" / ert.GENERATED)
    types = work / "app" / ert.GENERATED / "rtwtypes.h"
    types.write_text(types.read_text().replace("unsigned int uint32_T", "unsigned long uint32_T"))
    with pytest.raises(
        AssertionError, match="count is no uint32 here: generate the model for the processor of the robot"
    ):
        compiled(SHAPES["r2024a"], work)


@pytest.mark.parametrize(("word_size", "accepted"), [("32", "i386"), ("64", "amd64")])
def test_word_sizes_are_the_robots(fleet: Fleet, tmp_path: Path, word_size: str, accepted: str) -> None:
    """By the locked compilers: the coder's own check of word sizes is made, and judges the robot's processor."""
    directory = tmp_path / "model"
    write(Shape("any", reusable=True, word_size=word_size), directory / ert.GENERATED)
    (directory / app.FILE).write_text("kind: ert\nmodel: plant\n")
    (directory / app.TASK).write_text(TASK.format(written("plain", OWN)).replace("priority: 0", "priority: 70"))
    boards = {str(board.architecture): board for board in fleet.boards.values()}
    assert set(boards) == {"i386", "amd64"}
    builder.build(app.load(directory), boards.pop(accepted), tmp_path / "accepted")
    assert (tmp_path / "accepted" / "blocks" / "model.so").is_file()
    ((other, board),) = boards.items()
    with pytest.raises(UserError, match=f"was generated for another size of ulong/long than {other} has; choose the"):
        builder.build(app.load(directory), board, tmp_path / "refused")


MIXER = {
    "rtwtypes.h": "typedef double real_T;\ntypedef float real32_T;\ntypedef unsigned char boolean_T;\n",
    "mixer.h": """\
#include "rtwtypes.h"
typedef enum { Off = 0, On } mode;
typedef struct { real_T speed; boolean_T on; } wheel;
typedef struct { wheel left; wheel right; real32_T yaw[2]; } command;
typedef struct { command wanted; real_T gain; mode state; } ExtU_mixer_T;
typedef struct { wheel made[2]; real_T grid[2][2]; mode state; } ExtY_mixer_T;
extern ExtU_mixer_T mixer_U;
extern ExtY_mixer_T mixer_Y;
extern void mixer_initialize(void);
extern void mixer_step(void);
""",
    "mixer.c": """\
#include "mixer.h"
ExtU_mixer_T mixer_U;
ExtY_mixer_T mixer_Y;
void mixer_initialize(void) {}
void mixer_step(void)
{
  mixer_Y.made[0].speed = mixer_U.gain * mixer_U.wanted.left.speed;
  mixer_Y.made[1].speed = mixer_U.gain * mixer_U.wanted.right.speed;
  mixer_Y.made[1].on = mixer_U.wanted.right.on;
  mixer_Y.grid[1][0] = mixer_U.wanted.yaw[1];
  mixer_Y.state = mixer_U.state;
}
""",
}


def test_a_bus_is_a_port_for_each_of_its_numbers(flotilla_run: Path, work: Path) -> None:
    """Nested, in an array, and with an enumeration. Seen to fail as a root port of a type that is no number."""
    generated = work / "app" / ert.GENERATED
    generated.mkdir(parents=True)
    for name, text in MIXER.items():
        (generated / name).write_text(text)
    blocks = compiled(Shape("mixer", model="mixer"), work)
    inputs = "wanted_left_speed: 2, wanted_left_on: 0, wanted_right_speed: -3, wanted_right_on: 1, wanted_yaw: [5, 7]"
    block = f"  model: {{type: model, in: {{{inputs}, gain: 10, state: 1}}}}"
    outputs = ["made_1_speed", "made_1_on", "made_2_speed", "made_2_on", "grid", "state"]
    done = run(flotilla_run, blocks, TASK.format(block), ",".join(f"model.{name}" for name in outputs))
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout.splitlines()[0])
    assert [row[f"model.{name}"] for name in outputs] == [20, 0, -30, 1, [0, 0, 7, 0], 1]
