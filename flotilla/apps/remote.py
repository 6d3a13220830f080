"""Apps on a robot: sent, started, watched, ended and removed over SSH.

An app lies in /data/apps/NAME, a link to the version beside it: it changes at once or not at all. It runs as
flotilla-app@NAME.service.
"""

from __future__ import annotations

import io
import json
import shlex
import signal
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any, BinaryIO

import pydantic

from flotilla.apps import app, fmu
from flotilla.common import durable, namespace, paths, progress, text
from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT, content, limited
from flotilla.fleet import apps
from flotilla.fleet.model import Board, Robot
from flotilla.robot import ssh

Show = Callable[[str], None]
"""Takes a line of the app's log."""
SCRIPT = Path(__file__).with_suffix(".sh")
"""What runs on robots, as root."""
_ANSWER_BYTES = 64 << 20
"""Of what a robot answers to a command. A journal is the longest."""
MADE_BYTES = 1 << 30
"""Of what it compiled."""
_LINE = 1 << 16
"""Characters of a line that a robot writes; a longer one is taken apart."""
_ENTRY = 1 << 20
"""Of an entry of its journal, which has 48 KiB of text at most."""
_RESERVE_KIB = 4096
"""Of the data partition, for the robot's journal and an app's statistics."""

_ENDED = {"7ad2d189f7e94e70a38c781354912448": "success", "d9b373ed55a64feb8242e02dbe79a49c": "failure"}
"""MESSAGE_ID of what the service manager says when a service has ended (systemd's sd-messages.h); its result."""


@dataclass(frozen=True)
class Connection:
    """A way to a robot."""

    robot: Robot
    ssh: Sequence[str]
    """The command line that reaches it, up to what it is to run there."""

    def argv(self, command: str, name: str, *arguments: str) -> list[str]:
        """What runs a command of app_robot.sh for the app `name`."""
        words = ["sudo", "sh", "-c", SCRIPT.read_text(), "flotilla", command, name, *arguments]
        return [*self.ssh, shlex.join(words)]

    def run(self, command: str, name: str, *arguments: str, stdin: bytes = b"") -> str:
        """Run it; what it says. UserError with the reason when it refuses or the robot does not answer."""
        with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as failure:
            argv = [*limited(_ANSWER_BYTES), *self.argv(command, name, *arguments)]
            with _started(argv, output, failure) as process:
                try:
                    process.communicate(stdin)
                except BaseException:
                    process.kill()
                    raise
            if process.returncode:
                raise self.error(process.returncode, content(failure))
            return content(output)

    def stream(self, command: str, name: str, *arguments: str, stdin: Path, stdout: Path, log: Path) -> None:
        """Run it between two files; what it says besides is shown as it comes, and kept in `log`."""
        argv = [*DIE_WITH_PARENT, *limited(MADE_BYTES), *self.argv(command, name, *arguments)]
        last = failed = ""
        left = _ANSWER_BYTES
        with stdin.open("rb") as given, stdout.open("wb") as made, log.open("w") as kept:
            pipe = subprocess.PIPE
            with subprocess.Popen(argv, stdin=given, stdout=made, stderr=pipe, text=True, errors="replace") as process:
                assert process.stderr
                try:
                    for last in _lines(process.stderr):
                        left -= len(last)
                        if left < 0:
                            raise UserError(f"{self.robot.name}: sent more than {_ANSWER_BYTES >> 20} MiB; look there")
                        last = text.shown(last)
                        kept.write(last)
                        print(last, end="", file=sys.stderr, flush=True)
                        failed = failed or (last if namespace.ERROR.search(last) else "")
                    process.wait()
                finally:
                    process.terminate()
        if process.returncode:
            raise self.error(
                process.returncode, f"{(failed or last).strip()}; its output is above and in {paths.shown(log)}"
            )

    def error(self, status: int, message: str) -> UserError:
        """Why something failed on the robot, or on the way."""
        name, message = self.robot.name, message.strip()
        if status == -signal.SIGXFSZ:
            return UserError(f"{name}: its answer does not end; nothing was done with it: look at the robot")
        if status != 255:
            return UserError(f"{name}: {message or f'status {status}'}")
        if "Host key verification failed" in message or "IDENTIFICATION HAS CHANGED" in message:
            return UserError(
                f"{name}: rejected, because its host key is not the one of {paths.shown(paths.KEYS / 'known_hosts')}: "
                "another robot's card is in it, its image was made with other keys, or somebody is in between\n"
                + message
            )
        return ssh.no_answer(self.robot, message or "the connection broke")


def _lines(stream: IO[str]) -> Iterator[str]:
    return iter(lambda: stream.readline(_LINE), "")


