"""What is given to make's variables reaches a program as it stands, and never a shell."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.cli import make as front_door
from flotilla.cli import make_help
from flotilla.cli.main import commands
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.reference.commands import MAKEFILES, other_targets

HOSTILE = "a b;touch {file};'\"$HOME`touch {file}`$(touch {file})#"
RECORDER = """#!{python} -S
import json, os, sys
with open({said!r}, "a") as file:
    file.write(json.dumps([sys.argv[1:], dict(os.environ)]) + "\\n")
"""
TARGETS = front_door.targets(commands())
TEXT = "".join((paths.PROJECT / name).read_text() for name in MAKEFILES)


def given(target: str, *, words: bool) -> dict[str, front_door.Argument]:
    """A variable of each argument of a target that takes a text, or words; of several that exclude each other one."""
    command, of_make = TARGETS[target]
    own = front_door.own_parser(command)
    others = {id(action) for group in own._mutually_exclusive_groups for action in group._group_actions[1:]}
    known = front_door.variables(own, of_make) - set(front_door.GLOBAL)
    return {
        each.name: each
        for each in front_door.arguments(own, of_make)
        if each.name in known and each.action.nargs != 0 and each.variable.words == words
        and id(each.action) not in others and each.variable.only_with in ("", *known - {"TARGET"})
    }  # fmt: skip


def needed(target: str) -> dict[str, str]:
    """Variables of its example."""
    return dict(word.split("=", 1) for word in shlex.split(TARGETS[target][1].example or TARGETS[target][0].example))


def make(directory: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run make with programs that only note what they are given."""
    programs = directory / "venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", "ansible-playbook"):
        (programs / name).write_text(RECORDER.format(python=sys.executable, said=str(directory / "said")))
        (programs / name).chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name not in ("BUILD", "KEYS", "APPS")}
    argv = ["make", "-C", str(paths.PROJECT), *UNPREPARED, f"BUILD={directory}", *words]
    return subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60, check=False)


UNPREPARED = [
    word for target in ("", "-station", "-lab", "-runtime", "-tests") for word in ("-o", f"setup{target}")
]  # fmt: skip


def programs_said(directory: Path) -> list[list[str]]:
    """The words of each program that ran; of `flotilla make TARGET` those that the command line makes of it."""
    noted = [json.loads(line) for line in (directory / "said").read_text().splitlines()]
    return [
        front_door.words(commands(), words[3], environment) if words[:3] == ["-m", "flotilla", "make"] else words
        for words, environment in noted
    ]


ONE_WORD = [target for target in TARGETS if given(target, words=False)]
SEVERAL_WORDS = [target for target in TARGETS if given(target, words=True)]


@pytest.mark.parametrize("target", [*ONE_WORD, "bench"])
def test_what_is_given_is_one_word(tmp_path: Path, target: str) -> None:
    """Seen to fail where variables stand in commands as they are: APP='x;id' ran id; and where make exports values
    expanded: `$HOME` became `OME`."""
    file = tmp_path / "injected"
    value = HOSTILE.format(file=file)
    variables = ["ROBOT"] if target == "bench" else [*given(target, words=False)]
    words = {} if target == "bench" else dict.fromkeys(given(target, words=True), "a")
    done = make(
        tmp_path, target, *(f"{name}={each}" for name, each in (words | dict.fromkeys(variables, value)).items())
    )
    assert done.returncode == 0, done.stderr
    assert not file.exists()
    said = programs_said(tmp_path)[0]
    assert sum(word == value or word.partition("=")[2] == value for word in said) == len(variables), said


