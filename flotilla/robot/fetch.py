"""Recorder files of a robot's task brought to this computer (`make fetch`): those that are new, and what has grown.

A file comes as `NAME.part` and is renamed when all of it is there, so a fetch that broke off goes on where it ended.
Recorders only append, and say in a file's header when it was begun: that tells one file from another of its name.
"""

from __future__ import annotations

import hashlib
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.processes import bounded
from flotilla.fleet.model import Robot
from flotilla.robot import ssh

ROOTS = ("/var/lib/flotilla", "/var/lib/flotilla-apps")
"""Folders of tasks and of apps on the robot, each with one of its own."""
_BEGIN_BYTES = 256
"""Of a file, which tell it from others: the name and the time of its header are among them."""
_LIST = (
    'for file in *.rec; do test -s "$file" || continue; '
    f'echo "$(stat -c %s "$file") $(head -c {_BEGIN_BYTES} "$file" | sha256sum | cut -c 1-64) $file"; done'
)
_LISTED = re.compile(r"(\d+) ([0-9a-f]{64}) ([A-Za-z][A-Za-z0-9_-]*-\d{6}\.rec)")
_READ_BYTES = 1 << 16
_GONE = 3
"""Status for a file that the recorder has removed meanwhile, or a folder that is not there."""


@dataclass(frozen=True)
class _Remote:
    """A file on the robot."""

    name: str
    size: int
    begin: str
    """SHA-256 of its first bytes."""


def fetch(robot: Robot, task: str, out: Path | None = None) -> str:
    """Bring the files to `out` (build/recordings/ROBOT/TASK); what came of it.

    UserError where the robot does not answer or has none, another file has the name of one here, or it cannot be
    written. What came before stays.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", task):
        raise UserError(f"TASK={task}: is no name of a task; make top ASK=1 shows which tasks robots have")
    place = out or paths.BUILD / "recordings" / robot.name / task
    there = _listed(robot, task)
    wanted = [(each, begin) for each in there if (begin := _have(each, place)) < each.size]
    total = sum(each.size - begin for each, begin in wanted)
    done, gone = 0, []
    with progress.step(f"{len(wanted)} files of {robot.name}, {progress.size(total)}") as step:

        def came(count: int) -> None:
            nonlocal done
            done += count
            step.at(done, total)

        for each, begin in wanted:
            if not _bring(robot, task, each, begin, place / each.name, came):
                gone.append(f"{robot.name}: {each.name}: the recorder has removed it meanwhile, for newer ones")
    kept = len(there) - len(wanted)
    said = f"{robot.name}: {len(wanted) - len(gone)} files fetched, {progress.size(done)}; {kept} were there already"
    return "\n".join([f"{said}: {paths.shown(place)}", *gone])


def _listed(robot: Robot, task: str) -> list[_Remote]:
    """Those that are not empty, by name."""
    try:
        done = bounded(_command(robot, task, _LIST))
    except UserError as error:
        raise UserError(f"{robot.name}: {error}") from None
    _check(robot, done.returncode, done.stderr)
    found = [_Remote(m[3], int(m[1]), m[2]) for line in done.stdout.splitlines() if (m := _LISTED.fullmatch(line))]
    if not found:
        raise UserError(
            f"{robot.name}: {task} has recorded nothing: no *.rec in {' or '.join(f'{root}/{task}' for root in ROOTS)}"
            "; has it a block recorder that writes there? make top ASK=1 shows which tasks run"
        )
    return sorted(found, key=lambda each: each.name)


def _have(each: _Remote, place: Path) -> int:
    """How much of it is here, whole or not. UserError where another file has its name."""
    file, part = place / each.name, _part(place / each.name)
    if file.exists() and not _begins(file, each):
        raise UserError(
            f"{paths.shown(file)}: is another recording than {each.name} of the robot, where files begin at 1 again "
            "when they were removed; name another place: OUT="
        )
    if part.exists() and not _begins(part, each):
        part.unlink()
    if part.exists() and part.stat().st_size >= each.size:
        durable.rename(part, file)
    return max((path.stat().st_size for path in (file, part) if path.exists()), default=0)


def _begins(file: Path, each: _Remote) -> bool:
    """Whether it is the same, as far as it goes."""
    with file.open("rb") as opened:
        begin = opened.read(_BEGIN_BYTES)
    return len(begin) == min(_BEGIN_BYTES, each.size) and hashlib.sha256(begin).hexdigest() == each.begin


def _bring(robot: Robot, task: str, each: _Remote, begin: int, file: Path, came: Callable[[int], None]) -> bool:
    """What is missing of a file; whether the robot still has it."""
    part = _part(file)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.exists() and (not part.exists() or part.stat().st_size < begin):
            shutil.copyfile(file, part)
        with part.open("ab") as out:
            if not _append(robot, task, each, begin, out.write, came):
                return False
        if part.stat().st_size < each.size:
            raise UserError(f"{robot.name}: {each.name}: ended too early; fetch again, to resume there")
        durable.rename(part, file)
    except OSError as error:
        raise UserError(f"{paths.shown(file)}: {error.strerror}; make room, or name another place: OUT=") from error
    return True


def _append(
    robot: Robot, task: str, each: _Remote, begin: int, write: Callable[[bytes], object], came: Callable[[int], None]
) -> bool:
    name = shlex.quote(each.name)
    # What is appended while it comes is left to the next fetch.
    script = f"test -f {name} || exit {_GONE}; tail -c +{begin + 1} {name} | head -c {each.size - begin}"
    argv = _command(robot, task, script)
    with subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stderr
        try:
            left = each.size - begin
            while data := process.stdout.read(_READ_BYTES):
                left -= len(data)
                if left < 0:
                    raise UserError(f"{robot.name}: {each.name}: sends more than it has; look at the robot")
                write(data)
                came(len(data))
        except BaseException:
            process.kill()
            raise
        said = process.stderr.read(_READ_BYTES).decode("utf-8", "replace")
    if process.returncode == _GONE:
        return False
    _check(robot, process.returncode, said)
    return True


def _part(file: Path) -> Path:
    return file.with_name(f"{file.name}.part")


def _command(robot: Robot, task: str, script: str) -> Sequence[str]:
    folders = " || ".join(f"cd {shlex.quote(f'{root}/{task}')} 2>/dev/null" for root in ROOTS)
    return [*ssh.command(robot), f"{folders} || exit {_GONE}; {script}"]


def _check(robot: Robot, status: int, said: str) -> None:
    if status == ssh.FAILED:
        raise ssh.no_answer(robot, said.strip())
    if status not in (0, _GONE):
        raise UserError(
            f"{robot.name}: {said.strip() or f'status {status}'}; look there: make ssh ROBOT={robot.number}"
        )
