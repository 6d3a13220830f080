"""Apps: descriptions that are wrong, new ones from templates, what a robot is told and what its answers mean.

Building one and running it is tested on a guest, in tests/provisioning/test_deploy.py.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from flotilla.apps import app, builder, deploy, remote, scaffold
from flotilla.cli import make
from flotilla.cli.main import commands
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.fleet.model import Board, Robot

ROBOT = Robot.model_validate({"name": "robot3", "number": 3, "address": "10.42.0.3", "board": "smartcoret3"})


def write(directory: Path, text: str) -> Path:
    """An app that has all files but for what its description lacks."""
    directory.mkdir(exist_ok=True)
    for name in ("task.yml", "Makefile"):
        (directory / name).touch()
    (directory / "app.yml").write_text(text)
    return directory


WRONG = {
    "no YAML": ("kind: [", "while parsing a flow node"),
    "no keys": ("block", "has no keys; at least kind: block|make|ert|fmu"),
    "no kind": ("board: x86_64", "kind: (nothing): is missing; one of block, make, ert, fmu"),
    "unknown kind": ("kind: blok", "kind: blok: is no kind of app; one of block, make, ert, fmu"),
    "unknown key": ("kind: block\nprogram: x", "program: x: is no key of this kind of app; there are board, kind"),
    "no program": ("kind: make", "program: (nothing): is missing; an app of kind make needs it"),
    "program outside": ("kind: make\nprogram: ../x", "program: ../x: is not a file inside the app; such as hover"),
    "absolute program": ("kind: make\nprogram: /bin/sh", "program: /bin/sh: is not a file inside the app"),
    "a number": ("kind: make\nprogram: 5", "program: 5: is wrong; Input should be a valid string"),
    "a number in a list": ("kind: make\nprogram: x\narguments: [a, 7]", "arguments.1: 7: is wrong; Input should be"),
}


@pytest.mark.parametrize(("text", "said"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_description_is_refused_with_key_and_remedy(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(UserError) as refused:
        app.load(write(tmp_path / "hover", text))
    assert f"hover/app.yml: {said}" in str(refused.value)


def test_what_an_app_lacks_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"hover/app\.yml is missing; `make new-app"):
        app.load(tmp_path / "hover")
    for kind, file in (("block", "task.yml"), ("make\nprogram: x", "Makefile")):
        directory = write(tmp_path / "hover", f"kind: {kind}")
        (directory / file).unlink()
        with pytest.raises(UserError, match=f"hover/{file} is missing"):
            app.load(directory)


@pytest.mark.parametrize("name", ["Hover", "3d", "a_b", "", "a/b", "a.b", "x" * 33, "a@b", "hover\n"])
def test_names_that_no_unit_could_have(name: str) -> None:
    with pytest.raises(UserError, match="is not an app's name"):
        app.check_name(name)


def test_an_app_for_another_board(tmp_path: Path) -> None:
    board = Board.model_construct(name="smartcoret3")
    app.check_board(app.load(write(tmp_path / "hover", "kind: block\nboard: smartcoret3")), ROBOT, board)
    with pytest.raises(UserError, match="board: x86_64: robot3 is a smartcoret3; choose a robot of that board"):
        app.check_board(app.load(write(tmp_path / "hover", "kind: block\nboard: x86_64")), ROBOT, board)


def test_a_deployed_app_says_what_the_inventory_has_to_do_with_it() -> None:
    """Seen to fail where each robot was taken to have the app from the inventory."""
    given = ROBOT.model_copy(update={"apps": ["hover"]})
    assert deploy._hint(ROBOT, "hover", keep=False) == ""
    assert "until it has a new card; for good: apps: [hover]" in deploy._hint(ROBOT, "hover", keep=True)
    assert "make provision ROBOT=3 brings the inventory's back" in deploy._hint(given, "hover", keep=False)


@pytest.mark.parametrize("kind", scaffold.OF_KIND)
def test_a_new_app_is_one(tmp_path: Path, kind: str) -> None:
    scaffold.create(kind, "my-app", tmp_path)
    made = app.load(tmp_path / "my-app")
    assert (made.name, made.description.kind) == ("my-app", "block" if kind == "device" else kind)
    assert not list(tmp_path.glob(".*")), "something is left beside it"
    with pytest.raises(UserError, match="my-app is there already"):
        scaffold.create(kind, "my-app", tmp_path)


def test_a_new_app_of_no_kind(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"KIND=blok: is no kind of app; one of block, device, make, ert, fmu"):
        scaffold.create("blok", "hover", tmp_path)


def test_a_new_app_has_no_caches_of_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail: bytecode of the example's test was read as text, and pytest's cache was copied."""
    shutil.copytree(scaffold.EXAMPLES / "saw-tooth", tmp_path / "saw-tooth")
    for name in ("__pycache__/test.pyc", ".pytest_cache/README.md", ".ruff_cache/0.1/1", ".mypy_cache/a.json"):
        file = tmp_path / "saw-tooth" / name
        file.parent.mkdir(parents=True)
        file.write_bytes(b"\xa7\r\r\n")
    monkeypatch.setattr(scaffold, "EXAMPLES", tmp_path)
    scaffold.create("block", "my-app", tmp_path / "apps")
    assert {path.name for path in (tmp_path / "apps" / "my-app").rglob("*")} == {"app.yml", "my_app.c", "task.yml"}


