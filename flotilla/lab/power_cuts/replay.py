"""Every crash state of a recording judged: states that boot alike are grouped, and each group is started once.

A **brick** is a card of which no complete slot is started within four power-ons. A **wrong release** is one that is
started although it is not whole, or although it is not its turn: before the activation only the old one may start,
after the confirmation only the new one, and in between either.
"""

from __future__ import annotations

import itertools
import math
import os
import random
import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from flotilla.common import progress
from flotilla.fleet.model import Board
from flotilla.lab.power_cuts.crash_states import CrashState, all_states
from flotilla.lab.power_cuts.starter import Content, Started, Starter
from flotilla.lab.power_cuts.timeline import UNREADABLE, Layout, Signature, Timeline
from flotilla.lab.power_cuts.write_log import WriteLog

POWER_ONS = 4
READ_TOGETHER = 64
"""Sectors that GRUB reads at once, for its cache (include/grub/disk.h), even where it asks for one of them."""


@dataclass(frozen=True)
class Recording:
    """What happened to a card, and what may be started when."""

    base: Path
    """The card before."""
    log: Path
    layout: Layout
    releases: Mapping[str, Mapping[str, bytes]]
    """By name and slot, all that the slot holds of the release from its first sector on."""
    phases: Sequence[tuple[int, frozenset[str]]]
    """From which entry of the log on which releases may be started."""
    written_by_boot: Sequence[int] = ()
    """Sectors that the boot loader writes by itself."""
    stand_ins: Mapping[int, Mapping[bytes, bytes]] = field(default_factory=dict)
    """By sector and what it holds, what the computers get instead: kernels that say their release (`releases.py`)."""


@dataclass
class Verdict:
    """What came of a recording."""

    states: int = 0
    groups: int = 0
    power_ons: int = 0
    sampled: int = 0
    """States that were started by themselves, though another one of their group was."""
    bricks: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    ungrouped: list[str] = field(default_factory=list)
    """What shows that states are grouped wrongly."""
    started: Counter[str] = field(default_factory=Counter)
    """States by slot and release that were started in the end."""

    @property
    def sound(self) -> bool:
        return not (self.bricks or self.wrong or self.ungrouped)


