"""Co-simulation units as blocks: the new app's (FMI 2.0), that of `tests/fixtures/fmu` (FMI 3.0), and what is refused.

Both run as sources and as a binary. But for the last test, all is compiled by this computer's compiler;
tests/provisioning/test_deploy.py takes the new app to a robot.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from flotilla.apps import app, builder, fmu, scaffold
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.debian.lock import HOST
from flotilla.fleet.model import Fleet
from tests.running import running

TWO_LAGS = paths.PROJECT / "tests/fixtures/fmu"
REFERENCE_MODELS = paths.PROJECT / "tests/fixtures/fmu_reference"
PERIOD_S = 0.01
BINARIES = {"2": "binaries/linux64/{}.so", "3": "binaries/x86_64-linux/{}.so"}


@pytest.fixture
def apps(flotilla_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """An app with a unit of each version, with this computer's compiler in place of the locked one."""

    def command(work: Path, system: object, argv: Sequence[str], *_run: object) -> None:
        assert system == HOST
        runtime.copy_sources(work, "include")
        done = subprocess.run(
            [word.replace("/out", str(work)) for word in argv], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise UserError(done.stderr)

    monkeypatch.setattr(runtime, "command", command)
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    scaffold.create("fmu", "lag", tmp_path)
    shutil.copytree(TWO_LAGS, tmp_path / "two-lags" / "unit")
    shutil.copytree(REFERENCE_MODELS, tmp_path / "reference" / "unit")
    return {"2": tmp_path / "lag", "3": tmp_path / "two-lags", "reference": tmp_path / "reference"}


def read(directory: Path) -> fmu.Unit:
    return fmu.read(*fmu.unpacked(directory, None, directory.parent / "unpacked"))


def build(directory: Path) -> Path:
    """The app's plug-in and unit; the directory of plug-ins."""
    unit, name, out = read(directory), directory.name, directory.parent / "built"
    fmu.block(unit, name, out / "source")
    (out / "blocks").mkdir()
    strict = (*runtime.WARNINGS, "-Wconversion", "-Wshadow")
    (out / "blocks" / f"{name}.so").write_bytes(runtime.compile_plugin(out / "source", HOST, strict))
    fmu.build(unit, name, HOST, out)
    return out / "blocks"


def run(
    flotilla_run: Path, blocks: Path, task: str, *, steps: int = 30, watch: str = "", err: list[str] | None = None
) -> list[dict[str, Any]]:
    """The values of signals in each step; AssertionError with what it says where it fails."""
    file = blocks.parent / "task.yml"
    file.write_text(task)
    argv = [str(flotilla_run), "--blocks", str(blocks), "--steps", str(steps), "--no-wait"]
    argv += ["--watch", watch] if watch else []
    done = subprocess.run([*argv, str(file)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    if err is not None:
        err += done.stderr.splitlines()
    return [json.loads(line) for line in done.stdout.splitlines()]


def make_binary(directory: Path, version: str) -> None:
    """The app's unit as tools export it: packed, its sources compiled."""
    unit, made = read(directory), directory.parent / "made"
    fmu.build(unit, "made", HOST, made)
    place = directory / "unit" / BINARIES[version].format(unit.identifier)
    place.parent.mkdir(parents=True)
    shutil.copyfile(made / fmu.object_of("made"), place)
    shutil.rmtree(directory / "unit" / "sources")
    file = directory / "unit" / fmu.DESCRIPTION
    file.write_text(re.sub(r"<SourceFiles>.*</SourceFiles>", "", file.read_text(), flags=re.DOTALL))
    with zipfile.ZipFile(directory / "exported.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in (directory / "unit").rglob("*"):
            archive.write(path, path.relative_to(directory / "unit"))
    shutil.rmtree(directory / "unit")


def lag(rest: float, time_constant_s: float, steps: int) -> list[float]:
    """A lag's answer to a step, at the end of each period."""
    return [rest * (1 - math.exp(-(k + 1) * PERIOD_S / time_constant_s)) for k in range(steps)]


LAG_TASK = """\
period: 10 ms
priority: 0
blocks:
  plain: {type: lag, in: {u: 2}}
  other: {type: lag, in: {u: plain.y}, parameters: {T: 0.05, gain: -3}}
"""
TWO_LAGS_TASK = """\
period: 10 ms
priority: 0
blocks:
  plain: {type: two-lags, in: {u: [1, -2], hold: 0, status: 0}}
  other:
    type: two-lags
    in: {u: plain.lag_1_y, hold: 1, status: 0}
    parameters: {label: "lag"}
  inverse:
    type: two-lags
    in: {u: [1, 3], hold: 0, status: 0}
    parameters: {T: [0.1, 0.2], gain: 2, sense: 1}
"""


@pytest.mark.parametrize("binary", [False, True], ids=["sources", "binary"])
def test_a_unit_of_fmi_2_does_what_its_equation_says_twice_in_a_task(
    flotilla_run: Path, apps: dict[str, Path], binary: bool
) -> None:
    """Seen to fail with outputs read before the step, and with parameters left as the unit has them."""
    if binary:
        make_binary(apps["2"], "2")
    rows = run(flotilla_run, build(apps["2"]), LAG_TASK, watch="plain.y,other.y")
    plain = lag(2, 0.5, 30)
    assert [row["plain.y"] for row in rows] == pytest.approx(plain, rel=1e-9)
    other = 0.0
    for row, u in zip(rows, plain, strict=True):
        other = -3 * u + (other + 3 * u) * math.exp(-PERIOD_S / 0.05)
        assert row["other.y"] == pytest.approx(other, rel=1e-9)


@pytest.mark.parametrize("binary", [False, True], ids=["sources", "binary"])
def test_a_unit_of_fmi_3_with_variables_of_all_kinds(flotilla_run: Path, apps: dict[str, Path], binary: bool) -> None:
    """Seen to fail with time that stands still, with `T` left as the unit has it, and with its second element lost."""
    if binary:
        make_binary(apps["3"], "3")
    watch = "plain.lag_1_y,inverse.lag_1_y,other.lag_1_y,plain.steps,plain.letters,other.letters,plain.held,other.held"
    rows = run(flotilla_run, build(apps["3"]), TWO_LAGS_TASK, watch=watch)
    for port, rests, times_s in (("plain", (1, -2), (0.5, 1)), ("inverse", (-2, -6), (0.1, 0.2))):
        for element in (0, 1):
            wanted = lag(rests[element], times_s[element], 30)
            assert [row[f"{port}.lag_1_y"][element] for row in rows] == pytest.approx(wanted, rel=1e-6)
    assert [row["plain.steps"] for row in rows] == list(range(1, 31))
    last = rows[-1]
    assert (last["other.lag_1_y"], last["plain.held"], last["other.held"]) == ([0, 0], 0, 1)
    assert (last["plain.letters"], last["other.letters"]) == (len('a "b"'), len("lag"))


OWN_NAMES = """
double json_number(double value), fl_now_ns(double value);
double json_number(double value) { return value; }
double fl_now_ns(double value) { return value; }
"""


def test_a_unit_gets_its_own_functions(flotilla_run: Path, apps: dict[str, Path]) -> None:
    """A binary whose names are also those of the program that loads it, private and public ones. Seen to fail: the
    program's json_number() ended the process, and its fl_now_ns() gave the time for the unit's value."""
    source = apps["2"] / "unit" / "sources" / "lag.c"
    change(source, "#include <math.h>\n", "#include <math.h>\n" + OWN_NAMES)
    change(source, "exp(", "fl_now_ns(1) * json_number(1) * exp(")
    unit = read(apps["2"])
    place = apps["2"] / "unit" / BINARIES["2"].format(unit.identifier)
    place.parent.mkdir(parents=True)
    headers = paths.PROJECT / "flotilla" / "apps" / "fmi"
    subprocess.run(["cc", "-shared", "-fPIC", f"-I{headers}", "-o", place, source, "-lm"], check=True)
    shutil.rmtree(source.parent)
    rows = run(flotilla_run, build(apps["2"]), LAG_TASK, watch="plain.y")
    assert [row["plain.y"] for row in rows] == pytest.approx(lag(2, 0.5, 30), rel=1e-9)


def test_what_the_xml_says(apps: dict[str, Path]) -> None:
    unit = read(apps["3"])
    assert [(each.name, each.type, each.width) for each in unit.inputs] == [
        ("u", "double", 2), ("hold", "boolean", 1), ("status", "int32", 1)
    ]  # fmt: skip
    assert [(each.name, each.type, each.width) for each in unit.outputs] == [
        ("lag_1_y", "double", 2), ("steps", "uint16", 1), ("letters", "uint8", 1), ("held", "boolean", 1)
    ]  # fmt: skip
    said = [(p.name, p.type, p.width, p.start, p.tunable, p.unit, p.min, p.max) for p in unit.parameters]
    assert said[0][:5] == ("T", "double", 2, "", False)
    assert said[1:] == [
        ("gain", "single", 1, "1.0", True, "V/m", -5, 5),
        ("sense", "int64", 1, "0", False, "", -(2.0**63), 2.0**63),
        ("label", "text", 1, 'a "b"', False, "", 0, 0),
    ]
    assert unit.outputs[0].summary == "lag[1].y: of the unit"
    assert (unit.step_s, unit.step_key) == (0.005, "fixedInternalStepSize")


def test_a_tunable_parameter_is_set_while_the_task_runs(flotilla_run: Path, apps: dict[str, Path]) -> None:
    """Seen to fail with `tune` left out of the step."""
    blocks, task, control = build(apps["2"]), apps["2"] / "run.yml", apps["2"] / "control"
    text = "period: 10 ms\npriority: 0\nblocks:\n  lag: {type: lag, in: {u: 1}, parameters: {T: 0.001}}\n"
    command: list[str | Path] = [flotilla_run, "--blocks", blocks, "--control", control, "--watch", "lag.y"]
    with running(command, task, text) as lagging:
        lagging.until(lambda row: row["y"] > 0.99)
        param: list[str | Path] = [flotilla_run.with_name("flotilla-param"), "--control", control, "run"]
        done = subprocess.run([*param, "lag.gain", "5"], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        lagging.until(lambda row: row["y"] > 4.9)
        fixed = subprocess.run([*param, "lag.T", "5"], capture_output=True, text=True, timeout=60, check=False)
        assert (fixed.returncode, "T" in fixed.stderr) == (1, True), "a fixed parameter can be set"


def test_a_unit_finds_its_resources(flotilla_run: Path, apps: dict[str, Path]) -> None:
    (apps["3"] / "unit" / "resources").mkdir()
    (apps["3"] / "unit" / "resources" / "hint.txt").write_text("here it is")
    said: list[str] = []
    run(flotilla_run, build(apps["3"]), TWO_LAGS_TASK, steps=1, err=said)
    assert sum("here it is" in line for line in said) == 3, said


STATUS = "  unit: {type: two-lags, in: {u: [1, 1], hold: 0, status: STATUS}}\n"
STEPS = {
    "discard": ("2", "fmi3DoStep of the unit says discard: asked for it"),
    "error": ("3", "fmi3DoStep of the unit says error: asked for it"),
    "fatal": ("4", "fmi3DoStep of the unit says fatal: asked for it"),
}


@pytest.mark.parametrize(("status", "said"), STEPS.values(), ids=STEPS.keys())
def test_a_step_that_a_unit_refuses_ends_the_task(
    flotilla_run: Path, apps: dict[str, Path], status: str, said: str
) -> None:
    """In its own words, which are still heard: seen to fail with logging ended when real time begins."""
    task = "period: 10 ms\npriority: 0\nblocks:\n" + STATUS.replace("STATUS", status)
    with pytest.raises(AssertionError, match=f"unit: {re.escape(said)}"):
        run(flotilla_run, build(apps["3"]), task)


def test_a_unit_that_has_come_to_its_end_ends_the_task_in_good_order(flotilla_run: Path, apps: dict[str, Path]) -> None:
    """Seen to fail as a failure, after which the service manager starts it again."""
    said: list[str] = []
    task = "period: 10 ms\npriority: 0\nblocks:\n" + STATUS.replace("STATUS", "100")
    run(flotilla_run, build(apps["3"]), task, err=said)
    assert said == [
        "flotilla: task: unit: the unit has come to its end at 0.01 s, as it asks to; the task has no actuators"
    ]


REFERENCE: dict[str, dict[float, float]] = {
    "x": {0.1: 0.9, 1: 0.3486784401, 5: 0.005153775207320112, 8.9: 0.00008464149782874038},
    "x0": {0.1: 1.9916858102703756, 1: 1.509668337511498, 5: -0.8744029139228319, 8.9: -0.04127002195449519},
    "x1": {0.1: -0.1749487011684048, 1: -0.7809002675117097, 5: 1.273735873175349, 8.9: -2.2147275169581078},
    "h": {0.1: 0.9514405, 0.5: 0.13560068699999941, 1: 0.23664368699999475, 2: 0.05488907778900016},
    "v": {0.1: -0.980999999999999, 0.5: 2.64968099999999, 1: -2.255319000000016, 2: -0.3525449129999987},
    "counter": {0.1: 1, 1: 2, 5: 6, 8.9: 9},
}
"""By output and time in s: from Dahlquist_out.csv, VanDerPol_out.csv, BouncingBall_out.csv and Stair_out.csv of the
Reference FMUs 0.0.41, commit 1258711 (github.com/modelica/Reference-FMUs; Modelica Association, BSD 2-Clause)."""


@pytest.mark.parametrize("binary", [False, True], ids=["sources", "binary"])
def test_the_results_are_those_of_the_reference_fmus(flotilla_run: Path, apps: dict[str, Path], binary: bool) -> None:
    """Without wires the unit goes by its start values; it ends at 9 s, by a discarded step that says so.

    Seen to fail where inputs without a wire were refused, where they were set to zero (then `x` stays 1), where
    a discarded step was always a failure, and where a unit's name had no hyphens.
    """
    if binary:
        make_binary(apps["reference"], "2")
    said: list[str] = []
    task = "period: 100 ms\npriority: 0\nblocks:\n  model: {type: reference}\n"
    watch = ",".join(f"model.{name}" for name in REFERENCE)
    rows = run(flotilla_run, build(apps["reference"]), task, steps=200, watch=watch, err=said)
    assert len(rows) == 89, "the step to 9 s is its last"
    for name, wanted in REFERENCE.items():
        got = {time_s: rows[round(time_s / 0.1) - 1][f"model.{name}"] for time_s in wanted}
        assert got == pytest.approx(wanted, rel=1e-9, abs=0), name
    assert [line for line in said if "come to its end at 9 s" in line]


def test_an_input_with_a_wire_is_set(flotilla_run: Path, apps: dict[str, Path]) -> None:
    task = "period: 100 ms\npriority: 0\nblocks:\n  model: {type: reference, in: {k: 2, limit: 3}}\n"
    rows = run(flotilla_run, build(apps["reference"]), task, steps=200, watch="model.x")
    assert len(rows) == 19
    assert rows[4]["model.x"] == pytest.approx(0.8**5, rel=1e-9)


def test_an_input_without_a_start_value_needs_a_wire(flotilla_run: Path, apps: dict[str, Path]) -> None:
    change(apps["3"] / "unit" / fmu.DESCRIPTION, ' causality="input" start="false"', ' causality="input"')
    with pytest.raises(AssertionError, match="block plain: input hold has no wire"):
        run(flotilla_run, build(apps["3"]), TWO_LAGS_TASK.replace("hold: 0, ", ""))


MOST = {"UInt64": 2**64 - 1, "Int64": 2**63 - 1}


@pytest.mark.parametrize("kind", MOST)
def test_the_largest_whole_numbers_come_through(flotilla_run: Path, apps: dict[str, Path], kind: str) -> None:
    """As a start value, and from the task file to a parameter and to an input."""
    description, source = (apps["3"] / "unit" / name for name in (fmu.DESCRIPTION, "sources/two_lags.c"))
    change(
        description,
        "<Binary",
        f'<{kind} name="most" valueReference="20" causality="parameter" variability="tunable" start="{MOST[kind]}"/>'
        f'<{kind} name="much" valueReference="21" causality="input" start="0"/>'
        f'<{kind} name="out" valueReference="20" causality="output"/><{kind} name="in" valueReference="21" '
        'causality="output"/><Binary',
    )
    source.write_text(
        re.sub(rf"^ACCESS\({kind}, .*$", "", source.read_text(), flags=re.MULTILINE) + WHOLE.replace("KIND", kind)
    )
    blocks = build(apps["3"])
    task = TWO_LAGS_TASK.splitlines()[:3]
    inputs = f"u: [1, -2], hold: 0, status: 0, much: {MOST[kind]}"
    task += [f"  a: {{type: two-lags, in: {{{inputs}}}}}"]
    task += [f"  b: {{type: two-lags, in: {{{inputs}}}, parameters: {{most: {MOST[kind] - 1}}}}}"]
    row = run(flotilla_run, blocks, "\n".join(task), steps=1, watch="a.out,a.in,b.out")[0]
    assert (row["a.out"], row["a.in"], row["b.out"]) == (MOST[kind], MOST[kind], MOST[kind] - 1)
    for wrong in (MOST[kind] + 1, -(2**63) - 1):
        with pytest.raises(AssertionError, match=rf"{wrong} is not a"):
            run(flotilla_run, blocks, "\n".join(task).replace(str(MOST[kind] - 1), str(wrong)))


WHOLE = """
static struct { fmi3Instance unit; fmi3KIND value[2]; } whole[8];
static fmi3KIND *place(fmi3Instance unit, fmi3ValueReference which)
{
    static fmi3KIND other;
    for (int i = 0; i < 8 && which >= 20; i++)
        if (!whole[i].unit || whole[i].unit == unit)
            return &(whole[i].unit = unit, whole[i].value)[which - 20];
    return &other;
}
fmi3Status fmi3SetKIND(fmi3Instance c, const fmi3ValueReference w[], size_t n, const fmi3KIND v[], size_t m)
{
    for (size_t i = 0; i < n && n == m; i++)
        *place(c, w[i]) = v[i];
    return n == m ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetKIND(fmi3Instance c, const fmi3ValueReference w[], size_t n, fmi3KIND v[], size_t m)
{
    for (size_t i = 0; i < n && n == m; i++)
        v[i] = *place(c, w[i]);
    return n == m ? fmi3OK : fmi3Error;
}
"""
"""Variables 20 and 21, for the unit of tests/fixtures/fmu."""


def test_a_binary_is_taken_where_sources_are_not_there_or_not_c(flotilla_run: Path, apps: dict[str, Path]) -> None:
    """Seen to fail where the list of sources alone decided: `SourceFiles: reference.c: is not there`."""
    unit, kept = apps["reference"] / "unit", apps["reference"].parent / "kept"
    description = (unit / fmu.DESCRIPTION).read_text()
    make_binary(apps["reference"], "2")
    with zipfile.ZipFile(apps["reference"] / "exported.fmu") as archive:
        archive.extractall(kept)
    (apps["reference"] / "exported.fmu").rename(apps["reference"].parent / "exported.fmu")
    kept.rename(unit)
    (unit / fmu.DESCRIPTION).write_text(description)
    assert "reference.c" in description
    with pytest.raises(UserError, match=r"SourceFiles: reference\.c: is not there"):
        fmu.build(
            read(apps["reference"]), "reference", HOST._replace(architecture="i386"), apps["reference"].parent / "none"
        )
    task = "period: 100 ms\npriority: 0\nblocks:\n  model: {type: reference}\n"
    rows = run(flotilla_run, build(apps["reference"]), task, steps=10, watch="model.counter")
    assert rows[-1]["model.counter"] == 2


def test_an_array_of_a_structural_parameters_size(apps: dict[str, Path]) -> None:
    """As StateSpace of the Reference FMUs has them."""
    change(
        apps["3"] / "unit" / fmu.DESCRIPTION,
        '<Float64 name="u" valueReference="1" causality="input" start="0 0"><Dimension start="2"/>',
        '<UInt64 name="m" valueReference="30" causality="structuralParameter" start="2"/>'
        '<Float64 name="u" valueReference="1" causality="input" start="0 0"><Dimension valueReference="30"/>',
    )
    assert read(apps["3"]).inputs[0].width == 2


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


CODE = {
    "2": ("sources/lag.c", 'guid[] = "{6f', 'guid[] = "{7f', "the guid is {7f", "guid"),
    "3": ("sources/include/token.h", "{f5", "{e5", "another token", "instantiationToken"),
}


@pytest.mark.parametrize("version", CODE)
def test_code_of_another_export_is_said(flotilla_run: Path, apps: dict[str, Path], version: str) -> None:
    file, old, new, reason, key = CODE[version]
    change(apps[version] / "unit" / file, old, new)
    said = (
        rf"the unit does not begin: {re.escape(reason)}.*of another export than unit/modelDescription\.xml, whose {key}"
    )
    with pytest.raises(AssertionError, match=said):
        run(flotilla_run, build(apps[version]), {"2": LAG_TASK, "3": TWO_LAGS_TASK}[version])


def test_a_function_that_the_code_lacks(apps: dict[str, Path]) -> None:
    """Seen to fail: it was missed on the robot, when the task started."""
    change(apps["3"] / "unit" / "sources" / "two_lags.c", "fmi3Terminate", "elsewhere")
    with pytest.raises(UserError, match=r"modelDescription\.xml: its code has no function fmi3Terminate; export the"):
        build(apps["3"])


def shared(out: Path, code: str, *options: str) -> None:
    """A library of that code."""
    out.parent.mkdir(parents=True, exist_ok=True)
    source = out.with_suffix(".c")
    source.write_text(code)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", out, source, *options], check=True)


def test_a_binary_that_robots_cannot_load_is_not_built(apps: dict[str, Path]) -> None:
    """Seen to fail: both were found on the robot, the symbol after the app that was there had been replaced."""
    make_binary(apps["2"], "2")
    kept, unit = apps["2"].parent / "kept", apps["2"] / "unit"
    with zipfile.ZipFile(apps["2"] / "exported.fmu") as archive:
        archive.extractall(unit)
    (apps["2"] / "exported.fmu").unlink()
    place = unit / BINARIES["2"].format("lag")
    place.rename(kept)
    wanting = "double lookup(double); double table(double x) { return lookup(x); }"
    shared(place, wanting, f"-Wl,--no-as-needed,{kept}")
    with pytest.raises(
        UserError, match=r"its code needs what is missing on robots: .*lookup.*; export the unit with all"
    ):
        build(apps["2"])
    shutil.rmtree(apps["2"].parent / "built")
    shared(place.with_name("libtable.so"), "double lookup(double x) { return x; }", "-Wl,-soname,libtable.so")
    shared(place, wanting, f"-L{place.parent}", "-ltable")
    place.with_name("libtable.so").unlink()
    with pytest.raises(UserError, match=r"needs what is missing on robots: libtable\.so"):
        build(apps["2"])


def test_a_binary_is_taken_where_sources_do_not_compile(
    flotilla_run: Path, apps: dict[str, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    """As those that need a library of the exporting tool. Seen to fail with the compiler's error."""
    unit, made = apps["2"] / "unit", apps["2"].parent / "made"
    fmu.build(read(apps["2"]), "made", HOST, made)
    place = unit / BINARIES["2"].format("lag")
    place.parent.mkdir(parents=True)
    shutil.copyfile(made / fmu.object_of("made"), place)
    source = unit / "sources" / "lag.c"
    source.write_text('#include "tool.h"\n' + source.read_text())
    rows = run(flotilla_run, build(apps["2"]), LAG_TASK, watch="plain.y")
    assert [row["plain.y"] for row in rows] == pytest.approx(lag(2, 0.5, 30), rel=1e-9)
    said = capfd.readouterr().err
    assert "unit/modelDescription.xml: takes the unit's binary, because of its sources: " in said
    assert "tool.h: No such file" in said
    shutil.rmtree(unit / "binaries")
    shutil.rmtree(apps["2"].parent / "built")
    with pytest.raises(UserError, match=r"tool\.h: No such file"):
        build(apps["2"])


@pytest.mark.parametrize(("version", "file"), [("2", "lag.c"), ("3", "two_lags.c")])
def test_sources_may_ask_for_their_version(apps: dict[str, Path], version: str, file: str) -> None:
    """As those of the Reference FMUs, of which one file is for all versions. Seen to fail for FMI 2.0."""
    source = apps[version] / "unit" / "sources" / file
    source.write_text(f"#if FMI_VERSION != {version}\n#error of which version?\n#endif\n{source.read_text()}")
    build(apps[version])


def test_a_crash_names_block_and_place(flotilla_run: Path, apps: dict[str, Path]) -> None:
    """Seen to fail: status -11, and not a word."""
    source = apps["2"] / "unit" / "sources" / "lag.c"
    change(source, "fmi2DoStep(", "fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean b)\n"
           "{\n    *(volatile int *)c = 1;\n    return *(volatile int *)8;\n}\nfmi2Status elsewhere(")  # fmt: skip
    said = r"^flotilla: block plain: SIGSEGV at address 0x8, in unit\.so\+0x[0-9a-f]+ \(fmi2DoStep\)$"
    with pytest.raises(AssertionError) as crashed:
        run(flotilla_run, build(apps["2"]), LAG_TASK)
    assert re.search(said, str(crashed.value).replace("\\n", "\n"), re.M), crashed.value


def test_sources_with_headers_of_their_own_and_their_prefix(flotilla_run: Path, apps: dict[str, Path]) -> None:
    """As the standard's own headers do it."""
    source = apps["3"] / "unit" / "sources" / "two_lags.c"
    text = source.read_text()
    functions = r"^(fmi3Status|fmi3Instance|void) (fmi3\w+)\("
    text = re.sub(functions, r"\1 TwoLags_\2(", text, flags=re.MULTILINE)
    source.write_text(re.sub(r"fmi3(Get|Set)##type\(", r"TwoLags_fmi3\1##type(", text))
    rows = run(flotilla_run, build(apps["3"]), TWO_LAGS_TASK, watch="plain.steps")
    assert rows[-1]["plain.steps"] == 30


def test_a_unit_that_a_process_can_have_once(flotilla_run: Path, apps: dict[str, Path]) -> None:
    change(
        apps["2"] / "unit" / fmu.DESCRIPTION,
        "<CoSimulation ",
        '<CoSimulation canBeInstantiatedOnlyOncePerProcess="1" ',
    )
    blocks = build(apps["2"])
    run(flotilla_run, blocks, "\n".join(LAG_TASK.splitlines()[:4]))
    with pytest.raises(AssertionError, match="other: lag is a unit that a task can have once only"):
        run(flotilla_run, blocks, LAG_TASK)


VARIABLE = ' canHandleVariableCommunicationStepSize="true"'
UNFIT = {
    "FMI 3.0": ("3", "10 ms", "8 ms", "fixedInternalStepSize: 0.005: in s, does not divide the block's period of 8 ms"),
    "FMI 2.0": (
        "2",
        "10 ms",
        "30 ms",
        "stepSize: 0.02: in s, does not divide the block's period of 30 ms; take a mult",
    ),
    "too short": ("2", "10 ms", "5 ms", "stepSize: 0.02: in s, does not divide the block's period of 5 ms"),
    "an array": ("3", "T: [0.1, 0.2]", "T: [0.1]", "parameter T has 2 numbers, not 1"),
}


@pytest.mark.parametrize(("version", "old", "new", "said"), UNFIT.values(), ids=UNFIT.keys())
def test_a_task_that_does_not_fit_the_unit_is_refused(
    flotilla_run: Path, apps: dict[str, Path], version: str, old: str, new: str, said: str
) -> None:
    description = apps["2"] / "unit" / fmu.DESCRIPTION
    change(description, VARIABLE, "")
    change(description, "<UnitDefinitions>", '<DefaultExperiment stepSize="2e-2"/><UnitDefinitions>')
    task = {"2": LAG_TASK, "3": TWO_LAGS_TASK}[version]
    assert old in task
    with pytest.raises(AssertionError, match=re.escape(said)):
        run(flotilla_run, build(apps[version]), task.replace(old, new))


def test_a_period_of_several_steps_and_one_that_a_unit_only_prefers(flotilla_run: Path, apps: dict[str, Path]) -> None:
    change(
        apps["2"] / "unit" / fmu.DESCRIPTION,
        "<UnitDefinitions>",
        '<DefaultExperiment stepSize="2e-2"/><UnitDefinitions>',
    )
    assert VARIABLE in (apps["2"] / "unit" / fmu.DESCRIPTION).read_text()
    assert read(apps["2"]).step_s is None
    run(flotilla_run, build(apps["3"]), TWO_LAGS_TASK.replace("10 ms", "15 ms"))


BAD = {
    "no XML": ("3", "<fmiModelDescription", "<<", "modelDescription.xml: not well-formed"),
    "FMI 1.0": ("2", 'fmiVersion="2.0"', 'fmiVersion="1.0"', "fmiVersion: 1.0: cannot be read; export the unit"),
    "model exchange": (
        "3",
        "<CoSimulation",
        "<ModelExchange",
        "CoSimulation: (nothing): is missing, there is only Mode",
    ),
    "a tool": (
        "2",
        "<CoSimulation ",
        '<CoSimulation needsExecutionTool="true" ',
        "needsExecutionTool: true: needs the tool that made it",
    ),
    "no identifier": ("3", '"TwoLags"', '"Two lags"', "modelIdentifier: Two lags: is no identifier of C"),
    "no guid": ("2", " guid=", " other=", "guid: (nothing): is missing, so the code would not know its description"),
    "no token": ("3", " instantiationToken=", " other=", "instantiationToken: (nothing): is missing"),
    "too large": (
        "3",
        '<Dimension start="2"/>',
        '<Dimension start="5000"/>',
        "ModelVariables: 5002: are too many inputs",
    ),
    "no finite step size": ("3", '"0.005"', '"INF"', "fixedInternalStepSize: INF: is no time; a number of seconds"),
    "no step size": ("3", '"0.005"', '"-1"', "fixedInternalStepSize: -1: is no time; a number of seconds above 0"),
    "no type": ("2", '<Real start="0"/>', '<Whole start="0"/>', "u: ScalarVariable: is no type of FMI"),
    "no reference": ("3", 'valueReference="1"', 'valueReference="x"', "u.valueReference: x: is no number"),
    "sizes that change": (
        "3",
        '<Dimension start="2"/>',
        '<Dimension valueReference="20"/>',
        "u.Dimension.start: (nothing): is",
    ),
    "no start": ("2", '<Real start="0.5"', "<Real", "T.start: (nothing): is missing; a parameter has one"),
    "a start of words": ("2", '<Real start="0.5"', '<Real start="slow"', "T.start: slow: is no double"),
    "half an enumerator": ("3", 'declaredType="Sense" start="0"', 'start="0.5"', "sense.start: 0.5: is no int64"),
    "two of one name": (
        "3",
        'name="steps"',
        'name="lag_1_y"',
        "name: lag[1].y: is written lag_1_y in a task, like another out",
    ),
    "a file that is not there": ("2", 'File name="', 'File name="../', "SourceFiles: ../lag.c: is not there"),
}


@pytest.mark.parametrize(("version", "old", "new", "said"), BAD.values(), ids=BAD.keys())
def test_what_cannot_become_a_block_is_said(apps: dict[str, Path], version: str, old: str, new: str, said: str) -> None:
    change(apps[version] / "unit" / fmu.DESCRIPTION, old, new)
    with pytest.raises(UserError) as refused:
        fmu.sources(read(apps[version]), HOST)
    assert f"{apps[version]}/unit/modelDescription.xml" in str(refused.value)
    assert said in str(refused.value)


BAD_BUILD = {
    "no XML": ("<fmiBuildDescription", "<", "not well-formed"),
    "another platform": (
        '"TwoLags">',
        '"TwoLags" platform="x86-linux">',
        "BuildConfiguration: (nothing): none is of TwoLags for x86_64-linux",
    ),
    "a library": ('"m"', '"hdf5"', "Library: hdf5: is a library that robots do not have"),
    "C++": ('"C99"', '"C++11"', "language: C++11: is not C; export the unit as C, or a binary"),
    "outside": (
        '"two_lags.c"',
        '"../../../lag/unit/sources/lag.c"',
        "SourceFile: ../../../lag/unit/sources/lag.c: is not there",
    ),
}


@pytest.mark.parametrize(("old", "new", "said"), BAD_BUILD.values(), ids=BAD_BUILD.keys())
def test_sources_that_cannot_be_compiled_are_said(apps: dict[str, Path], old: str, new: str, said: str) -> None:
    change(apps["3"] / "unit" / "sources" / "buildDescription.xml", old, new)
    with pytest.raises(UserError) as refused:
        fmu.sources(read(apps["3"]), HOST)
    assert "two-lags/unit/sources/buildDescription.xml: " in str(refused.value)
    assert said in str(refused.value)


def test_a_binary_for_another_architecture(apps: dict[str, Path]) -> None:
    make_binary(apps["2"], "2")
    unit = read(apps["2"])
    with pytest.raises(UserError) as refused:
        fmu.binary(unit, HOST._replace(architecture="i386"))
    assert "exported.fmu/binaries/linux32/lag.so: is missing, and the robot is an i386; there are" in str(refused.value)
    (unit.directory / "binaries" / "linux64").rename(unit.directory / "binaries" / "linux32")
    with pytest.raises(UserError, match=r"linux32/lag\.so: is for amd64, not for i386; export it anew"):
        fmu.binary(unit, HOST._replace(architecture="i386"))
    (unit.directory / "binaries" / "linux32" / "lag.so").write_text("MZ")
    with pytest.raises(UserError, match=r"linux32/lag\.so: is no shared object for a PC, not for i386"):
        fmu.binary(unit, HOST._replace(architecture="i386"))


def test_a_unit_that_is_too_large(apps: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    make_binary(apps["2"], "2")
    read(apps["2"])
    monkeypatch.setattr(fmu, "_MOST_BYTES", 4096)
    with pytest.raises(UserError, match=r"exported\.fmu: unpacks to 0 MiB; at most 0 MiB fit a robot"):
        read(apps["2"])


def test_units_that_are_missing_or_too_many(apps: dict[str, Path]) -> None:
    directory, work = apps["2"], apps["2"].parent / "work"
    (directory / "one.fmu").write_text("no archive")
    with pytest.raises(UserError, match=r"lag: has several units or none: one\.fmu, unit; put one \*\.fmu there"):
        fmu.unpacked(directory, None, work)
    assert fmu.unpacked(directory, "unit", work)[0] == directory / "unit"
    with pytest.raises(UserError, match=r"one\.fmu: is not a unit: File is not a zip file; export it anew"):
        fmu.unpacked(directory, "one.fmu", work)
    with pytest.raises(UserError, match=r"lag/app\.yml: unit: two\.fmu: is not there; name the app's \*\.fmu"):
        fmu.unpacked(directory, "two.fmu", work)
    (directory / "unit" / fmu.DESCRIPTION).unlink()
    with pytest.raises(UserError, match=r"unit/modelDescription\.xml is missing; a unit has one at its top"):
        fmu.read(*fmu.unpacked(directory, "unit", work))


def test_the_new_app_as_robots_get_it(fleet: Fleet, flotilla_run: Path, tmp_path: Path) -> None:
    """By the locked compilers, for all boards; here runs what is for this computer."""
    scaffold.create("fmu", "lag", tmp_path)
    built = {}
    for board in fleet.boards.values():
        builder.build(app.load(tmp_path / "lag"), board, tmp_path / board.name)
        heads = {path.read_bytes()[4] for path in (tmp_path / board.name).rglob("*.so")}
        built[board.architecture] = heads
    assert built == {"i386": {1}, "amd64": {2}}
    (out,) = (tmp_path / board.name for board in fleet.boards.values() if board.architecture == "amd64")
    task = (out / app.TASK).read_text().replace("priority: 64", "priority: 0")
    rows = run(flotilla_run, out / "blocks", task, watch="plant.y")
    y = 0.0
    for row in rows:
        u = 3 * (1 - y)
        y = u + (y - u) * math.exp(-PERIOD_S / 0.2)
        assert row["plant.y"] == pytest.approx(y, rel=1e-9)


def test_what_is_refused_is_not_deployed(fleet: Fleet, tmp_path: Path) -> None:
    """Before anything is sent: by the builder, by the compiler and by the runtime."""
    scaffold.create("fmu", "lag", tmp_path)
    board = next(board for board in fleet.boards.values() if board.architecture == "amd64")
    source, description = tmp_path / "lag/unit/sources/lag.c", tmp_path / "lag/unit/modelDescription.xml"
    good = description.read_text()

    def refused(number: int) -> str:
        with pytest.raises(UserError, match="nothing was built") as error:
            builder.build(app.load(tmp_path / "lag"), board, tmp_path / f"out{number}")
        return str(error.value)

    change(description, "<CoSimulation ", '<CoSimulation needsExecutionTool="true" ')
    assert "needsExecutionTool" in refused(1)
    description.write_text(good)
    change(description, VARIABLE, "")
    change(description, "<UnitDefinitions>", '<DefaultExperiment stepSize="0.02"/><UnitDefinitions>')
    assert re.search(r"task\.yml:\d+: .*stepSize: 0\.02: in s, does not divide the block's period of 10 ms", refused(2))
    description.write_text(good)
    change(source, "exp(", "exq(")
    assert re.search(r"lag\.c:\d+:\d+: (warning|error): implicit declaration of function .exq", refused(3))
