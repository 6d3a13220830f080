"""Naming of differences, on fabricated images; each case has one without the difference beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.images import card, compare
from flotilla.images.compare import Entry


def image(path: Path, **changes: int) -> Path:
    """An empty card with a byte set at each offset of `changes`."""
    with path.open("wb") as file:
        file.truncate(card.SIZE)
        for value, offset in enumerate(changes.values(), 1):
            file.seek(offset)
            file.write(bytes([value]))
    return path


def test_parts_cover_the_card_without_gap() -> None:
    assert compare.PARTS[0].start == 0
    assert [part.end for part in compare.PARTS[:-1]] == [part.start for part in compare.PARTS[1:]]
    assert compare.PARTS[-1].end == card.SIZE


def test_identical_images_have_no_differing_part(tmp_path: Path) -> None:
    assert compare.differing_parts(image(tmp_path / "1", a=100), image(tmp_path / "2", a=100)) == []


def test_identical_content_beside_holes_is_identical(tmp_path: Path) -> None:
    content = bytes(range(256)) * 600
    for name in ("1", "2"):
        with image(tmp_path / name).open("r+b") as file:
            for offset in (0, card.STATE.start, card.SLOTS[0].start + 3000):
                file.seek(offset)
                file.write(content)
    assert compare.differing_parts(tmp_path / "1", tmp_path / "2") == []


@pytest.mark.parametrize(
    ("offset", "name", "first"),
    [
        (0, "MBR", 0),
        (511, "MBR", 511),
        (512, "GRUB's core image", 0),
        (card.STATE.start - 1, "GRUB's core image", card.STATE.start - 513),
        (card.STATE.start, "boot state", 0),
        (card.SLOTS[0].start + 5_000_000, "slot A", 5_000_000),
        (card.SLOTS[1].start + card.SLOTS[1].size - 1, "slot B", card.SLOTS[1].size - 1),
        (card.DATA.start, "data partition", 0),
        (card.SIZE - 1, "data partition", card.DATA.size - 1),
    ],
)
def test_names_the_part_and_byte(tmp_path: Path, offset: int, name: str, first: int) -> None:
    (found,) = compare.differing_parts(image(tmp_path / "1"), image(tmp_path / "2", a=offset))
    assert (found.part.name, found.first, found.blocks) == (name, first, 1)


def test_counts_blocks_and_names_every_part(tmp_path: Path) -> None:
    slot = card.SLOTS[0].start
    changed = image(tmp_path / "2", a=slot + 10, b=slot + 20, c=slot + 2 * 4096, d=card.DATA.start)
    found = compare.differing_parts(image(tmp_path / "1"), changed)
    assert [(difference.part.name, difference.blocks) for difference in found] == [("slot A", 2), ("data partition", 1)]


def test_longer_image_differs(tmp_path: Path) -> None:
    longer = image(tmp_path / "2")
    with longer.open("ab") as file:
        file.write(b"x")
    (found,) = compare.differing_parts(image(tmp_path / "1"), longer)
    assert found.part.name == "beyond the last partition"


def test_shorter_image_differs(tmp_path: Path) -> None:
    shorter = image(tmp_path / "2")
    with shorter.open("r+b") as file:
        file.truncate(card.SIZE - 1)
    (found,) = compare.differing_parts(image(tmp_path / "1"), shorter)
    assert (found.part.name, found.first) == ("data partition", card.DATA.size - 1)


@pytest.mark.parametrize(
    ("left", "right", "position"),
    [(b"abc", b"abd", 2), (b"xbc", b"abc", 0), (b"abc", b"abcd", 3), (b"", b"a", 0), (b"axcx", b"abcd", 1)],
)
def test_first_difference(left: bytes, right: bytes, position: int) -> None:
    assert compare.first_difference(left, right) == position
    assert compare.first_difference(right, left) == position


def content(path: Path, data: bytes, mode: int = 0o644) -> Path:
    path.write_bytes(data)
    path.chmod(mode)
    return path


def test_names_files_that_differ(tmp_path: Path) -> None:
    same, other = content(tmp_path / "1", b"day 20614"), content(tmp_path / "2", b"day 20654")
    common = {"/etc": Entry("drwxr-xr-x 0/0"), "/etc/same": Entry("-rw-r--r-- 0/0 9", same)}
    first = common | {"/etc/day": Entry("-rw-r--r-- 0/0 9", same), "/etc/old": Entry("-rw-r--r-- 0/0 9", same)}
    second = common | {"/etc/day": Entry("-rw-r--r-- 0/7 9", other), "/etc/new": Entry("-rw-r--r-- 0/0 9", same)}
    assert compare.differing_files(first, first) == []
    assert compare.differing_files(first, second) == [
        "/etc/day: 0/0 / 0/7",
        "/etc/day: differs from byte 7 on: b'14' / b'54'",
        "/etc/new: only in the second image",
        "/etc/old: only in the first image",
    ]


def test_shows_nothing_of_a_private_file(tmp_path: Path) -> None:
    one, other = content(tmp_path / "1", b"secret one", 0o600), content(tmp_path / "2", b"secret two", 0o600)
    assert compare.differing_files({"/key": Entry("", one)}, {"/key": Entry("", other)}) == [
        "/key: differs from byte 7 on"
    ]


LISTING = """\
drwxr-xr-x 0/0                 268 2026-11-19 02:12 squashfs-root
lrwxrwxrwx 0/0                   7 2026-11-19 02:12 squashfs-root/bin -> usr/bin
-rw-r----- 0/42                511 2026-11-19 02:12 squashfs-root/etc/a shadow
"""


def test_reads_a_squashfs_listing(tmp_path: Path) -> None:
    entries = compare.squashfs_listing(LISTING, tmp_path)
    assert entries == {
        "/": Entry("drwxr-xr-x 0/0 2026-11-19 02:12"),
        "/bin": Entry("lrwxrwxrwx 0/0 7 2026-11-19 02:12 -> usr/bin"),
        "/etc/a shadow": Entry("-rw-r----- 0/42 511 2026-11-19 02:12", tmp_path / "etc/a shadow"),
    }
    assert compare.squashfs_listing("no listing", tmp_path) == {}