@pytest.mark.parametrize("target", SEVERAL_WORDS)
def test_what_is_given_as_words_is_no_command(tmp_path: Path, target: str) -> None:
    file = tmp_path / "injected"
    (name,) = given(target, words=True)
    values = needed(target) | {name: f"--check x;touch {file} `touch {file}`"}
    done = make(tmp_path, target, *(f"{name}={each}" for name, each in values.items()))
    assert done.returncode == 0, done.stderr
    assert not file.exists()
    (words,) = programs_said(tmp_path)
    found = [word.removeprefix("--signature=") for word in words]
    at = found.index("--check")
    assert found[at : at + 5] == ["--check", "x;touch", f"{file}", "`touch", f"{file}`"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("image ROBOT=3", "image -- 3"),
        ("images", "image --all"),
        ("kernel", "kernel"),
        ("flash ROBOT=3 CARD=card FORCE=word", "flash --file=card --force=word -- 3"),
        ("flash ROBOT=3 DEV=/dev/sdX", "flash -- 3 /dev/sdX"),
        ("bundle SIGNATURES='a b'", "bundle --signature=a --signature=b"),
        ("fleet N=4 LINK=ibss", "fleet --link=ibss -- up 4"),
        ("fleet-status", "fleet -- status"),
        ("fleet-down", "fleet -- down"),
        ("wheeled N=2 ROOM=corner", "wheeled --room=corner -- 2"),
        ("update ROBOT=3 ON=guests ARGS='-e stop_tasks=true'",
         "provision --robot=3 --guests --playbook=update -- -e stop_tasks=true"),
        ("releases JSON=1", "releases --json"),
        ("releases JSON=0", "releases"),
        ("releases JSON=", "releases"),
        ("rotate-key KEY=operator RETIRE=1", "rotate-key --retire -- operator"),
        ("admit-operator NAME=a KEY_FILE=k FROM=10.0.0.0/8", "admit-operator --from=10.0.0.0/8 -- a k"),
        ("init FLEET=dir", "init -- dir"),
        ("backup-keys OUT=file", "backup-keys -- file"),
        ("import-model ZIP=z NAME=n SAMPLE_TIMES=1,2", "import-model --sample-times=1,2 -- z n"),
        ("station ADDRESS=::1 OUT=f", "station --page-address=::1 --record=f"),
        ("record OUT='a b' PORT=1 ADDRESS=::1", "record --live=1 --live-address=::1 -- 'a b'"),
        ("live PORT=1 OUT=f", "live --record=f -- 1"),
        ("top ASK=1 PORT=1 OUT=f", "top --ask --record=f --live=1"),
        ("param ROBOT=1 TASK=t PARAM=p VALUE=-1 CONFIRM=2", "param --confirm=2 -- 1 t p -1"),
        ("scope ROBOT=1 TASK=t SIGNALS='a b'", "scope -- 1 t a b"),
        ("hwcheck TARGET=ssh:a@b NAME=n", "hwcheck --target=ssh:a@b --name=n"),
        ("scenarios ON=lockstep FLIGHTS='udp dds'", "scenarios --lockstep -- udp dds"),
        ("convert FILE='a b' OUT=o TOPIC=t", "convert --topic=t -- o a b"),
        ("radio-capacity UPDATE=1 INVENTORY=i", "radio-capacity --inventory=i --update"),
    ],
)  # fmt: skip
def test_variables_are_arguments(given: str, words: str) -> None:
    target, *variables = shlex.split(given)
    environment = dict(each.split("=", 1) for each in variables)
    environment |= {front_door.GOALS: target, front_door.NAMES: " ".join(environment)}
    assert shlex.join(front_door.words(commands(), target, environment)) == words


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            "image ROBT=3",
            "make image ROBT=…: there is no such variable; the nearest is ROBOT, `make help TARGET=image`",
        ),
        ("image ROBOT=3 SEED=1", "make image SEED=…: there is no such variable; `make help TARGET=image` shows those"),
        ("images ROBOT=3", "make images ROBOT=…: there is no such variable; "),
        ("check-fleet image SEED=1", "make check-fleet image SEED=…: there is no such variable; "),
        ("test TEIR=unit", "make test TEIR=…: there is no such variable; take TIER PART COSTS"),
        ("setup ROBOT=1", "make setup ROBOT=…: there is no such variable; none is needed"),
        ("image", "say which: make image ROBOT=…"),
        ("flash ROBOT=3", "say which: make flash DEV=… or CARD=…"),
        ("fleet", "say which: make fleet N=…"),
        ("convert OUT=a.csv", "say which: make convert FILE=…"),
        ("rotate-key", "say which: make rotate-key ROBOT=… or KEY=…"),
        ("param ROBOT=1 TASK=t VALUE=1", "say which: make param PARAM=…"),
        ("scenarios ON=guest", "ON=guest: take guests or lockstep"),
    ],
)
def test_a_variable_that_is_unknown_or_missing_is_named(tmp_path: Path, given: str, said: str) -> None:
    """Seen to fail: `make image ROBT=3` named no variable, and `make lock ONYL=x` resolved all locks."""
    done = make(tmp_path, *given.split())
    if done.returncode:  # make itself
        assert said in done.stderr
        return
    with pytest.raises(UserError, match=re.escape(said)):
        programs_said(tmp_path)