def replay(
    board: Board,
    recording: Recording,
    directory: Path,
    *,
    seed: int = 1,
    per_cut: int = 500,
    sample: float = 0,
    to_the_end: bool = True,
) -> Verdict:
    """Judge every state of a recording.

    `directory`: for what the computers say; `per_cut`: limit of the states with lost writes at one cut, of which `seed`
    chooses; `sample`: share of the states that are also started by themselves, which tests the grouping; `to_the_end`:
    also after the first state that is not sound.
    """
    directory.mkdir(parents=True, exist_ok=True)
    verdict = Verdict()
    computers = _Computers(board, recording, directory)
    with (
        WriteLog(recording.log) as log,
        Timeline(recording.base, log, recording.layout, recording.releases) as timeline,
        computers,
    ):
        allowed = list(_allowed(len(log.entries), recording.phases))
        groups: dict[Signature, list[CrashState]] = {}
        for state in all_states(log.entries, recording.layout.damaged, seed=seed, per_cut=per_cut):
            groups.setdefault(timeline.signature(state), []).append(state)
        outcomes: dict[Signature, Sequence[Started]] = {}
        with progress.step(f"start {len(groups)} groups of {sum(map(len, groups.values()))} states") as step:
            firsts = [(signature, states[0]) for signature, states in groups.items()]
            if not to_the_end:
                firsts.reverse()  # towards the end, less may be started
            for (signature, _), starts in computers.start(timeline, firsts):
                outcomes[signature] = starts
                verdict.groups += 1
                verdict.power_ons += len(starts)
                for state in groups[signature]:
                    _judge(verdict, state, starts, signature, allowed[state.upto])
                step.at(verdict.groups, len(groups), "groups")
                if not (to_the_end or verdict.sound):
                    return verdict
        others = [(signature, state) for signature, states in groups.items() for state in states[1:]]
        chosen = random.Random(seed).sample(others, min(len(others), math.ceil(sample * verdict.states)))
        with progress.step(f"start {len(chosen)} states by themselves") as step:
            chosen.sort(key=lambda each: each[1].upto)
            for (signature, state), starts in computers.start(timeline, chosen):
                verdict.sampled += 1
                if starts != outcomes[signature]:
                    verdict.ungrouped.append(f"{state}: {starts}, its group: {outcomes[signature]}")
                step.at(verdict.sampled, len(chosen), "states")
        layout = recording.layout
        known = {
            each // READ_TOGETHER for each in itertools.chain(*layout.always, *itertools.chain(*layout.loaded.values()))
        }
        if unknown := sorted(each for each in computers.sectors_read() if each // READ_TOGETHER not in known):
            verdict.ungrouped.append(f"boots read sectors that the layout does not name: {unknown[:20]}")
    return verdict


_Job = tuple[Signature, CrashState]


class _Computers:
    """One for each processor of the host and each set of sectors that cannot be read."""

    def __init__(self, board: Board, recording: Recording, directory: Path) -> None:
        self._board = board
        self._recording = recording
        self._directory = directory
        self._number = os.cpu_count() or 1
        self._own = threading.local()
        self._made = itertools.count()
        self._stack = ExitStack()
        self._all: list[Starter] = []
        self._asked: list[Future[Sequence[Started]]] = []

    def __enter__(self) -> _Computers:
        # Its threads stay until the computers have ended, which die with the thread that made them.
        self._pool = self._stack.enter_context(ThreadPoolExecutor(self._number))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for future in self._asked:
            future.cancel()
        wait(self._asked)  # what has begun needs its computer
        self._stack.close()

    def start(self, timeline: Timeline, jobs: Iterable[_Job]) -> Iterator[tuple[_Job, Sequence[Started]]]:
        """Start each state, in this order, as long as results are asked for."""
        waiting: deque[tuple[_Job, Future[Sequence[Started]]]] = deque()
        for job in jobs:
            self._asked.append(self._pool.submit(self._power_ons, self._content(timeline, job[1]), job[0]))
            waiting.append((job, self._asked[-1]))
            if len(waiting) > self._number:
                first, future = waiting.popleft()
                yield first, future.result()
        for first, future in waiting:
            yield first, future.result()

    def sectors_read(self) -> set[int]:
        """What all computers have read so far."""
        return set().union(*(starter.sectors_read() for starter in self._all))

    def _content(self, timeline: Timeline, state: CrashState) -> Content:
        overlay = timeline.overlay(state)
        content = {sector: timeline.content(number) for sector, number in overlay.items() if number != UNREADABLE}
        for sector, instead in self._recording.stand_ins.items():
            found = content.get(sector) or timeline.base(sector)
            if found in instead:
                content[sector] = instead[found]
        return content

    def _power_ons(self, content: Content, signature: Signature) -> Sequence[Started]:
        """Power on until a complete slot is started, or four times."""
        starter = self._starter(signature.unreadable)
        starter.plant(content, self._recording.written_by_boot)
        starts = []
        for _ in range(POWER_ONS):
            starts.append(starter.power_on())
            if _complete(starts[-1], signature):
                break
        return starts

    def _starter(self, unreadable: frozenset[int]) -> Starter:
        starters: dict[frozenset[int], Starter] = self._own.__dict__.setdefault("starters", {})
        if unreadable not in starters:
            directory = self._directory / f"computer{next(self._made)}"
            starter = Starter(self._board, self._recording.base, directory, unreadable)
            starters[unreadable] = self._stack.enter_context(starter)
            self._all.append(starter)
        return starters[unreadable]


def _allowed(number: int, phases: Sequence[tuple[int, frozenset[str]]]) -> Iterator[frozenset[str]]:
    """By number of completed entries, up to the whole log: what may be started."""
    for upto in range(number + 1):
        before = [allowed for start, allowed in phases if start <= upto]
        yield before[-1] if before else frozenset()


def _complete(started: Started, signature: Signature) -> bool:
    return started.whole and (started.slot, started.release) in signature.complete


def _judge(
    verdict: Verdict, state: CrashState, starts: Sequence[Started], signature: Signature, allowed: frozenset[str]
) -> None:
    verdict.states += 1
    last = starts[-1]
    verdict.started[f"{last.release} in {last.slot}"] += 1
    if not _complete(last, signature):
        verdict.bricks.append(f"{state}: {last}")
    for started in starts:
        if started.slot is None:
            continue
        if not _complete(started, signature):
            verdict.wrong.append(f"{state}: {started}: not whole")
        elif started.release not in allowed:
            verdict.wrong.append(f"{state}: {started}: only {' or '.join(sorted(allowed))} may be started")
