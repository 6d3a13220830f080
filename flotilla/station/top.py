"""How what robots tell the station comes: a table on the terminal, a line for each stream, with a dialog above it.

Lost are those of the robot's steps of which nothing came, wherever on the way that was: a stream's signal `step` counts
them. Rates and flags are those of the last WINDOW_NS.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from flotilla.common.signals import size
from flotilla.common.text import shown
from flotilla.station.dialog import Dialog, TaskOf
from flotilla.station.receiver import Receiver
from flotilla.station.recording import Value
from flotilla.station.services import State
from flotilla.station.telemetry import Stream

WINDOW_NS = 2_000_000_000
_LATE = 10
CURRENT_S = 0.5
"""What is older is not shown as current."""
_PERIODS = 2.5
"""Of a stream that is slower than that: so many, for one datagram to be lost."""
"""Datagrams by which one may be overtaken, what is further back is a start anew; that may stay away unremarked."""
HEALTH = ("good", "flag")
"""Names, or ends of them, of flags that are true when all is well."""
_GOOD_LINK = 0.9
_LOW_CHARGE = 0.2
_WIDTH = 160
"""Characters of a line that no terminal shows."""
_TITLES = (
    "robot",
    "task",
    "ms",
    "stream",
    "Hz",
    "of",
    "came",
    "refused",
    "lost",
    "%",
    "link%",
    "age s",
    "charge%",
    "flags",
)
_ASKED = ("runs", "overruns", "sensors")
_LEFT = ("robot", "task", "stream", "flags", "runs", "sensors")


@dataclass(frozen=True)
class Row:
    """Of a stream."""

    rate_hz: float
    lost: int | None
    """None where the stream has no steps."""
    link: float | None
    """In which part of the last steps something came, 0 to 1; None where the stream has no steps."""
    age_s: float | None
    """Of the last datagram; None: there was none."""
    charge: float | None
    """The battery's last, 0 to 1; None where the stream has none."""
    attempts: dict[str, int]
    """What the robot refused since its task began, by kind; those that are not 0."""
    flags: dict[str, float]
    """By the names of boolean signals: in which part of the datagrams each was true, 0 to 1."""

    @property
    def refusals(self) -> str:
        """`410 forged, 206 replayed`; empty: it refused nothing."""
        return ", ".join(f"{count} {kind}" for kind, count in self.attempts.items())

    def silent(self, stream: Stream) -> bool:
        """Whether what came last of its stream is not current any more."""
        return self.age_s is None or self.age_s > max(CURRENT_S, _PERIODS / stream.rate_hz)


class _Came(NamedTuple):
    received_ns: int
    lost: int
    """Steps, all in all."""
    flags: tuple[bool, ...]


