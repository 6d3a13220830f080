"""Logs of writes, the states made of them, and their signatures, against a plain model: a disk as bytes."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from flotilla.lab.power_cuts.crash_states import CrashState, Damage, all_states, filler
from flotilla.lab.power_cuts.replay import Recording, Verdict, replay
from flotilla.lab.power_cuts.starter import Content, Started
from flotilla.lab.power_cuts.timeline import UNREADABLE, Read, Timeline
from flotilla.lab.power_cuts.write_log import SECTOR, LogWriter, WriteLog, count_entries
from flotilla.lab.qemu import tiny
from flotilla.lab.qemu.timing import LabError

SECTORS = 24
SLOT = 12
FAR = 70
"""A sector that the boot loader does not read together with those that are named."""


class Layout:
    """The first sectors are read always, sector 8 says whether the slot behind is."""

    always: Sequence[range] = (range(9),)
    damaged: Sequence[range] = (range(9),)
    slots: Mapping[str, int] = {"A": SLOT}
    loaded: Mapping[str, Sequence[range]] = {"A": [range(SLOT, SLOT + 4)]}

    def startable(self, slot: str, read: Read) -> bool:
        content = read(8)
        return content is not None and content[0] == 1


def sector(value: int) -> bytes:
    return bytes([value]) * SECTOR


def random_log(path: Path, chance: random.Random, number: int) -> None:
    """Writes of up to five sectors with few contents, so that equal states come about in several ways."""
    with LogWriter(path) as log:
        for _ in range(number):
            start = chance.randrange(SECTORS - 5)
            kind = chance.choice(("write", "write", "write", "flush", "fua", "discard", "mark"))
            if kind == "flush":
                log.flush()
            elif kind == "discard":
                log.discard(start, chance.randrange(1, 4))
            elif kind == "mark":
                log.mark("here")
            else:
                content = b"".join(sector(chance.randrange(3)) for _ in range(chance.randrange(1, 6)))
                log.write(start, content, fua=kind == "fua")


def applied(base: bytes, log: WriteLog, state: CrashState) -> list[bytes | None]:
    """The disk in a state, the plain way."""
    disk: list[bytes | None] = [base[at : at + SECTOR] for at in range(0, len(base), SECTOR)]
    for index, entry in enumerate(log.entries[: state.upto + 1]):
        count = entry.count if index < state.upto else state.torn
        for number in range(count if index not in state.lost else 0):
            disk[entry.sector + number] = bytes(SECTOR) if entry.discard else log.content(entry, number)
    for damage in state.damage:
        for each in range(damage.sector, min(damage.sector + damage.count, SECTORS)):
            disk[each] = None if damage.fill == "unreadable" else filler(damage, each)
    return disk


@pytest.fixture
def base(tmp_path: Path) -> Path:
    path = tmp_path / "base"
    path.write_bytes(b"".join(sector(number % 3) for number in range(SECTORS)))
    return path


def test_log_reads_back(tmp_path: Path) -> None:
    """Failed with `place` advanced over the data of discards, which have none."""
    path = tmp_path / "log"
    with LogWriter(path) as out:
        out.write(3, sector(1) + sector(2))
        out.discard(7, 1000)
        out.flush()
        out.mark("half")
        out.write(9, sector(3), fua=True)
        assert out.number == 5
    assert count_entries(path) == 5
    with WriteLog(path) as log, LogWriter(tmp_path / "copy") as out:
        first, discard, flush, mark, last = log.entries
        assert (first.sector, first.count, first.writes, first.flush) == (3, 2, True, False)
        assert [log.content(first, number) for number in range(2)] == [sector(1), sector(2)]
        assert (discard.sector, discard.count, discard.discard, discard.writes) == (7, 1000, True, False)
        assert (flush.flush, flush.count, mark.mark) == (True, 0, "half")
        assert (last.fua, log.content(last, 0)) == (True, sector(3))
        for entry in log.entries:
            out.copy(log, entry)
    assert (tmp_path / "copy").read_bytes() == path.read_bytes()


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    """Failed with any check of `_read` taken out: an error of `struct`, or a log with less in it."""
    path = tmp_path / "log"
    with LogWriter(path) as out:
        out.write(3, sector(1) * 4)
        out.flush()
    whole = path.read_bytes()
    for content, said in (
        (b"", "empty"),
        (whole[:20], "20 bytes"),
        (b"x" + whole[1:], "magic"),
        (whole[:8] + b"\2" + whole[9:], "version 2"),
        (whole[:24] + b"\0\x10" + whole[26:], "sectors of 4096 bytes"),
        (whole[: SECTOR * 3], "within entry 0 of 2"),
        (whole[:-SECTOR], "before entry 1 of 2"),
    ):
        path.write_bytes(content)
        with pytest.raises(LabError, match=said):
            WriteLog(path)


def test_states_of_a_short_log(tmp_path: Path) -> None:
    """By hand. Failed with losses across a flush, and with a torn write of no sector or of all."""
    path = tmp_path / "log"
    with LogWriter(path) as out:
        out.write(0, sector(1) * 8)
        out.write(20, sector(1))
        out.write(21, sector(2))
        out.flush()
        out.write(22, sector(3))
        out.write(2, sector(4))
    with WriteLog(path) as log:
        states = list(all_states(log.entries, [range(3)], seed=1, per_cut=10))
    plain = [state for state in states if not state.damage]
    assert plain == [
        CrashState(0), CrashState(0, torn=1), CrashState(0, torn=4), CrashState(0, torn=7),
        CrashState(1), CrashState(2), CrashState(2, lost=(0,)),
        CrashState(3), CrashState(3, lost=(0,)), CrashState(3, lost=(1,)), CrashState(3, lost=(0, 1)),
        CrashState(4), CrashState(5), CrashState(6), CrashState(6, lost=(4,)),
    ]  # fmt: skip
    damaged = [state for state in states if state.damage]
    assert {state.upto for state in damaged} == {1, 6}, "only the writes in the range are damaged"
    assert [each.damage[0] for each in damaged if each.upto == 6] == [
        Damage(2, 1, "unreadable"), Damage(0, 128, "zeros"), Damage(0, 128, "ones"), Damage(0, 128, "random")
    ]  # fmt: skip


def test_many_lost_writes_are_chosen_by_the_seed(tmp_path: Path) -> None:
    """Failed with the limit ignored, and with a generator of its own for each cut."""
    path = tmp_path / "log"
    with LogWriter(path) as out:
        for number in range(60):
            out.write(number, sector(1))
    with WriteLog(path) as log:
        first, again, other = (list(all_states(log.entries, [], seed=seed, per_cut=50)) for seed in (1, 1, 2))
    assert first == again != other
    for upto, states in itertools.groupby(first, key=lambda state: state.upto):
        lost = [state.lost for state in states if state.lost]
        assert len(set(lost)) == len(lost) <= 50
        assert all(index < upto - 1 for each in lost for index in each)
    assert {len(state.lost) for state in first} == {0, 1, 2}


def every(log: WriteLog) -> Iterator[CrashState]:
    return all_states(log.entries, Layout.damaged, seed=1, per_cut=40)


@pytest.mark.parametrize("seed", range(8))
def test_overlay_is_what_a_disk_would_hold(base: Path, tmp_path: Path, seed: int) -> None:
    """Failed with lost writes applied in their order: of two to a sector, the later one's past remained."""
    random_log(tmp_path / "log", random.Random(seed), 40)
    with WriteLog(tmp_path / "log") as log, Timeline(base, log, Layout(), {}) as timeline:
        states = list(every(log))
        assert len(states) > 100
        for state in [*states, *random.Random(seed).sample(states, 20)]:  # also going back
            found = dict(timeline.overlay(state))
            for number, wanted in enumerate(applied(base.read_bytes(), log, state)):
                content = found.get(number)
                if content == UNREADABLE:
                    assert wanted is None, f"{state}: sector {number}"
                else:
                    read = timeline.base(number) if content is None else timeline.content(content)
                    assert read == wanted, f"{state}: sector {number}"


