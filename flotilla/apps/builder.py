"""Builds an app for a board, by the locked compiler: the files as they lie on the robot."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import yaml

from flotilla.apps import app, ert, fmu
from flotilla.common import cache, paths, progress, sources
from flotilla.common.errors import UserError
from flotilla.debian import runtime, toolchain
from flotilla.fleet import privileges
from flotilla.fleet.model import Board, System

_BUILT = ("*.o", "*.d")
"""What a copy of a project leaves out besides: what its own build left behind may be for another processor."""
_NO_DATA = re.compile(
    r"[^.]*|\..*|.*\.(c|h|cc|cpp|cxx|hh|hpp|hxx|inc|s|S|asm|o|d|a|mk|am|ac|in|cmake|py|sh|md|rst)"
    r"|(app|safe)\.yml|(CMakeLists|README|LICENSE)\.txt"
)
"""Names of what a project consists of and its program does without, if nobody says otherwise."""


def build(subject: app.App, board: Board, out: Path, run: toolchain.Run = toolchain.run) -> None:
    """Fill `out` with what goes to a robot of `board`; UserError with the compiler's or the runtime's own words.

    `run` says where the robot's code is compiled.
    """
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    sources.files(subject.directory)  # refuses what cannot be sent
    if not isinstance(subject.description, app.Make):  # whose links stay links
        _check_links(subject.directory)
    with cache.exclusive(), progress.step(f"{subject.name} for {board.system}"):
        (out / "unit.d").mkdir(parents=True)  # what the app's service has beyond runtime/systemd/
        description = subject.description
        drives = False
        try:
            if isinstance(description, app.Make):
                _make(subject, description, board.system, out, run)
            elif isinstance(description, app.Ert):
                with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".ert-") as work:
                    source = Path(work) / "source"
                    model, times_s = description.model, description.sample_times
                    tasking = description.tasking
                    name = subject.name
                    defines = ert.block(subject.directory, model, name, times_s, source, board.system, tasking)
                    try:
                        drives = _blocks(subject, source, ("-Wall", *defines), board.system, out, run)
                    except UserError as error:
                        raise ert.explained(error, board.system) from None
            elif isinstance(description, app.Fmu):
                drives = _fmu(subject, description, board.system, out, run)
            else:
                drives = _blocks(subject, subject.directory, runtime.WARNINGS, board.system, out, run)
            if drives or (isinstance(description, app.Make) and _drives(description, out)):
                (out / "unit.d" / privileges.DROP_IN).write_text(privileges.IO_PORTS)
        except UserError as error:
            raise UserError(f"{paths.shown(subject.directory)}: nothing was built: {error}") from None


def _check_links(directory: Path) -> None:
    """Refuse links by which an app would get any file of this computer. What several apps share may lie beside them,
    but for what is hidden there, such as keys of a user."""
    beside = directory.parent.resolve()
    for path in filter(Path.is_symlink, sources.files(directory)):
        target = path.resolve()
        named = target.relative_to(beside).parts if sources.inside(beside, path) else ()
        if not named or any(part.startswith(".") for part in named) or sources.inside(paths.KEYS, path):
            where = paths.shown(directory.parent)
            raise UserError(f"{paths.shown(path)}: is a link that leads out of {where}; put a copy in its place")
        if target in path.absolute().parents:
            raise UserError(f"{paths.shown(path)}: is a link to a directory that has it; remove it")


def _drives(description: app.Make, out: Path) -> bool:
    """Whether a program drives I/O ports, or what makes its outputs safe."""
    safe = out / app.SAFE
    return description.io_ports or (safe.exists() and privileges.drives_io_ports(yaml.safe_load(safe.read_text())))


_INSIDE = re.compile(r'\bfl_inner_new\(\s*"([^"]+)"')
"""How code begins a block within a block: a model with blocks of the runtime does."""


def _blocks(
    subject: app.App, source: Path, options: Sequence[str], system: System, out: Path, run: toolchain.Run
) -> bool:
    """The plug-in of all that is in `source`, and the task; the runtime judges both as the robot would. Whether its
    blocks drive I/O ports, as they declare it."""
    task = subject.directory / app.TASK
    inside: set[str] = set()
    needs: privileges.Needs = {}
    (out / "blocks").mkdir()
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".blocks-") as directory:
        if files := [path for path in sources.files(source) if path.parent == source and path.suffix == ".c"]:
            inside.update(*(_INSIDE.findall(path.read_text(errors="replace")) for path in files))
            plugin = runtime.compile_plugin(source, system, options, run)
            (out / "blocks" / f"{subject.name}.so").write_bytes(plugin)
            (Path(directory) / f"{subject.name}.so").write_bytes(plugin)
            needs = privileges.needs_of(runtime.check_plugins(Path(directory), system))
        runtime.check_task(task, task.read_bytes(), Path(directory), system)
    shutil.copyfile(task, out / app.TASK)
    try:
        described = yaml.safe_load(task.read_text())
    except yaml.YAMLError as error:  # a plug-in may end the program that judges tasks
        raise UserError(f"{paths.shown(task)}: {error}") from None
    return privileges.drives_io_ports(described, needs, inside)


def _fmu(subject: app.App, description: app.Fmu, system: System, out: Path, run: toolchain.Run) -> bool:
    """The unit, and the plug-in that calls it."""
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".fmu-") as work:
        unit = fmu.read(*fmu.unpacked(subject.directory, description.unit, Path(work) / "unit"))
        fmu.block(unit, subject.name, Path(work) / "source")
        drives = _blocks(subject, Path(work) / "source", runtime.WARNINGS, system, out, run)
        fmu.build(unit, subject.name, system, out, run)
        return drives


def _make(subject: app.App, description: app.Make, system: System, out: Path, run: toolchain.Run) -> None:
    """The program, and how its service differs from a task's."""
    safe = subject.directory / app.SAFE
    if safe.exists():
        runtime.check_task(safe, safe.read_bytes())
        shutil.copyfile(safe, out / app.SAFE)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".make-") as directory:
        source = Path(directory) / "source"
        shutil.copytree(
            subject.directory, source, symlinks=True, ignore=shutil.ignore_patterns(*sources.LEFT_BEHIND, *_BUILT)
        )
        made = source / description.program
        if not sources.inside(source, made.parent):
            where = paths.shown(subject.directory / app.FILE)
            raise UserError(f"{where}: program: {description.program}: lies behind a link; name a file of the app")
        made.unlink(missing_ok=True)
        # From the environment, because a Makefile may add to these; it cannot to what stands on make's command line.
        flags = " ".join(["-O2", *toolchain.LONG_TIMES, "-I/out/include"])
        variables = ["CC=gcc", "AR=ar", "PKG_CONFIG=pkg-config", f"CFLAGS={flags}"]
        variables += ["LDFLAGS=-Wl,--build-id=none"]
        runtime.command(Path(directory), system, ["env", "-C", "/out/source", *variables, "make"], run)
        if not (made.is_file() and sources.inside(source, made)):
            where = paths.shown(subject.directory / app.FILE)
            raise UserError(f"{where}: program: {description.program}: make does not make it; name what it makes")
        program = out / made.name
        shutil.copyfile(made, program)
        program.chmod(0o755)
        _send_along(subject, description, source, out)
    (out / "unit.d" / "program.conf").write_text(service(subject, description, safe=safe.exists()))


