"""Rows of signals of a running task, as they come: the robot's own `flotilla-scope` by ssh, which ends with its stdin,
so that no watcher stays on the robot when a page, this program or the connection goes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import shlex
from collections.abc import AsyncIterator, Sequence
from typing import Any

from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.fleet.model import Robot
from flotilla.robot import scope, ssh

ROWS_HZ = 100
"""To a browser, without a trigger."""
_BATCH_S = 0.1
_BATCH_ROWS = 2000
_LINE_BYTES = 65536
_SETTINGS = ("-o", "ServerAliveInterval=10", "-o", "ServerAliveCountMax=3")
_UNTIL_STDIN_ENDS = (
    "exec 3<&0; {command} & task=$!; {{ cat <&3; kill $task; }} >/dev/null 2>&1 & cat=$!; "
    "wait $task; status=$?; kill $cat 2>/dev/null; exit $status"
)


def every(period_s: float | None) -> int:
    """Steps from one row to the next, so that no more than ROWS_HZ come."""
    return max(1, round(1 / (period_s * ROWS_HZ) + 0.499)) if period_s else 10


async def rows(robot: Robot, command: Sequence[str], signals: Sequence[str]) -> AsyncIterator[list[list[Any]]]:
    """Batches of rows until the command ends: time in s since the robot started, lost rows before, then the signals.

    UserError when the robot refuses or does not answer.
    """
    program, *way = ssh.command(robot)
    script = _UNTIL_STDIN_ENDS.format(command=shlex.join(command))
    argv = [*DIE_WITH_PARENT, program, *_SETTINGS, *way, shlex.join(["sh", "-c", script])]
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *argv, stdin=pipe, stdout=pipe, stderr=pipe, limit=_LINE_BYTES
    )  # fmt: skip
    assert process.stdin
    assert process.stdout
    assert process.stderr
    complaints = asyncio.create_task(_said(process.stderr))
    batch: asyncio.Queue[list[Any] | None] = asyncio.Queue(_BATCH_ROWS)
    reading = asyncio.create_task(_read(process.stdout, signals, batch))
    try:
        more = True
        while more:
            found = [await batch.get()]
            if found[0] is not None:
                await asyncio.sleep(_BATCH_S)  # what comes meanwhile goes along
            while not batch.empty():
                found.append(batch.get_nowait())
            more = found[-1] is not None
            if come := [row for row in found if row is not None]:
                yield come
        process.stdin.close()  # a line that was none ends it, too
        status = await process.wait()
        reason = (await complaints).decode("utf-8", "replace").strip()
        if status == ssh.FAILED:
            raise ssh.no_answer(robot, reason)
        if status:
            raise UserError(f"{robot.name}: {reason.removeprefix('flotilla-scope: ')}")
    finally:
        reading.cancel()
        complaints.cancel()
        process.stdin.close()
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await asyncio.shield(process.wait())


async def _read(lines: asyncio.StreamReader, signals: Sequence[str], batch: asyncio.Queue[list[Any] | None]) -> None:
    """Rows, and None at the end; a line that is none ends them."""
    with contextlib.suppress(ValueError, KeyError, TypeError, OverflowError, RecursionError):
        while line := await lines.readline():
            row = json.loads(line)
            times = [_number(row["release_ns"]), _number(row["lost"])]
            if any(not isinstance(each, int) for each in times):
                raise ValueError(times)
            await batch.put([row["release_ns"] / 1e9, row["lost"], *(_values(row[signal]) for signal in signals)])
    await batch.put(None)


def _values(value: object) -> object:
    """Of a signal: a number, or a list of them."""
    return [_number(each) for each in value] if isinstance(value, list) else _number(value)


def _number(value: object) -> float | None:
    """None of what is not finite, which JSON has no word for; ValueError of what is none."""
    if value is not None and not isinstance(value, bool | int | float):
        raise ValueError(value)
    if isinstance(value, int) and abs(value) >= 1 << 64:
        raise ValueError(value)
    return value if value is not None and math.isfinite(value) else None


async def _said(stream: asyncio.StreamReader) -> bytes:
    """All of it, or its beginning where that is longer than anything that makes sense."""
    said = b""
    while chunk := await stream.read(_LINE_BYTES):
        said += chunk[: _LINE_BYTES - len(said)]
    return said


def words(
    task: str, signals: Sequence[str], *, period_s: float | None, at_least: int | None, trigger: str | None,
    before: int, count: int,
) -> list[str]:  # fmt: skip
    """The command on the robot. With a trigger, each step has a row and `count` end it."""
    steps = (at_least or 1) if trigger else max(at_least or 1, every(period_s))
    return scope.words(
        task, signals, every=steps, rows=count if trigger else None, trigger=trigger,
        before=min(before, count - 1) if trigger else None, csv=False,
    )  # fmt: skip
