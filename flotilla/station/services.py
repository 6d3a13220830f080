"""Whether control tasks run, and how, the radio cell and floods: asked of each robot by ssh every ASK_S, over one
connection that stays."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import tempfile
import threading
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import pydantic

from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.common.text import shown
from flotilla.fleet.model import Robot
from flotilla.robot import ssh
from flotilla.robot.health import READ_ONLY

ASK_S = 5
_END = "."
_CELL = "/run/flotilla/cell"
"""What the robot's service `flotilla-cell@` writes."""
_IN_THE_CELL = "in the cell"
_FLOOD = "nft --json list chain inet flotilla flood"
"""What the robot's firewall dropped as too many; /etc/nftables.conf."""
_TIME = "echo $(chronyc -n ntpdata 2>/dev/null | grep RX)"
"""Answers of time servers: how many came, and how many were valid."""
_DATA = "echo $(findmnt -rno VFS-OPTIONS,FS-OPTIONS /data 2>/dev/null)"
"""How the data partition is mounted; ext4 makes it read-only after an error."""
_PROPERTIES = ("Id", "ActiveState", "SubState", "NRestarts", "ActiveEnterTimestampMonotonic")
_SETTINGS = ("ServerAliveInterval=5", "ServerAliveCountMax=4")
"""A busy robot takes its time to let somebody in: no less than `ssh.options` gives every command."""


_LONGEST = 1 << 16
"""Bytes of a task's status, and half of those of any line."""
_WORDS = 200
"""Characters of what is shown of a robot's words."""
_NONSENSE = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, RecursionError)

_Name = Annotated[str, pydantic.StringConstraints(pattern=r"^[A-Za-z0-9_.\[\]-]{1,64}$")]
_Count = Annotated[int, pydantic.Field(ge=0, le=2**63)]


class _Sensor(pydantic.BaseModel):
    flag: bool


class _Report(pydantic.BaseModel):
    """What runtime/executive/status.h writes, of which the station shows this."""

    task: _Name
    period_s: float = pydantic.Field(gt=0, le=3600, allow_inf_nan=False)
    overruns: _Count
    sensors: dict[_Name, _Sensor] = pydantic.Field(max_length=256)
    refused: dict[_Name, dict[_Name, _Count]] = pydantic.Field({}, max_length=256)
    waiting: list[_Name] = pydantic.Field([], max_length=256)
    serial_overruns: dict[_Name, _Count] = pydantic.Field({}, max_length=256)


@dataclass(frozen=True)
class TaskStatus:
    """By the running task itself; runtime/executive/status.h."""

    period_s: float
    overruns: int
    """Since it was started."""
    lately: int
    """Of them, those since it was asked before."""
    flags: dict[str, bool]
    """Of its sensors."""
    refused: dict[str, dict[str, int]] = field(default_factory=dict)
    """By block and kind, how many messages it refused since it was started. A robot with an older release does not say
    so."""
    waiting: list[str] = field(default_factory=list)
    """Actuators that do not act until a command was off, because the task was started since."""
    serial_overruns: dict[str, int] = field(default_factory=dict)
    """By block, how often its serial port has lost bytes."""

    @property
    def lost(self) -> str:
        """`12 at gyro, 1 at compass`; empty: no serial port has lost bytes."""
        return ", ".join(f"{count} at {block}" for block, count in self.serial_overruns.items())

    @property
    def refusals(self) -> str:
        """`410 forged, 206 replayed by wrench; 3 forged by state`; empty: it refused nothing."""
        return "; ".join(
            ", ".join(f"{count} {kind}" for kind, count in kinds.items()) + f" by {block}"
            for block, kinds in self.refused.items()
        )


@dataclass(frozen=True)
class State:
    """Of a control task's service."""

    words: str
    """`running 75 s`, `failed`: the service manager's, and since when."""
    good: bool
    """It runs, and has done so since it was started."""
    status: TaskStatus | None = None
    """None: it does not run."""