def test_the_new_apps_compile_without_a_warning(tmp_path: Path) -> None:
    """With this computer's compiler; tests/provisioning/test_deploy.py takes the locked one."""
    for kind in scaffold.OF_KIND:
        scaffold.create(kind, f"my-{kind}", tmp_path)
    include = paths.PROJECT / "runtime" / "include"
    unit = [f"-I{paths.PROJECT / 'flotilla/apps/fmi'}", str(tmp_path / "my-fmu" / "unit" / "sources" / "my_fmu.c")]
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-fsyntax-only"]
    blocks = [str(tmp_path / "my-block" / "my_block.c"), str(tmp_path / "my-device" / "my_device.c")]
    subprocess.run(["cc", "-std=c11", *warnings, f"-I{include}", *blocks], check=True)
    subprocess.run(["cc", "-std=gnu11", *warnings, str(tmp_path / "my-make" / "main.c")], check=True)
    subprocess.run(["cc", "-std=gnu17", "-Wall", "-Werror", "-fsyntax-only", *unit], check=True)


def test_a_programs_service(tmp_path: Path) -> None:
    """Quoted as systemd.service(5) says: seen to fail without the doubled percent sign."""
    text = "kind: make\nprogram: build/hover\narguments: ['50 %', '$HOME', 'a\"b\\c']\n"
    made = app.load(write(tmp_path / "hover", text))
    assert isinstance(made.description, app.Make)
    service = builder.service(made, made.description, safe=True)
    assert r'ExecStart="/data/apps/hover/hover" "50 %%" "$$HOME" "a\"b\\c"' in service.splitlines()
    assert "ExecStopPost=/usr/bin/flotilla-run --safe /data/apps/hover/safe.yml" in service.splitlines()
    assert "WatchdogSec=0" in service.splitlines()
    watched = builder.service(made, made.description.model_copy(update={"notify": True}), safe=False)
    assert "WatchdogSec" not in watched
    assert "--safe" not in watched


PROJECT = {
    "Makefile": """hover: main.c lib/libown.so
\t$(CC) -o $@ main.c -Llib -lown -Wl,-rpath,'$$ORIGIN/lib'
lib/libown.so: own.c
\tmkdir -p lib && $(CC) -shared -fPIC -o $@ own.c
""",
    "own.c": "int own(void) { return 7; }\n",
    "main.c": """#include <stdio.h>
int own(void);
int main(void)
{
    char word[9] = "";
    FILE *data = fopen("data/gains.csv", "r");
    return !(data && fscanf(data, "%8s", word) == 1 && printf("%d %s\\n", own(), word) > 0);
}
""",
    "data/gains.csv": "2.5\n",
    "README.md": "",
}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An app of kind make with data and a library of its own, with this computer's compiler for the locked one."""

    def command(work: Path, _: str, argv: Sequence[str], *_run: object) -> None:
        subprocess.run([word.replace("/out", str(work)) for word in argv], check=True, capture_output=True)

    monkeypatch.setattr(runtime, "command", command)
    monkeypatch.setattr(paths, "BUILD", tmp_path / "build")
    for name, text in PROJECT.items():
        (tmp_path / "hover" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "hover" / name).write_text(text)
    return tmp_path / "hover"


def built(project: Path, keys: str) -> Path:
    """What goes to the robot, with further keys of app.yml."""
    (project / "app.yml").write_text(f"kind: make\nprogram: hover\n{keys}")
    out = project.with_name("out")
    shutil.rmtree(out, ignore_errors=True)
    builder.build(app.load(project), Board.model_construct(name="pc", architecture="amd64"), out)
    return out


def test_a_program_gets_its_data_and_libraries(project: Path) -> None:
    """Seen to fail where the program alone was sent: the robot said that it lacks libown.so."""
    out = built(project, "files: [data/gains.csv, lib]\n")
    done = subprocess.run([out / "hover"], cwd=out, capture_output=True, text=True, check=True)
    assert done.stdout == "7 2.5\n"
    assert not (out / "main.c").exists()


