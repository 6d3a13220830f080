"""The build tools: nothing is unpacked that is not what the lock says."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian import mirror, toolchain, tools
from flotilla.debian.lock import Lock, Package, Suite
from flotilla.fleet import inventory


def test_tree_of_a_changed_package_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "POOL", tmp_path / "pool")
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    paths.POOL.mkdir()
    right = hashlib.sha256(b"right").hexdigest()
    package = Package("tool", "1", "amd64", "userland", "debian", 5, right, "pool/tool.deb")
    lock = Lock("tools", "amd64", (Suite("debian", "bookworm", datetime(2026, 1, 2, tzinfo=UTC)),), (package,))
    monkeypatch.setattr(mirror, "resolve", mirror.Mirrors)
    (paths.POOL / f"{right}.deb").write_bytes(b"wrong")
    with pytest.raises(UserError, match="no mirror known"):  # it is removed, and there is nothing to replace it
        tools.tree(lock)
    assert not any(paths.CACHE.glob("[!.]*"))

    (paths.POOL / f"{right}.deb").write_bytes(b"right")  # passes the hashes, and fails only as no Debian package
    with pytest.raises(UserError, match="cannot unpack tool"):
        tools.tree(lock)


@pytest.mark.parametrize(("processor", "compiled_for"), [("pentium3", "pentium3"), (None, "i686")])
def test_a_program_is_compiled_for_the_boards_processor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processor: str | None, compiled_for: str
) -> None:
    """Seen to fail: each i386 board got programs for a Pentium III."""
    compiled: list[str] = []

    def run(_: str, work: Path, command: Sequence[str], _log: Path) -> None:
        compiled.extend(command)
        (work / "made").write_bytes(b"program")

    monkeypatch.setattr(toolchain, "run", run)
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    (tmp_path / "program.c").touch()
    board = inventory.load_fleet().boards["smartcoret3"].model_copy(update={"processor": processor})
    assert toolchain.compile_static(tmp_path / "program.c", board) == b"program"
    assert [word for word in compiled if word.startswith("-march=")][-1] == f"-march={compiled_for}"


@pytest.mark.parametrize(
    ("architecture", "triplet", "asked_for"),
    [
        ("amd64", "x86_64-linux-gnu", "lib64/ld-linux-x86-64.so.2"),
        ("i386", "i386-linux-gnu", "lib/ld-linux.so.2"),
    ],
)
def test_a_tool_is_run_by_the_loader_of_its_own_tree(
    tmp_path: Path, architecture: str, triplet: str, asked_for: str
) -> None:
    """Seen to fail: the link that Debian's package has at the loader's well-known place led out of the tree, so the
    host's loader ran with the tree's C library, which of another glibc ends by `stack smashing detected`."""
    link = tmp_path / "usr" / asked_for
    real = tmp_path / f"usr/lib/{triplet}" / link.name
    for directory in (link.parent, real.parent):
        directory.mkdir(parents=True, exist_ok=True)
    real.touch()
    link.symlink_to(f"/lib/{triplet}/{link.name}")
    (tmp_path / Path(asked_for).parent).symlink_to(f"usr/{Path(asked_for).parent}")
    loader, option, libraries, program = tools.command(tmp_path, "usr/sbin/mke2fs", architecture)
    assert Path(loader).resolve() == real
    assert (option, Path(libraries).resolve()) == ("--library-path", real.parent)
    assert program == str(tmp_path / "usr/sbin/mke2fs")
