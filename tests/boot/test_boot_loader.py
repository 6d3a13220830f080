"""Robot 3's boot loader, with its boot state in every condition that could be thought of.

The boot loader is the card's; the kernel only says that it was started (`flotilla/lab/qemu/boot_loader.py`). That whole
systems boot, and repair the state, is in `test_accidents.py`.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.debian import tools
from flotilla.debian.lock import read_lock
from flotilla.debian.tools import Tools
from flotilla.fleet import inventory
from flotilla.fleet.model import Board, Fleet
from flotilla.images import card, environment_block
from flotilla.images.build import image_of
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.boot_loader import BootLoader, Started, State, StubCard, header_place, initrd_place, kernel_place
from flotilla.lab.qemu.stub_computer import GAVE_UP, assemble

ROBOT = 3
UEFI_ROBOT = 2
_STATES = list(itertools.product(("A B", "B A"), ("A", "B", "AB"), ("", "A", "B"), range(4), range(4)))
"""Order, good slots and slot on trial of all states that can be written, with the tries that can be counted."""
SEED = 3
SECONDS = 600
"""Limit for what takes half a minute on an idle host."""
CLEARED = "\x1b[1;1H"
"""What GRUB says first."""
A, B = card.SLOTS
TRIES = card.STATE.start + card.TRIES
COPIES = [card.STATE.start + place for place in card.COPIES]

TRUSTING = b"""\
serial --unit=0 --speed=115200
terminal_output serial
load_env --file (hd0,msdos1)8192+1 ORDER A_OK B_OK
set chosen=
for slot in $ORDER; do
    if [ "$slot" = "A" -a -z "$chosen" -a "$A_OK" = "1" ]; then set chosen=A; fi
    if [ "$slot" = "B" -a -z "$chosen" -a "$B_OK" = "1" ]; then set chosen=B; fi
