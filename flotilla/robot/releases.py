"""Which release each robot runs (`make releases`), asked of all robots at once."""

from __future__ import annotations

import json
import subprocess
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timedelta

import pydantic

from flotilla.common import progress
from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import ssh

_ASK = "cat /proc/uptime && sudo flotilla-slot show"
"""Time since the boot, and boot state: the station's clock is the better one to tell when that was."""
_TIMEOUT_S = 60.0
"""For a robot that accepts the connection and then says nothing; `ssh` itself ends those that do not."""
_AT_ONCE = 32
_NO_PROGRAM = (1, 127)
"""Status of sudo, or of a shell, that finds no such command."""
_BLOB_DIGITS = 12
"""Of a slot's SHA-256 in the table."""
_COLUMNS = ("robot", "release", "slot", "state", "kernel", "blob", "since", "other slot")


class Slot(pydantic.BaseModel):
    """One slot, as the robot says it. Other keys are ignored."""

    ok: bool
    """Whether its release was confirmed."""
    release: str | None = None
    """None: the slot is empty."""
    blob: str | None = None
    """SHA-256 of its content, root file system, kernel and initramfs, in hexadecimal digits."""
    kernel: str | None = None


class State(pydantic.BaseModel):
    """Boot state of a robot: what `flotilla-slot show` prints."""

    running: str | None
    """Slot that was booted; None: the robot was started in another way."""
    sequence: int
    order: tuple[str, ...]
    """Slots in the order in which the boot loader tries them."""
    trial: str | None = None
    """Slot that is on trial; it is left again unless it is confirmed."""
    slots: dict[str, Slot]

    @pydantic.model_validator(mode="after")
    def _has_its_slot(self) -> State:
        if self.running and self.running not in self.slots:
            raise ValueError(f"running: there is no slot {self.running}")
        return self

    @property
    def slot(self) -> Slot:
        """The one that runs; an empty one where none does."""
        return self.slots[self.running] if self.running else Slot(ok=False)

    @property
    def standing(self) -> str:
        """Of the release that runs."""
        if not self.running:
            return "of no slot"
        if self.trial == self.running:
            return "on trial"
        return "confirmed" if self.slot.ok else "not confirmed"


@dataclass(frozen=True)
class Answer:
    """What one robot said: its state, or why there is none."""

    robot: Robot
    state: State | None = None
    since: datetime | None = None
    """When it booted, by the station's clock."""
    problem: str = ""


def ask(robots: Sequence[Robot], now: datetime | None = None) -> list[Answer]:
    """Ask all of them in parallel, each one's guest when one runs. In the order of `robots`."""
    if not robots:
        return []
    with (
        progress.step(f"ask {len(robots)} robots"),
        ThreadPoolExecutor(min(len(robots), _AT_ONCE)) as threads,
    ):
        return list(threads.map(lambda robot: _ask(robot, now), robots))


def _ask(robot: Robot, now: datetime | None) -> Answer:
    try:
        argv = [*ssh.command(robot), _ASK]
        done = subprocess.run(
            argv, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", errors="replace", check=False,
            timeout=_TIMEOUT_S,
        )  # fmt: skip
    except UserError as error:
        return Answer(robot, problem=str(error))
    except subprocess.TimeoutExpired:
        return Answer(robot, problem=str(ssh.no_answer(robot, f"nothing in {_TIMEOUT_S:.0f} s")))
    message = (done.stderr.strip().splitlines() or [""])[-1]
    if done.returncode == ssh.FAILED:
        return Answer(robot, problem=str(ssh.no_answer(robot, message)))
    if done.returncode in _NO_PROGRAM and "not found" in message:
        remedy = f"its card is older than releases: flash it again, `make flash ROBOT={robot.number}`"
        return Answer(robot, problem=f"{robot.name}: has no flotilla-slot; {remedy}")
    if done.returncode:
        return Answer(robot, problem=f"{robot.name}: flotilla-slot: {message or f'status {done.returncode}'}")
    return _read(robot, done.stdout, now or datetime.now().astimezone())


def _read(robot: Robot, text: str, now: datetime) -> Answer:
    try:
        uptime, _, shown = text.partition("\n")
        state = State.model_validate_json(shown)
        return Answer(robot, state, now - timedelta(seconds=float(uptime.split()[0])))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        why = ": ".join([*map(str, first["loc"]), first["msg"]])
    remedy = "use the station's checkout of the robot's release"
    return Answer(robot, problem=f"{robot.name}: does not report the state of its slots ({why}); {remedy}")


def problems(answers: Sequence[Answer]) -> list[str]:
    """Of those robots that said nothing, in words with the remedy."""
    return [answer.problem for answer in answers if answer.state is None]


def table(answers: Sequence[Answer]) -> str:
    """A line for each robot, and one for each release that runs."""
    rows = [_COLUMNS, *(_row(answer) for answer in answers)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    running: dict[str, list[str]] = defaultdict(list)
    for answer in answers:
        if answer.state:
            running[answer.state.slot.release or "?"].append(answer.robot.name)
    lines += [
        "",
        *(f"release {release}: {', '.join(names)}" for release, names in sorted(running.items(), key=_counted)),
    ]
    if silent := [answer.robot.name for answer in answers if answer.state is None]:
        lines.append(f"unknown: {', '.join(silent)}")
    return "\n".join(lines)


def _counted(release: tuple[str, object]) -> tuple[int, str]:
    """Order of releases: 10 after 9."""
    return len(release[0]), release[0]


def _row(answer: Answer) -> tuple[str, ...]:
    state = answer.state
    if state is None or answer.since is None:
        return answer.robot.name, "no answer", *[""] * (len(_COLUMNS) - 2)
    slot = state.slot
    others = (f"{name}: {other.release or 'empty'}" for name, other in state.slots.items() if name != state.running)
    return (
        answer.robot.name,
        slot.release or "?",
        state.running or "none",
        state.standing,
        slot.kernel or "?",
        (slot.blob or "?")[:_BLOB_DIGITS],
        f"{answer.since:%Y-%m-%d %H:%M}",
        ", ".join(others),
    )


def as_json(answers: Sequence[Answer]) -> str:
    """The same for programs: a list, in which a robot that said nothing has `problem` alone."""
    return json.dumps([_as_dict(answer) for answer in answers], indent=1)


def _as_dict(answer: Answer) -> dict[str, object]:
    about: dict[str, object] = {"robot": answer.robot.name, "number": answer.robot.number}
    state = answer.state
    if state is None or answer.since is None:
        return about | {"problem": answer.problem}
    return about | {
        "release": state.slot.release,
        "slot": state.running,
        "state": state.standing,
        "kernel": state.slot.kernel,
        "blob": state.slot.blob,
        "since": answer.since.isoformat(timespec="seconds"),
        "boot_state": state.model_dump(),
    }
