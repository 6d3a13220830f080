"""The scripts for MATLAB, run by GNU Octave: the blocks' script of the Legacy Code Tool, and the function that deploys.

What Octave lacks is in `tests/fixtures/octave/`: it holds each argument against MATLAB's manual, evaluates masks, and
records the calls. It is written after the manual; MATLAB itself was never asked.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from flotilla.apps import app, ert, imported
from flotilla.common import paths
from flotilla.debian import runtime
from flotilla.debian.lock import HOST
from tests.fixtures import ert_rates

pytestmark = pytest.mark.nightly  # Octave, which nothing else needs, is 261 MB

STUBS = paths.PROJECT / "tests" / "fixtures" / "octave"
FUNCTION = paths.PROJECT / "flotilla" / "apps" / "matlab"


class Octave:
    def __init__(self, work: Path) -> None:
        self.work = work
        self.environment = os.environ | {
            "FLOTILLA_CALLS": str(work / "calls"), "FLOTILLA_BUILDS": str(work), "TMPDIR": str(work),
            "HOME": str(work / "home"),
        }  # fmt: skip

    def run(self, text: str, *places: Path) -> subprocess.CompletedProcess[str]:
        before = "warning('off', 'Octave:shadowed-function'); " + "".join(
            f"addpath('{place}'); " for place in (STUBS, *places)
        )
        argv = ["octave-cli", "--no-init-file", "--no-history", "--quiet", "--eval", before + text]
        return subprocess.run(
            argv, cwd=self.work, env=self.environment, capture_output=True, text=True, timeout=120, check=False
        )

    def messages(self, texts: list[str], *places: Path) -> list[str]:
        """What each fails with, one after the other in one process; nothing where it does not fail."""
        tries = "".join(
            f"message = ''; try; {text}; catch e; message = e.message; end; fprintf(2, 'said: %s\\n', message); "
            for text in texts
        )
        done = self.run(tries, *places)
        assert done.returncode == 0, done.stderr
        return [line.removeprefix("said: ") for line in done.stderr.splitlines() if line.startswith("said: ")]

    def calls(self, name: str) -> list[Any]:
        """What was given to a function, call after call."""
        lines = [json.loads(line) for line in (self.work / "calls").read_text().splitlines()]
        return [line["arguments"] for line in lines if line["call"] == name]


@pytest.fixture
def octave(tmp_path: Path) -> Octave:
    (tmp_path / "home").mkdir()
    return Octave(tmp_path)


# --- blocks for Simulink ---


def script(flotilla_run: Path, work: Path, *words: str) -> Path:
    argv = [flotilla_run.with_name("flotilla-blocks"), "--legacy-code", "--out", work, *words]
    done = subprocess.run(list(map(str, argv)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return work / "flotilla_simulink.m"


def test_all_blocks_get_masks_with_named_parameters(flotilla_run: Path, octave: Octave) -> None:
    """Seen to fail with a default in hexadecimal digits, which is no double in MATLAB."""
    done = octave.run(f"run('{script(flotilla_run, octave.work)}')")
    assert done.returncode == 0, done.stderr
    actions = [action for action, _ in octave.calls("legacy_code")]
    assert actions == ["sfcn_cmex_generate", "compile", "sfcn_tlc_generate", "rtwmakecfg_generate"]
    blocks = {path: (function, given, mask) for path, function, given, mask in octave.calls("block")}
    assert len(blocks) > 25
    for path, (function, given, mask) in blocks.items():
        assert path == f"flotilla_blocks/{function.removeprefix('flotilla_')}"
        assert given == [parameter["Name"] for parameter in mask]
    _, given, mask = blocks["flotilla_blocks/pid"]
    assert given[:5] == ["period_s", "kp", "ki", "kd", "filter"]
    tunable = {parameter["Name"]: parameter["Tunable"] for parameter in mask}
    assert (tunable["kp"], tunable["anti_windup"]) == ("on", "off")
    assert "flotilla_blocks/clock" in blocks
    assert octave.calls("save_system") == [["flotilla_blocks", str(octave.work / "flotilla_blocks.slx")]]


def test_the_script_runs_again(flotilla_run: Path, octave: Octave) -> None:
    """While its library is open."""
    made = script(flotilla_run, octave.work, "clock", "gain", "factor=2", "gain", "factor=3")
    again = "state = simulink_state(); state.functions = containers.Map(); simulink_state(state); "
    done = octave.run(f"run('{made}'); {again} run('{made}')")
    assert done.returncode == 0, done.stderr
    assert [path for path, *_ in octave.calls("block")] == 2 * [
        "flotilla_blocks/clock", "flotilla_blocks/gain", "flotilla_blocks/gain_2"
    ]  # fmt: skip


SPOILT = {
    "a type": ("double p1", "int64 p1", "int64 p1 is no argument"),
    "a field": ("def.SampleTime", "def.Sampletime", "other fields than those of the manual"),
    "a number of parameters": ("'Parameters', 'period_s, factor'", "'Parameters', 'factor'", "takes 2 parameters"),
    "a name in the mask": ("'Name', 'factor'", "'Name', 'Position'", "Position is a parameter of every block"),
    "a type in the mask": ("'Value', '0'", "'Value', 'uint8(0)'", "period_s is a uint8 and not a double"),
    "an option of the mask": ("'Evaluate'", "'Evaluated'", "an unknown argument"),
}


def test_what_stands_for_matlab_judges(flotilla_run: Path, octave: Octave) -> None:
    """Otherwise a script that passes would say nothing."""
    made = script(flotilla_run, octave.work, "gain")
    text, scripts = made.read_text(), []
    for number, (old, new, _) in enumerate(SPOILT.values()):
        scripts.append(octave.work / f"spoilt_{number}.m")
        scripts[-1].write_text(text.replace(old, new))
        assert scripts[-1].read_text() != text
    messages = octave.messages([f"clear -f simulink_state; run('{each}')" for each in scripts])
    for (_, _, said), message in zip(SPOILT.values(), messages, strict=True):
        assert said in message


# --- deployment ---

THERE = """\
import-model deploy:
\t@{ echo $@; echo '$(NAME) $(MODEL) $(SAMPLE_TIMES) $(ROBOT) $(APP) $(KEEP)'; } >>said
\t@test -z '$(ZIP)' || cp '$(ZIP)' imported.zip
"""
"""The station computer's Makefile: what it is asked, and the archive."""
SSH = """#!/bin/sh
# Runs on this computer what ssh would run there: as there, one string for a shell. `scp` copies to the home directory.
echo "$0" "$@" >>"$HOME/../argv"
[ "$1" != -V ] || exit ${BROKEN:-0}
[ -z "$REFUSED" ] || exit 255
case "$0" in
*/scp) [ "$5" = "user@station:" ] && exec cp "$4" "$HOME/" ;;
*) [ "$3" = user@station ] && exec sh -c "cd && $4" ;;
esac
exit 9
"""