done
if [ "$chosen" = "A" ]; then linux (hd0,msdos2)0+SECTORS root=PARTUUID=OF_A quiet a=b flotilla.slot=A; fi
if [ "$chosen" = "B" ]; then linux (hd0,msdos3)0+SECTORS root=PARTUUID=OF_B quiet a=b flotilla.slot=B; fi
boot
echo "slot $chosen does not boot"
sleep 5
reboot
"""
"""A configuration that believes the first copy: what the checks below must refuse."""


@pytest.fixture(scope="module")
def board(fleet: Fleet) -> Board:
    return fleet.boards[inventory.robot(fleet, ROBOT).board]


@pytest.fixture(scope="module")
def toolset() -> Tools:
    lock = read_lock("tools")
    return Tools(tools.tree(lock), lock.epoch)


@pytest.fixture(scope="module")
def stubbed(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> StubCard:
    image = image_of(inventory.robot(fleet, ROBOT))
    if not image.exists():
        pytest.fail(f"{image} is missing; build it: make image ROBOT={ROBOT}", pytrace=False)
    return StubCard(image, tmp_path_factory.mktemp("stub"))


@pytest.fixture(scope="module")
def loader(board: Board, stubbed: StubCard, session_artefacts: Path) -> Iterator[BootLoader]:
    with BootLoader(board, stubbed, session_artefacts / "boot-loader") as loader:
        yield loader


def copies(first: bytes, second: bytes | None = None) -> dict[int, bytes]:
    """The state with these two copies, or the same one twice."""
    return dict(zip(COPIES, (first, first if second is None else second), strict=True))


def tries(sequence: int, a: int = 0, b: int = 0) -> dict[int, bytes]:
    """The state in which the boot loader has counted so many starts."""
    values = {"FOR": str(sequence), "A_TRIES": str(a), "B_TRIES": str(b)}
    return {TRIES: environment_block.make(values, card.SECTOR)}


def counted(loader: BootLoader) -> dict[str, str]:
    """What the boot loader has written."""
    return environment_block.values(loader.read(TRIES, card.SECTOR))


def expected(order: str, good: str, trial: str, a: int, b: int) -> tuple[str, bool, dict[str, int]]:
    """Who is started, whether on trial, and the tries that are left behind: the rules of grub.cfg once more."""
    count = {"A": a, "B": b}
    if trial and not count[trial]:
        return trial, True, count | {trial: 1}
    for _ in range(2):
        for slot in order.split():
            if slot in good and count[slot] < 3:
                return slot, False, count | {slot: count[slot] + 1}
        count |= dict.fromkeys(good, 0)
    return order.split()[0], False, count


def unsound(chance: random.Random) -> Iterator[tuple[str, bytes]]:
    """Sectors that nobody wrote on purpose."""
    size, header = card.SECTOR, environment_block.SIGNATURE.encode()
    new = card.state_copy(7, order="B A", good="AB", trial="B")
    yield from {
        "zeros": bytes(size), "ones": b"\xff" * size, "padding": b"#" * size, "newlines": b"\n" * size,
        "header alone": header.ljust(size, b"#"), "header, zeros": header.ljust(size, b"\0"),
        "header, no end": header.ljust(size, b"x"), "another file system's": (b"hsqs" * size)[:size],
    }.items()  # fmt: skip
    for number in range(10):
        yield f"random {number}", chance.randbytes(size)
        yield f"random behind the header {number}", header + chance.randbytes(size - len(header))
        cut = chance.randrange(len(header), 80)
        yield f"torn at {cut}", new[:cut] + chance.randbytes(size - cut)
        flipped = bytearray(new)
        for _ in range(chance.choice((1, 3, 10, 100))):
            flipped[chance.randrange(120)] ^= 1 << chance.randrange(8)
        yield f"bits flipped {number}", bytes(flipped)
    words = [
        "A",
        "B",
        "C",
        "A A",
        "B C A",
        "a b",
        "AB",
        "-a",
        "-z",
        "( A",
        "$root",
        "A\r",
        "4",
        "-1",
        "01",
        "1 ",
        "A=B",
    ]
    words += ["", " ", *"!\"';\\*]{`|#=\0", "9" * 300]
    names = ["SEQ", "ORDER", "A_OK", "B_OK", "TRIAL", "END", "FOR", "A_TRIES", "root", "prefix", "chosen", "slot"]
    names += ["order", "A_kernel", "sequence", "on_trial", "cmdpath", "?"]
    for number in range(50):
        lines = [f"{chance.choice(names)}={chance.choice(words)}\n" for _ in range(chance.randrange(1, 12))]
        if number % 2:
            lines = ["SEQ=9\n", *lines, "END=9\n"]  # as if it were a state
        yield f"values {number}: {lines}", (header + "".join(lines).encode())[:size].ljust(size, b"#")


def check(loader: BootLoader, name: str, state: State) -> Started:
    started = loader.start(state)
    assert started.slot in ("A", "B"), f"{name}: no slot was started:\n{started.said}"
    slot = next(each for each in card.SLOTS if each.name == started.slot)
    assert f"root=PARTUUID={slot.partuuid(loader.board, loader.disk_id)} quiet a=b " in started.arguments, (
        f"{name}: {started.arguments}"
    )
    return started


def test_a_new_card_boots_without_an_error(loader: BootLoader, fleet: Fleet) -> None:
    """Seen to fail: `error: invalid environment block.`, of the slot that is empty."""
    with image_of(inventory.robot(fleet, ROBOT)).open("rb") as image:
        image.seek(header_place(B))
        empty = image.read(card.HEADER_BYTES)
    assert "error" not in check(loader, "as made", {header_place(B): empty}).said


@pytest.mark.parametrize(
    "every", [pytest.param(23, id="each-23rd"), pytest.param(1, id="all", marks=pytest.mark.nightly)]
)
def test_every_state_leads_to_its_slot(loader: BootLoader, every: int) -> None:
    """Of the states that can be written, with the tries that can be counted: by the rules who is
    started, and what is counted.

    Seen to fail, with every seventh, where A's tries are never read, where A is good whatever the state says, where a
    third try does not end A, and without the word `flotilla.trial`.
    """
    for state in _STATES[::every]:
        _check_state(loader, *state)


def test_every_state_leads_to_its_slot_with_uefi(fleet: Fleet, tmp_path: Path) -> None:
    """The same configuration by another GRUB, from another disk's table. A start takes eight times as long.

    Seen to fail where the configuration does not ask which disk it came from, and takes the second one.
    """
    robot = inventory.robot(fleet, UEFI_ROBOT)
    stubbed = StubCard(image_of(robot), tmp_path / "stub")
    with BootLoader(fleet.boards[robot.board], stubbed, tmp_path / "uefi") as loader:
        for state in _STATES[::41]:
            _check_state(loader, *state)


@pytest.mark.parametrize("other", [1, 4])
def test_a_card_is_started_from_any_drive_beside_another(
    fleet: Fleet, board: Board, stubbed: StubCard, tmp_path: Path, other: int
) -> None:
    """The first drive is another robot's card, from which something starts the second drive. Seen to fail: the boot
    loader looked for the slots on the first drive, and both cards had the same identifier, so the kernel took the root
    of either."""
    another = StubCard(image_of(fleet.robots[other]), tmp_path / "another")
    assert fleet.robots[other].board == board.name
    assert another.disk_id != stubbed.disk_id
    first = tmp_path / "first"
    code = assemble("next_drive", tmp_path)
    another.write(first, code.ljust(440, b"\0") + another.head[440:])
    with BootLoader(board, stubbed, tmp_path / "second", first=first) as loader:
        started = check(loader, "second drive", {})
        assert f"BOOT_IMAGE=(hd1,msdos{A.number})" in started.arguments, started.said


def test_a_card_is_started_beside_another_with_uefi(fleet: Fleet, toolset: Tools, tmp_path: Path) -> None:
    """With its own root. The firmware finds nothing to start on the other one, which has another identifier."""
    robot = inventory.robot(fleet, UEFI_ROBOT)
    stubbed = StubCard(image_of(robot), tmp_path / "stub")
    first = tmp_path / "first"
    stubbed.write(first, stubbed.head[: card.SYSTEM.start].ljust(len(stubbed.head), b"\0"))
    card.identify(fleet.boards[robot.board], toolset, first, 0xF1)
    with BootLoader(fleet.boards[robot.board], stubbed, tmp_path / "second", first=first) as loader:
        check(loader, "second drive", {})


def _check_state(loader: BootLoader, order: str, good: str, trial: str, a: int, b: int) -> None:
    """Judge a start with one of `_STATES`."""
    content = card.state_copy(5, order=order, good=good, trial=trial)
    name = f"{order}, good {good}, trial {trial}, tries {a} {b}"
    started = check(loader, name, {**copies(content), **tries(5, a, b)})
    slot, on_trial, count = expected(order, good, trial, a, b)
    assert (started.slot, started.arguments.endswith(" flotilla.trial")) == (slot, on_trial), f"{name}\n{started.said}"
    left = counted(loader)
    assert {each: int(left[f"{each}_TRIES"]) for each in "AB"} == count, f"{name}: {left}"
    assert left["FOR"] == "5"


def test_the_newer_valid_copy_counts(loader: BootLoader) -> None:
    """Also where the other copy is torn or lost. Seen to fail where the later one in the file counts, and where the end
    mark is not compared."""
    old, new = card.state_copy(9, good="AB"), card.state_copy(10, order="B A", good="AB")
    torn = new.replace(b"END=10", b"END=9#")
    damaged = [bytes(512), b"\xff" * 512, torn, new[:60] + bytes(452)]
    for name, state, slot in (
        ("second", copies(old, new), "B"), ("first", copies(new, old), "B"), ("both", copies(new), "B"),
        *((f"damaged {number}", copies(old, bad), "A") for number, bad in enumerate(damaged)),
        *((f"damaged first {number}", copies(bad, new), "B") for number, bad in enumerate(damaged)),
    ):  # fmt: skip
        assert check(loader, name, state).slot == slot, name


def test_tries_of_another_state_do_not_count(loader: BootLoader) -> None:
    """Seen to fail where B's tries count whatever they are for."""
    on_trial = copies(card.state_copy(6, good="A", trial="B"))
    assert check(loader, "tried before", {**on_trial, **tries(6, 0, 1)}).slot == "A"
    assert check(loader, "of the state before", {**on_trial, **tries(5, 0, 1)}).slot == "B"


