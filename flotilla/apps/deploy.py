"""`make deploy`: an app built, sent to a robot and run there, or what became of one that was sent before."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from flotilla.apps import app, builder, remote, remote_compiler
from flotilla.common.errors import UserError
from flotilla.debian import toolchain
from flotilla.fleet.model import Board, Robot

Run = Callable[[remote.Connection, str], str]


def _start(to: remote.Connection, name: str) -> str:
    remote.start(to, name)
    return remote.status(to, name)


def _log(to: remote.Connection, name: str) -> str:
    remote.follow_log(to, name)
    return ""


def _remove(to: remote.Connection, name: str) -> str:
    remote.remove(to, name)
    return f"{name} is gone from {to.robot.name}"


RUNS: dict[str, Run] = {
    "start": _start,
    "stop": remote.stop,
    "status": remote.status,
    "log": _log,
    "remove": _remove,
}
"""What RUN= does with an app that is on the robot."""


def command(to: remote.Connection, name: str, run: str) -> str:
    """One of RUNS; what came of it."""
    if run not in RUNS:
        raise UserError(f"RUN={run}: is none of {', '.join(RUNS)}")
    return RUNS[run](to, name)


def deploy(
    to: remote.Connection, directory: Path, board: Board, *, keep: bool, show: remote.Show, on_robot: bool = False
) -> str:
    """Build the app, here or on the robot, and bring it there. Then run it until it ends or KeyboardInterrupt ends it,
    and report; or, to `keep` it, let it go on by itself, now and whenever the robot starts. What interrupts it
    says what the robot has of the app."""
    subject = app.load(directory)
    app.check_board(subject, to.robot, board)
    try:
        place(to, subject, board, on_robot=on_robot)
        if not keep:
            report = remote.run(to, subject.name, show)
        else:
            remote.keep(to, subject.name)
            report = _start(to, subject.name)
        return "\n".join(filter(None, (report, _hint(to.robot, subject.name, keep=keep))))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(remote.interrupted(to, subject.name)) from None


def _hint(robot: Robot, name: str, *, keep: bool) -> str:
    """What the inventory has to do with the app; empty where that is nothing."""
    if name in robot.apps:
        return f"{name} is one of {robot.name}'s apps: make provision ROBOT={robot.number} brings the inventory's back"
    return f"{robot.name} has it until it has a new card; for good: apps: [{name}] in robots.yml" if keep else ""


def place(to: remote.Connection, subject: app.App, board: Board, *, on_robot: bool = False) -> None:
    """Build the app and put it on the robot; it does not run."""
    run = remote_compiler.Compiler(to, subject.name).run if on_robot else toolchain.run
    with tempfile.TemporaryDirectory(prefix="flotilla-app-") as work:
        files = Path(work) / subject.name
        builder.build(subject, board, files, run)
        remote.send(to, subject, board, files)