@pytest.fixture
def station(octave: Octave) -> Octave:
    """A build of the model `three`, and a station computer behind ssh and scp."""
    build, programs = octave.work / "three_ert_rtw", octave.work / "bin"
    ert_rates.write(build)
    (build / "three.mk").write_text("")
    files = ", ".join(f"'{build / name}'" for name in ("three.c", "three.h", "rtwtypes.h", "three.mk"))
    done = octave.run(
        f"buildInfo = struct('files', {{{{{files}}}}}); save('-v7', '{build}/buildInfo.mat', 'buildInfo')"
    )
    assert done.returncode == 0, done.stderr
    programs.mkdir()
    for name in ("ssh", "scp"):
        (programs / name).write_text(SSH)
        (programs / name).chmod(0o755)
    octave.environment["PATH"] = f"{programs}:{octave.environment['PATH']}"
    checkout = octave.work / "home" / "my flotilla"
    checkout.mkdir()
    (checkout / "Makefile").write_text(THERE)
    return octave


GIVEN = "'Station', 'user@station', 'Checkout', '~/my flotilla'"


def test_a_build_is_packed_sent_imported_and_deployed(station: Octave, local_compiler: None, tmp_path: Path) -> None:
    """The archive that arrives becomes an app whose code compiles. Seen to fail with the station computer's directory
    unquoted, and with the archive left on this computer."""
    there = station.work / "home" / "my flotilla"
    done = station.run(f"flotilla_deploy('three', 'Robot', 3, {GIVEN}, 'Keep', true)", FUNCTION)
    assert done.returncode == 0, done.stdout + done.stderr
    said = (there / "said").read_text().splitlines()
    assert [line.split() for line in said] == [
        ["import-model"], ["three", "three"], ["deploy"], ["3", "apps/three", "1"]
    ]  # fmt: skip
    (options,) = station.calls("packNGo")[0]
    assert options["packType"] == "flat"
    assert not Path(options["fileName"]).parent.exists(), "the archive is left on this computer"
    assert not list((station.work / "home").glob("*.zip")) + list((there / "build").iterdir())
    imported.create(there / "imported.zip", "three", [HOST], "three", parent=tmp_path / "apps")
    made = app.load(tmp_path / "apps" / "three")
    assert isinstance(made.description, app.Ert)
    ert.block(made.directory, "three", "three", [], tmp_path / "source", HOST)
    argv = ["cc", "-std=c11", "-Wall", "-Werror", "-fsyntax-only", f"-I{runtime.SOURCE / 'include'}"]
    subprocess.run([*argv, *map(str, (tmp_path / "source").glob("*.c"))], check=True)