def test_no_trial_where_the_card_keeps_no_count(loader: BootLoader) -> None:
    """It would be tried at every start. Elsewhere: the count is written, but not where it is read at the next start.

    Seen to fail, with the last case, where the count is not compared when it is read back; without the last, only where
    the result of `count` is not looked at either.
    """
    on_trial = copies(card.state_copy(6, good="A", trial="B"))
    for name, damage in (
        ("no name", {card.STATE.start: bytes(512)}),
        ("no block", {TRIES: bytes(512)}),
        (
            "another size",
            {card.STATE.start: loader.read(card.STATE.start, 512).replace(b"00000001000", b"00000000000")},
        ),
        ("elsewhere", {card.STATE.start: card.tries_block("other") + card.tries_block()}),
    ):
        assert check(loader, name, {**on_trial, **damage}).slot == "A", name


@pytest.mark.parametrize(
    "every", [pytest.param(4, id="each-4th"), pytest.param(1, id="all", marks=pytest.mark.nightly)]
)
def test_a_slot_is_started_whatever_the_sectors_hold(loader: BootLoader, every: int) -> None:
    """Each content in one of the places by turns. Seen to fail with the configuration below."""
    chance = random.Random(SEED)
    good = card.state_copy(3, good="AB")
    for number, (name, content) in enumerate(itertools.islice(unsound(chance), 0, None, every)):
        places = (copies(content), {**copies(good, content), TRIES: content}, {header_place(A): content + bytes(512)})
        started = check(loader, name, {**copies(good), **places[number % 3]})
        assert number % 3 < 2 or started.slot == "B", name
    assert check(loader, "all of it is lost", {card.STATE.start: chance.randbytes(3 * card.REGION)}).slot == "A"


