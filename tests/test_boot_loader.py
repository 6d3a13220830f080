"""Robot 3's boot loader, with its environment block and its partition in every state that could be thought of.

The boot loader is the card's; the kernel only says that it was started (`tests/lab/boot_loader.py`). That whole systems
boot, and repair the block, is in `test_boot.py`.
"""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from images.builder import card, inventory, tools
from images.builder.build import image_of
from images.builder.fleet import Board, Fleet
from images.builder.lock import read_lock
from images.builder.tools import Tools
from tests.lab.boot_loader import BootLoader, BootPartition, Started, State

pytestmark = pytest.mark.boot

ROBOT = 3
SEED = 3
SIZE = 1024
HEADER = b"# GRUB Environment Block\n"
ENV = "/grub/grubenv"
KERNELS = [f"/{slot.name}/vmlinuz" for slot in card.SLOTS]
TRIES = ("0", "1", "2", "3")

TRUSTING = b"""\
serial --unit=0 --speed=115200
terminal_output serial
load_env --file ($root)/grub/grubenv
set chosen=
for slot in $ORDER; do
    if [ "$slot" = "A" -a -z "$chosen" -a "$A_OK" = "1" -a "$A_TRY" != "3" ]; then set chosen=A; fi
    if [ "$slot" = "B" -a -z "$chosen" -a "$B_OK" = "1" -a "$B_TRY" != "3" ]; then set chosen=B; fi
done
if [ "$chosen" = "A" ]; then linux ($root)/A/vmlinuz root=PARTUUID=464c4f54-02 flotilla.slot=A; fi
if [ "$chosen" = "B" ]; then linux ($root)/B/vmlinuz root=PARTUUID=464c4f54-03 flotilla.slot=B; fi
boot
echo "slot $chosen does not boot"
sleep 5
reboot
"""
"""A configuration that believes the block: what the checks below must refuse."""


@pytest.fixture(scope="module")
def board(fleet: Fleet) -> Board:
    return fleet.boards[inventory.robot(fleet, ROBOT).board]


@pytest.fixture(scope="module")
def toolset() -> Tools:
    lock = read_lock("tools")
    return Tools(tools.tree(lock), lock.epoch)


@pytest.fixture(scope="module")
def partition(fleet: Fleet, toolset: Tools, tmp_path_factory: pytest.TempPathFactory) -> BootPartition:
    image = image_of(inventory.robot(fleet, ROBOT))
    if not image.exists():
        pytest.fail(f"{image} is missing; build it: make image ROBOT={ROBOT}", pytrace=False)
    return BootPartition(image, toolset, tmp_path_factory.mktemp("partition"))


@pytest.fixture(scope="module")
def loader(board: Board, partition: BootPartition, session_artefacts: Path) -> Iterator[BootLoader]:
    with BootLoader(board, partition, session_artefacts / "boot-loader") as loader:
        yield loader


def block(order: str = "A B", a: str = "10", b: str = "10") -> bytes:
    """An environment block; of each slot OK and TRY."""
    text = f"ORDER={order}\nA_OK={a[0]}\nA_TRY={a[1]}\nB_OK={b[0]}\nB_TRY={b[1]}\n"
    return (HEADER + text.encode()).ljust(SIZE, b"#")


def after(content: bytes) -> tuple[str, bytes]:
    """Which slot a sound block leads to, and the block that the start leaves: the rules of grub.cfg once more."""
    values = dict(re.findall(r"^(\w+)=(.*)$", content.decode(), re.M))
    order = values["ORDER"].split()
    for _ in range(2):
        for slot in order:
            if values[f"{slot}_OK"] == "1" and values[f"{slot}_TRY"] != "3":
                values[f"{slot}_TRY"] = str(int(values[f"{slot}_TRY"]) + 1)
                return slot, block(values["ORDER"], *(values[f"{each}_OK"] + values[f"{each}_TRY"] for each in "AB"))
        values |= {"A_TRY": "0", "B_TRY": "0"}
    return order[0], block(values["ORDER"], *(values[f"{each}_OK"] + "0" for each in "AB"))


def sound() -> list[bytes]:
    """Every block that GRUB and the running system write."""
    tries = [ok + count for ok in "01" for count in TRIES]
    return [block(order, a, b) for order in ("A B", "B A") for a, b in itertools.product(tries, tries)]


