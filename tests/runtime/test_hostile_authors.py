"""Apps and units with code against whoever builds and checks them, on the computer that has the keys.

Each tries to read a planted key, to write outside its folder, to reach the network, or to change its root directory.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import shutil
import stat
import subprocess
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest

from flotilla.apps import app, builder, fmu, imported, remote, remote_compiler, scaffold
from flotilla.common import paths, sandbox
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.debian.lock import HOST, runtime_lock
from flotilla.fleet.model import Board, Fleet
from tests import hostile
from tests.figures import PROPERTY
from tests.hostile import SECRET


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hostile.Target]:
    with hostile.target(tmp_path_factory.mktemp("hostile")) as made:
        yield made


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that tests reach soon."""
    for name in ("BUILD", "CHECK"):
        limits = getattr(sandbox, name)
        small = {**hostile.SMALL, "file_bytes": min(hostile.SMALL["file_bytes"], limits.file_bytes)}
        monkeypatch.setattr(sandbox, name, dataclasses.replace(limits, **small))


def shortened(monkeypatch: pytest.MonkeyPatch, attack: str) -> None:
    """The limit of time, for attacks that wait for it."""
    for name in ("BUILD", "CHECK") if attack == "waiting" else ():
        monkeypatch.setattr(sandbox, name, dataclasses.replace(getattr(sandbox, name), seconds=2))


Stage = Callable[[hostile.Target, Path, Board, str], str]
"""Where an attack runs; its messages."""


def make_build(target: hostile.Target, place: Path, board: Board, attack: str) -> str:
    """The Makefile of an app starts the attack."""
    if not (place / "hover").exists():
        scaffold.create("make", "hover", place)
        shutil.copy(target.program, place / "hover" / target.alias)
    kept = " 2>&1 | cat >hover" if attack == "all" else ""
    (place / "hover/Makefile").write_text(f"hover:\n\t./{target.alias} '{attack}'{kept}\n.PHONY: hover\n")
    builder.build(app.load(place / "hover"), board, place / "out")
    return (place / "out/hover").read_text()


def plugin_check(target: hostile.Target, place: Path, board: Board, attack: str) -> str:
    """The constructor of a plug-in does, which the runtime lists."""
    target.named.write_text(attack)
    with pytest.raises(UserError) as refused:
        runtime.check_plugins(target.plugins, HOST)
    return str(refused.value)


def task_check(target: hostile.Target, place: Path, board: Board, attack: str) -> str:
    """It does, when the runtime checks a task with it."""
    target.named.write_text(attack)
    task = b"period: 10 ms\nblocks:\n  a: {type: attack}\n"
    with pytest.raises(UserError) as refused:
        runtime.check_task(place / "task.yml", task, target.plugins, HOST)
    return str(refused.value)


STAGES: dict[str, Stage] = {"Makefile": make_build, "plug-in": plugin_check, "task": task_check}


@pytest.mark.parametrize("stage", STAGES)
def test_code_of_an_author_reaches_nothing(
    target: hostile.Target, tmp_path: Path, board: Board, stage: str, record_property: Callable[[str, str], None]
) -> None:
    """Seen to fail: `may set the kernel's core_pattern` where root builds, the builder's environment, a key of its
    session's keyring, and the mode of its log. Before there was a sandbox, most of them succeeded."""
    said = STAGES[stage](target, tmp_path, board, "all")
    attacks = [*hostile.ATTACKS, *hostile.ROOTS_ATTACKS]
    assert [attack for attack in attacks if f"attacked: {attack}" not in said.splitlines()] == [], said
    found = target.evidence(said)
    record_property(PROPERTY, f"hostile author, {stage}: {len(attacks)} attacks, {len(found)} traces of success")
    assert found == [], said


