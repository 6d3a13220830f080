"""The block map: what it maps, its checksums, and that a damaged one is refused."""

from __future__ import annotations

import hashlib
import random
import re
from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.images.bmap import BLOCK, BlockMap, Range, bmap_of, read_bmap, write_bmap

BLOCKS = 64
CONTENT = random.Random(3).randbytes(BLOCKS * BLOCK)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "robot3.img"
    path.write_bytes(CONTENT)
    return path


def mapped(image: Path, extents: list[tuple[int, int]]) -> list[tuple[int, int]]:
    return [(blocks.first, blocks.last) for blocks in write_bmap(image, extents, bmap_of(image)).ranges]


@pytest.mark.parametrize(
    ("extents", "expected"),
    [
        pytest.param([(0, BLOCK)], [(0, 0)], id="one block"),
        pytest.param([(BLOCK - 1, 2)], [(0, 1)], id="aligned outward"),
        pytest.param([(5, 0)], [], id="nothing"),
        pytest.param([(0, 1), (BLOCK, 1)], [(0, 1)], id="neighbours"),
        pytest.param([(0, 1), (2 * BLOCK, 1)], [(0, 0), (2, 2)], id="apart"),
        pytest.param([(9 * BLOCK, 1), (0, 1)], [(0, 0), (9, 9)], id="unsorted"),
        pytest.param([(0, 9 * BLOCK), (BLOCK, BLOCK), (8 * BLOCK, 2 * BLOCK)], [(0, 9)], id="overlapping, contained"),
        pytest.param([(BLOCKS * BLOCK - 1, 1)], [(BLOCKS - 1, BLOCKS - 1)], id="last byte"),
    ],
)
def test_extents_become_ranges(image: Path, extents: list[tuple[int, int]], expected: list[tuple[int, int]]) -> None:
    assert mapped(image, extents) == expected


@pytest.mark.parametrize("extent", [(-1, 2), (0, -1), (BLOCKS * BLOCK - 1, 2)])
def test_an_extent_outside_the_image_is_a_defect_of_the_caller(image: Path, extent: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="not inside the image"):
        mapped(image, [extent])


def test_a_map_is_read_as_it_was_written(image: Path) -> None:
    written = write_bmap(image, [(0, 1), (3 * BLOCK, 2 * BLOCK)], bmap_of(image))
    assert read_bmap(bmap_of(image)) == written
    assert written.image_size == len(CONTENT)
    assert written.mapped == 3 * BLOCK
    assert [blocks.sha256 for blocks in written.ranges] == [
        hashlib.sha256(CONTENT[:BLOCK]).hexdigest(),
        hashlib.sha256(CONTENT[3 * BLOCK : 5 * BLOCK]).hexdigest(),
    ]
    assert [path.name for path in sorted(image.parent.iterdir())] == ["robot3.bmap", "robot3.img"]


def test_the_same_image_gives_the_same_map(image: Path) -> None:
    write_bmap(image, [(0, 1), (3 * BLOCK, BLOCK)], bmap_of(image))
    first = bmap_of(image).read_bytes()
    write_bmap(image, [(4 * BLOCK - 1, 1), (7, 1)], bmap_of(image))
    assert bmap_of(image).read_bytes() == first


def test_what_is_known_of_another_image_is_not_read_again(image: Path) -> None:
    """One that goes on further is read. Seen to fail where `known` goes by the first block alone."""
    known = [Range(0, 0, "a" * 64), Range(3, 3, "b" * 64), Range(9, 9, "c" * 64)]
    made = write_bmap(image, [(0, 1), (3 * BLOCK, 2 * BLOCK)], bmap_of(image), known)
    assert made.ranges == (
        Range(0, 0, "a" * 64),
        Range(3, 4, hashlib.sha256(CONTENT[3 * BLOCK : 5 * BLOCK]).hexdigest()),
    )