def _started(argv: Sequence[str], output: BinaryIO, failure: BinaryIO) -> subprocess.Popen[bytes]:
    """A process that writes to files. Ctrl-C meanwhile leaves none behind, which would hold its end of the robot's
    command."""
    interrupts: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=output, stderr=failure)
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupts:
        with process:
            process.kill()
        raise KeyboardInterrupt
    return process


@contextmanager
def connection(robot: Robot, words: Sequence[str] | None = None) -> Iterator[Connection]:
    """One connection that all commands share; `words`: ssh by another way than the inventory's."""
    program, *way = words or ssh.command(robot)
    with tempfile.TemporaryDirectory(prefix="flotilla-") as directory:  # short: it holds a socket
        settings = ["ControlMaster=auto", f"ControlPath={directory}/master", "ControlPersist=60", "ConnectTimeout=20"]
        settings += ["ServerAliveInterval=10", "ServerAliveCountMax=6"]
        options = [word for setting in settings for word in ("-o", setting)]
        try:
            yield Connection(robot, [program, *options, *way])
        finally:
            subprocess.run([program, *options, "-O", "exit", *way], capture_output=True, check=False)


def send(to: Connection, subject: app.App, board: Board, files: Path) -> None:
    """Put the built app `files` in the place of what the robot has of it, and end that."""
    apps.check_names(files)
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        tar.add(files, arcname=".", filter=_plain)
    size = sum(file.stat().st_size for file in files.rglob("*") if file.is_file())
    program = linked(subject)
    version = apps.version(files)
    arguments = [version, str(need_kib(size)), program]
    # Before anything is sent, and by the connection that all share: what is cut off then ends on the robot at once.
    to.run("fits", subject.name, board.machine)
    with progress.step(f"{subject.name} to {to.robot.name}, {progress.size(size)}"):
        to.run("receive", subject.name, *arguments, stdin=archive.getvalue())


def keep(to: Connection, name: str) -> None:
    """Let it start with the robot."""
    to.run("keep", name)


def start(to: Connection, name: str) -> None:
    """Start it; it goes on by itself."""
    to.run("start", name)


def stop(to: Connection, name: str) -> str:
    """End it; its report."""
    to.run("stop", name)
    return report(to, name)


def remove(to: Connection, name: str) -> None:
    """End it, and remove all of it."""
    to.run("remove", name)


def status(to: Connection, name: str) -> str:
    """Whether it runs, since when, and whether it starts with the robot; a line each."""
    return text.shown(to.run("status", name).strip())


class _Interrupts:
    """While it lasts, the first Ctrl-C ends the run and the second one this command, from before anything starts."""

    def __init__(self) -> None:
        self.any = False
        self._run: subprocess.Popen[str] | None = None

    def __enter__(self) -> _Interrupts:
        self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def end(self, run: subprocess.Popen[str] | None = None) -> None:
        """Let the run end now; with a run, whenever an interrupt says so."""
        self._run = run or self._run
        self.any = self.any or run is None
        if self.any and self._run and self._run.stdin:
            self._run.stdin.close()

    def _handle(self, *_: object) -> None:
        if self.any and self._run:  # while it is being started, all are one
            raise KeyboardInterrupt
        self.end()


def run(to: Connection, name: str, show: Show) -> str:
    """Start it anew and show its log until it ends, or until KeyboardInterrupt ends it; its report.

    It runs for as long as this does: the robot ends it when nobody listens any more.
    """
    # In a session of its own: Ctrl-C ends the app and not the log, whose last lines say what came of it.
    argv = [*DIE_WITH_PARENT, *to.argv("run", name)]
    log: list[str] = []
    ended: _Entry | None = None
    cursor = ""

    def take(line: str) -> None:
        nonlocal ended, cursor
        entry = _entry(to, line)
        cursor = entry.cursor
        if entry.id in _ENDED:
            ended = entry
        log.append(_message(entry))
        show(log[-1])

    pipe = subprocess.PIPE
    with (
        _Interrupts() as interrupts,
        subprocess.Popen(argv, stdin=pipe, stdout=pipe, stderr=pipe, text=True, start_new_session=True) as process,
    ):
        assert process.stdout
        assert process.stderr
        try:
            interrupts.end(process)
            cursor = process.stdout.readline(_LINE).strip()
            while not ended and (line := process.stdout.readline(_ENTRY)).endswith("\n"):
                try:
                    take(line)
                except KeyboardInterrupt:
                    if interrupts.any:
                        raise
                    interrupts.end()
            if not ended and not interrupts.any:
                raise to.error(process.wait(), process.stderr.read(_LINE))
        except KeyboardInterrupt:
            to.run("stop", name)
            raise
        finally:
            process.kill()
    for line in to.run("rest", name, cursor).splitlines():
        take(line)
    _write(to, name, "log", "".join(f"{line}\n" for line in log))
    outcome = report(to, name)
    if ended and _ENDED[ended.id or ""] != "success":
        remedy = f"its log is {paths.shown(_file(to, name, 'log'))}"
        raise UserError("\n".join(filter(None, (outcome, f"{to.robot.name}: {name} ended: {ended.result}; {remedy}"))))
    return outcome


