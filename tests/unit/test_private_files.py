"""Whatever holds a robot's private key is for its owner alone, under any umask."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.images import bmap, card
from flotilla.images.flash import flash
from flotilla.lab.qemu import qemu


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def mode(file: Path) -> int:
    return stat.S_IMODE(file.stat().st_mode)


@pytest.mark.parametrize("there", [False, True], ids=["new", "from an earlier build"])
def test_a_card(tmp_path: Path, *, there: bool) -> None:
    (tmp_path / "card.img").write_bytes(b"board")
    (tmp_path / "extents.json").write_text(json.dumps([[0, 5]]))
    out = tmp_path / "robot3.img"
    if there:
        out.touch(0o644)
    card.begin(tmp_path, out)
    assert mode(out) == 0o600
    assert out.read_bytes()[:5] == b"board"


@pytest.mark.parametrize("there", [False, True], ids=["new", "there already"])
def test_a_file_that_stands_for_a_card(tmp_path: Path, *, there: bool) -> None:
    image, file = tmp_path / "robot3.img", tmp_path / "card"
    image.write_bytes(bytes(range(256)) * 16)
    bmap.write_bmap(image, [(0, 4096)], bmap.bmap_of(image))
    if there:
        file.touch(0o644)
    flash(image, device=None, file=file, force=None, yes=False, robot="3")
    assert mode(file) == 0o600
    assert file.read_bytes() == image.read_bytes()


def test_what_a_guest_writes(tmp_path: Path) -> None:
    image, overlay = tmp_path / "robot3.img", tmp_path / "card.qcow2"
    image.write_bytes(bytes(4096))
    qemu.make_overlay(image, overlay)
    assert mode(overlay) == 0o600
