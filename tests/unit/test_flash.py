"""Writing a card: each refusal on a made-up sysfs tree, and that what was written is what was meant."""

from __future__ import annotations

import errno
import io
import os
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from flotilla.common import progress
from flotilla.common.errors import UserError
from flotilla.images.bmap import BLOCK, bmap_of, write_bmap
from flotilla.images.flash import Card, Host, Target, flash

BLOCKS = 600
SIZE = BLOCKS * BLOCK
CONTENT = random.Random(3).randbytes(SIZE)
EXTENTS = [(0, 100), (10 * BLOCK, 300 * BLOCK), (500 * BLOCK, 5), (SIZE - BLOCK, BLOCK)]
MAPPED = [(0, 1), (10, 310), (500, 501), (BLOCKS - 1, BLOCKS)]


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "robot3.img"
    path.write_bytes(CONTENT)
    write_bmap(path, EXTENTS, bmap_of(path))
    return path


@dataclass(frozen=True)
class MadeUpHost(Host):
    """A host whose block devices are ordinary files below `root`."""

    numbers: dict[int, str] = field(default_factory=dict)
    """Device number by inode of the file that stands for the node."""

    def number(self, target: Path | int) -> str | None:
        try:
            return self.numbers.get(os.stat(target).st_ino)  # noqa: PTH116 (a Path has no descriptor)
        except OSError:
            return None

    def put(self, path: str, content: str) -> None:
        (self.root / path).parent.mkdir(parents=True, exist_ok=True)
        (self.root / path).write_text(content + "\n")

    def add(self, folder: str, number: str, size: int, **attributes: str) -> None:
        """A device: its folder below sys/devices, its entry in sys/class/block, its node in dev."""
        name = Path(folder).name
        for key, value in {"dev": number, "size": str(size // 512), "ro": "0", **attributes}.items():
            self.put(f"sys/devices/{folder}/{key.replace('__', '/')}", value)
        entries = self.root / "sys/class/block"
        entries.mkdir(parents=True, exist_ok=True)
        (entries / name).symlink_to(self.root / "sys/devices" / folder)
        node = self.root / "dev" / name
        node.parent.mkdir(exist_ok=True)
        node.write_bytes(b"\xff" * size)
        self.numbers[node.stat().st_ino] = number

    def hold(self, folder: str, holder: str) -> None:
        holders = self.root / "sys/devices" / folder / "holders"
        holders.mkdir(exist_ok=True)
        (holders / Path(holder).name).symlink_to(self.root / "sys/devices" / holder)

    def mount(self, number: str, point: str, source: str) -> None:
        path = self.root / "proc/self/mountinfo"
        before = path.read_text() if path.exists() else ""
        self.put("proc/self/mountinfo", f"{before}30 1 {number} / {point} rw,relatime shared:1 - ext4 {source} rw")


CARD = "pci0000:00/usb2/2-1/host6/block/sdb"
SYSTEM = "pci0000:00/ata1/host0/block/sda"
MAPPER = "virtual/block/dm-0"


@pytest.fixture
def host(tmp_path: Path) -> MadeUpHost:
    """A computer that runs from LVM on sda, with a card of two partitions in a USB reader, sdb."""
    made = MadeUpHost(tmp_path / "host")
    made.add(SYSTEM, "8:0", 2 * SIZE, removable="0", device__model="Disk")
    made.add(f"{SYSTEM}/sda1", "8:1", SIZE, partition="1")
    made.add(f"{SYSTEM}/sda2", "8:2", SIZE, partition="2")
    made.add(MAPPER, "253:0", SIZE, dm__name="vg-root")
    made.hold(f"{SYSTEM}/sda2", MAPPER)
    made.mount("253:0", "/", "/dev/mapper/vg-root")
    made.add(CARD, "8:16", SIZE + 8 * BLOCK, removable="1", device__vendor="Generic", device__model="Reader")
    made.add(f"{CARD}/sdb1", "8:17", BLOCK, partition="1")
    made.add(f"{CARD}/sdb2", "8:18", BLOCK, partition="2")
    made.put("run/udev/data/b8:17", "E:ID_FS_TYPE=vfat\nE:ID_FS_LABEL=CAMERA")
    made.put("proc/swaps", "Filename Type Size Used Priority")
    return made


class Keyboard(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    def types(text: str) -> None:
        monkeypatch.setattr("sys.stdin", Keyboard(text))

    return types


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_TERMINAL", False)
    monkeypatch.setattr("sys.stdin", io.StringIO())


def to_file(image: Path, file: Path) -> None:
    flash(image, device=None, file=file, force=None, yes=False, robot="3")


def to_card(image: Path, host: Host, name: str = "sdb", *, force: str | None = None, yes: bool = False) -> None:
    flash(image, device=host.root / "dev" / name, file=None, force=force, yes=yes, robot="3", host=host)


def assert_written(path: Path, beyond: int = 0) -> None:
    """Mapped blocks as in the image, all others as before: 0xFF."""
    expected = bytearray(b"\xff" * (SIZE + beyond))
    for first, end in MAPPED:
        expected[first * BLOCK : end * BLOCK] = CONTENT[first * BLOCK : end * BLOCK]
    assert path.read_bytes() == expected


def untouched(path: Path) -> bool:
    content = path.read_bytes()
    return content.count(0xFF) == len(content)


# A card


def test_a_card_is_written_when_its_name_is_typed(
    image: Path, host: MadeUpHost, keyboard: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    keyboard("sdb\n")
    to_card(image, host)
    assert_written(host.root / "dev/sdb", beyond=8 * BLOCK)
    out, err = capsys.readouterr()
    assert "sdb: Generic Reader, 2.4 MiB, usb\n  sdb1  4.0 KiB  vfat  CAMERA\n  sdb2  4.0 KiB\n" in err
    assert "put it into robot 3, power on, then: make ssh ROBOT=3" in out


@pytest.mark.parametrize("answer", ["", "\n", "sda\n", "yes\n", "/dev/sdb\n"])
def test_any_other_answer_writes_nothing(
    image: Path, host: MadeUpHost, keyboard: Callable[[str], None], answer: str
) -> None:
    keyboard(answer)
    with pytest.raises(UserError, match=r"not confirmed .* instead of sdb\); nothing was written"):
        to_card(image, host)
    assert untouched(host.root / "dev/sdb")


def test_without_a_terminal_nothing_is_written(image: Path, host: MadeUpHost) -> None:
    with pytest.raises(UserError, match=r"no terminal to ask on; .*--yes.*nothing was written"):
        to_card(image, host)
    assert untouched(host.root / "dev/sdb")


def test_yes_takes_a_lasting_name_only(image: Path, host: MadeUpHost) -> None:
    lasting = host.root / "dev/disk/by-id/usb-Generic_Reader-0:0"
    lasting.parent.mkdir(parents=True)
    lasting.symlink_to(host.root / "dev/sdb")
    with pytest.raises(UserError, match=f"--yes wants a name that stays with the device: {lasting}"):
        to_card(image, host, yes=True)
    assert untouched(host.root / "dev/sdb")
    to_card(image, host, "disk/by-id/usb-Generic_Reader-0:0", yes=True)
    assert_written(host.root / "dev/sdb", beyond=8 * BLOCK)


Change = Callable[[MadeUpHost], object]


def attribute(name: str, value: str) -> Change:
    return lambda host: host.put(f"sys/devices/{CARD}/{name}", value)


def bus(folder: str, **attributes: str) -> Change:
    """The card appears as sdc at another place of the device tree."""
    return lambda host: host.add(f"{folder}/sdc", "8:32", 2 * SIZE, **{"removable": "0", **attributes})


def holder(host: MadeUpHost) -> None:
    host.add("virtual/block/dm-1", "253:1", BLOCK, dm__name="backup")
    host.hold(f"{CARD}/sdb2", "virtual/block/dm-1")


def swap_on_holder(host: MadeUpHost) -> None:
    holder(host)
    host.put("proc/swaps", "Filename Type Size Used Priority\n/dev/dm-1 partition 4 0 -2")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        pytest.param("sdx", None, "no such device; insert the card", id="absent"),
        pytest.param("sdb2", None, "it is a partition; give the whole disk, /dev/sdb$", id="partition"),
        pytest.param("sda", None, r"this computer runs from it \(/\)", id="system behind LVM"),
        pytest.param("sda", None, r"part of vg-root \(LVM", id="holder named"),
        pytest.param("sda", None, "fixed disk on ata; .*FORCE=fixed-disk", id="fixed"),
        pytest.param("sdb", lambda host: host.mount("8:17", "/boot/efi", "x"), r"runs from it \(/boot/efi\)", id="efi"),
        pytest.param(
            "sdb",
            lambda host: host.mount("8:17", r"/media/my\040card", "x"),
            "mounted at /media/my card; `umount '/media/my card'`",
            id="partition mounted",
        ),
        pytest.param("sdb", lambda host: host.mount("8:16", "/mnt", "x"), "mounted at /mnt", id="disk mounted"),
        pytest.param("sdb", lambda host: host.mount("0:40", "/mnt", "/dev/sdb2"), "mounted at /mnt", id="btrfs"),
        pytest.param(
            "sdb",
            lambda host: host.put("proc/swaps", "Filename\n/dev/sdb2 partition 4 0 -2"),
            "in use as swap",
            id="swap",
        ),
        pytest.param("sdb", swap_on_holder, "in use as swap", id="swap on LVM"),
        pytest.param("sdb", holder, r"part of backup \(LVM", id="held"),
        pytest.param("sdb", attribute("size", "0"), "the reader is empty", id="empty reader"),
        pytest.param(
            "sdb",
            attribute("size", str(SIZE // 512 - 1)),
            f"holds {SIZE - 512} bytes, the image needs {SIZE}",
            id="small",
        ),
        pytest.param("sdb", attribute("ro", "1"), "read-only; move the card's lock switch", id="read-only"),
        pytest.param("sdb", attribute("queue/logical_block_size", "4096"), "sectors of 4096 bytes", id="sectors"),
        pytest.param("sdc", bus("pci0000:00/nvme0"), "fixed disk on nvme", id="nvme"),
        pytest.param("sdc", bus("mmc_host/mmc0/mmc0:1", device__type="MMC"), "fixed disk on mmc", id="soldered eMMC"),
    ],
)
def test_refused(
    image: Path,
    host: MadeUpHost,
    keyboard: Callable[[str], None],
    name: str,
    change: Change | None,
    message: str,
) -> None:
    if change:
        change(host)
    keyboard(f"{name}\n")
    with pytest.raises(UserError, match=re.compile(message, re.MULTILINE)) as refusal:
        to_card(image, host, name)
    assert name in str(refusal.value)
    assert all(untouched(node) for node in (host.root / "dev").iterdir())


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(bus("pci0000:00/usb1/1-2/block"), id="USB that calls itself fixed"),
        pytest.param(bus("mmc_host/mmc0/mmc0:1", device__type="SD"), id="SD card"),
        pytest.param(bus("pci0000:00/ata2/block", removable="1"), id="removable"),
    ],
)
def test_what_counts_as_a_card(image: Path, host: MadeUpHost, keyboard: Callable[[str], None], change: Change) -> None:
    change(host)
    keyboard("sdc\n")
    to_card(image, host, "sdc")
    assert_written(host.root / "dev/sdc", beyond=SIZE)


def test_the_word_goes_past_the_fixed_disk_only(image: Path, host: MadeUpHost, keyboard: Callable[[str], None]) -> None:
    bus("pci0000:00/ata2/block")(host)
    keyboard("sdc\n")
    to_card(image, host, "sdc", force="fixed-disk")
    assert_written(host.root / "dev/sdc", beyond=SIZE)
    with pytest.raises(UserError, match="this computer runs from it") as refusal:
        to_card(image, host, "sda", force="fixed-disk")
    assert "fixed disk" not in str(refusal.value)
    with pytest.raises(UserError, match="--force yes: no such word; there is fixed-disk"):
        to_card(image, host, "sdb", force="yes")


def test_everything_wrong_is_said_at_once(image: Path, host: MadeUpHost) -> None:
    host.mount("8:17", "/mnt", "x")
    attribute("ro", "1")(host)
    with pytest.raises(UserError, match=r"(?s)Generic Reader.*was rejected, nothing was written:.*/mnt.*read-only"):
        to_card(image, host)


def test_a_file_is_no_device(image: Path, host: MadeUpHost) -> None:
    host.put("dev/card", "")
    with pytest.raises(UserError, match=r"not a block device; .*CARD=file"):
        to_card(image, host, "card")


def test_an_ordinary_user_is_told_the_way(
    image: Path, host: MadeUpHost, monkeypatch: pytest.MonkeyPatch, keyboard: Callable[[str], None]
) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    keyboard("sdb\n")
    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(UserError, match=r"belongs to the group .*; `sudo chown .*usermod -aG"):
        to_card(image, host)


def test_a_device_that_changed_meanwhile_is_left_alone(image: Path, host: MadeUpHost, tmp_path: Path) -> None:
    class Swapped(MadeUpHost):
        def number(self, target: Path | int) -> str | None:
            return "8:64" if isinstance(target, int) else super().number(target)

    with pytest.raises(UserError, match="has become another device"):
        to_card(image, Swapped(host.root, host.numbers))
    assert untouched(host.root / "dev/sdb")


# A file


def test_a_file_full_of_garbage(image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    card = tmp_path / "card"
    card.write_bytes(b"\xff" * (SIZE + 100))
    to_file(image, card)
    assert_written(card, beyond=100)
    out, err = capsys.readouterr()
    assert "is robot 3" in out
    assert "\r" not in err
    assert "MB/s" not in err


def test_a_new_file_and_a_short_one_grow_to_the_image(image: Path, tmp_path: Path) -> None:
    short = tmp_path / "short"
    short.write_bytes(b"\xff" * 20 * BLOCK)
    for card in (tmp_path / "new", short):
        to_file(image, card)
        content = card.read_bytes()
        assert len(content) == SIZE
        assert all(content[a * BLOCK : b * BLOCK] == CONTENT[a * BLOCK : b * BLOCK] for a, b in MAPPED)
    assert (tmp_path / "new").stat().st_blocks * 512 < SIZE


def test_an_image_that_ends_inside_a_block(tmp_path: Path) -> None:
    image = tmp_path / "odd.img"
    image.write_bytes(CONTENT[: 3 * BLOCK + 7])
    write_bmap(image, [(0, 1), (3 * BLOCK, 7)], bmap_of(image))
    to_file(image, tmp_path / "card")
    assert (tmp_path / "card").read_bytes()[3 * BLOCK :] == CONTENT[3 * BLOCK : 3 * BLOCK + 7]


def test_progress_on_a_terminal(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_TERMINAL", True)
    monkeypatch.setattr(progress, "VERBOSE", False)
    to_file(image, tmp_path / "card")
    assert re.search(r"\r.*Write .*: 100 % of 1 MiB, ([\d.]+ MB/s, )?\d+:\d\d", capsys.readouterr().err)


def test_files_that_are_refused(image: Path, tmp_path: Path) -> None:
    refusals = {
        tmp_path: "not a file but something else",
        Path("/dev/null"): "not a file but something else",
        Path("/dev/sdx9"): "a file in /dev would be no device",
        image: "that is the image itself",
        tmp_path / "absent" / "card": "cannot be opened, No such file",
    }
    for file, message in refusals.items():
        with pytest.raises(UserError, match=message):
            to_file(image, file)
    assert image.read_bytes() == CONTENT


def test_a_file_in_use_is_refused(image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def locked(*_: object) -> None:
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    card = tmp_path / "card"
    card.write_bytes(b"\xff" * SIZE)
    monkeypatch.setattr("fcntl.lockf", locked)
    with pytest.raises(UserError, match="in use by another program, probably a guest"):
        to_file(image, card)
    assert untouched(card)


def test_it_must_be_said_where_to(image: Path, tmp_path: Path) -> None:
    for device, file in ((None, None), (tmp_path / "sdb", tmp_path / "card")):
        with pytest.raises(UserError, match="say where to"):
            flash(image, device=device, file=file, force=None, yes=False, robot="3")


# The image


def remove(path: Path) -> None:
    path.unlink()


def grow(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"x")


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[12 * BLOCK] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("robot3.img", remove, "robot3.img is missing; `make image ROBOT=3`"),
        ("robot3.bmap", remove, "robot3.bmap is missing; `make image ROBOT=3`"),
        ("robot3.bmap", lambda path: path.write_text("?"), "robot3.bmap: damaged block map"),
        ("robot3.img", grow, f"has {SIZE + 1} bytes, its block map has {SIZE}; `make image ROBOT=3`"),
        ("robot3.img", flip, "does not match its block map at blocks 10 to 309 .*; `make image ROBOT=3`"),
    ],
)
def test_a_bad_image_is_not_written(
    image: Path, tmp_path: Path, name: str, damage: Callable[[Path], None], message: str
) -> None:
    card = tmp_path / "card"
    card.write_bytes(b"\xff" * SIZE)
    damage(tmp_path / name)
    with pytest.raises(UserError, match=message):
        to_file(image, card)
    assert untouched(card)


# Media that fail


def test_a_flipped_bit_is_found(image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Target.write

    def wrong(self: Target, offset: int, data: memoryview | bytes) -> None:
        worn = bytearray(data)
        if offset == 500 * BLOCK:
            worn[77] ^= 4
        write(self, offset, bytes(worn))

    monkeypatch.setattr(Target, "write", wrong)
    with pytest.raises(UserError, match=r"did not keep .*: blocks 500 to 500 \(2\.0 MiB to 2\.0 MiB\) .*incomplete"):
        to_file(image, tmp_path / "card")


def test_a_card_that_wraps_around_is_called_a_fake(
    image: Path, host: MadeUpHost, keyboard: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Target.write
    monkeypatch.setattr(Card, "write", lambda self, offset, data: write(self, offset % (400 * BLOCK), data))
    keyboard("sdb\n")
    with pytest.raises(UserError, match="read back otherwise; the card is worn out or a fake, take another one"):
        to_card(image, host)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, ""), "the disk is full; make room"),
        (OSError(errno.EIO, ""), "the disk reports an error"),
        (OSError(errno.EBADMSG, "Bad message"), "Bad message"),
        (KeyboardInterrupt(), "interrupted"),
    ],
)
def test_what_broke_off_does_not_start_and_is_called_incomplete(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, message: str
) -> None:
    write = Target.write

    def fail(self: Target, offset: int, data: memoryview | bytes) -> None:
        if offset >= 500 * BLOCK:
            raise error
        write(self, offset, data)

    card = tmp_path / "card"
    card.write_bytes(b"\xff" * SIZE)
    monkeypatch.setattr(Target, "write", fail)
    with pytest.raises(UserError, match=f"{message}.*incomplete, do not use it before it is flashed again"):
        to_file(image, card)
    content = card.read_bytes()
    assert content[:BLOCK] == bytes(BLOCK)
    assert content[10 * BLOCK : 310 * BLOCK] == CONTENT[10 * BLOCK : 310 * BLOCK]


def test_what_a_card_says_differs_from_a_file(tmp_path: Path) -> None:
    assert "pulled out" in Card(tmp_path, -1).explain(OSError(errno.ENODEV, ""))
    assert "a fake" in Card(tmp_path, -1).explain(OSError(errno.ENOSPC, ""))
    assert "a fake" not in Target(tmp_path, -1).explain(OSError(errno.ENOSPC, ""))
