"""What the system tells the boot loader: `flotilla-slot` on a card that is a file."""

from __future__ import annotations

import itertools
import json
import random
import struct
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flotilla.fleet import inventory
from flotilla.images import card, environment_block

COPIES = [card.STATE.start + place for place in card.COPIES]
EMPTY = environment_block.make({}, card.HEADER_BYTES)
"""The header of a slot that holds nothing."""
TRIES = card.STATE.start + card.TRIES
PC = next(board for board in inventory.load_fleet().boards.values() if board.firmware == "uefi")


@dataclass(frozen=True)
class Card:
    """A card with a release in each slot, of which A is good."""

    path: Path
    program: Path

    def run(self, *words: str, running: str = "A") -> subprocess.CompletedProcess[str]:
        argv = [str(self.program), "--disk", str(self.path), "--running", running, *words]
        return subprocess.run(argv, capture_output=True, text=True, check=False)

    def do(self, *words: str, running: str = "A") -> dict[str, Any]:
        """What the card says after a command that succeeds."""
        done = self.run(*words, running=running)
        assert done.returncode == 0, done.stderr
        shown: dict[str, Any] = json.loads(self.run("show", running=running).stdout)
        return shown

    def read(self, place: int, length: int = card.SECTOR) -> bytes:
        with self.path.open("rb") as file:
            file.seek(place)
            return file.read(length)

    def write(self, place: int, content: bytes) -> None:
        with self.path.open("r+b") as file:
            file.seek(place)
            file.write(content)

    def count(self, sequence: int, a: int = 0, b: int = 0) -> None:
        """As the boot loader does."""
        values = {"FOR": str(sequence), "A_TRIES": str(a), "B_TRIES": str(b)}
        self.write(TRIES, environment_block.make(values, card.SECTOR))


@pytest.fixture
def new(tmp_path: Path, flotilla_slot: Path) -> Card:
    made = Card(tmp_path / "card", flotilla_slot)
    with made.path.open("wb") as file:
        file.truncate(card.SIZE)
    made.write(0, partition_table())
    made.write(card.STATE.start, card.tries_block())
    for place in COPIES:
        made.write(place, card.state_copy())
    for number, each in enumerate(card.SLOTS, 1):
        values = {"RELEASE": str(number), "FLOOR": "1", "BLOB": f"{number:064x}", "VERSION": "6.1.0-rt"}
        made.write(each.end - card.HEADER_ROOM, environment_block.make(values, card.HEADER_BYTES))
    return made