def test_only_import(station: Octave) -> None:
    call = f"flotilla_deploy('three', {GIVEN}, 'App', 'other', 'SampleTimes', [0.01 0.02 0.06], 'Deploy', false)"
    done = station.run(call, FUNCTION)
    assert done.returncode == 0, done.stdout + done.stderr
    said = (station.work / "home" / "my flotilla" / "said").read_text()
    assert said.split() == ["import-model", "other", "three", "0.01,0.02,0.06"]


REFUSED = {
    "no robot": ("", f"'three', {GIVEN}", "Robot: is missing; say 'Robot', 3, or 'Deploy', false"),
    "half a robot": ("", f"'three', 'Robot', 1.5, {GIVEN}", "ROBOT"),
    "an option for ssh": ("", "'three', 'Robot', 3, 'Station', '-oProxyCommand=x'", "Station: '-oProxyCommand"),
    "a command": (
        "", "'three', 'Robot', 3, 'Station', 's', 'Checkout', '~/x; reboot'", "Checkout: '~/x; reboot' is not allowed"
    ),
    "a name": ("", f"'three', 'Robot', 3, {GIVEN}, 'App', 'Three'", "App: 'Three' is not allowed; give a small letter"),
    "no build": (
        "", f"'other', 'Robot', 3, {GIVEN}", "buildInfo.mat is missing; build the model first: slbuild('other')"
    ),
    "no key": (
        "setenv('REFUSED', '1')", f"'three', 'Robot', 3, {GIVEN}",
        "scp ended with 255; connect once by hand (ssh user@station), and give it your public key",
    ),
    "no checkout": (
        "setenv('REFUSED', '')", f"'three', 'Robot', 3, {GIVEN.replace('my', 'no')}",
        "'Checkout' (~/no flotilla) has to be the directory of Flotilla there",
    ),
    "no ssh": ("setenv('BROKEN', '127')", f"'three', 'Robot', 3, {GIVEN}", "ssh does not start; install openssh"),
}  # fmt: skip


def test_what_fails_is_said_with_a_remedy(station: Octave) -> None:
    texts = [f"{spoil}; flotilla_deploy({given})" for spoil, given, _ in REFUSED.values()]
    messages = station.messages(texts, FUNCTION)
    for (_, _, said), message in zip(REFUSED.values(), messages, strict=True):
        assert said in message
    assert not list(station.work.glob("oct-*")), "the archive is left on this computer"


def words(command: str) -> list[str]:
    """A command line as a program on Windows takes it apart: here without backslashes before quotation marks."""
    assert not re.search(r'\\"|""', command)
    return [quoted or plain for quoted, plain in re.findall(r'"([^"]*)"|(\S+)', command)]


def test_on_windows_the_same_words_arrive(station: Octave) -> None:
    """No character is outside of quotation marks that cmd.exe reads, and none within that it reads there."""
    done = station.run(f"flotilla_deploy('three', 'Robot', 3, {GIVEN})", FUNCTION, STUBS / "windows")
    assert done.returncode == 0, done.stdout + done.stderr
    commands = [command for (command,) in station.calls("system")]
    assert [words(command)[0] for command in commands] == ["ssh", "scp", "ssh"]
    for command in commands:
        assert not re.search(r"[&|<>^()]", re.sub(r'"[^"]*"', "", command))
        assert not re.search(r"[%!]", command)
    assert words(commands[1])[1:] == ["-q", "-o", "BatchMode=yes", "flotilla-import-three.zip", "user@station:"]
    *_, host, there = words(commands[2])
    assert host == "user@station"
    assert there == (
        "cd ~/'my flotilla' && mkdir -p build && mv ~/flotilla-import-three.zip build/flotilla-import-three.zip && "
        "make import-model ZIP=build/flotilla-import-three.zip NAME=three MODEL=three && "
        "rm build/flotilla-import-three.zip && make deploy ROBOT=3 APP=apps/three"
    )