def test_a_variable_of_one_target_may_stand_beside_others(tmp_path: Path) -> None:
    done = make(tmp_path, "check-fleet", "image", "ROBOT=3", "V=0")
    assert done.returncode == 0, done.stderr
    assert programs_said(tmp_path) == [["check-fleet"], ["image", "--", "3"]]


def test_the_environment_gives_way_to_the_command_line() -> None:
    """And alone, it counts: `ROBOT=3 make image`. A name there that no target has is no error."""
    environment = {"ROBOT": "3", "NAME": "desktop", "SEED": "1", front_door.GOALS: "hwcheck"}
    assert front_door.words(commands(), "hwcheck", environment) == ["hwcheck", "--", "3"]
    typed = {"TARGET": "ssh:a@b", front_door.NAMES: "TARGET"}
    assert front_door.words(commands(), "hwcheck", environment | typed) == [
        "hwcheck", "--target=ssh:a@b", "--name=desktop"
    ]  # fmt: skip


def test_a_make_below_another_does_not_check_names(tmp_path: Path) -> None:
    """Variables of the first one's command line are in its MAKEFLAGS. Seen to fail: `make runtime` of `power-cuts`."""
    environment = os.environ | {"MAKELEVEL": "1", "MAKEFLAGS": " -- BOARD=x86_64"}
    argv = ["make", "-n", "-C", str(paths.PROJECT), f"BUILD={tmp_path}", "clean"]
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_makefile_has_the_declared_targets_and_variables() -> None:
    lists = dict(re.findall(r"^(\w+) := (.*)$", TEXT.replace("\\\n", " "), re.MULTILINE))
    for group in ("build", "station"):
        assert lists[f"{group}_targets"].split() == sorted(
            name for name, (command, _) in TARGETS.items() if command.packages == group
        )
    assert lists["variables_of_all"].split() == [*front_door.GLOBAL]


def test_the_makefile_is_short() -> None:
    assert len((paths.PROJECT / "Makefile").read_text().splitlines()) <= 150


@pytest.mark.parametrize("target", TARGETS)
def test_each_variable_of_a_target_sets_one_argument(target: str) -> None:
    """Or each of its values one, as of ON=guests and ON=lockstep."""
    command, of_make = TARGETS[target]
    found = [
        (name, each.variable.value)
        for each in front_door.arguments(front_door.own_parser(command), of_make)
        for name in each.variable.names
    ]
    assert len(found) == len(set(found))
    assert {*of_make.given, *(of_make.takes or ()), *of_make.needs} <= {name for name, _ in found}


@pytest.mark.parametrize("target", TARGETS)
def test_each_example_is_a_command(target: str) -> None:
    """Seen to fail with an example without ROBOT=."""
    variables = needed(target)
    environment = variables | {front_door.GOALS: target, front_door.NAMES: " ".join(variables)}
    words = front_door.words(commands(), target, environment)
    front_door.own_parser(TARGETS[target][0]).parse_args(words[1:])