def interrupted(to: Connection, name: str) -> str:
    """What the robot has of the app now: for whoever interrupted a command that may have changed it."""
    try:
        properties = dict(line.split("=", 1) for line in status(to, name).splitlines())
    except UserError as error:
        return str(error)
    kept = "starts" if properties["Kept"] == "yes" else "does not start"
    state, version = properties["ActiveState"], properties["Version"]
    return f"{to.robot.name}: {name} is {state}, version {version}, and {kept} with the robot"


class _Entry(pydantic.BaseModel):
    """Of a journal in JSON, where bytes that are no text come as a list of numbers."""

    model_config = pydantic.ConfigDict(strict=True)
    cursor: str = pydantic.Field(alias="__CURSOR", max_length=1000)
    message: str | list[Annotated[int, pydantic.Field(ge=0, le=255)]] | None = pydantic.Field(None, alias="MESSAGE")
    id: str | None = pydantic.Field(None, alias="MESSAGE_ID")
    result: str = pydantic.Field("it failed", alias="UNIT_RESULT")


def _entry(to: Connection, line: str) -> _Entry:
    try:
        return _Entry.model_validate_json(line)
    except pydantic.ValidationError:
        raise UserError(f"{to.robot.name}: its log has what is no entry of a journal: {line[:100]!a}") from None


def _message(entry: _Entry) -> str:
    """The entry's text, fit for a terminal."""
    message = entry.message
    return text.shown(bytes(message).decode(errors="replace") if isinstance(message, list) else message or "")


def follow_log(to: Connection, name: str) -> None:
    """Its last lines and all that come, on standard output, until KeyboardInterrupt."""
    sys.stdout.flush()
    with suppress(KeyboardInterrupt):
        argv = [*DIE_WITH_PARENT, *to.argv("log", name)]
        pipe = subprocess.PIPE
        with subprocess.Popen(argv, stdout=pipe, stderr=subprocess.STDOUT, text=True, errors="replace") as process:
            assert process.stdout
            try:
                for line in _lines(process.stdout):
                    print(text.shown(line), end="", flush=True)
            finally:
                process.terminate()
        if process.returncode:
            raise to.error(process.returncode, "its output is above")


def report(to: Connection, name: str) -> str:
    """What it measured when it ended; empty when it wrote nothing. The file is brought along."""
    statistics = to.run("statistics", name)
    if not statistics:
        return ""
    _write(to, name, "json", statistics)
    try:
        lines = [text.shown(line) for line in summary(json.loads(statistics))]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        lines = ["its statistics are not those of flotilla-run"]
    return "\n".join([*lines, f"all of it: {paths.shown(_file(to, name, 'json'))}"])


def summary(statistics: dict[str, Any]) -> list[str]:
    """What flotilla-run's statistics say about real time, a line each."""

    def times(what: dict[str, Any]) -> str:
        words = (("mean", "mean_ns"), ("99 %", "p99_ns"), ("max", "max_ns"))  # blocks have no percentiles
        return ", ".join(f"{word} {what[key] / 1000:.1f} µs" for word, key in words if key in what)

    return [
        f"period {statistics['period_ns'] / 1e6:g} ms, {statistics['steps']} steps, "
        f"{statistics['overruns']} overruns, {statistics['skipped']} skipped",
        f"jitter: {times(statistics['jitter'])}",
        f"step:   {times(statistics['step'])}",
        *(
            line
            for block, what in statistics.get("blocks", {}).items()
            for line in (
                f"  {block}: {times(what)}",
                *(
                    f"    {rate['name']}, every {rate['every']} steps: {times(rate)}, {rate['overruns']} overruns"
                    for rate in what.get("rates", [])
                ),
            )
        ),
    ]


def _file(to: Connection, name: str, kind: str) -> Path:
    return paths.BUILD / "reports" / f"app-{to.robot.name}-{name}.{kind}"


def _write(to: Connection, name: str, kind: str, text: str) -> None:
    file = _file(to, name, kind)
    file.parent.mkdir(parents=True, exist_ok=True)
    durable.write(file, text)


def need_kib(size: int) -> int:
    """What must be free on a robot's data partition for an app of `size` bytes."""
    return size // 1024 + _RESERVE_KIB


def linked(subject: app.App) -> str:
    """What of the app is linked with libraries that the robot may lack; nothing of what is compiled here alone."""
    if isinstance(subject.description, app.Make):
        return Path(subject.description.program).name
    return str(fmu.object_of(subject.name)) if isinstance(subject.description, app.Fmu) else ""


def _plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
    """Of nobody in particular."""
    member.uid = member.gid = member.mtime = 0
    member.uname = member.gname = ""
    member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
    return member