def test_nothing_but_the_count_is_written(loader: BootLoader, stubbed: StubCard) -> None:
    """Seen to fail with another name in the block."""
    check(loader, "as made", {header_place(B): bytes(1024)})
    assert counted(loader) == {"FOR": "1", "A_TRIES": "1", "B_TRIES": "0"}
    before = bytearray(stubbed.state)
    before[card.TRIES : card.TRIES + card.SECTOR] = loader.read(TRIES, card.SECTOR)
    assert loader.read(card.STATE.start, card.STATE.size) == before


def test_on_a_new_card_only_the_slot_with_a_header_is_started(loader: BootLoader) -> None:
    """And its starts are counted, whatever the empty one is said to be: seen to fail where an empty slot is chosen, in
    its turn or on trial."""
    empty = {header_place(B): bytes(1024)}
    states = [card.state_copy(), card.state_copy(2, order="B A", good="AB"), bytes(512), card.state_copy(2, trial="B")]
    for content in states:
        assert check(loader, repr(content[:70]), {**empty, **copies(content)}).slot == "A"
        left = counted(loader)
        assert (left["A_TRIES"], left["B_TRIES"]) == ("1", "0"), f"{content[:70]!r}: {left}"


def test_a_slot_that_cannot_be_loaded_is_passed_over(loader: BootLoader, stubbed: StubCard) -> None:
    """Seen to fail where nothing follows the chosen slot, where an initramfs that fails does not matter, and where the
    slot's tries are not used up."""
    both = copies(card.state_copy(2, good="AB"))
    for name, state in (
        ("no kernel", {kernel_place(A): bytes(512)}),
        ("kernel is garbage", {kernel_place(A): random.Random(SEED).randbytes(1024)}),
        ("no kernel, state lost", {kernel_place(A): bytes(512), card.STATE.start: bytes(3 * card.REGION)}),
        ("a kernel beyond the card", {header_place(A): stubbed.header(KERNEL="99999999+4")}),
        ("no place", {header_place(A): stubbed.header(KERNEL="x")}),
        ("an initramfs beyond the card", {header_place(A): stubbed.header(INITRD="99999999+4")}),
    ):
        started = check(loader, name, {**both, **state})
        assert started.slot == "B", name
        assert started.said.count(CLEARED) <= 2, f"{name}: the slot was loaded again"


def test_sectors_that_cannot_be_read(board: Board, stubbed: StubCard, tmp_path: Path) -> None:
    """Seen to fail where nothing follows the chosen slot, and where an initramfs that fails does not matter."""
    for place, slot in (
        (TRIES, "B"), (COPIES[0], "B"), (COPIES[1], "B"), (header_place(B), "A"), (kernel_place(B), "A"),
        (initrd_place(B) + 512, "A"),
    ):  # fmt: skip
        with BootLoader(board, stubbed, tmp_path / str(place), unreadable=[place]) as loader:
            started = check(loader, str(place), copies(card.state_copy(4, order="B A", good="AB")))
            assert started.slot == slot, started.said
            assert "failure reading sector" in started.said, f"{place} was read:\n{started.said}"


def test_a_kernel_without_an_initramfs(board: Board, stubbed: StubCard, toolset: Tools, tmp_path: Path) -> None:
    """As our own is; and a board without a watchdog. Seen to fail where GRUB loads an initramfs for any kernel."""
    none = {header_place(slot): stubbed.header(INITRD="") for slot in card.SLOTS}
    for each in (board, board.model_copy(update={"watchdog": None})):
        core = card.grub_core(each, toolset, tmp_path, card.grub_config(each))
        with BootLoader(board, stubbed, tmp_path / str(bool(each.watchdog)), head=stubbed.with_core(core)) as other:
            for order in ("A B", "B A"):
                started = check(other, order, {**none, **copies(card.state_copy(2, order=order, good="AB"))})
                assert started.slot == order[0]