def partition_table() -> bytes:
    """The MBR, without boot code."""
    entries = b"".join(
        bytes(8) + (each.start // 512).to_bytes(4, "little") + (each.size // 512).to_bytes(4, "little")
        for each in (card.STATE, *card.SLOTS, card.DATA)
    )
    return bytes(446) + entries + b"\x55\xaa"


def gpt() -> bytes:
    """The MBR that protects a GPT, its header, and entries; the program looks at nothing else (UEFI 2.10, 5.3)."""
    parts = sorted(card.partitions(PC), key=lambda one: one.number)
    entries = b"".join(
        bytes(32) + struct.pack("<QQ", one.start // 512, one.end // 512 - 1) + bytes(80) for one in parts
    )
    return bytes(450) + b"\xee" + bytes(59) + b"\x55\xaa" + b"EFI PART".ljust(512, b"\0") + entries


def test_a_card_with_a_gpt(new: Card) -> None:
    """Partitions are where it says, whatever order they lie in. Seen to fail where the MBR's entries are read."""
    before = new.do("show")
    new.write(0, gpt())
    assert new.do("show") == before
    new.count(1, a=2)
    assert new.do("started")["slots"]["A"]["tries"] == 0
    assert [new.read(place) for place in COPIES] == [card.state_copy(2)] * 2
    for damage in (b"EFI PARX", gpt()[512:1024] + bytes(40) + b"\xff" * 8):
        new.write(512, damage)
        refused = new.run("show")
        assert refused.returncode
        assert "has no partition table of a card" in refused.stderr


def test_a_new_card_needs_nothing(new: Card) -> None:
    """Builder and program agree on every byte. Seen to fail with another tar header."""
    before = new.read(card.STATE.start, card.STATE.size)
    shown = new.do("started")
    assert shown == {
        "running": "A", "sequence": 1, "order": ["A", "B"], "trial": None,
        "slots": {
            "A": {"ok": True, "tries": 0, "release": "1", "floor": "1", "blob": f"{1:064x}", "kernel": "6.1.0-rt",
                  "start": card.SLOTS[0].start, "size": card.SLOTS[0].size},
            "B": {"ok": False, "tries": 0, "release": "2", "floor": "1", "blob": f"{2:064x}", "kernel": "6.1.0-rt",
                  "start": card.SLOTS[1].start, "size": card.SLOTS[1].size},
        },
    }  # fmt: skip
    assert new.read(card.STATE.start, card.STATE.size) == before


def test_a_count_begins_anew_with_each_start_that_works(new: Card) -> None:
    new.count(1, a=2)
    assert new.do("show")["slots"]["A"]["tries"] == 2
    shown = new.do("started")
    assert (shown["sequence"], shown["slots"]["A"]["tries"]) == (2, 0)
    assert [new.read(place) for place in COPIES] == [card.state_copy(2)] * 2


def test_a_slot_that_never_got_there_is_not_good(new: Card) -> None:
    for place in COPIES:
        new.write(place, card.state_copy(4, good="AB"))
    new.count(4, a=3, b=1)
    shown = new.do("started", running="B")
    assert [shown["slots"][name]["ok"] for name in "AB"] == [False, True]


def test_a_trial_and_its_end(new: Card) -> None:
    """Seen to fail where `started` confirms a slot on trial."""
    assert new.do("trial", "B")["trial"] == "B"
    new.count(2, b=1)
    assert new.do("started", running="B")["trial"] == "B", "nobody has confirmed it"
    shown = new.do("confirm", running="B")
    assert (shown["order"], shown["trial"], shown["slots"]["B"]["ok"], shown["slots"]["A"]["ok"]) == (
        ["B", "A"],
        None,
        True,
        True,
    )


def test_a_trial_that_failed_is_over(new: Card) -> None:
    new.do("trial", "B")
    new.count(2, b=1)
    shown = new.do("started")
    assert (shown["order"], shown["trial"], shown["slots"]["B"]["ok"]) == (["A", "B"], None, False)


def test_what_is_refused_changes_nothing(new: Card) -> None:
    before = new.read(card.STATE.start, card.STATE.size)
    for words, why in (
        (("trial", "A"), "needs no trial"), (("clear", "A"), "cannot be cleared"),
        (("trial", "B"), "is empty"), (("trial", "C"), "usage"), (("begin",), "usage"),
    ):  # fmt: skip
        if why == "is empty":
            new.write(card.SLOTS[1].end - card.HEADER_ROOM, EMPTY)
        done = new.run(*words)
        assert done.returncode in (1, 2)
        assert why in done.stderr, done.stderr
    assert new.read(card.STATE.start, card.STATE.size) == before
    other = new.path.with_name("other")
    other.write_bytes(bytes(1 << 20))
    done = Card(other, new.program).run("show")
    assert (done.returncode, "has no partition table of a card" in done.stderr) == (1, True)


def test_a_cleared_slot_is_empty(new: Card) -> None:
    for place in COPIES:
        new.write(place, card.state_copy(4, order="B A", good="AB"))
    shown = new.do("clear", "B")
    assert (shown["order"], shown["slots"]["B"]["ok"], shown["slots"]["B"]["release"]) == (["A", "B"], False, None)
    assert new.read(card.SLOTS[1].end - card.HEADER_ROOM, card.HEADER_BYTES) == EMPTY


def test_one_copy_is_enough_and_the_other_is_made_again(new: Card) -> None:
    """Whatever a copy holds: each of its bits flipped, torn, random. Seen to fail without the check sum."""
    chance = random.Random(1)
    good = card.state_copy(9, order="B A", good="AB")
    bad = [bytes(512), b"\xff" * 512, good[:70] + bytes(442), good[:-100], chance.randbytes(512)]
    for bit in range(0, 110 * 8, 7):
        flipped = bytearray(good)
        flipped[bit // 8] ^= 1 << bit % 8
        bad.append(bytes(flipped))
    for number, content in enumerate(bad):
        place, other = COPIES[number % 2], COPIES[1 - number % 2]
        new.write(other, card.state_copy(8, good="AB"))
        new.write(place, content.ljust(512, b"\0"))
        assert new.do("show")["sequence"] == 8, f"{number} is taken for a state"
        assert new.do("started")["sequence"] == 9
        assert new.read(place) == new.read(other) == card.state_copy(9, good="AB")


def test_both_copies_lost_is_the_boot_loaders_default(new: Card) -> None:
    for place in COPIES:
        new.write(place, bytes(512))
    shown = new.do("show")
    assert (shown["sequence"], shown["order"], [shown["slots"][name]["ok"] for name in "AB"]) == (
        0,
        ["A", "B"],
        [True, True],
    )


def test_a_lost_count_is_made_again(new: Card) -> None:
    for damage in ({card.STATE.start: bytes(512)}, {TRIES: bytes(512)}):
        for place, content in damage.items():
            new.write(place, content)
        new.do("started")
        assert new.read(card.STATE.start, 1024) == card.tries_block()


def test_power_may_go_at_any_write(new: Card) -> None:
    """With some writes of a command on the card, one torn and the others lost, the card says what it said before or
    what it says after. Seen to fail where the first copy is the only one that is ever written."""
    orders: list[Callable[[], None]] = [
        lambda: None,
        lambda: new.count(json.loads(new.run("show").stdout)["sequence"], a=1),
    ]
    new.do("trial", "B")
    new.do("confirm")  # so that what is written is not the first of its kind
    for words, prepare in itertools.product((("trial", "B"), ("clear", "B"), ("started",), ("confirm",)), orders):
        prepare()
        start = new.read(0, card.SIZE)
        before, after = new.do("show"), new.do(*words)
        writes = changed(start, new.read(0, card.SIZE))
        for torn, content in writes:
            rest = [write for write in writes if write[0] != torn]
            for done in itertools.chain.from_iterable(itertools.combinations(rest, n) for n in range(len(rest) + 1)):
                new.path.write_bytes(start)
                for place, whole in done:
                    new.write(place, whole)
                new.write(torn, content[:60] + b"\xff" * 452)
                said = new.do("show")
                state = {before["sequence"]: before, after["sequence"]: after}.get(said["sequence"])
                assert state, f"{words}: neither the state before nor the one after"
                assert (said["order"], said["trial"]) == (state["order"], state["trial"])
        new.path.write_bytes(start)


def changed(before: bytes, after: bytes) -> list[tuple[int, bytes]]:
    """The sectors that differ."""
    return [
        (place, after[place : place + card.SECTOR])
        for place in (card.STATE.start, TRIES, *COPIES, card.SLOTS[1].end - card.HEADER_ROOM)
        if before[place : place + card.SECTOR] != after[place : place + card.SECTOR]
    ]