@pytest.mark.parametrize("attack", hostile.LIMITS)
@pytest.mark.parametrize("stage", STAGES)
def test_code_of_an_author_takes_no_more_than_its_part(
    target: hostile.Target,
    tmp_path: Path,
    board: Board,
    stage: str,
    attack: str,
    small: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of memory, processes, files, messages and time. Seen to fail: each ended by itself after its time."""
    shortened(monkeypatch, attack)
    if stage == "Makefile":
        with pytest.raises(UserError) as refused:
            make_build(target, tmp_path, board, attack)
        said = str(refused.value)
        assert f"{tmp_path}/hover: nothing was built: " in said
    else:
        said = STAGES[stage](target, tmp_path, board, attack)
    limit = hostile.LIMITS[attack]
    if stage != "Makefile":
        limit = {"one file": "1 MiB for a file", "holes": "1 MiB for a file"}.get(attack, limit)
    assert f"the sandbox's limit of {limit}" in said.splitlines()[0]
    assert target.evidence("") == []


@pytest.mark.parametrize("attack", [*hostile.ATTACKS, *hostile.LIMITS])
def test_the_same_attack_succeeds_without_a_sandbox(target: hostile.Target, attack: str) -> None:
    assert target.plainly(attack)


@pytest.mark.skipif(os.geteuid() != 0, reason="the computer itself rejects these, but for root")
@pytest.mark.parametrize("attack", hostile.ROOTS_ATTACKS)
def test_the_same_attack_of_root_succeeds_without_a_sandbox(target: hostile.Target, attack: str) -> None:
    assert target.plainly(attack)


def test_a_crash_of_a_plugin_is_named(target: hostile.Target, tmp_path: Path, board: Board) -> None:
    for check in (plugin_check, task_check):
        assert "was ended by SIGABRT" in check(target, tmp_path, board, "crash")


LIES = [
    "5",
    "[1]",
    '{"a": 1}',
    '[{"name": [], "parameters": []}]',
    '[{"name": "a", "parameters": null}]',
    "[" * 100_000,
]


@pytest.mark.parametrize("status", [0, 1, 255])
@pytest.mark.parametrize("listed", LIES, ids=range(len(LIES)))
def test_a_plugin_that_lies_about_blocks_is_refused(tmp_path: Path, listed: str, status: int) -> None:
    """Seen to fail: with status 0 or 255 in a traceback."""
    (tmp_path / "listed").write_text(f'const char listed[] = "{listed.replace(chr(34), chr(92) + chr(34))}";\n')
    (tmp_path / "lie.c").write_text(
        '#include "listed"\n#include <unistd.h>\n__attribute__((constructor)) static void lie(void)\n'
        f"{{\n    (void)!write(1, listed, sizeof listed - 1);\n    _exit({status});\n}}\n"
    )
    (tmp_path / "blocks").mkdir()
    plugin = tmp_path / "blocks/lie.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", plugin, tmp_path / "lie.c"], check=True)
    with pytest.raises(UserError, match=r"no list of blocks came|ended with status"):
        runtime.check_plugins(tmp_path / "blocks", HOST)


@pytest.fixture
def board(fleet: Fleet) -> Board:
    return next(board for board in fleet.boards.values() if board.system == HOST)


@pytest.fixture
def planted(tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys/release").write_text(SECRET)


@pytest.fixture
def made(tmp_path: Path, board: Board, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Build an app with a Makefile, by the locked compiler; what goes to a robot."""
    scaffold.create("make", "hover", tmp_path)

    def make(makefile: str, keys: str = "") -> Path:
        (tmp_path / "hover/Makefile").write_text(makefile)
        (tmp_path / "hover/app.yml").write_text(f"kind: make\nprogram: hover\n{keys}")
        builder.build(app.load(tmp_path / "hover"), board, tmp_path / "out")
        return tmp_path / "out"

    return make


def test_what_a_build_makes_is_never_set_user_id(tmp_path: Path) -> None:
    """Nor is it a directory that the builder cannot remove. Seen to fail: root's build had a program of mode 4755."""
    script = "cp /bin/true /out/made && chmod 4755 /out/made && mkdir -p /out/a/b && chmod 0 /out/a"
    runtime.command(tmp_path, HOST, ["sh", "-c", script])
    assert [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("made", "a")] == [0o755, 0o700]


SOURCES = {"block": "hover.c", "ert": "generated/hover.c", "fmu": "unit/sources/hover.c", "make": "main.c"}
"""A file of each kind of app that the compiler reads."""
STEALS = {"a header": '#include "{key}"', "bytes": '__asm__(".incbin \\"{key}\\"");'}


@pytest.mark.parametrize("steal", STEALS)
@pytest.mark.parametrize("kind", SOURCES)
def test_sources_have_the_compiler_read_no_key(
    planted: None, tmp_path: Path, board: Board, kind: str, steal: str
) -> None:
    """The compiler of this computer reads it, so that the test can fail."""
    scaffold.create(kind, "hover", tmp_path)
    source, line = tmp_path / "hover" / SOURCES[kind], STEALS[steal].format(key=tmp_path / "keys/release")
    source.write_text(f"{source.read_text()}\n{line}\n")
    with pytest.raises(UserError, match="release") as refused:
        builder.build(app.load(tmp_path / "hover"), board, tmp_path / "out")
    assert SECRET not in str(refused.value)
    assert not any(SECRET in path.read_text(errors="replace") for path in tmp_path.glob("out/**/*") if path.is_file())
    (tmp_path / "plain.c").write_text(f"{line}\n")
    argv = ["cc", "-c", "-o", str(tmp_path / "plain.o"), str(tmp_path / "plain.c")]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    made = (tmp_path / "plain.o").read_bytes() if done.returncode == 0 else b""
    assert SECRET in done.stderr or SECRET.encode() in made


MEMBERS = {
    "a path that leads out": "../../keys/marker.c",
    "a path from the root": "{keys}/marker.c",
    "a link": "link.c",
}
UNPACKERS: dict[str, Callable[[Path, Path], object]] = {
    "model": lambda archive, place: imported.create(archive, "hover", [HOST], parent=place / "a/b"),
    "unit": lambda archive, place: fmu.unpacked(archive.parent, archive.name, place / "a/b"),
}


@pytest.mark.parametrize("member", MEMBERS)
@pytest.mark.parametrize("kind", UNPACKERS)
def test_an_archive_writes_and_links_nowhere_else(planted: None, tmp_path: Path, kind: str, member: str) -> None:
    """An unpacker that writes each member to its path does, so that the test can fail."""
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "in").mkdir()
    name = MEMBERS[member].format(keys=tmp_path / "keys")
    with zipfile.ZipFile(tmp_path / "in/hover.fmu", "w") as archive:
        info = zipfile.ZipInfo(name)
        info.external_attr = (stat.S_IFLNK if member == "a link" else stat.S_IFREG | 0o644) << 16
        archive.writestr(info, str(tmp_path / "keys/release"))
    with contextlib.suppress(UserError):
        UNPACKERS[kind](tmp_path / "in/hover.fmu", tmp_path)
    assert [path.name for path in (tmp_path / "keys").iterdir()] == ["release"]
    assert not any(path.is_symlink() for path in tmp_path.rglob("*"))
    plain = tmp_path / "a/b" / name
    plain.unlink(missing_ok=True)
    plain.symlink_to(tmp_path / "keys/release") if member == "a link" else plain.write_text("")
    assert plain.is_symlink() or len(list((tmp_path / "keys").iterdir())) == 2


