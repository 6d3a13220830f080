"""Builds an app for a board, by the locked compiler: the files as they lie on the robot."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from images.builder import app, app_ert, app_fmu, cache, paths, progress, runtime, toolchain
from images.builder.errors import UserError
from images.builder.fleet import Board

_BUILT = ("*.o", "*.d", ".git")
"""What a copy of a project leaves out: what its own build left behind may be for another processor."""


def build(subject: app.App, board: Board, out: Path, run: toolchain.Run = toolchain.run) -> None:
    """Fill `out` with what goes to a robot of `board`; UserError with the compiler's or the runtime's own words.

    `run` says where the robot's code is compiled.
    """
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    with cache.exclusive(), progress.step(f"{subject.name} for {board.architecture}"):
        (out / "unit.d").mkdir(parents=True)  # what the app's service has beyond runtime/systemd/
        description = subject.description
        try:
            if isinstance(description, app.Make):
                _make(subject, description, board.architecture, out, run)
            elif isinstance(description, app.Ert):
                with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".ert-") as work:
                    source = Path(work) / "source"
                    model, times_s = description.model, description.sample_times
                    app_ert.block(subject.directory, model, subject.name, times_s, source, board.architecture)
                    try:
                        _blocks(subject, source, ("-Wall",), board.architecture, out, run)
                    except UserError as error:
                        raise app_ert.explained(error, board.architecture) from None
            elif isinstance(description, app.Fmu):
                _fmu(subject, description, board.architecture, out, run)
            else:
                _blocks(subject, subject.directory, runtime.WARNINGS, board.architecture, out, run)
        except UserError as error:
            raise UserError(f"{paths.shown(subject.directory)}: nothing was deployed: {error}") from None


def _blocks(
    subject: app.App, source: Path, options: Sequence[str], architecture: str, out: Path, run: toolchain.Run
) -> None:
    """The plug-in of all that is in `source`, and the task; the runtime judges both as the robot would."""
    task = subject.directory / app.TASK
    (out / "blocks").mkdir()
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".blocks-") as directory:
        if any(source.glob("*.c")):
            plugin = runtime.compile_plugin(source, architecture, options, run)
            (out / "blocks" / f"{subject.name}.so").write_bytes(plugin)
            (Path(directory) / f"{subject.name}.so").write_bytes(plugin)
            runtime.check_plugins(Path(directory), architecture)
        runtime.check_task(task, task.read_bytes(), Path(directory), architecture)
    shutil.copyfile(task, out / app.TASK)


def _fmu(subject: app.App, description: app.Fmu, architecture: str, out: Path, run: toolchain.Run) -> None:
    """The unit, and the plug-in that calls it."""
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".fmu-") as work:
        unit = app_fmu.read(*app_fmu.unpacked(subject.directory, description.unit, Path(work) / "unit"))
        app_fmu.block(unit, subject.name, Path(work) / "source")
        _blocks(subject, Path(work) / "source", runtime.WARNINGS, architecture, out, run)
        app_fmu.build(unit, subject.name, architecture, out, run)


def _make(subject: app.App, description: app.Make, architecture: str, out: Path, run: toolchain.Run) -> None:
    """The program, and how its service differs from a task's."""
    safe = subject.directory / app.SAFE
    if safe.exists():
        runtime.check_task(safe, safe.read_bytes())
        shutil.copyfile(safe, out / app.SAFE)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".make-") as directory:
        source = Path(directory) / "source"
        shutil.copytree(subject.directory, source, symlinks=True, ignore=shutil.ignore_patterns(*_BUILT))
        made = source / description.program
        made.unlink(missing_ok=True)
        # From the environment, because a Makefile may add to these; it cannot to what stands on make's command line.
        variables = ["CC=gcc", "AR=ar", "PKG_CONFIG=pkg-config", "CFLAGS=-O2 -I/out/include"]
        variables += ["LDFLAGS=-Wl,--build-id=none"]
        runtime.command(Path(directory), architecture, ["env", "-C", "/out/source", *variables, "make"], run)
        if not made.is_file():
            where = paths.shown(subject.directory / app.FILE)
            raise UserError(f"{where}: program: {description.program}: make does not make it; name what it makes")
        program = out / made.name
        shutil.copyfile(made, program)
        program.chmod(0o755)
    (out / "unit.d" / "program.conf").write_text(service(subject, description, safe=safe.exists()))


def service(subject: app.App, description: app.Make, *, safe: bool) -> str:
    """A drop-in for flotilla-app@.service: a program instead of a task."""
    place = app.on_robot(subject.name)
    command = [str(place / Path(description.program).name), *description.arguments]
    lines = ["[Service]", f"WorkingDirectory={place}"]
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