@pytest.mark.parametrize("target", ["ssh ROBOT=1", "station", "provision"])
def test_the_inventory_reaches_every_program(tmp_path: Path, target: str) -> None:
    """Whether programs use it: tests/unit/test_param.py."""
    programs = tmp_path / "venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "python").write_text(f'#!/bin/sh\necho "$INVENTORY" >>{tmp_path}/said\n')
    (programs / "python").chmod(0o755)
    argv = ["make", "-s", "-C", str(paths.PROJECT), *target.split(), f"BUILD={tmp_path}", "INVENTORY=/of/others"]
    subprocess.run([*argv, *UNPREPARED], capture_output=True, text=True, check=True)
    assert set((tmp_path / "said").read_text().split()) == {"/of/others"}


@pytest.mark.parametrize("target", ["wheeled", "scenarios", "test"])
def test_a_command_with_a_fleet_of_its_own_refuses_another(target: str) -> None:
    argv = ["make", "-C", str(paths.PROJECT), "-n", target, "INVENTORY=/of/others"]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert (done.returncode, f"INVENTORY=/of/others: {target} has a fleet of its own" in done.stderr) == (2, True)


def test_each_variable_is_defined_once() -> None:
    """Seen to fail: of two named `measured`, the one that ran the tests' lanes meant the later one's words."""
    defined = re.findall(r"^([A-Za-z_]+) *[:?]?= ", TEXT, re.MULTILINE)
    assert {name for name in defined if defined.count(name) > 1} == set()
    assert "COSTS" in defined