def test_no_file_behind_a_link_is_removed_for_a_program(board: Board, tmp_path: Path) -> None:
    """Seen to fail: a file of the computer that builds was removed before make ran."""
    scaffold.create("make", "hover", tmp_path)
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys/release").write_text(SECRET)
    (tmp_path / "hover/conf").symlink_to(tmp_path / "keys")
    (tmp_path / "hover/app.yml").write_text("kind: make\nprogram: conf/release\n")
    subject = app.load(tmp_path / "hover")
    with pytest.raises(UserError, match=r"program: conf/release: lies behind a link"):
        builder.build(subject, board, tmp_path / "out")
    assert (tmp_path / "keys/release").read_text() == SECRET


LINKS = {
    "the program": ("ln -sf {key} hover", ""),
    "data": ("cp main.c hover && ln -s {key} data", "files: [data]\n"),
    "data in a directory": ("cp main.c hover && mkdir data && ln -s {key} data/key", "files: [data]\n"),
    "a directory": ("cp main.c hover && ln -s {keys} data", "files: [data/release]\n"),
    "the headers": ("cp main.c hover && rm -rf ../include && ln -s {keys} ../include", ""),
    "a pipe": ("mkfifo hover", ""),
}


@pytest.mark.parametrize(("commands", "keys"), LINKS.values(), ids=LINKS.keys())
def test_what_a_build_leaves_is_read_where_it_is_a_file_of_its_own(
    made: Callable[..., Path], tmp_path: Path, planted: None, commands: str, keys: str
) -> None:
    """Seen to fail: the key went to the robot as the program, and as a directory's file."""
    recipe = commands.format(key=tmp_path / "keys/release", keys=tmp_path / "keys")
    with pytest.raises(UserError, match=r"leads out of|is neither a file"):
        made(f"hover:\n\t{recipe}\n.PHONY: hover\n", keys)
    assert not any(SECRET in path.read_text(errors="replace") for path in tmp_path.glob("out/**/*") if path.is_file())