@dataclass(frozen=True)
class Answer:
    """Of a robot."""

    tasks: dict[str, State]
    """By name."""
    notes: tuple[str, ...] = ()
    """What else is to be said of it: how often it lost its place in the ad hoc cell, and why; what its firewall dropped
    as a flood; answers that were no time server's; a data partition that is read-only."""


def ask(robot: Robot, shared: Sequence[str] = ()) -> Generator[Answer, None, None]:
    """What it says, again and again, until UserError says why it does not answer any more. `shared`: options of ssh by
    which others use the connection, too."""
    units = [f"flotilla-task@{task}.service" for task in robot.control_tasks]
    longest = 5 + len(units) * (len(_PROPERTIES) + 2)  # lines of an answer
    show = shlex.join(["systemctl", "show", f"--property={','.join(_PROPERTIES)}", *units])
    # One line for each task, whatever it writes.
    status = "; ".join(
        f"printf '%s\\n' \"$(flotilla-param --status=json {task} 2>/dev/null | head -c {_LONGEST} | tr -d '\\n')\""
        for task in robot.control_tasks
    )
    notes = f"cat {_CELL} 2>/dev/null || echo; {_FLOOD} 2>/dev/null || echo null; {_TIME}; {_DATA}"
    script = f"while cat /proc/uptime && {show} && {{ {status}; {notes}; }} && echo {_END}; do sleep {ASK_S}; done"
    before: dict[str, State] = {}
    program, *way = ssh.command(robot)
    options = [word for setting in _SETTINGS for word in ("-o", setting)]
    argv = [*DIE_WITH_PARENT, program, *options, *shared, *way, shlex.join(["sudo", "sh", "-c", script])]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        argv, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True, encoding="utf-8", errors="replace"
    ) as process:
        try:
            assert process.stdout
            assert process.stderr
            lines: list[str] = []
            for line in iter(partial(process.stdout.readline, 2 * _LONGEST), ""):
                if not line.endswith("\n"):
                    raise UserError(f"{robot.name}: sends a line about its tasks that does not end")
                if line.rstrip() != _END and len(lines) < longest:
                    lines.append(line)
                    continue
                answer = read_round(robot, lines, before)
                before = answer.tasks
                yield answer
                lines = []
            raise ssh.no_answer(robot, shown(process.stderr.read(_LONGEST).strip()) or "the connection broke")
        finally:
            process.kill()


def read_round(robot: Robot, lines: Sequence[str], before: Mapping[str, State]) -> Answer:
    """The answer in the lines of one round; `before`: the tasks of the round before. UserError if it is invalid."""
    try:
        *rest, cell, flood, clock, data = lines
        units = len(robot.control_tasks)
        reports, odd = _reports(robot.control_tasks, rest[len(rest) - units :], before)
        tasks = _states(rest[: len(rest) - units], robot.control_tasks, reports)
        return Answer(tasks, (*odd, *_notes(cell.strip(), json.loads(flood), clock, data)))
    except _NONSENSE as error:
        raise UserError(f"{robot.name}: its report of its tasks is invalid: {shown(repr(error)[:200])}") from error


def _notes(cell: str, flood: dict[str, Any] | None, clock: str, data: str) -> Iterator[str]:
    """`flood`: a chain as libnftables-json(5) describes it; None: the robot has none. `clock`: of all time servers.
    `data`: options of the mount and of the file system."""
    if cell not in ("", _IN_THE_CELL):
        yield f"radio {shown(cell[:_WORDS])}"
    rules = [each["rule"]["expr"] for each in flood["nftables"] if "rule" in each] if flood else []
    if packets := sum(part["counter"]["packets"] for rule in rules for part in rule if "counter" in part):
        yield f"firewall dropped {packets} packets of a flood"
    came, valid = (sum(map(int, re.findall(rf"{name} *: (\d+)", clock))) for name in ("Total RX", "Total valid RX"))
    if came > valid:
        yield f"clock rejected {came - valid} answers that were not a time server's"
    if "ro" in re.split("[ ,]", data.strip()):
        yield READ_ONLY


