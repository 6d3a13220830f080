"""What a card holds in each crash state, without making a card for each: what a boot reads, as a short signature."""

from __future__ import annotations

import os
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol

from flotilla.lab.power_cuts.crash_states import CrashState, filler
from flotilla.lab.power_cuts.write_log import SECTOR, WriteLog

Read = Callable[[int], bytes | None]
"""Content of a sector; None: it cannot be read."""
UNREADABLE = -1
"""In the place of a content's number."""
Overlay = Mapping[int, int]
"""Numbers of contents by sector."""


class Layout(Protocol):
    """What the boot chain reads of a card."""

    @property
    def always(self) -> Sequence[range]:
        """Sectors that every boot reads."""

    @property
    def damaged(self) -> Sequence[range]:
        """Where a cut may also destroy what was being written."""

    @property
    def slots(self) -> Mapping[str, int]:
        """First sector of each slot."""

    @property
    def loaded(self) -> Mapping[str, Sequence[range]]:
        """Sectors that the boot loader reads only of a slot that it may start."""

    def startable(self, slot: str, read: Read) -> bool:
        """Whether the boot loader may start the slot."""


@dataclass(frozen=True, slots=True)
class Signature:
    """Two states with the same signature boot alike.

    They agree on every sector that the boot loader reads. Linux reads the slot that is started: of a complete one all
    contents are the same, and one that is not complete must not be started at all.
    """

    always: int
    """Digest of the sectors that every boot reads."""
    unreadable: frozenset[int]
    loaded: tuple[tuple[str, int], ...]
    """Of each slot that may be started: name, digest of the sectors that the boot loader reads."""
    complete: frozenset[tuple[str, str]]
    """Slots whose content is to the byte a release's, and which."""