@pytest.mark.parametrize("seed", range(8))
def test_states_are_grouped_by_what_a_boot_reads(base: Path, tmp_path: Path, seed: int) -> None:
    """Two states have one signature exactly when all sectors agree that a boot reads.

    Failed with the slot's digest left out of the signature, with it there while the slot cannot be started, and with
    sectors counted as wrong that became right.
    """
    random_log(tmp_path / "log", random.Random(seed), 40)
    blob = sector(0) + sector(1)
    with WriteLog(tmp_path / "log") as log, Timeline(base, log, Layout(), {"new": {"A": blob}}) as timeline:
        by_signature: dict[object, set[tuple[object, ...]]] = {}
        by_content: dict[tuple[object, ...], set[object]] = {}
        for state in every(log):
            disk = applied(base.read_bytes(), log, state)
            signature = timeline.signature(state)
            startable = disk[8] is not None and disk[8][0] == 1
            complete = disk[SLOT : SLOT + 2] == [sector(0), sector(1)]
            assert (("A", "new") in signature.complete) == complete, str(state)
            read = (*disk[:9], *(disk[SLOT : SLOT + 4] if startable else ()), complete)
            by_signature.setdefault(signature, set()).add(read)
            by_content.setdefault(read, set()).add(signature)
    assert len(by_content) > 20
    assert {reads[-1] for reads in by_content} == {True, False}
    assert all(len(reads) == 1 for reads in by_signature.values()), "one group holds states that boot differently"
    assert all(len(signatures) == 1 for signatures in by_content.values()), "states that boot alike are not one group"