def test_without_a_console_grub_writes_nothing_to_a_serial_port(
    board: Board, loader: BootLoader, stubbed: StubCard, toolset: Tools, tmp_path: Path
) -> None:
    """The computer has the port, and the stub writes to it."""
    assert CLEARED in check(loader, "as made", {}).said
    none = board.model_copy(update={"console": None})
    head = stubbed.with_core(card.grub_core(none, toolset, tmp_path, card.grub_config(none)))
    with BootLoader(board, stubbed, tmp_path / "none", head=head) as silent:
        started = silent.start({})
    assert started.slot == "A"
    assert CLEARED not in started.said


def test_the_watchdog_runs_before_the_kernel_does(
    board: Board, loader: BootLoader, stubbed: StubCard, toolset: Tools, tmp_path: Path
) -> None:
    """The stub stands still, as a kernel may; and GRUB itself may, here in its first line. A kernel has the whole time,
    however long GRUB took: seen to fail where GRUB does not start it again."""
    check(loader, "as made", {})
    assert loader.wait_event("WATCHDOG", SECONDS)
    head = stubbed.with_core(card.grub_core(board, toolset, tmp_path, b"sleep 100\n"))
    with BootLoader(board, stubbed, tmp_path / "asleep", head=head) as asleep:
        asleep.plant({})
        assert asleep.wait_event("WATCHDOG", SECONDS)
    slow_s, watchdog_s = 20, 30
    head = stubbed.with_core(
        card.grub_core(board, toolset, tmp_path, f"sleep {slow_s}\n".encode() + card.grub_config(board))
    )
    with BootLoader(board, stubbed, tmp_path / "slow", head=head) as slow:
        slow.execute("watchdog-set-action", action="pause")
        check(slow, "slow", {})
        assert slow.wait_event("WATCHDOG", SECONDS)
        assert qemu.virtual_s(slow.execute) >= slow_s + watchdog_s


def test_a_configuration_that_believes_the_state_is_refused(
    board: Board, stubbed: StubCard, toolset: Tools, tmp_path: Path
) -> None:
    config = TRUSTING.replace(b"SECTORS", str(len(stubbed.stub) // card.SECTOR).encode())
    for slot in card.SLOTS:
        config = config.replace(f"OF_{slot.name}".encode(), slot.partuuid(board, stubbed.disk_id).encode())
    head = stubbed.with_core(card.grub_core(board, toolset, tmp_path, config))
    with BootLoader(board, stubbed, tmp_path / "trusting", head=head) as trusting:
        assert check(trusting, "sound", copies(card.state_copy(2, order="B A", good="AB"))).slot == "B"
        for name, state in (
            ("zeros", copies(bytes(512))),
            ("no order", copies(card.state_copy(3, order="", good="AB"))),
        ):
            with pytest.raises(AssertionError, match=f"{name}: no slot was started"):
                check(trusting, name, state)


@pytest.mark.parametrize(
    ("changes", "cpu", "lacks"),
    [
        ({"kernel": "debian"}, "pentium3", ""),
        ({"kernel": "debian"}, "pentium3,-pae", "PAE"),
        ({"architecture": "amd64"}, "pentium3", "long mode"),
        ({"kernel": "lean"}, "pentium3,-pae", ""),
    ],
)
def test_a_processor_that_the_kernel_does_not_run_on_is_named(
    board: Board,
    stubbed: StubCard,
    toolset: Tools,
    session_artefacts: Path,
    tmp_path: Path,
    changes: dict[str, str],
    cpu: str,
    lacks: str,
) -> None:
    """Seen to fail: the kernel was started, which a real one does not report on such a processor."""
    other = board.model_copy(update=changes | {"qemu": board.qemu.model_copy(update={"cpu": cpu})})
    head = stubbed.with_core(card.grub_core(other, toolset, tmp_path, card.grub_config(other)))
    with BootLoader(
        other, stubbed, session_artefacts / f"processor-{'-'.join(changes.values())}-{cpu}", head=head
    ) as loader:
        loader.plant({})
        lacking = "its kernel needs (.*), which this processor does not have"
        found = loader.console.expect(rf"{lacking}|stub kernel: |{GAVE_UP}", SECONDS)
        assert (found[1] or "") == lacks
