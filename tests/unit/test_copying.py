"""Copies of parts of a file; by which way they go is the file system's to say, and must not show."""

from __future__ import annotations

import os
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.images import copying

SHM = Path("/dev/shm")
"""A file system that neither shares blocks nor, in older kernels, takes direct input and output."""
EXTENTS = [(12288, 512), (0, 512), (512, 5000), (65536, 4096 * 3 + 512)]
SIZE = 1 << 18


@pytest.fixture(params=[None, SHM], ids=["here", "shm"])
def directory(request: pytest.FixtureRequest) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=request.param) as name:
        yield Path(name)


@pytest.fixture
def source(directory: Path) -> Path:
    """Holds something in its extents alone."""
    path = directory / "source"
    chance = random.Random(1)
    with path.open("wb") as file:
        file.truncate(SIZE)
        for offset, length in EXTENTS:
            file.seek(offset)
            file.write(chance.randbytes(length))
    return path


@pytest.mark.parametrize("start", [0, 1 << 20])
@pytest.mark.parametrize("past", [False, True])
def test_a_copy_is_the_same_whichever_way_it_goes(directory: Path, source: Path, start: int, past: bool) -> None:
    """Seen to fail with extents that were cut to whole pages."""
    target = directory / "target"
    target.touch()
    os.truncate(target, start + SIZE)
    copying.copy(source, EXTENTS, target, start, past_page_cache=past)
    assert target.read_bytes() == bytes(start) + source.read_bytes()


def test_a_source_may_end_within_a_page(directory: Path, source: Path) -> None:
    """Seen to fail: the rest of the page was awaited for ever."""
    os.truncate(source, SIZE + 512)
    target = directory / "target"
    target.touch()
    os.truncate(target, SIZE + 512)
    copying.copy(source, [*EXTENTS, (SIZE, 512)], target, past_page_cache=True)
    assert target.read_bytes() == source.read_bytes()


def test_a_source_that_is_too_short_is_refused(directory: Path, source: Path) -> None:
    target = directory / "target"
    target.touch()
    with pytest.raises(UserError, match="shorter than its extents"):
        copying.copy(source, [(SIZE - 512, 513)], target, past_page_cache=True)
    assert not target.stat().st_size


@pytest.mark.parametrize("past", [False, True])
def test_a_copy_goes_to_another_file_system(tmp_path: Path, source: Path, past: bool) -> None:
    """As where build/cache is a link to another disk. Seen to fail with "Invalid cross-device link"."""
    with tempfile.TemporaryDirectory(dir=tmp_path if source.is_relative_to(SHM) else SHM) as name:
        target = Path(name, "target")
        target.touch()
        os.truncate(target, SIZE)
        copying.copy(source, EXTENTS, target, past_page_cache=past)
        assert target.read_bytes() == source.read_bytes()


@pytest.mark.parametrize(
    ("extents", "pages"),
    [
        ([(0, 1)], [(0, 4096)]),
        ([(4095, 2)], [(0, 8192)]),
        ([(8192, 4096), (0, 512), (512, 100)], [(0, 4096), (8192, 4096)]),
        ([(0, 4096), (4096, 4096)], [(0, 8192)]),
        ([(0, 9000), (100, 1)], [(0, 12288)]),
    ],
)
def test_whole_pages(extents: list[tuple[int, int]], pages: list[tuple[int, int]]) -> None:
    assert copying.whole_pages(extents) == pages