class StreamStats:
    """What came of a stream since `begun_ns`; times are nanoseconds since 1970-01-01 UTC."""

    def __init__(self, stream: Stream, begun_ns: int) -> None:
        scalars = {each.name: each.type for each in stream.fields if each.width == 1}
        self._flags = [name for name, kind in scalars.items() if kind == "boolean"]
        self._steps = 1 << 8 * size(scalars["step"]) if "int" in scalars.get("step", "") else 0
        """How many numbers its signal `step` has; 0: there is none."""
        self._every = stream.every
        self._period_s = 1 / stream.rate_hz
        self._begun_ns = begun_ns
        self._recent: deque[_Came] = deque()
        """At least the last one."""
        self._step = self._lost = 0
        self._charge_of = stream.charge
        self._charge: float | None = None
        self._counted = stream.attempts
        self._attempts: dict[str, int] = {}

    def take(self, values: Mapping[str, Value], received_ns: int) -> None:
        if self._steps and isinstance(step := values["step"], int):
            self._count_lost(step)
        if self._charge_of and isinstance(charge := values[self._charge_of], float):
            self._charge = charge
        counts = {kind: values[kind] for kind in self._counted}
        self._attempts = {kind: count for kind, count in counts.items() if isinstance(count, int) and count}
        self._recent.append(_Came(received_ns, self._lost, tuple(bool(values[name]) for name in self._flags)))
        while self._recent[0].received_ns <= received_ns - WINDOW_NS:
            self._recent.popleft()

    def _count_lost(self, step: int) -> None:
        """Steps go up, begin again after the largest number of their type, and are 0 before there is one."""
        ahead = (step - self._step) % self._steps
        if self._step and ahead < self._steps // 2:
            self._lost += max(0, round(ahead / self._every) - 1)
        elif self._step and self._steps - ahead <= _LATE * self._every:  # it was counted when it was overtaken
            self._lost = max(0, self._lost - 1)
            return
        self._step = step

    def row(self, now_ns: int) -> Row:
        recent = [came for came in self._recent if came.received_ns > now_ns - WINDOW_NS]
        # After a jump of a replay, messages from before it come again: the window begins with the first of them.
        begun_ns = min([self._begun_ns, *(came.received_ns for came in recent[:1])])
        window_ns = min(WINDOW_NS, max(round(1e9 * self._period_s), now_ns - begun_ns))
        shown = [came.flags for came in recent or list(self._recent)[-1:]]
        lost = max(0, self._lost - recent[0].lost) if recent else 1
        return Row(
            rate_hz=len(recent) * 1e9 / window_ns,
            lost=self._lost if self._steps else None,
            link=len(recent) / (len(recent) + lost) if self._steps else None,
            age_s=(now_ns - self._recent[-1].received_ns) / 1e9 if self._recent else None,
            charge=self._charge,
            attempts=self._attempts,
            flags={name: sum(each[i] for each in shown) / len(shown) for i, name in enumerate(self._flags) if shown},
        )