class Timeline:
    """A log over the card that it began with. Use it as a context manager.

    Equal contents of sectors have equal numbers, so a state is compared and kept as numbers.
    """

    def __init__(self, base: Path, log: WriteLog, layout: Layout, releases: Mapping[str, Mapping[str, bytes]]) -> None:
        """`releases`: by name and slot, all that the slot holds of the release from its first sector on."""
        self._base = os.open(base, os.O_RDONLY)
        self._log = log
        self._layout = layout
        self._contents: list[bytes] = []
        self._numbers: dict[bytes, int] = {}
        self._of_base: dict[int, int] = {}
        self._zeros = self._number(bytes(SECTOR))
        self._parts: dict[int, tuple[str, ...]] = {}
        self._ranges = {"": tuple(layout.always), **{name: tuple(each) for name, each in layout.loaded.items()}}
        self._wanted = {
            (slot, release): {
                layout.slots[slot] + at // SECTOR: self._number(blob[at : at + SECTOR].ljust(SECTOR, b"\0"))
                for at in range(0, len(blob), SECTOR)
            }
            for release, by_slot in releases.items()
            for slot, blob in by_slot.items()
        }
        self._written = {index: self._numbers_of(index) for index, each in enumerate(log.entries) if each.count}
        self._begin()

    def __enter__(self) -> Timeline:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._base)

    def content(self, number: int) -> bytes:
        return self._contents[number]

    def base(self, sector: int) -> bytes:
        """What the card began with."""
        return os.pread(self._base, SECTOR, sector * SECTOR).ljust(SECTOR, b"\0")

    def overlay(self, state: CrashState) -> Overlay:
        """All sectors in which the state differs from what the card began with."""
        self._seek(state.upto)
        return {**self._now, **self._difference(state)}

    def signature(self, state: CrashState) -> Signature:
        """States are asked for in the order of `upto`; going back costs a new start."""
        self._seek(state.upto)
        if state.lost and not state.damage and not state.torn and self._overwritten.isdisjoint(state.lost):
            return self._without(state.lost)
        changed = self._difference(state)
        digests, wrong = dict(self._digests), dict(self._wrong)
        for sector, number in changed.items():
            self._count(sector, self._at(sector), number, digests, wrong)
        loaded = self._loaded(digests, self._reader(changed))
        read_of = [*self._layout.always, *(each for name, _ in loaded for each in self._layout.loaded[name])]
        unreadable = frozenset(
            sector
            for sector, number in changed.items()
            if number == UNREADABLE and any(sector in each for each in read_of)
        )
        return Signature(digests[""], unreadable, loaded, frozenset(key for key, count in wrong.items() if not count))

    def _without(self, lost: Sequence[int]) -> Signature:
        """The same without entries that share no sector with others: most states, so what each changes is kept."""
        digests, wrong = dict(self._digests), dict(self._wrong)
        for index in lost:
            kept = self._undone.get(index)
            if kept is None:
                kept = self._undone[index] = dict.fromkeys(digests, 0), dict.fromkeys(wrong, 0)
                for sector, before in self._before[index].items():
                    self._count(sector, self._at(sector), before, *kept)
            for name, change in kept[0].items():
                digests[name] = (digests[name] + change) & _MASK
            for key, difference in kept[1].items():
                wrong[key] += difference
        changed = ChainMap(*(self._before[index] for index in lost))
        loaded = self._loaded(digests, self._reader(changed))
        return Signature(digests[""], frozenset(), loaded, frozenset(key for key, count in wrong.items() if not count))

    def _loaded(self, digests: Mapping[str, int], read: Read) -> tuple[tuple[str, int], ...]:
        return tuple((name, digests[name]) for name in self._layout.loaded if self._layout.startable(name, read))

    def _begin(self) -> None:
        self._upto = 0
        self._now: dict[int, int] = {}
        self._digests = dict.fromkeys(self._ranges, 0)
        self._wrong = {
            key: sum(self._at_base(sector) != number for sector, number in wanted.items())
            for key, wanted in self._wanted.items()
        }
        self._before: dict[int, dict[int, int]] = {}
        """By entry since the last flush, what its sectors held before it."""
        self._writers: dict[int, list[int]] = {}
        """By sector, the entries since the last flush that wrote it."""
        self._overwritten: set[int] = set()
        """Entries since the last flush that share a sector with another one."""
        self._undone: dict[int, tuple[dict[str, int], dict[tuple[str, str], int]]] = {}
        """By entry, what digests and wrong sectors change by when it is lost."""

    def _seek(self, upto: int) -> None:
        if upto < self._upto:
            self._begin()
        for index in range(self._upto, upto):
            entry = self._log.entries[index]
            if entry.flush:
                self._before.clear()
                self._writers.clear()
                self._overwritten.clear()
                self._undone.clear()
            if entry.count:
                before = {}
                for sector, number in self._written[index].items():
                    old = before[sector] = self._at(sector)
                    self._count(sector, old, number, self._digests, self._wrong)
                    self._now[sector] = number
                    writers = self._writers.setdefault(sector, [])
                    writers.append(index)
                    if len(writers) > 1:
                        self._overwritten.update(writers)
                self._before[index] = before
        self._upto = upto

    def _difference(self, state: CrashState) -> dict[int, int]:
        """Sectors in which the state differs from all entries before `upto`."""
        changed: dict[int, int] = {}
        for index in reversed(state.lost):  # what a lost write would have overwritten is there still
            for sector, before in self._before[index].items():
                if not any(later > index and later not in state.lost for later in self._writers[sector]):
                    changed[sector] = before
        if state.torn:
            entry = self._log.entries[state.upto]
            written = self._written[state.upto]
            changed |= {sector: written[sector] for sector in range(entry.sector, entry.sector + state.torn)}
        for damage in state.damage:
            for sector in range(damage.sector, damage.sector + damage.count):
                fill = UNREADABLE if damage.fill == "unreadable" else self._number(filler(damage, sector))
                changed[sector] = fill
        return changed

    def _numbers_of(self, index: int) -> dict[int, int]:
        entry = self._log.entries[index]
        if entry.discard:  # a card may forget them or not: zeros stand for forgetting, lost entries for the other
            return dict.fromkeys(range(entry.sector, entry.sector + entry.count), self._zeros)
        return {entry.sector + number: self._number(self._log.content(entry, number)) for number in range(entry.count)}

    def _number(self, content: bytes) -> int:
        found = self._numbers.get(content)
        if found is None:
            found = self._numbers[content] = len(self._contents)
            self._contents.append(content)
        return found

    def _at(self, sector: int) -> int:
        found = self._now.get(sector)
        return self._at_base(sector) if found is None else found

    def _at_base(self, sector: int) -> int:
        found = self._of_base.get(sector)
        if found is None:
            found = self._of_base[sector] = self._number(self.base(sector))
        return found

    def _reader(self, changed: Overlay) -> Read:
        def read(sector: int) -> bytes | None:
            number = changed.get(sector)
            if number is None:
                number = self._at(sector)
            return None if number == UNREADABLE else self._contents[number]

        return read

    def _count(
        self, sector: int, old: int, new: int, digests: dict[str, int], wrong: dict[tuple[str, str], int]
    ) -> None:
        """One sector changes: in digests, which are sums over sectors, and in what differs from releases."""
        if old == new:
            return
        for name in self._names(sector):
            digests[name] = (digests[name] + self._term(sector, new) - self._term(sector, old)) & _MASK
        for key, wanted in self._wanted.items():
            number = wanted.get(sector)
            if number is not None:
                wrong[key] += (new != number) - (old != number)

    def _names(self, sector: int) -> tuple[str, ...]:
        """The digests that the sector is part of."""
        found = self._parts.get(sector)
        if found is None:
            found = tuple(name for name, ranges in self._ranges.items() if any(sector in each for each in ranges))
            self._parts[sector] = found
        return found

    def _term(self, sector: int, number: int) -> int:
        """A share of a digest: as good as random, and zero for what the card began with."""
        if number == self._at_base(sector):
            return 0
        return hash((sector, number, 1)) * 0x9E3779B97F4A7C15F39CC0605CEDC835 & _MASK


_MASK = (1 << 128) - 1