class Computer:
    """In the place of `Starter`: sector 8 says whether slot A is started, sector 0 whether it reads `FAR` too."""

    def __init__(self, board: object, base: Path, directory: Path, unreadable: frozenset[int] = frozenset()) -> None:
        self._base = base.read_bytes()
        self._unreadable = unreadable
        self._read: set[int] = set()

    def __enter__(self) -> Computer:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def plant(self, content: Content, own: object) -> None:
        disk = bytearray(self._base)
        for number, data in content.items():
            disk[number * SECTOR : (number + 1) * SECTOR] = data
        self._disk = bytes(disk)

    def power_on(self) -> Started:
        if 8 in self._unreadable or self._value(8) != 1:
            return Started(None, None, False)
        release = {3: "old", 4: "new"}.get(self._value(SLOT), "neither")
        if self._value(0) == 9 and self._value(FAR):
            release = "new"
        return Started("A", release, self._value(SLOT + 1) == 5)

    def sectors_read(self) -> set[int]:
        return self._read

    def _value(self, number: int) -> int:
        self._read.add(number)
        return self._disk[number * SECTOR]


OLD, NEW = frozenset({"old"}), frozenset({"new"})


def judged(monkeypatch: pytest.MonkeyPatch, directory: Path, phases: Sequence[tuple[int, frozenset[str]]],
           *writes: tuple[int, int], first: int = 0) -> Verdict:  # fmt: skip
    """The verdict on a card that begins with release `old` in slot A, after writes of one sector each: place, value."""
    monkeypatch.setattr("flotilla.lab.power_cuts.replay.Starter", Computer)
    base = bytearray((FAR + 1) * SECTOR)
    for number, value in ((0, first), (8, 1), (SLOT, 3), (SLOT + 1, 5)):
        base[number * SECTOR] = value
    (directory / "base").write_bytes(base)
    with LogWriter(directory / "log") as log:
        for place, value in writes:
            log.write(place, bytes([value]).ljust(SECTOR, b"\0"))
            log.flush()
    releases = {name: {"A": bytes([value]).ljust(SECTOR, b"\0")} for name, value in (("old", 3), ("new", 4))}
    layout = Layout()
    layout.damaged = []
    recording = Recording(directory / "base", directory / "log", layout, releases, phases)
    return replay(tiny.BOARD, recording, directory / "replay", sample=1)


def test_verdicts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Failed with phases one entry later, without states after flushes, and without each check of `_judge`."""
    sound = judged(monkeypatch, tmp_path, [(0, OLD), (1, NEW)], (SLOT, 4))
    assert (sound.sound, sound.states, sound.groups) == (True, 3, 2), "before, after, and flushed"
    assert sound.started == {"old in A": 1, "new in A": 2}

    late = judged(monkeypatch, tmp_path, [(0, OLD)], (SLOT, 4))
    assert (len(late.bricks), len(late.wrong)) == (0, 2)
    assert "after 1 entries" in late.wrong[0]
    assert "only old may be started" in late.wrong[0]

    early = judged(monkeypatch, tmp_path, [(0, OLD | NEW), (2, NEW)], (20, 1))
    assert len(early.wrong) == 1, "the old one may be started until the flush, not after it"

    brick = judged(monkeypatch, tmp_path, [(0, OLD)], (8, 0))
    assert (len(brick.bricks), len(brick.wrong), brick.power_ons) == (2, 0, 1 + 4)

    torn = judged(monkeypatch, tmp_path, [(0, OLD)], (SLOT + 1, 6))
    assert (len(torn.bricks), len(torn.wrong)) == (2, 8), "four power-ons, none of them of a whole release"

    other = judged(monkeypatch, tmp_path, [(0, OLD)], (SLOT, 7))
    assert (len(other.bricks), len(other.wrong)) == (2, 8)
    assert "not whole" in other.wrong[0]


def test_grouping_is_tested(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A boot loader that reads a sector that the layout does not name. Failed without each of the two checks."""
    verdict = judged(monkeypatch, tmp_path, [(0, OLD | NEW)], (FAR, 1), first=9)
    assert (verdict.states, verdict.groups, verdict.sampled) == (3, 1, 2)
    assert len(verdict.ungrouped) == 3
    assert "its group" in verdict.ungrouped[0]
    assert f"[{FAR}]" in verdict.ungrouped[-1]