def test_an_image_that_ends_inside_a_block(image: Path) -> None:
    image.write_bytes(CONTENT[: BLOCK + 100])
    bmap = write_bmap(image, [(BLOCK, 100)], bmap_of(image))
    assert bmap == BlockMap(BLOCK + 100, (Range(1, 1, hashlib.sha256(CONTENT[BLOCK : BLOCK + 100]).hexdigest()),))
    assert bmap.mapped == 100
    assert read_bmap(bmap_of(image)) == bmap


def sealed(text: str) -> str:
    """The text with the checksum it should have, computed the way bmaptool does."""
    blank = re.sub(r"(<BmapFileChecksum> )\w+", r"\g<1>" + "0" * 64, text)
    return blank.replace("0" * 64, hashlib.sha256(blank.encode()).hexdigest(), 1)


def test_the_checksum_of_the_map_is_what_bmaptool_computes(image: Path) -> None:
    write_bmap(image, [(0, 1)], bmap_of(image))
    text = bmap_of(image).read_text()
    assert sealed(text) == text


def test_a_map_by_bmaptool_is_understood(tmp_path: Path) -> None:
    path = tmp_path / "other.bmap"
    path.write_text(
        sealed(
            '<?xml version="1.0" ?>\n<!-- a comment -->\n<bmap version="2.0">\n'
            "  <!-- Image size in bytes: 40.0 KiB -->\n  <ImageSize> 40960 </ImageSize>\n"
            "  <BlockSize> 4096 </BlockSize>\n  <BlocksCount> 10 </BlocksCount>\n"
            "  <MappedBlocksCount> 3      </MappedBlocksCount>\n  <ChecksumType> sha256 </ChecksumType>\n"
            f"  <BmapFileChecksum> {'0' * 64} </BmapFileChecksum>\n"
            f'  <BlockMap>\n    <Range chksum="{"a" * 64}"> 0-1 </Range>\n    <Range chksum="{"b" * 64}"> 9 </Range>\n'
            "  </BlockMap>\n</bmap>\n"
        )
    )
    assert read_bmap(path) == BlockMap(40960, (Range(0, 1, "a" * 64), Range(9, 9, "b" * 64)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (' version="2.0"', ' version="3.0"', "version is 3.0 instead of 2.0"),
        ("> sha256 <", "> sha1 <", "ChecksumType is sha1"),
        ("<BlockSize> 4096", "<BlockSize> 512", "BlockSize is 512"),
        ("<BlocksCount> 64", "<BlocksCount> 65", "BlocksCount is 65 instead of 64"),
        ("<MappedBlocksCount> 3", "<MappedBlocksCount> 4", "MappedBlocksCount is 4 instead of 3"),
        ("> 3-4 <", "> 63-64 <", "range 63-64 is out of order or outside"),
        ("> 3-4 <", "> 0-1 <", "range 0-1 is out of order"),
        ("> 3-4 <", "> three <", "invalid literal"),
        ("</BlockMap>", "", "mismatched tag"),
        ("<ImageSize>", "<Size>", "mismatched tag"),
    ],
)
def test_a_map_that_cannot_be_is_refused(image: Path, old: str, new: str, message: str) -> None:
    write_bmap(image, [(0, 1), (3 * BLOCK, 2 * BLOCK)], bmap_of(image))
    text = bmap_of(image).read_text()
    assert text.count(old) == 1
    bmap_of(image).write_text(sealed(text.replace(old, new)))
    with pytest.raises(UserError, match=f"damaged block map, .*{message}.*; build the image again"):
        read_bmap(bmap_of(image))


@pytest.mark.parametrize("damage", ["flip", "truncate", "empty"])
def test_a_damaged_map_is_refused(image: Path, damage: str) -> None:
    write_bmap(image, [(0, 1), (3 * BLOCK, 2 * BLOCK)], bmap_of(image))
    content = bmap_of(image).read_bytes()
    damaged = {"flip": content.replace(b"> 3-4 <", b"> 3-5 <"), "truncate": content[:-9], "empty": b""}[damage]
    assert damaged != content
    bmap_of(image).write_bytes(damaged)
    with pytest.raises(UserError, match="its own checksum does not match"):
        read_bmap(bmap_of(image))