ANSWERS: dict[str, Callable[[tarfile.TarFile, Path], None]] = {
    "a link to a key as the plug-in": lambda tar, keys: add(tar, "plugin.so", link=keys / "release"),
    "a link over the headers": lambda tar, keys: add(tar, "include", link=keys),
    "a path that leads out": lambda tar, keys: add(tar, "../../marker", b"x"),
    "a path from the root": lambda tar, keys: add(tar, f"{keys}/../marker", b"x"),
    "a file behind a link": lambda tar, keys: behind_a_link(tar, keys.parent),
    "a device": lambda tar, keys: add(tar, "plugin.so", kind=tarfile.CHRTYPE),
    "a pipe": lambda tar, keys: add(tar, "plugin.so", kind=tarfile.FIFOTYPE),
    "a directory": lambda tar, keys: add(tar, "plugin.so", kind=tarfile.DIRTYPE),
    "a huge file of holes": lambda tar, keys: add(tar, "plugin.so", b"x", sparse_bytes=1 << 45),
}


def add(
    tar: tarfile.TarFile,
    name: str,
    content: bytes = b"",
    *,
    link: Path | None = None,
    kind: bytes = b"",
    sparse_bytes: int = 0,
) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.type, member.mode = len(content), kind or tarfile.REGTYPE, 0o644
    if link:
        member.type, member.linkname = tarfile.SYMTYPE, str(link)
    if sparse_bytes:
        member.pax_headers = {
            "GNU.sparse.major": "0", "GNU.sparse.minor": "1", "GNU.sparse.name": name, "GNU.sparse.numblocks": "1",
            "GNU.sparse.size": str(sparse_bytes), "GNU.sparse.map": f"{sparse_bytes - 1},1",
        }  # fmt: skip
    tar.addfile(member, io.BytesIO(content))


def behind_a_link(tar: tarfile.TarFile, place: Path) -> None:
    add(tar, "x", link=place)
    add(tar, "x/marker", b"x")