def _states(lines: list[str], tasks: Sequence[str], reports: Mapping[str, TaskStatus]) -> dict[str, State]:
    """What one round says: /proc/uptime, then the services, an empty line between them."""
    uptime, _, blocks = "".join(lines).partition("\n")
    found = {}
    for block in blocks.strip().split("\n\n"):
        unit = dict(line.split("=", 1) for line in block.splitlines())
        task = unit["Id"].removeprefix("flotilla-task@").removesuffix(".service")
        if task not in tasks:
            raise ValueError(f"nobody asked for {task}")
        active = unit["ActiveState"] == "active"
        since_s = float(uptime.split()[0]) - int(unit["ActiveEnterTimestampMonotonic"]) / 1e6
        restarts = int(unit["NRestarts"])
        words = (
            shown(unit["SubState"][:_WORDS])
            + (f" {since_s:.0f} s" if active else "")
            + (f", restarted {restarts}×" if restarts else "")
        )
        found[task] = State(words, active and not restarts, reports.get(task))
    return found


def _reports(
    tasks: Sequence[str], lines: Sequence[str], before: Mapping[str, State]
) -> tuple[dict[str, TaskStatus], list[str]]:
    """By task, a line each, and what is wrong with those that are none: a task whose program somebody replaced says
    nothing of others, and does not silence them."""
    found, odd = {}, []
    for task, line in zip(tasks, lines, strict=True):
        if not line.strip() or line.strip() == "null":
            continue
        try:
            report = _Report.model_validate_json(line)
            if report.task != task:
                raise ValueError(f"it is of {report.task}")
        except ValueError as error:  # as pydantic's errors are
            why = error.errors()[0]["msg"] if isinstance(error, pydantic.ValidationError) else str(error)
            odd.append(f"{task} does not report its status: the answer is invalid: {shown(why[:_WORDS])}")
            continue
        past = before[task].status if task in before else None
        found[task] = _status_of(report, past)
    return found, odd


def _status_of(report: _Report, past: TaskStatus | None) -> TaskStatus:
    overruns = report.overruns
    counted = past.overruns if past else overruns
    return TaskStatus(
        period_s=report.period_s,
        overruns=overruns,
        lately=overruns - (counted if counted <= overruns else 0),  # it was started anew
        flags={name: bool(sensor.flag) for name, sensor in report.sensors.items()},
        refused=report.refused,
        waiting=report.waiting,
        serial_overruns=report.serial_overruns,
    )


class Services:
    """Asks robots that have control tasks, by a thread each, which ends with the process. UserError without keys."""

    def __init__(self, robots: Iterable[Robot]) -> None:
        asked = [robot for robot in robots if robot.control_tasks]
        self.states = {
            (robot.name, task): State("not answered yet", False) for robot in asked for task in robot.control_tasks
        }
        """By robot and task, as they were reported last."""
        self._sockets = tempfile.TemporaryDirectory(prefix="flotilla-")  # short: it holds sockets
        self.notes: dict[str, tuple[str, ...]] = {robot.name: () for robot in asked}
        """By robot, what else is to be said of it."""
        for robot in asked:
            ssh.command(robot)
            threading.Thread(target=self._follow, args=(robot,), daemon=True).start()

    def way(self, robot: Robot) -> list[str]:
        """The command line of ssh by the connection that is there, or a new one: nobody has to be let in first."""
        program, *way = ssh.command(robot)
        return [program, *self._shared(robot, "no"), *way]

    def _shared(self, robot: Robot, master: str) -> list[str]:
        return ["-o", f"ControlMaster={master}", "-o", f"ControlPath={self._sockets.name}/{robot.number}"]

    def _follow(self, robot: Robot) -> None:
        while True:
            try:
                for answer in ask(robot, self._shared(robot, "auto")):
                    for task, state in answer.tasks.items():
                        self.states[robot.name, task] = state
                    self.notes[robot.name] = answer.notes
            except (UserError, OSError):  # such as too many open files
                for task in robot.control_tasks:
                    self.states[robot.name, task] = State("no answer", False)
            time.sleep(ASK_S)
