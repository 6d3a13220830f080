"""Apps that the inventory gives to robots, built for their boards: for a card, and for a robot that lacks them.

What is built stays in the cache: a roll-out to a fleet, and the image after it, compile nothing again.
"""

from __future__ import annotations

import base64
import io
import tarfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import cache, host, namespace, paths, sources
from flotilla.common.errors import UserError
from flotilla.fleet import apps, interfaces
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Board, Fleet, Robot


def check(fleet: Fleet, robots: Iterable[Robot]) -> None:
    """Refuse what no build is needed to refuse, all of it at once: descriptions, and interfaces that a robot lacks."""
    from flotilla.apps import app

    problems = []
    for robot in robots:
        for name in robot.apps:
            try:
                subject = app.load(paths.APPS / name)
                app.check_board(subject, robot, fleet.boards[robot.board])
                task = subject.directory / app.TASK
                problems += [_of(robot, name, problem) for problem in _interfaces(task, fleet, robot)]
            except UserError as error:
                problems.append(_of(robot, name, error))
    if problems:
        raise UserError("\n".join(problems))


def built(fleet: Fleet, robots: Sequence[Robot]) -> dict[str, list[BuiltApp]]:
    """The apps of each robot by its name, in the inventory's order; from the cache where nothing changed.

    UserError with the compiler's or the runtime's own words.
    """
    if any(robot.apps for robot in robots):
        host.check()
        namespace.check()
        check(fleet, robots)
    made: dict[str, list[BuiltApp]] = {robot.name: [] for robot in robots}
    for robot in robots:
        for name in robot.apps:
            try:
                made[robot.name].append(_built(name, fleet.boards[robot.board]))
            except UserError as error:
                raise UserError(_of(robot, name, error)) from None
    return made


def _built(name: str, board: Board) -> BuiltApp:
    # Here, because robots without apps need none of it, and provisioning asks for each robot in a process of its own.
    from flotilla.apps import app, builder, remote
    from flotilla.debian import runtime

    subject = app.load(paths.APPS / name)
    apps.check_names(subject.directory)

    def make(out: Path) -> None:
        builder.build(subject, board, out / name)

    key = key_of(subject.directory, runtime.key(board.system), str(board.system))
    return apps.read(name, cache.result("app", key, make) / name, remote.linked(subject))


def key_of(directory: Path, *words: str) -> str:
    """Hash of all that decides what is built of the app in `directory`; `words`: what it is built for, and with.

    Rather too much, all of this package and of those that it uses, than too little.
    """
    rooms = [paths.PACKAGE / name for name in ("apps", "debian", "fleet", "common")]
    locked = paths.PROJECT / "requirements/build.lock"
    return cache.digest(*words, directory, *behind_links(directory), *rooms, locked)


def behind_links(directory: Path) -> list[Path]:
    """The files outside of an app's directory that its links lead to: a build reads them as its own."""
    links = [path.resolve() for path in sources.files(directory) if path.is_symlink()]
    return [path for path in links if path.exists() and not path.is_relative_to(directory.resolve())]


def repairs(actions: Sequence[tuple[str, str]], there: Sequence[BuiltApp]) -> list[dict[str, Any]]:
    """What a robot runs, as root and in this order, so that its apps become `there`: a command line and its standard
    input in base64, with the app's name.

    `actions`: of apps by name, as `flotilla.robot.apps` finds them.
    """
    from flotilla.apps import remote

    given = {app.name: app for app in there}
    commands = []
    for name, action in actions:
        arguments: list[str] = []
        stdin = b""
        if action == "receive":
            app = given[name]
            arguments, stdin = [app.version, str(remote.need_kib(app.bytes)), app.program], _archive(app)
        argv = ["sh", "-c", remote.SCRIPT.read_text(encoding="utf-8"), "flotilla", action, name, *arguments]
        commands.append({"name": name, "argv": argv, "stdin": base64.b64encode(stdin).decode()})
    return commands


def _archive(app: BuiltApp) -> bytes:
    """Its files, of nobody in particular."""
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for directory in app.directories:
            member = tarfile.TarInfo(str(directory))
            member.type, member.mode = tarfile.DIRTYPE, 0o755
            tar.addfile(member)
        for path, (content, mode) in sorted(app.files.items()):
            member = tarfile.TarInfo(str(path))
            member.size, member.mode = len(content), mode
            tar.addfile(member, io.BytesIO(content))
    return archive.getvalue()


def _interfaces(task: Path, fleet: Fleet, robot: Robot) -> list[str]:
    """What is wrong with the interfaces that an app's task names, as for control tasks."""
    try:
        description = yaml.safe_load(task.read_text(encoding="utf-8")) if task.is_file() else None
    except (yaml.YAMLError, UnicodeDecodeError):  # the runtime's to say
        description = None
    return [f"{paths.shown(task)}: {problem}" for problem in interfaces.problems(description, fleet, robot)]


def _of(robot: Robot, name: str, error: object) -> str:
    return f"{paths.shown(paths.INVENTORY)}: {robot.name}.apps: {name}: {error}"