@pytest.fixture
def compiler(tmp_path: Path, fleet: Fleet, board: Board, monkeypatch: pytest.MonkeyPatch) -> remote_compiler.Compiler:
    """That of a robot which answers with the file `answer`."""
    packed = tmp_path / "compiler"
    packed.write_text("")
    monkeypatch.setattr(remote_compiler, "packed", lambda lock: packed)
    script = tmp_path / "robot"
    script.write_text(
        "#!/bin/sh\ncase $* in *'flotilla has-compiler '*) echo yes ;; "
        f"*) cat >/dev/null; exec cat {tmp_path}/answer; esac\n"
    )
    script.chmod(0o755)
    robot = next(robot for robot in fleet.robots.values() if robot.board == board.name)
    return remote_compiler.Compiler(remote.Connection(robot, [str(script)]), "hover")


@pytest.fixture
def robots_plugin(tmp_path: Path, compiler: remote_compiler.Compiler) -> Callable[[bytes], bytes]:
    """The plug-in that a robot compiles, when it answers with that."""

    def compiled(answer: bytes) -> bytes:
        (tmp_path / "answer").write_bytes(answer)
        source = tmp_path / "source.c"
        source.write_text("#include <flotilla/block.h>\n")
        return runtime.compile_plugin(source, HOST, run=compiler.run)

    return compiled


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS.keys())
def test_a_robot_that_compiles_returns_one_file(
    robots_plugin: Callable[[bytes], bytes], tmp_path: Path, answer: Callable[[tarfile.TarFile, Path], None]
) -> None:
    """Seen to fail: the key came as the plug-in, a pipe was waited for without end, the rest ended in a traceback."""
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys/release").write_text(SECRET)
    sent = io.BytesIO()
    with tarfile.open(fileobj=sent, mode="w", format=tarfile.PAX_FORMAT) as tar:
        answer(tar, tmp_path / "keys")
    with pytest.raises(UserError) as refused:
        robots_plugin(sent.getvalue())
    assert str(refused.value)
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == ["release"]
    assert (tmp_path / "keys/release").read_text() == SECRET
    assert not (tmp_path / "marker").exists()


def test_a_robot_that_compiles_writes_behind_no_link(compiler: remote_compiler.Compiler, tmp_path: Path) -> None:
    """Of those that a program's source has. Seen to fail: tar followed it."""
    (tmp_path / "keys").mkdir()
    (tmp_path / "work").mkdir()
    (tmp_path / "work/there").symlink_to(tmp_path / "keys")
    with tarfile.open(tmp_path / "answer", "w") as tar:
        add(tar, "there/marker", b"x")
    compiler.run(runtime_lock(HOST), tmp_path / "work", ["make"], tmp_path / "log")
    assert list((tmp_path / "keys").iterdir()) == []
    assert (tmp_path / "work/there/marker").read_bytes() == b"x"
    assert not (tmp_path / "work/there").is_symlink()


def test_a_robot_that_compiles_sends_nothing_compressed(robots_plugin: Callable[[bytes], bytes]) -> None:
    """Of which little may become much. Seen to fail: tar unpacked it."""
    sent = io.BytesIO()
    with tarfile.open(fileobj=sent, mode="w:gz") as tar:
        add(tar, "plugin.so", b"x")
    with pytest.raises(UserError, match=r"what it compiled is no archive: .*ompressed"):
        robots_plugin(sent.getvalue())