def unsound(chance: random.Random) -> Iterator[tuple[str, bytes]]:
    """Blocks of the right size that nobody wrote on purpose."""
    old, new = block(a="11"), block("B A", "13", "12")
    yield from {
        "zeros": bytes(SIZE), "ones": b"\xff" * SIZE, "padding": b"#" * SIZE, "newlines": b"\n" * SIZE,
        "header alone": HEADER.ljust(SIZE, b"#"), "header, zeros": HEADER.ljust(SIZE, b"\0"),
        "header, no end": HEADER.ljust(SIZE, b"x"), "another file system's": (b"hsqs" * SIZE)[:SIZE],
        "torn: zeros": new[:512] + bytes(512), "torn: nothing": bytes(512) + new[512:],
        "torn: ones": new[:512] + b"\xff" * 512, "torn: old": new[:512] + old[512:],
    }.items()  # fmt: skip
    for number in range(20):
        yield f"random {number}", chance.randbytes(SIZE)
        yield f"random behind the header {number}", HEADER + chance.randbytes(SIZE - len(HEADER))
        cut = chance.randrange(len(HEADER), 80)
        yield f"torn at {cut}", new[:cut] + chance.randbytes(SIZE - cut)
        flipped = bytearray(new)
        for _ in range(chance.choice((1, 3, 10, 100))):
            flipped[chance.randrange(90)] ^= 1 << chance.randrange(8)
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
    names = (
        "ORDER",
        "A_OK",
        "A_TRY",
        "B_OK",
        "B_TRY",
        "root",
        "prefix",
        "chosen",
        "slot",
        "order",
        "seen_A",
        "cmdpath",
        "?",
    )
    for number in range(50):
        lines = [f"{chance.choice(names)}={chance.choice(words)}\n" for _ in range(chance.randrange(1, 12))]
        yield f"values {number}: {lines}", (HEADER + "".join(lines).encode())[:SIZE].ljust(SIZE, b"#")


def files(partition: BootPartition, chance: random.Random) -> Iterator[tuple[str, State]]:
    """The block as a file that is not as it should be."""
    yield "missing", partition.changed(f"rm {ENV}")
    yield "a directory", partition.changed(f"rm {ENV}", f"mkdir {ENV}")
    yield "no folder", partition.changed(f"rm {ENV}", "rmdir /grub")
    yield "its inode is cleared", partition.changed(f"clri {ENV}")
    yield "a hole", partition.changed(f"sif {ENV} block[0] 0")
    yield "beyond the partition", partition.changed(f"sif {ENV} block[0] 0x7fffffff")
    for size in (0, 1, 24, 25, 40, 60, 511, 512, 513, 1023, 1025, 4096, 5000, 1 << 30):
        yield f"{size} bytes", partition.changed(f"sif {ENV} size {size}")
    for _ in range(6):
        content = chance.randbytes(chance.randrange(1, 20_000))
        yield f"{len(content)} random bytes", partition.with_file(ENV, content)


def check(loader: BootLoader, name: str, state: State) -> Started:
    started = loader.start(state)
    assert started.slot in ("A", "B"), f"{name}: no slot was started:\n{started.said}"
    slot = next(each for each in card.SLOTS if each.name == started.slot)
    assert f"root=PARTUUID={slot.partuuid} " in started.arguments, f"{name}: {started.arguments}"
    return started


def test_every_sound_block_leads_to_its_slot(loader: BootLoader, partition: BootPartition) -> None:
    """Of the 128 that there are every third, by the rules: who is started, and what is counted."""
    place = partition.place(ENV)
    for content in sound()[::3]:
        started = check(loader, repr(content[:70]), {place: content})
        assert (started.slot, loader.read(place, SIZE)) == after(content), f"{content[:70]!r}\n{started.said}"


def test_a_slot_is_started_whatever_the_block_holds(loader: BootLoader, partition: BootPartition) -> None:
    chance = random.Random(SEED)
    place = partition.place(ENV)
    states = [(name, {place: content}) for name, content in unsound(chance)] + list(files(partition, chance))
    assert len(states) >= 160, f"{len(states)} states, and 43 sound ones: fewer than 200 in all"
    for name, state in states:
        check(loader, name, state)
    torn = block("B A", "13", "12")[:512] + bytes(512)
    assert check(loader, "all of it is in the first sector", {place: torn}).slot == "B"