def _send_along(subject: app.App, description: app.Make, source: Path, out: Path) -> None:
    """What the program needs beside it; UserError where that may be left here without a word."""
    where = paths.shown(subject.directory / app.FILE)
    for name in description.files or []:
        sent, taken = source / name, out / name
        if any(map(sources.left_behind, Path(name).parts)):
            raise UserError(f"{where}: files: {name}: is what programs leave behind, by its name; give it another")
        if not sent.exists():
            raise UserError(f"{where}: files: {name}: is not there, and make does not make it; name what there is")
        if taken.exists():
            raise UserError(f"{where}: files: {name}: is sent anyhow; leave it out, or give it another name")
        if not all(sources.inside(source, path) for path in _below(sent)):
            raise UserError(f"{where}: files: {name}: has a link to outside the app; put a copy in its place")
        taken.parent.mkdir(parents=True, exist_ok=True)
        if sent.is_dir():
            shutil.copytree(sent, taken, ignore=sources.ignored)
        else:
            shutil.copy(sent, taken)
    if description.files is None and (left := _left(subject, description, source)):
        listed = ", ".join(left[:5]) + (", …" if len(left) > 5 else "")
        remedy = f"write files: [{left[0]}] for the files that the program needs there, files: [] for none"
        raise UserError(f"{where}: files: (nothing): would leave {listed} here; {remedy}")


def _left(subject: app.App, description: app.Make, source: Path) -> list[str]:
    """What the program may need, and does not get: data of the project, and libraries that make made."""
    data = {path.relative_to(subject.directory) for path in sources.files(subject.directory) if path.is_file()}
    hidden = {path for path in data if any(part.startswith(".") for part in path.parts)}
    data = {path for path in data - hidden if not _NO_DATA.fullmatch(path.name)}
    libraries = {path.relative_to(source) for path in _below(source) if ".so" in path.suffixes}
    return sorted(str(path) for path in (data | libraries) - {Path(description.program)})


def _below(path: Path) -> list[Path]:
    return [path, *path.rglob("*")]


def service(subject: app.App, description: app.Make, *, safe: bool) -> str:
    """A drop-in for flotilla-app@.service: a program instead of a task."""
    place = app.on_robot(subject.name)
    command = [str(place / Path(description.program).name), *description.arguments]
    # At a task's nice value a program that computes at ordinary priority leaves 1 % of a processor to all others.
    lines = ["[Service]", f"WorkingDirectory={place}", "Nice=0"]
    lines += ["ExecStart=", f"ExecStart={' '.join(map(_quoted, command))}", "ExecStopPost="]
    if safe:
        lines.append(f"ExecStopPost=/usr/bin/flotilla-run --safe {place / app.SAFE}")
    if not description.notify:
        lines += ["Type=exec", "WatchdogSec=0"]
    return "\n".join(lines) + "\n"


def _quoted(word: str) -> str:
    """A word of a unit's command line (systemd.service(5))."""
    for character, written in (("\\", "\\\\"), ('"', '\\"'), ("\n", "\\n"), ("%", "%%"), ("$", "$$")):
        word = word.replace(character, written)
    return f'"{word}"'
