"""`make deploy`: an app built, sent to a robot and run there, or what became of one that was sent before."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from images.builder import app, app_build, app_compiler, app_robot, toolchain
from images.builder.errors import UserError
from images.builder.fleet import Board

Run = Callable[[app_robot.Connection, str], str]


def _start(to: app_robot.Connection, name: str) -> str:
    app_robot.start(to, name)
    return app_robot.status(to, name)


def _log(to: app_robot.Connection, name: str) -> str:
    app_robot.follow_log(to, name)
    return ""


def _remove(to: app_robot.Connection, name: str) -> str:
    app_robot.remove(to, name)
    return f"{name} is gone from {to.robot.name}"


RUNS: dict[str, Run] = {
    "start": _start,
    "stop": app_robot.stop,
    "status": app_robot.status,
    "log": _log,
    "remove": _remove,
}
"""What RUN= does with an app that is on the robot."""


def command(to: app_robot.Connection, name: str, run: str) -> str:
    """One of RUNS; what came of it."""
    if run not in RUNS:
        raise UserError(f"RUN={run}: is none of {', '.join(RUNS)}")
    return RUNS[run](to, name)


def deploy(
    to: app_robot.Connection, directory: Path, board: Board, *, keep: bool, show: app_robot.Show, on_robot: bool = False
) -> str:
    """Build the app, here or on the robot, and bring it there. Then run it until it ends or KeyboardInterrupt ends it,
    and report; or, to `keep` it, let it go on by itself, now and whenever the robot starts. What interrupts it
    says what the robot has of the app."""
    subject = app.load(directory)
    app.check_board(subject, to.robot, board)
    try:
        place(to, subject, board, on_robot=on_robot)
        if not keep:
            return app_robot.run(to, subject.name, show)
        app_robot.keep(to, subject.name)
        return _start(to, subject.name)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(app_robot.interrupted(to, subject.name)) from None


def place(to: app_robot.Connection, subject: app.App, board: Board, *, on_robot: bool = False) -> None:
    """Build the app and put it on the robot; it does not run."""
    run = app_compiler.Compiler(to, subject.name).run if on_robot else toolchain.run
    with tempfile.TemporaryDirectory(prefix="flotilla-app-") as work:
        files = Path(work) / subject.name
        app_build.build(subject, board, files, run)
        app_robot.send(to, subject, board, files)