def test_nothing_but_the_block_is_written(loader: BootLoader, partition: BootPartition) -> None:
    place = partition.place(ENV)
    check(loader, "as made", {})
    written = loader.read(0, card.BOOT.size)
    before = bytearray(partition.content)
    before[place : place + SIZE] = written[place : place + SIZE]
    assert written[place : place + SIZE] == block(a="11", b="00")
    assert written == before


def test_on_a_new_card_only_the_slot_with_a_kernel_is_started(loader: BootLoader, partition: BootPartition) -> None:
    empty = partition.changed(f"rm {KERNELS[1]}", "rm /B/initrd.img")
    place = partition.place(ENV)
    for content in (block(), block("B A"), bytes(SIZE), block("B A", "13")):
        assert check(loader, repr(content[:70]), {**empty, place: content}).slot == "A"


def test_a_slot_that_cannot_be_loaded_is_passed_over(loader: BootLoader, partition: BootPartition) -> None:
    for name, state in (
        ("no kernel", partition.changed(f"rm {KERNELS[0]}")),
        ("no initramfs", partition.changed("rm /A/initrd.img")),
        ("an empty initramfs", partition.changed("sif /A/initrd.img size 0")),
        ("an empty kernel", partition.changed(f"sif {KERNELS[0]} size 0")),
        ("no kernel, block lost", partition.changed(f"rm {KERNELS[0]}", f"rm {ENV}")),
        ("kernel is garbage", partition.with_file(KERNELS[0], random.Random(SEED).randbytes(5000))),
    ):
        assert check(loader, name, state).slot == "B", name


def test_sectors_that_cannot_be_read(board: Board, partition: BootPartition, tmp_path: Path) -> None:
    for path, expected in ((ENV, "A"), (KERNELS[0], "B"), ("/A/initrd.img", "B")):
        unreadable = [partition.place(path)]
        with BootLoader(board, partition, tmp_path / path.replace("/", "-"), unreadable=unreadable) as loader:
            started = check(loader, path, {partition.place(ENV): block()})
            assert started.slot == expected, started.said
            assert "failure reading sector" in started.said, f"{path} was read:\n{started.said}"


def test_a_kernel_without_an_initramfs(board: Board, partition: BootPartition, toolset: Tools, tmp_path: Path) -> None:
    """As our own is: the board's other configuration, and a board without a watchdog."""
    place = partition.place(ENV)
    none = partition.changed("rm /A/initrd.img", "rm /B/initrd.img")
    for each in (board, board.model_copy(update={"watchdog": None})):
        core = card.grub_core(each, toolset, tmp_path, card.grub_config(each, initramfs=False))
        with BootLoader(board, partition, tmp_path / str(bool(each.watchdog)), head=partition.with_core(core)) as other:
            for content in (block(), block("B A"), bytes(SIZE), block("B A", "13", "13")):
                started = check(other, repr(content[:70]), {**none, place: content})
                assert started.slot == ("B" if content[:35].endswith(b"ORDER=B A\n") else "A")
            assert ("flotilla.watchdog_stop=1089:0" in started.arguments) == bool(each.watchdog)


def test_the_watchdog_runs_before_the_kernel_does(
    board: Board, loader: BootLoader, partition: BootPartition, toolset: Tools, tmp_path: Path
) -> None:
    """The stub stands still, as a kernel may; and GRUB itself may, here in its first line."""
    check(loader, "as made", {})
    assert loader.wait_event("WATCHDOG", 60)
    head = partition.with_core(card.grub_core(board, toolset, tmp_path, b"sleep 100\n"))
    with BootLoader(board, partition, tmp_path / "asleep", head=head) as asleep:
        asleep.plant({})
        assert asleep.wait_event("WATCHDOG", 60)


def test_a_configuration_that_believes_the_block_is_refused(
    board: Board, partition: BootPartition, toolset: Tools, tmp_path: Path
) -> None:
    place = partition.place(ENV)
    head = partition.with_core(card.grub_core(board, toolset, tmp_path, TRUSTING))
    with BootLoader(board, partition, tmp_path / "trusting", head=head) as trusting:
        assert check(trusting, "sound", {place: block("B A")}).slot == "B"
        for name, state in (
            ("zeros", {place: bytes(SIZE)}),
            ("no order", {place: block("")}),
            ("missing", partition.changed(f"rm {ENV}")),
        ):
            with pytest.raises(AssertionError, match=f"{name}: no slot was started"):
                check(trusting, name, state)
