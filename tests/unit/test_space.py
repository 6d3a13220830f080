"""What a build asks of the disk is what is not there yet."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.debian import pool
from flotilla.debian.lock import Lock, read_lock
from flotilla.images import space

MIB = 1 << 20


@pytest.fixture
def locks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> tuple[Lock, Lock]:
    """The build tools' and a board's, of 10 and 20 MiB."""
    for name in ("POOL", "CACHE"):
        monkeypatch.setattr(paths, name, tmp_path / name)
        (tmp_path / name).mkdir()
    lock = read_lock("tools")
    package = lock.packages[0]
    tree = replace(lock, packages=(replace(package, size=10 * MIB, sha256="1" * 64),))
    root = replace(lock, name="board", packages=(replace(package, size=20 * MIB, sha256="2" * 64),))
    return tree, root


def test_what_is_there_counts_as_nothing(locks: tuple[Lock, Lock]) -> None:
    """Seen to fail: 1 GiB was asked, whatever the cache had."""
    tree, root = locks
    needed = [space.needed([tree, tree], [root], [root])]
    pool.file(tree.packages[0]).touch()
    needed.append(space.needed([tree], [root], [root]))
    for kind in ("tools", "rootfs", "slot", "card"):
        (paths.CACHE / f"{kind}-{'0' * 16}.part").mkdir()
        assert space.needed([tree], [root], [root]) == needed[-1], "half a result"
        (paths.CACHE / f"{kind}-{'0' * 16}").mkdir()
        needed.append(space.needed([tree], [root], [root]))
    pool.file(root.packages[0]).touch()
    needed.append(space.needed([tree], [root], [root]))
    differences = [(before - after) / MIB for before, after in itertools.pairwise(needed)]
    assert differences == pytest.approx([10, 32, 42, 13, 13, 20], abs=0.01)
    assert needed[-1] / MIB == pytest.approx(13 + 8, abs=0.01)
    assert space.needed([tree], [root], [root] * 3) == 3 * needed[-1]
    assert space.needed([tree], [root], []) == 0