def make_help_of(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["make", "-C", str(paths.PROJECT), "-s", "help", *words], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("about", ["", "all", *TARGETS])
def test_help_fits_a_terminal(about: str) -> None:
    """Seen to fail: 57 of 104 lines were longer, the longest 197 characters."""
    text = make_help.text(commands(), about)
    assert [line for line in text.splitlines() if len(line) > make_help.WIDTH] == []
    done = make_help_of(f"TARGET={about}")
    assert done.returncode == 0
    assert done.stdout == text or (about == "all" and set(text.split()) < set(done.stdout.split()))


def test_help_shows_the_twenty_that_people_use() -> None:
    lines = make_help_of().stdout.splitlines()
    assert "  flash        write a card and read it back" in lines
    assert sum(line.startswith("  ") for line in lines) == 20


@pytest.mark.parametrize("target", [name for rows in other_targets().values() for name in rows])
def test_help_of_a_target_without_a_command_has_its_variables(target: str) -> None:
    """Those that make takes."""
    shown = make_help_of(f"TARGET={target}").stdout
    taken = set(" ".join(re.findall(rf"^variables_{target} := (.*)$", TEXT, re.MULTILINE)).split()) - {"COSTS", "PART"}
    if target == "test-all":
        taken |= {"PART"}
    assert set(re.findall(r"\b([A-Z_]+)=", shown)) == taken


def test_help_of_an_unknown_target_is_an_error() -> None:
    done = make_help_of("TARGET=flush")
    assert (done.returncode, done.stdout) == (2, "")
    assert "TARGET=flush: no such target; see make help TARGET=all" in done.stderr


@pytest.mark.parametrize("name", ["BUILD", "KEYS", "APPS", "INVENTORY"])
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


def copy_a_part(checkout: Path) -> None:
    """A checkout with the files that `make help` and `flotilla.common.paths` read."""
    for name in ("Makefile", "docs/reference/targets.txt", "flotilla/__init__.py"):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(paths.PROJECT / name, checkout / name)
    shutil.copytree(paths.PROJECT / "flotilla" / "common", checkout / "flotilla" / "common")


@pytest.mark.parametrize("folder", ["my robots/ü'x", "two  blanks", "a\nb", "$HOME", 'quo"te', "100%"])
def test_a_checkout_on_such_a_path_is_refused_at_once(tmp_path: Path, folder: str) -> None:
    """By make, and by the program. Seen to fail: make installed an environment elsewhere, and a card had no keys."""
    checkout = tmp_path / folder / "flotilla"
    copy_a_part(checkout)
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
    copy_a_part(tmp_path / folder)
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
    (last / ".build").touch()
    os.utime(last / ".build", (0, 0))  # older than the locks
    half = f'#!/bin/sh\ncase $1 in -m) ;; *) exec {sys.executable} "$@" ;; esac\nmkdir {last}\n'
    (programs / "python3").write_text(half + ("kill -INT $PPID" if interrupted else "exit 1"))
    (programs / "python3").chmod(0o755)
    done = subprocess.run(
        ["make", "-C", str(paths.PROJECT), f"BUILD={tmp_path / 'build'}", f"{last}/.build"],
        env=os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}, capture_output=True, text=True, timeout=60,
        check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert sorted(path.name for path in last.iterdir()) == [".build", "marker"], done.stderr
    assert not last.with_name("venv.before").exists()


def test_commands_run_in_utf_8_whatever_the_users_locale_is() -> None:
    """Seen to fail: with the path `/home/u/Müller` and a locale of ISO 8859-1, pip's first line had the path's bytes
    encoded twice, and `make setup` ended with `build/venv/bin/pip: not found`."""
    argv = ["make", "--eval=shown: ; @locale charmap", "shown"]
    done = subprocess.run(
        argv, cwd=paths.PROJECT, env=os.environ | {"LC_ALL": "C"}, capture_output=True, text=True, check=True
    )
    assert done.stdout == "UTF-8\n"


def checkout(directory: Path) -> Path:
    """What `make setup` reads, with an environment that was made there by a Python that is still there."""
    for name in ("Makefile", "images", "pyproject.toml", "requirements"):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).symlink_to(paths.PROJECT / name)
    programs = directory / "build" / "venv" / "bin"
    programs.mkdir(parents=True)
    real = Path(sys.executable).resolve()
    (programs / "python3").symlink_to(real)
    (programs.parent / "lib" / real.name).mkdir(parents=True)
    (programs.parent / "pyvenv.cfg").write_text(f"command = {real} -m venv {programs.parent}\n")
    (programs / "pip").write_text("#!/bin/sh\nexit 0\n")
    (programs / "pip").chmod(0o755)
    (programs.parent / ".build").touch()
    (programs.parent / ".installed").write_text(f"{directory}\n")
    return directory


def setup(directory: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    inherited = {name: value for name, value in os.environ.items() if name not in ("BUILD", "PYTHON3")}
    return subprocess.run(
        ["make", "-C", str(directory), "setup", *words], env=inherited | environment, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip


def without_venv(directory: Path) -> Path:
    """A Python that makes no environment, but says where it should."""
    python = directory / "python3"
    python.write_text(
        f'#!/bin/sh\ncase $1 in -m) echo "makes $3" >&2; exit 1 ;; *) exec {sys.executable} "$@" ;; esac\n'
    )
    python.chmod(0o755)
    return python


def test_a_good_environment_is_left_alone(tmp_path: Path) -> None:
    done = setup(checkout(tmp_path), PYTHON3="/bin/false")
    assert (done.returncode, done.stderr) == (0, "")


def test_a_moved_checkout_gets_an_environment_of_its_own(tmp_path: Path) -> None:
    """Seen to fail: a copy of a checkout ran the code of the first, and after a move nothing ran."""
    checkout(tmp_path / "first")
    (tmp_path / "first").rename(tmp_path / "second")
    python = without_venv(tmp_path)
    said = setup(tmp_path / "second", PYTHON3=str(python)).stderr.splitlines()
    assert said[:2] == [
        "build/venv was made in another place: it is made anew", f"makes {tmp_path / 'second/build/venv'}"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("place", "was made in another place"),
        ("python", "was made by a Python that is gone"),
        ("version", "was made by another version of Python"),
        ("", ""),
    ],
)
def test_why_an_environment_cannot_be_used(tmp_path: Path, damage: str, said: str) -> None:
    """Such as after a move, the removal of pyenv's Python, or an upgrade of the system."""
    venv = checkout(tmp_path / "a b" / "first") / "build" / "venv"
    if damage == "place":
        venv = venv.rename(tmp_path / "venv")
    elif damage == "python":
        (venv / "bin/python3").unlink()
        (venv / "bin/python3").symlink_to(tmp_path / "python3.11")
    elif damage == "version":
        (found,) = (venv / "lib").iterdir()
        found.rename(venv / "lib" / "python3.1")
    argv = [str(paths.PROJECT / "images" / "environment-state"), str(venv)]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, said, "")