def test_a_robot_that_compiles_and_does_not_end(
    robots_plugin: Callable[[bytes], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "MADE_BYTES", 1 << 16)
    with pytest.raises(UserError, match="its answer does not end"):
        robots_plugin(bytes(1 << 20))


def test_a_robot_that_compiles_returns_what_is_no_archive(robots_plugin: Callable[[bytes], bytes]) -> None:
    with pytest.raises(UserError, match=r"robot\d+: what it compiled is no archive"):
        robots_plugin(b"hello" * 1000)


OPTIONS = {
    "a wrapper": "-wrapper /bin/sh,-c,id",
    "a plug-in of the compiler": "-fplugin=./sources/x.so",
    "specifications": "-specs=sources/x",
    "programs of its own": "-B sources/",
    "a file of options": "@sources/x",
    "a linker of its own": "-fuse-ld=x",
    "options of the linker": "-Wl,-rpath,/tmp",
    "options of the assembler": "-Wa,-I/",
    "a header from anywhere": "-include /etc/passwd",
    "a directory": "-I/root",
    "an output": "-o /out/x",
    "no words": "-O2 'x",
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_a_unit_asks_the_compiler_for_what_is_harmless_alone(tmp_path: Path, options: str) -> None:
    """Seen to fail: all of them reached the compiler, `-wrapper` with a program to start."""
    shutil.copytree(paths.PROJECT / "tests/fixtures/fmu", tmp_path / "two-lags/unit")
    unit = fmu.read(*fmu.unpacked(tmp_path / "two-lags", None, tmp_path / "unpacked"))
    description = tmp_path / "two-lags/unit/sources/buildDescription.xml"

    def asking(options: str) -> fmu.Sources | None:
        group = f'<SourceFileSet compiler="gcc" compilerOptions={quoteattr(options)}'
        description.write_text(re.sub('<SourceFileSet language="C99"', lambda _: group, original))
        return fmu.sources(unit, HOST)

    original = description.read_text()
    with pytest.raises(UserError, match="compilerOptions: "):
        asking(options)
    found = asking("-O2 -std=c99 -Wall -fno-math-errno -ffast-math -DA=1")
    assert found
    assert "-ffast-math" in found.options


def test_a_unit_with_a_link_that_leads_out_is_refused(tmp_path: Path) -> None:
    """Seen to fail: `resources/x` was shipped with what it led to."""
    shutil.copytree(paths.PROJECT / "tests/fixtures/fmu", tmp_path / "two-lags/unit")
    (tmp_path / "two-lags/unit/resources").mkdir(exist_ok=True)
    (tmp_path / "two-lags/unit/resources/x").symlink_to("/etc/hostname")
    with pytest.raises(UserError, match=r"resources/x: leads out of .*; put a copy in its place"):
        fmu.unpacked(tmp_path / "two-lags", None, tmp_path / "unpacked")


@pytest.mark.parametrize("target", ["/etc/hostname", "../.ssh/id", "..", "../.ssh", "../other/../../x", "."])
def test_an_app_with_a_link_to_any_file_of_this_computer_is_refused(tmp_path: Path, board: Board, target: str) -> None:
    """Seen to fail: the app was built; an assembler's `.incbin` puts such a file into the plug-in."""
    scaffold.create("block", "mine", tmp_path)
    (tmp_path / "shared.h").write_text("")
    (tmp_path / "mine/beside.h").symlink_to("../shared.h")
    (tmp_path / ".ssh").mkdir()
    (tmp_path / ".ssh/id").write_text(SECRET)
    (tmp_path / "mine/key").symlink_to(target)
    with pytest.raises(UserError, match=r"mine/key: is a link (that leads out of|to a directory that has it)"):
        builder.build(app.load(tmp_path / "mine"), board, tmp_path / "out")


AS_APP = """#!/bin/sh
case " $* " in *" --reuid=app --regid=app --clear-groups --bounding-set=-all --inh-caps=-all --no-new-privs "*) ;;
*) exit 1 ;; esac
while case $1 in --*) ;; *) false ;; esac; do shift; done
AS=app exec "$@"
"""
ALONE = """#!/bin/sh
read -r score </proc/self/oom_score_adj
[ "$score" = 1000 ] || exit 1
case " $* " in *" --net --pid --fork --kill-child "*) ;; *) exit 1 ;; esac
while case $1 in --*) ;; *) false ;; esac; do shift; done
ALONE=alone exec "$@"
"""
RECORDS = """#!/bin/sh
echo "{name} as ${{AS:-root}} ${{ALONE:-among others}}" >>{log}
exit 1
"""


def test_a_robot_runs_no_code_of_an_app_as_root_to_check_it(tmp_path: Path) -> None:
    """The robot's script, with programs in place of its own that record who starts them, and reject the app.

    Seen to fail: `flotilla-run as root`, so a plug-in's constructor was root; root's `cat` followed an app's link;
    `among others`: the code had the robot's network, and its processes were left."""
    log, programs, apps = tmp_path / "log", tmp_path / "bin", tmp_path / "apps"
    programs.mkdir()
    texts = {name: RECORDS.format(name=name, log=log) for name in ("flotilla-run", "ldd", "head", "cat")}
    for name, text in {**texts, "setpriv": AS_APP, "unshare": ALONE}.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    script = remote.SCRIPT.read_text().replace("/data/apps", str(apps)).replace("/var/lib/flotilla-apps", str(apps))
    environment = os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        add(tar, "task.yml")
    (apps / "hover").mkdir(parents=True)
    (apps / "hover/statistics.json").write_text("{}")
    for words in (["receive", "hover", "1", "1", ""], ["statistics", "hover"]):
        argv = ["sh", "-c", script, "flotilla", *words]
        done = subprocess.run(argv, env=environment, input=archive.getvalue(), capture_output=True, check=False)
        assert done.returncode, done.stderr
    assert log.read_text().splitlines() == ["flotilla-run as app alone", "head as app alone"]


LDD = """#!/bin/sh
[ "$AS" = app ] || exit 1
printf '%b' '{text}'
exit {status}
"""


@pytest.mark.parametrize(
    ("text", "status", "isolated", "rejected"),
    [
        ("libc.so.6 => /lib/libc.so.6\\n", 0, True, ""),
        ("\\tnot a dynamic executable\\n", 1, True, ""),
        ("libx.so.1 => not found\\n", 0, True, "libx.so.1 => not found\nhover needs libraries or functions"),
        ("libx.so.1 => not found\\n", 1, True, "libx.so.1 => not found\nhover needs libraries or functions"),
        ("undefined symbol: f\\n" * 9000, 0, True, "hover needs libraries or functions"),
        ("libc.so.6 => /lib/libc.so.6\\n", 1, True, "ended with status 1\nhover cannot be checked"),
        ("", 124, True, "ended with status 124\nhover cannot be checked"),
        ("libx.so.1 => not found\\n", 0, False, "unshare failed\nended with status 1\nhover cannot be checked"),
    ],
    ids=["whole", "static", "missing", "missing, status", "undefined", "status", "time", "not isolated"],
)
def test_a_program_that_a_robot_cannot_check_is_rejected(
    tmp_path: Path, text: str, status: int, isolated: bool, rejected: str
) -> None:
    """Seen to fail where ldd or the isolation around it ended with an error: the program was put in place, whatever
    libraries it needs."""
    programs, apps, units = tmp_path / "bin", tmp_path / "apps", tmp_path / "units"
    programs.mkdir()
    units.mkdir()
    isolation = ALONE if isolated else "#!/bin/sh\necho unshare failed >&2\nexit 1\n"
    texts = {"ldd": LDD.format(text=text, status=status), "setpriv": AS_APP, "unshare": isolation}
    for name, content in {**texts, "systemctl": "#!/bin/sh\n"}.items():
        (programs / name).write_text(content)
        (programs / name).chmod(0o755)
    script = remote.SCRIPT.read_text().replace("/data/apps", str(apps)).replace("/etc/systemd/system", str(units))
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        add(tar, "hover")
    done = subprocess.run(
        ["sh", "-c", script, "flotilla", "receive", "hover", "1", "1", "hover"],
        env=os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"},
        input=archive.getvalue(),
        capture_output=True,
        check=False,
    )
    said = done.stderr.decode()
    assert (done.returncode, (apps / "hover").exists()) == ((3, False) if rejected else (0, True)), said
    assert rejected in said
    assert not rejected or said.endswith("; nothing was changed\n")
