"""How what robots tell the station comes: a table on the terminal, a line for each stream.

Lost are those of the robot's steps of which nothing came, wherever on the way that was: a stream's signal `step` counts
them. Rates and flags are those of the last WINDOW_NS.
"""

from __future__ import annotations

import contextlib
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from runtime.station.receiver import Receiver
from runtime.station.recording import CODES, Value
from runtime.station.services import State
from runtime.station.telemetry import Stream

WINDOW_NS = 2_000_000_000
_LATE = 10
"""Datagrams by which one may be overtaken, what is further back is a start anew; that may stay away unremarked."""
_HEALTH = ("good", "flag")
"""Names, or ends of them, of flags that are true when all is well."""
_WIDTH = 120
"""Characters of a line that no terminal shows."""
_TITLES = ("robot", "task", "stream", "Hz", "of", "came", "refused", "lost", "%", "age s", "flags")
_RUNS = "runs"
_LEFT = ("robot", "task", "stream", "flags", _RUNS)


@dataclass(frozen=True)
class Row:
    """Of a stream."""

    rate_hz: float
    lost: int | None
    """None where the stream has no steps."""
    age_s: float | None
    """Of the last datagram; None: there was none."""
    flags: dict[str, float]
    """By the names of boolean signals: in which part of the datagrams each was true, 0 to 1."""


class Heard:
    """What came of a stream since `begun_ns`; times are nanoseconds since 1970-01-01 UTC."""

    def __init__(self, stream: Stream, begun_ns: int) -> None:
        scalars = {each.name: each.type for each in stream.fields if each.width == 1}
        self._flags = [name for name, kind in scalars.items() if kind == "boolean"]
        self._steps = 1 << 8 * struct.calcsize(f"<{CODES[scalars['step']]}") if "int" in scalars.get("step", "") else 0
        """How many numbers its signal `step` has; 0: there is none."""
        self._every = stream.every
        self._begun_ns = begun_ns
        self._recent: deque[tuple[int, tuple[bool, ...]]] = deque()
        """When, and the flags; at least the last one."""
        self._step = self._lost = 0

    def take(self, values: Mapping[str, Value], received_ns: int) -> None:
        self._recent.append((received_ns, tuple(bool(values[name]) for name in self._flags)))
        while self._recent[0][0] <= received_ns - WINDOW_NS:
            self._recent.popleft()
        if self._steps and isinstance(step := values["step"], int):
            self._count_lost(step)

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
        recent = [flags for received_ns, flags in self._recent if received_ns > now_ns - WINDOW_NS]
        window_ns = min(WINDOW_NS, max(1, now_ns - self._begun_ns))
        shown = recent or [flags for _, flags in self._recent][-1:]
        return Row(
            rate_hz=len(recent) * 1e9 / window_ns,
            lost=self._lost if self._steps else None,
            age_s=(now_ns - self._recent[-1][0]) / 1e9 if self._recent else None,
            flags={name: sum(each[i] for each in shown) / len(shown) for i, name in enumerate(self._flags) if shown},
        )


class Top:
    """A sink of `receiver`. `states`: of control tasks, by robot and task, if they are asked for. `clock`: ns since
    1970-01-01 UTC."""

    def __init__(
        self,
        receiver: Receiver,
        states: Mapping[tuple[str, str], State] = MappingProxyType({}),
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self.console = Console()
        self._known = sorted(receiver.known.values(), key=lambda stream: stream.topic)
        self._receiver = receiver
        self._states = states
        self._clock = clock
        self._heard = {stream.topic: Heard(stream, clock()) for stream in self._known}
        self._live: Live | None = None

    @contextlib.contextmanager
    def screen(self) -> Iterator[None]:
        """While it is open, the terminal shows the table; one that is none shows nothing."""
        if not self.console.is_terminal:
            yield
            return
        with Live(self._table(), console=self.console, screen=True, auto_refresh=False) as self._live:
            yield

    def take(self, stream: Stream, values: Mapping[str, Value], received_ns: int) -> None:
        self._heard[stream.topic].take(values, received_ns)

    def refresh(self) -> None:
        if self._live:
            self._live.update(self._table(), refresh=True)

    def end(self) -> str:
        """The table."""
        if not self.console.is_terminal:
            self.console.width = _WIDTH
        with self.console.capture() as capture:
            self.console.print(self._table())
        return capture.get().rstrip("\n")

    def _table(self) -> Table:
        now_ns = self._clock()
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 1, 0, 0))
        for title in (*_TITLES, _RUNS) if self._states else _TITLES:
            table.add_column(title, justify="left" if title in _LEFT else "right")
        silent_tasks = dict(self._states)
        for stream in self._known:
            row, count = self._heard[stream.topic].row(now_ns), self._receiver.counts[stream.topic]
            silent_tasks.pop((stream.robot, stream.task), None)
            silent = row.age_s is None or row.age_s * stream.rate_hz > _LATE
            sent = count.received + (row.lost or 0)
            table.add_row(
                stream.robot,
                stream.task,
                stream.block,
                _marked(f"{row.rate_hz:.1f}", silent),
                f"{stream.rate_hz:g}",
                f"{count.received}",
                _marked(f"{count.refused}", count.refused > 0),
                "" if row.lost is None else _marked(f"{row.lost}", row.lost > 0),
                "" if row.lost is None or not sent else f"{100 * row.lost / sent:.1f}",
                _marked("never" if row.age_s is None else f"{row.age_s:.2f}", silent),
                Text(", ").join(_flag(name, share) for name, share in row.flags.items()),
                *_runs(self._states.get((stream.robot, stream.task))),
            )
        for (robot, task), state in silent_tasks.items():
            table.add_row(robot, task, *[""] * (len(_TITLES) - 2), *_runs(state))
        if self._receiver.strangers:
            table.caption = f"{self._receiver.strangers} datagrams of strangers left out"
            table.caption_justify = "left"
        return table


def _marked(text: str, bad: bool) -> Text:
    return Text(text, style="bold red" if bad else "")


def _runs(state: State | None) -> list[Text]:
    return [_marked(state.words, not state.good)] if state else []


def _flag(name: str, share: float) -> Text:
    """`good`, `not good`, or `good 98 %` for one that changed."""
    text = name if share == 1 else f"not {name}" if share == 0 else f"{name} {int(100 * share)} %"
    return _marked(text, name.endswith(_HEALTH) and share < 1)
