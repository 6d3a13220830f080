"""Signals of a running task from the station, by the robot's own `flotilla-scope` (`make scope`)."""

from __future__ import annotations

import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.common.text import shown
from flotilla.fleet.model import Robot
from flotilla.robot import ssh

_PROGRAM = "flotilla-scope"
_LINE = 1 << 16
"""Bytes of a line that is shown; a longer one is taken apart."""


def words(
    task: str, signals: Sequence[str], *, every: int | None, rows: int | None, trigger: str | None, before: int | None,
    csv: bool,
) -> list[str]:  # fmt: skip
    """The command on the robot; its `--help` says what the options mean."""
    options = {"every": every, "rows": rows, "trigger": trigger, "before": before}
    given = [f"--{name}={value}" for name, value in options.items() if value is not None]
    return [_PROGRAM, *given, *(["--csv"] if csv else []), "--", task, *signals]


def signals(robot: Robot, task: str) -> str:
    """All signals of a task that runs, a line each: name, type, number of elements, unit. UserError as below."""
    return ssh.output(robot, [_PROGRAM, "--", task])


def show(robot: Robot, command: Sequence[str]) -> None:
    """Print what the command says until it ends. UserError when the robot refuses or does not answer."""
    _run(robot, command, None)


def record(robot: Robot, command: Sequence[str], file: Path) -> int:
    """Write what the command says to a file, until it ends or the user interrupts. Returns the number of rows.

    UserError as above, and where the file cannot be written. Rows that came before an error are kept; without any, the
    former file is.
    """
    beside = file.with_name(f"{file.name}.part")
    try:
        with beside.open("wb") as out, suppress(KeyboardInterrupt):
            try:
                _run(robot, command, out.fileno())
            except UserError:
                _keep(beside, file)
                raise
        return _keep(beside, file)
    except OSError as error:
        raise UserError(f"{paths.shown(file)}: {error.strerror}; name a file that can be written") from error
    finally:
        beside.unlink(missing_ok=True)


def _keep(beside: Path, file: Path) -> int:
    """Replace the file if there are rows; how many. What interrupts may have cut the last line."""
    content = beside.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    rows = max(whole.count(b"\n") - 1, 0)
    if rows:
        beside.write_bytes(whole)
        durable.rename(beside, file)
    return rows


def _run(robot: Robot, command: Sequence[str], stdout: int | None) -> None:
    argv = [*ssh.command(robot), shlex.join(command)]
    with (
        tempfile.TemporaryFile() as complaints,
        subprocess.Popen(
            argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE if stdout is None else stdout, stderr=complaints
        ) as process,
    ):
        try:
            while process.stdout and (line := process.stdout.readline(_LINE)):
                print(shown(line.decode("utf-8", "replace")), end="", flush=True)
            process.wait()
        except BaseException:
            process.terminate()
            raise
        complaints.seek(0)
        reason = shown(complaints.read(_LINE).decode("utf-8", "replace").strip())
    if process.returncode == ssh.FAILED:
        raise ssh.no_answer(robot, reason)
    if process.returncode:
        raise UserError(f"{robot.name}: {reason.removeprefix(f'{_PROGRAM}: ')}")
