"""What is given to make's variables reaches a program as it stands, and never a shell."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory

HOSTILE = "a b;touch {file};'\"$HOME`touch {file}`$(touch {file})"
RECORDER = """#!{python}
import json, sys
with open({said!r}, "a") as file:
    file.write(json.dumps(sys.argv[1:]) + "\\n")
"""
GIVEN = {
    "image": ["ROBOT"],
    "kernel": ["BOARD"],
    "flash": ["ROBOT", "DEV", "FORCE"],
    "boot": ["ROBOT"],
    "ssh": ["ROBOT"],
    "verify": ["ROBOT"],
    "size": ["ROBOT"],
    "verify-bundle": ["BUNDLE"],
    "fleet": ["N"],
    "fleet-scale": ["N", "BOARD"],
    "provision": ["PLAYBOOK", "ROBOT"],
    "new-app": ["KIND", "NAME"],
    "deploy": ["ROBOT", "APP", "RUN"],
    "rotate-key": ["KEY"],
    "revoke-key": ["ROBOT"],
    "admit-operator": ["NAME", "KEY_FILE", "DAYS", "FROM", "OUT"],
    "revoke-operator": ["NAME"],
    "backup-keys": ["OUT", "PASSWORD_FILE"],
    "restore-keys": ["FILE", "PASSWORD_FILE"],
    "releases": ["ROBOT"],
    "cve": ["TRACKER"],
    "bench": ["ROBOT"],
    "station": ["PORT", "ADDRESS", "OUT", "REPLAY", "INVENTORY", "SECONDS"],
    "record": ["PORT", "SECONDS", "ADDRESS"],
    "live": ["OUT", "SECONDS"],
    "top": ["OUT", "PORT"],
    "fetch": ["ROBOT", "TASK", "OUT"],
    "convert": ["OUT"],
    "report": ["OUT"],
    "param": ["ROBOT", "TASK", "PARAM", "VALUE"],
    "scope": ["ROBOT", "TASK", "EVERY", "ROWS", "TRIGGER", "BEFORE", "CSV"],
    "latency": ["BOARD", "KERNEL", "PLAN", "TARGET"],
    "latency-accept": ["BOARD", "KERNEL", "PLAN"],
    "boot-time": ["BOARD"],
    "hwcheck": ["ROBOT", "SECONDS"],
    "accept": ["ROBOT", "PLAN", "SECONDS"],
    "scenarios": ["ROBOTS", "SIDE"],
}
WORDS = {
    "provision": "ARGS", "scenarios": "FLIGHTS", "record": "OUT", "live": "PORT", "report": "FILE", "convert": "FILE",
}  # fmt: skip
"""Of which each word is one of the program."""
NEEDED = {"report": {"FILE": "a.mcap"}, "convert": {"FILE": "a.rec b.rec", "OUT": "a.csv"}}
"""What a target does not do without."""


def make(directory: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run make with programs that only note what they are given."""
    programs = directory / "venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", "ansible-playbook"):
        (programs / name).write_text(RECORDER.format(python=sys.executable, said=str(directory / "said")))
        (programs / name).chmod(0o755)
    environment = {
        name: value for name, value in os.environ.items() if name not in ("BUILD", "KEYS", "APPS", "MAKEFLAGS")
    }
    argv = ["make", "-C", str(paths.PROJECT), "-o", "setup", "-o", "setup-tests", f"BUILD={directory}", *words]
    return subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60, check=False)


def programs_said(directory: Path) -> list[list[str]]:
    """The words of each program that ran."""
    return [json.loads(line) for line in (directory / "said").read_text().splitlines()]


@pytest.mark.parametrize("target", GIVEN)
def test_what_is_given_is_one_word(tmp_path: Path, target: str) -> None:
    """Seen to fail where variables stand in commands as they are: APP='x;id' ran id."""
    file = tmp_path / "injected"
    value = HOSTILE.format(file=file)
    given = NEEDED.get(target, {}) | dict.fromkeys(GIVEN[target], value)
    done = make(tmp_path, target, *(f"{name}={each}" for name, each in given.items()))
    assert done.returncode == 0, done.stderr
    assert not file.exists()
    words = programs_said(tmp_path)[0]
    assert sum(value in word for word in words) == len(GIVEN[target]), words


@pytest.mark.parametrize("target", WORDS)
def test_what_is_given_as_words_is_no_command(tmp_path: Path, target: str) -> None:
    file = tmp_path / "injected"
    given = NEEDED.get(target, {}) | {WORDS[target]: f"--check x;touch {file} `touch {file}`"}
    done = make(tmp_path, target, *(f"{name}={each}" for name, each in given.items()))
    assert done.returncode == 0, done.stderr
    assert not file.exists()
    (words,) = programs_said(tmp_path)
    assert [word for word in words if "check" in word or "touch" in word or str(file) in word] == [
        "--check", "x;touch", f"{file}", "`touch", f"{file}`"
    ]  # fmt: skip


def test_each_variable_is_defined_once() -> None:
    """Seen to fail: of two named `measured`, the one that ran the tests' lanes meant the later one's words."""
    defined = re.findall(r"^([A-Za-z_]+) *[:?]?= ", (paths.PROJECT / "Makefile").read_text(), re.MULTILINE)
    assert {name for name in defined if defined.count(name) > 1} == set()
    assert "COSTS" in defined