class Top:
    """A sink of `receiver`. `states`: of control tasks, by robot and task, if they are asked for. `dialog`: what keys
    do, on a terminal. `clock`: ns since 1970-01-01 UTC."""

    def __init__(
        self,
        receiver: Receiver,
        states: Mapping[tuple[str, str], State] = MappingProxyType({}),
        dialog: Dialog | None = None,
        clock: Callable[[], int] = time.time_ns,
        notes: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        """`notes`: by robot, what else it says."""
        self.console = Console()
        self._known = sorted(receiver.known.values(), key=lambda stream: stream.topic)
        self._receiver = receiver
        self._states = states
        self._dialog = dialog
        self._clock = clock
        self._notes = notes
        self._stats = {stream.topic: StreamStats(stream, clock()) for stream in self._known}
        self._live: Live | None = None

    @contextlib.contextmanager
    def screen(self) -> Iterator[None]:
        """While it is open, the terminal shows the table; one that is none shows nothing."""
        if not self.console.is_terminal:
            yield
            return
        with Live(self._screen(), console=self.console, screen=True, auto_refresh=False) as self._live:
            yield

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        self._stats[stream.topic].take(values, received_ns)

    def refresh(self) -> None:
        if self._live:
            self._live.update(self._screen(), refresh=True)

    def press(self, typed: str) -> None:
        """Keys of the terminal."""
        if self._dialog:
            self._dialog.press(typed, self._tasks())
        self.refresh()

    def end(self) -> str:
        """The table."""
        if not self.console.is_terminal:
            self.console.width = _WIDTH
        with self.console.capture() as capture:
            self.console.print(self._table())
        return capture.get().rstrip("\n")

    def _tasks(self) -> list[TaskOf]:
        """Robot and task of each line: streams, then tasks without one."""
        with_stream = [(stream.robot, stream.task) for stream in self._known]
        return with_stream + [each for each in self._states if each not in with_stream]

    def _screen(self) -> Group:
        """The dialog above the table, which may be longer than the terminal."""
        if not self._dialog:
            return Group(self._table())
        lines = self._dialog.lines
        room = max(1, self.console.height // 2)
        more = [f"… {len(lines) - room} more lines"] if len(lines) > room else []
        chosen = self._dialog.chosen(self._tasks())
        return Group(*map(Text, [*lines[:room], *more]), self._table(chosen))

    def _table(self, chosen: int | None = None) -> Table:
        now_ns = self._clock()
        tasks = self._tasks()
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 1, 0, 0))
        for title in (*_TITLES, *_ASKED) if self._states else _TITLES:
            table.add_column(title, justify="left" if title in _LEFT else "right")
        notes = [
            f"{robot}: {task} refused: {state.status.refusals}"
            for (robot, task), state in self._states.items()
            if state.status and state.status.refused
        ]
        notes += [
            f"{robot}: {task} is stopped since its start, switch off and on: {', '.join(state.status.waiting)}"
            for (robot, task), state in self._states.items()
            if state.status and state.status.waiting
        ]
        notes += [
            f"{robot}: {task} has serial overruns, bytes were lost: {state.status.lost}"
            for (robot, task), state in self._states.items()
            if state.status and state.status.lost
        ]
        for stream in self._known:
            row, count = self._stats[stream.topic].row(now_ns), self._receiver.counts[stream.topic]
            if row.refusals and not _says(self._states.get((stream.robot, stream.task)), row.attempts):
                notes.append(f"{stream.robot}: {stream.task} refused messages: {row.refusals}")
            if count.attempts:
                notes.append(f"left out as {stream.robot}'s {stream.task} {stream.name}: {count.attempts}")
            silent = row.silent(stream)
            sent = count.received + (row.lost or 0)
            table.add_row(
                stream.robot,
                stream.task,
                f"{1000 * stream.step_s:g}",
                stream.name,
                _marked(f"{row.rate_hz:.1f}", silent),
                f"{stream.rate_hz:g}",
                f"{count.received}",
                _marked(f"{count.bad}", count.bad > 0),
                "" if row.lost is None else _marked(f"{row.lost}", row.lost > 0),
                "" if row.lost is None or not sent else f"{100 * row.lost / sent:.1f}",
                ""
                if row.link is None
                else _marked(
                    "old" if silent and row.link else f"{100 * row.link:.0f}", silent or row.link < _GOOD_LINK
                ),
                _marked("never" if row.age_s is None else f"{row.age_s:.2f}", silent),
                "" if row.charge is None else _marked(f"{100 * row.charge:.0f}", row.charge < _LOW_CHARGE),
                Text(", ").join(_flag(name, share) for name, share in row.flags.items()),
                *_asked(self._states.get((stream.robot, stream.task))),
                style="dim" if silent else "",
            )
        for robot, task in tasks[len(self._known) :]:
            state = self._states[robot, task]
            period = f"{1000 * state.status.period_s:g}" if state.status else ""
            table.add_row(robot, task, period, *[""] * (len(_TITLES) - 3), *_asked(state))
        if chosen is not None:
            table.rows[chosen].style = "reverse"
        notes += [f"{robot}: {note}" for robot, said in sorted(self._notes.items()) for note in said]
        if self._receiver.strangers:
            notes.append(f"{self._receiver.strangers} datagrams of strangers left out")
        if notes:
            table.caption, table.caption_justify = Text(shown("\n".join(notes))), "left"
        return table


def _marked(text: str, bad: bool) -> Text:
    return Text(text, style="bold red" if bad else "")


def _says(state: State | None, kinds: Iterable[str]) -> bool:
    """Whether the task says itself that it refused something of each of these kinds."""
    counted = state.status.refused.values() if state and state.status else ()
    return all(any(kind in each for each in counted) for kind in kinds)


def _asked(state: State | None) -> list[Text]:
    if not state:
        return []
    status = state.status
    lately = f" (+{status.lately})" if status and status.lately else ""
    return [
        _marked(state.words, not state.good),
        _marked(f"{status.overruns}{lately}" if status else "", bool(lately)),
        Text(", ").join(_sensor(name, flag) for name, flag in status.flags.items()) if status else Text(),
    ]


def _flag(name: str, share: float) -> Text:
    """`good`, `not good`, or `good 98 %` for one that changed."""
    text = name if share == 1 else f"not {name}" if share == 0 else f"{name} {int(100 * share)} %"
    return _marked(text, name.endswith(HEALTH) and share < 1)


def _sensor(name: str, flag: bool) -> Text:
    return _marked(name if flag else f"not {name}", not flag)
