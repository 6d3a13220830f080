"""The build tools: nothing is unpacked that is not what the lock says."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from images.builder import tools
from images.builder.lock import Lock, Package, Suite


def test_tree_of_a_changed_package_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "POOL", tmp_path / "pool")
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    paths.POOL.mkdir()
    right = hashlib.sha256(b"right").hexdigest()
    package = Package("tool", "1", "amd64", "userland", "debian", 5, right, "pool/tool.deb")
    lock = Lock("tools", "amd64", (Suite("debian", "bookworm", datetime(2026, 1, 2, tzinfo=UTC)),), (package,))
    (paths.POOL / f"{right}.deb").write_bytes(b"wrong")
    with pytest.raises(UserError, match=f"the lock says {right}"):
        tools.tree(lock)
    assert not any(paths.CACHE.glob("[!.]*"))

    (paths.POOL / f"{right}.deb").write_bytes(b"right")  # passes the hashes, and fails only as no Debian package
    with pytest.raises(UserError, match="cannot unpack tool"):
        tools.tree(lock)