@pytest.mark.parametrize("name", ["BUILD", "KEYS", "APPS"])
@pytest.mark.parametrize("character", paths.UNFIT.replace("\n", ""))
def test_paths_that_a_shell_would_read_are_refused(name: str, character: str) -> None:
    """By make, before anything is installed, and where Python is started without it."""
    value = f"/tmp/a{character}b"
    given = value.replace("$", "$$").replace("#", "\\#")
    argv = ["make", "-C", str(paths.PROJECT), "-n", "help", f"{name}={given}"]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "is a path with blanks or with a character that means something to a shell; take another" in done.stderr
    assert f"{name}=/tmp/a" in done.stderr
    argv = [sys.executable, "-c", "from flotilla.common import paths; paths.check()"]
    done = subprocess.run(argv, env=os.environ | {name: value}, capture_output=True, text=True, check=False)
    assert f"UserError: {name}={value!a}: is a path with blanks or" in done.stderr


def test_make_and_python_refuse_the_same_paths() -> None:
    (listed,) = re.findall(r"^not_in_paths := (.*)$", (paths.PROJECT / "Makefile").read_text(), re.MULTILINE)
    characters = {each.replace("$$", "$").replace("\\#", "#") for each in listed.split()}
    assert characters == set(paths.UNFIT) - {" ", "\t", "\n"}


@pytest.mark.parametrize("folder", ["my robots/ü'x", "two  blanks", "a\nb", "$HOME", 'quo"te', "100%"])
def test_a_checkout_on_such_a_path_is_refused_at_once(tmp_path: Path, folder: str) -> None:
    """By make, and by the program. Seen to fail: make installed an environment elsewhere, and a card had no keys."""
    checkout = tmp_path / folder / "flotilla"
    shutil.copytree(paths.PROJECT / "flotilla" / "common", checkout / "flotilla" / "common")
    shutil.copy(paths.PROJECT / "Makefile", checkout)
    before = sorted(checkout.rglob("*"))
    for words in (["image", "ROBOT=3"], ["setup"], ["help"]):
        done = subprocess.run(["make", "-C", str(checkout), *words], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert f"{checkout}: this checkout lies on a path with blanks or with a character that means" in done.stderr
    assert sorted(checkout.rglob("*")) == before
    argv = [sys.executable, "-B", "-c", "from flotilla.common import paths; paths.check()"]
    environment = {name: value for name, value in os.environ.items() if name not in ("BUILD", "KEYS", "APPS")}
    done = subprocess.run(
        argv, cwd=checkout, env=environment | {"PYTHONPATH": str(checkout)}, capture_output=True, text=True, check=False
    )
    assert f"UserError: {str(checkout)!a}: this checkout lies on a path with blanks" in done.stderr
    assert done.stderr.count("lies on") == 1
    assert "BUILD" not in done.stderr


@pytest.mark.parametrize("folder", ["ü", "日本", "a-b_c.d,e+f@g~h"])
def test_a_checkout_on_another_path_is_none_of_those(tmp_path: Path, folder: str) -> None:
    shutil.copytree(paths.PROJECT / "flotilla" / "common", tmp_path / folder / "flotilla" / "common")
    shutil.copy(paths.PROJECT / "Makefile", tmp_path / folder)
    subprocess.run(["make", "-C", str(tmp_path / folder), "help"], stdout=subprocess.DEVNULL, check=True)
    argv = [sys.executable, "-c", "from flotilla.common import paths; paths.check()"]
    subprocess.run(argv, cwd=tmp_path / folder, env=os.environ | {"PYTHONPATH": str(tmp_path / folder)}, check=True)


def test_every_command_and_every_playbook_checks_the_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail where make alone did."""
    monkeypatch.setattr(paths, "KEYS", Path("/tmp/my keys"))
    with pytest.raises(UserError, match=r"^KEYS='/tmp/my keys': is a path with blanks"):
        inventory.load_fleet()
    argv = [sys.executable, "-m", "flotilla", "check-fleet"]
    environment = os.environ | {"APPS": "/tmp/my apps", "KEYS": "/tmp/k'k"}
    done = subprocess.run(argv, env=environment, cwd=paths.PROJECT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"""error: KEYS="/tmp/k'k": is a.*\nAPPS='/tmp/my apps': is a .*\n""", done.stderr)


@pytest.mark.parametrize("interrupted", [False, True])
def test_an_environment_that_cannot_be_made_leaves_the_last_one(tmp_path: Path, interrupted: bool) -> None:
    """Seen to fail: without network, a changed lock removed the environment, and nothing came in its place."""
    last, programs = tmp_path / "build/venv", tmp_path / "programs"
    for directory in (last, programs):
        directory.mkdir(parents=True)
    (last / "marker").touch()
    (last / ".complete").touch()
    os.utime(last / ".complete", (0, 0))  # older than the locks
    half = f"#!/bin/sh\nmkdir {last}\n"
    (programs / "python3").write_text(half + ("kill -INT $PPID" if interrupted else "exit 1"))
    (programs / "python3").chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name != "MAKEFLAGS"}
    done = subprocess.run(
        ["make", "-C", str(paths.PROJECT), f"BUILD={tmp_path / 'build'}", f"{last}/.complete"],
        env=environment | {"PATH": f"{programs}:{os.environ['PATH']}"}, capture_output=True, text=True, timeout=60,
        check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert sorted(path.name for path in last.iterdir()) == [".complete", "marker"], done.stderr
    assert not last.with_name("venv.before").exists()


def test_commands_run_in_utf_8_whatever_the_users_locale_is() -> None:
    """Seen to fail: with the path `/home/u/Müller` and a locale of ISO 8859-1, pip's first line had the path's bytes
    encoded twice, and `make setup` ended with `build/venv/bin/pip: not found`."""
    argv = ["make", "--eval=shown: ; @locale charmap", "shown"]
    done = subprocess.run(
        argv, cwd=paths.PROJECT, env=os.environ | {"LC_ALL": "C"}, capture_output=True, text=True, check=True
    )
    assert done.stdout == "UTF-8\n"
