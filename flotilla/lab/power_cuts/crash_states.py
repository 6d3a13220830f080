"""The states that a power cut can leave: descriptions of them, made from a log of writes.

What is assumed of a card: a sector of 512 bytes is written whole or not at all; sectors of one write arrive in their
order; of the writes since the last flush any may be missing. Worn flash is worse: a sector that was being written may
be unreadable afterwards, and all that is erased with it may be lost.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from flotilla.lab.power_cuts.write_log import SECTOR, Entry

NEIGHBOURS = 64 * 1024 // SECTOR
"""Sectors that are erased together."""
LOST_TOGETHER = 2
"""Writes that are missing at most, of those that no flush has made sure of."""
Fill = Literal["unreadable", "zeros", "ones", "random"]
FILLS: Sequence[Fill] = ("zeros", "ones", "random")


@dataclass(frozen=True, slots=True)
class Damage:
    """Sectors that the cut destroyed."""

    sector: int
    count: int
    fill: Fill


@dataclass(frozen=True, slots=True)
class CrashState:
    """What is on the card after a cut."""

    upto: int
    """The entries of the log before this one were completed."""
    torn: int = 0
    """So many sectors of the next entry, too."""
    lost: tuple[int, ...] = ()
    """Entries, by number, that were completed and yet are not on the card: no flush came after them."""
    damage: tuple[Damage, ...] = ()

    def __str__(self) -> str:
        words = [f"after {self.upto} entries"]
        words += [f"and {self.torn} sectors of the next"] * bool(self.torn)
        words += [f"without {', '.join(map(str, self.lost))}"] * bool(self.lost)
        words += [f"{each.count} sectors from {each.sector} are {each.fill}" for each in self.damage]
        return ", ".join(words)


def all_states(entries: Sequence[Entry], watched: Iterable[range], *, seed: int, per_cut: int) -> Iterator[CrashState]:
    """Every state, ordered by how many entries were completed.

    `watched`: ranges of sectors in which a write is followed by damage, too. `per_cut`: limit of the states with lost
    writes at one cut, beyond which `seed` chooses: a file system leaves hundreds of writes without a flush.
    """
    chance = random.Random(seed)
    ranges = list(watched)
    unflushed: list[int] = []
    yield CrashState(0)
    for index, entry in enumerate(entries):
        if entry.flush:
            unflushed.clear()
            if not entry.count:  # the same card as before, but what waited for it has gone on
                yield CrashState(index + 1)
        if not entry.count:
            continue
        yield from (CrashState(index, torn) for torn in tears(entry))
        yield CrashState(index + 1)
        yield from _without(index + 1, unflushed, chance, per_cut)
        if entry.writes and any(_meet(entry, each) for each in ranges):
            yield from (CrashState(index + 1, damage=(damage,)) for damage in damages(entry))
        if not entry.fua:
            unflushed.append(index)


def tears(entry: Entry) -> list[int]:
    """Where a write is torn: after one sector, half, all but one."""
    if not entry.writes:
        return []
    return sorted({1, entry.count // 2, entry.count - 1} & set(range(1, entry.count)))


def damages(entry: Entry) -> Iterator[Damage]:
    """What a cut does to the place of a write that it meets: at worst the whole erased unit, and it has no other."""
    yield Damage(entry.sector, entry.count, "unreadable")
    first = entry.sector // NEIGHBOURS * NEIGHBOURS
    end = -(-(entry.sector + entry.count) // NEIGHBOURS) * NEIGHBOURS
    for fill in FILLS:
        yield Damage(first, end - first, fill)


def filler(damage: Damage, sector: int) -> bytes:
    """What a destroyed sector reads as."""
    if damage.fill == "zeros":
        return bytes(SECTOR)
    if damage.fill == "ones":
        return b"\xff" * SECTOR
    return random.Random(sector).randbytes(SECTOR)


def _without(upto: int, unflushed: Sequence[int], chance: random.Random, limit: int) -> Iterator[CrashState]:
    """The last write arrived and up to two before it did not; were it missing too, the cut would have been earlier."""
    number = len(unflushed)
    if number + number * (number - 1) // 2 <= limit:
        for many in range(1, LOST_TOGETHER + 1):
            yield from (CrashState(upto, lost=lost) for lost in itertools.combinations(unflushed, many))
        return
    chosen = {(each,) for each in (unflushed if number <= limit // 2 else chance.sample(unflushed, limit // 2))}
    pairs = {tuple(sorted(chance.sample(unflushed, LOST_TOGETHER))) for _ in range(limit - len(chosen))}
    yield from (CrashState(upto, lost=lost) for lost in sorted(chosen | pairs))


def _meet(entry: Entry, sectors: range) -> bool:
    return entry.sector < sectors.stop and sectors.start < entry.sector + entry.count