FILES = {
    "nothing is said": ("", "files: (nothing): would leave data/gains.csv, lib/libown.so here; write files: [data/gai"),
    "not there": ("files: [date]\n", "files: date: is not there, and make does not make it; name what there is"),
    "outside": ("files: [../x]\n", "files.0: ../x: is not a file inside the app"),
    "the program": ("files: [hover]\n", "files: hover: is sent anyhow; leave it out, or give it another name"),
    "a link": ("files: [there]\n", "files: there: has a link to outside the app; put a copy in its place"),
}


@pytest.mark.parametrize(("keys", "said"), FILES.values(), ids=FILES.keys())
def test_what_would_be_left_or_lost_is_refused(project: Path, keys: str, said: str) -> None:
    """Seen to fail where a program was sent without its data, and nobody said so."""
    (project / "there").symlink_to("/etc/hostname")
    with pytest.raises(UserError) as refused:
        built(project, keys)
    assert f"hover/app.yml: {said}" in str(refused.value)


def test_what_may_stay_here_stays(project: Path) -> None:
    assert not (built(project, "files: []\n") / "data").exists()


TIMES = {"count": 100, "min_ns": 1000, "mean_ns": 2500, "p99_ns": 80000, "max_ns": 91250}


def test_the_report() -> None:
    counted = {"period_ns": 10_000_000, "steps": 100, "overruns": 2, "skipped": 3}
    rate = {"name": "hover_step1", "every": 5, "count": 20, "overruns": 1, "mean_ns": 30000, "max_ns": 31000}
    block = {"count": 100, "mean_ns": 2500, "max_ns": 91250, "rates": [rate]}
    lines = remote.summary({**counted, "jitter": TIMES, "step": TIMES, "blocks": {"a": block}})
    assert lines == [
        "period 10 ms, 100 steps, 2 overruns, 3 skipped",
        "jitter: mean 2.5 µs, 99 % 80.0 µs, max 91.2 µs",
        "step:   mean 2.5 µs, 99 % 80.0 µs, max 91.2 µs",
        "  a: mean 2.5 µs, max 91.2 µs",
        "    hover_step1, every 5 steps: mean 30.0 µs, max 31.0 µs, 1 overruns",
    ]


SAID = {
    "host key": (255, "Host key verification failed.", "rejected, because its host key is not the one of"),
    "away": (255, "connect to host 10.42.0.3 port 22: No route to host", "did not answer: connect to host"),
    "broken": (255, "", "did not answer: the connection broke; is it on and reachable? `make ssh ROBOT=3`"),
    "refusal": (3, "/data has 12 KiB left\n", "robot3: /data has 12 KiB left"),
    "silent": (1, "", "robot3: status 1"),
}


@pytest.mark.parametrize(("status", "stderr", "said"), SAID.values(), ids=SAID.keys())
def test_what_goes_wrong_on_the_way_is_said(tmp_path: Path, status: int, stderr: str, said: str) -> None:
    script = tmp_path / "ssh"
    script.write_text(f"#!/bin/sh\nprintf '%s' '{stderr}' >&2\nexit {status}\n")
    script.chmod(0o755)
    with remote.connection(ROBOT, [str(script)]) as to, pytest.raises(UserError) as refused:
        deploy.command(to, "hover", "status")
    assert said in str(refused.value)


def test_words_of_a_remote_compiler_are_shown_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script, log = tmp_path / "ssh", tmp_path / "log"
    script.write_text("#!/bin/sh\ncat\nprintf 'a.c:1: error\\nit does not compile\\n' >&2\nexit 3\n")
    script.chmod(0o755)
    sent, made = tmp_path / "sent", tmp_path / "made"
    sent.write_text("sources")
    with pytest.raises(UserError, match=r"robot3: it does not compile; its output is above and in .*log"):
        remote.Connection(ROBOT, [str(script)]).stream("compile", "hover", stdin=sent, stdout=made, log=log)
    assert made.read_text() == "sources"
    assert log.read_text() == capsys.readouterr().err == "a.c:1: error\nit does not compile\n"


@pytest.mark.parametrize(
    ("given", "on_robot"),
    [({"ON_ROBOT": "1"}, True), ({"ON_ROBOT": "1", "BUILD": "other"}, True), ({"BUILD": "other"}, False),
     ({"ON_ROBOT": "0"}, False)],
)  # fmt: skip
def test_how_make_is_asked_for_a_remote_build(given: dict[str, str], on_robot: bool) -> None:
    """BUILD is the directory of outputs and nothing else."""
    words = make.words(commands(), "deploy", {"ROBOT": "3", "APP": "apps/hover", **given})
    assert words == ["deploy", *(["--on-robot"] if on_robot else []), "--", "3", "apps/hover"]


def test_an_unknown_run() -> None:
    with pytest.raises(UserError, match="RUN=restart: is none of start, stop, status, log, remove"):
        deploy.command(remote.Connection(ROBOT, ["false"]), "hover", "restart")