def test_an_editable_install_is_of_this_checkout(tmp_path: Path) -> None:
    """Where BUILD= names a place that stays: seen to fail, the first checkout's code ran."""
    first = checkout(tmp_path / "first")
    (first / "build/venv/.installed").write_text("/another/place\n")
    assert setup(first, PYTHON3="/bin/false").returncode == 0
    assert (first / "build/venv/.installed").read_text() == f"{first}\n"


@pytest.mark.parametrize("version", ["3.10.12", "2.7.18"])
def test_an_old_python_is_refused_before_anything_is_installed(tmp_path: Path, version: str) -> None:
    """Seen to fail with Python 3.10: packages were installed by sudo, then pip said which of uv's it did not find."""
    old = tmp_path / "old python"
    old.write_text(f"#!/bin/sh\necho {version}\nexit 1\n")
    old.chmod(0o755)
    directory = checkout(tmp_path / "first")
    (directory / "build/venv/.build").unlink()
    done = setup(directory, PYTHON3=str(old))
    assert done.returncode == 2
    assert done.stderr.splitlines()[0] == (
        f"error: {old} is Python {version}; Python 3.11 or newer with venv and ensurepip is needed: name one, "
        "PYTHON3=python3.12"
    )


def test_a_second_make_waits_for_the_first_and_does_nothing_again(tmp_path: Path) -> None:
    """Seen to fail: both removed the environment that the other was making."""
    directory = checkout(tmp_path)
    complete = directory / "build/venv/.build"
    os.utime(complete, (0, 0))  # older than the locks
    with (directory / "build/.venv.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        argv = ["make", "-C", str(directory), "setup", "BUILD=build", f"PYTHON3={without_venv(tmp_path)}"]
        with subprocess.Popen(argv, stderr=subprocess.PIPE, text=True) as second:
            assert second.stderr
            try:
                assert second.stderr.readline() == "build/venv: another make sets it up; waiting for that\n"
                os.utime(complete)
                fcntl.flock(lock, fcntl.LOCK_UN)
                said = second.stderr.read()
            finally:
                fcntl.flock(lock, fcntl.LOCK_UN)
    assert (second.returncode, said) == (0, "")


UV = """#!/bin/sh
echo "$*" >>{log}
rm -f {package} && echo new >{package}
{end}
"""


def with_groups(directory: Path, *groups: str, end: str = "exit 0") -> Path:
    """A checkout with these groups installed, and a uv that notes what it is given and replaces a package."""
    venv = checkout(directory) / "build/venv"
    package = venv / "package"
    package.write_text("old\n")
    (venv / "bin/python").symlink_to("python3")
    (venv / "bin/uv").write_text(UV.format(log=directory / "uv.log", package=package, end=end))
    (venv / "bin/uv").chmod(0o755)
    for group in groups:
        (venv / f".{group}").touch()
    return venv


def installs(directory: Path) -> list[list[str]]:
    """Of each call of uv: the locks, and `--exact` where it removes what they do not name."""
    log = directory / "uv.log"
    lines = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
    return [[word for word in line if word.endswith(".lock") or word == "--exact"] for line in lines]


def locks(*names: str) -> list[str]:
    return [f"requirements/{name}.lock" for name in names]


def test_a_group_is_added_to_what_is_there(tmp_path: Path) -> None:
    """And nothing of it is installed once more."""
    venv = with_groups(tmp_path, "build")
    assert setup(tmp_path).returncode == 0
    assert installs(tmp_path) == []
    for _ in range(2):
        assert setup(tmp_path, "setup-station").returncode == 0
        assert installs(tmp_path) == [locks("build", "station")]
        assert (venv / ".station").exists()
        assert not (venv / ".tests").exists()
    assert setup(tmp_path, "build/venv/.tests").returncode == 0
    assert installs(tmp_path)[1:] == [locks("build", "station", "tests"), locks("tests-source")]
    assert not venv.with_name("venv.before").exists()


@pytest.mark.parametrize(("changed", "noticed"), [("build", True), ("station", False), ("tests", False)])
def test_a_group_is_installed_anew_when_its_lock_changes(tmp_path: Path, changed: str, noticed: bool) -> None:
    """By the commands that need it: `make image` does not wait for another browser's driver."""
    venv = with_groups(tmp_path, "build", "station", "tests")
    os.utime(venv / f".{changed}", (0, 0))
    assert setup(tmp_path).returncode == 0
    all_locks = [["--exact", *locks("build", "station", "tests")], locks("tests-source")]
    assert installs(tmp_path) == (all_locks if noticed else [])
    for _ in range(2):
        assert setup(tmp_path, "build/venv/.tests").returncode == 0
        assert installs(tmp_path) == all_locks


@pytest.mark.parametrize("end", ["exit 1", "kill -INT 0"])
def test_a_group_that_cannot_be_added_leaves_all_as_it_was(tmp_path: Path, end: str) -> None:
    venv = with_groups(tmp_path, "build", end=end)
    before = {path.relative_to(venv) for path in venv.rglob("*")}
    inherited = {name: value for name, value in os.environ.items() if name not in ("BUILD", "PYTHON3")}
    done = subprocess.run(
        ["make", "-C", str(tmp_path), "setup-station"], env=inherited, capture_output=True, text=True, timeout=60,
        check=False, start_new_session=True,
    )  # fmt: skip
    assert done.returncode != 0
    assert installs(tmp_path) == [locks("build", "station")]
    assert (venv / "package").read_text() == "old\n"
    assert {path.relative_to(venv) for path in venv.rglob("*")} == before
    assert not venv.with_name("venv.before").exists()


def test_a_checkout_with_the_line_ends_of_windows_is_refused(tmp_path: Path) -> None:
    """Seen to fail: `images/install-host-packages: not found`."""
    (tmp_path / "Makefile").write_bytes((paths.PROJECT / "Makefile").read_bytes().replace(b"\n", b"\r\n"))
    done = subprocess.run(["make", "-C", str(tmp_path), "help"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "the files of this checkout end their lines with CR LF; take a new clone" in done.stderr


def test_git_leaves_the_lines_of_a_checkout_as_they_are(tmp_path: Path) -> None:
    """Seen to fail with core.autocrlf=true: shells found no command, and hashes of inputs were others."""
    before = {"script": b"#!/bin/sh\necho\n", "stream": b"a\r\nb\r\n", "mixed": b"a\r\nb\n"}
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)
    shutil.copy(paths.PROJECT / ".gitattributes", tmp_path)
    git = ["git", "-C", str(tmp_path), "-c", "core.autocrlf=true", "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "a"]):
        subprocess.run([*git, *words], check=True, capture_output=True)
    for name in before:
        (tmp_path / name).unlink()
    subprocess.run([*git, "checkout", "-q", "--", "."], check=True, capture_output=True)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
