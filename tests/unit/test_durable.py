"""Outputs are on the disk before they get their names; tests/image/test_power_cuts_of_the_builder.py cuts the power."""

from __future__ import annotations

import ast
import ctypes
import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.common import cache, durable, paths
from flotilla.fleet import keys

SOURCES = ("flotilla", "ansible/plugins")
NOT_DURABLE = {
    "flotilla/common/durable.py": "has it",
    "flotilla/apps/remote_compiler.py": "inside a result that is not complete yet",
    "flotilla/apps/fmu.py": "inside a result that is not complete yet",
    "flotilla/images/rootfs.py": "inside a result that is not complete yet",
    "flotilla/station/adapter.py": "in /run, which ends with the power",
    "flotilla/cli/commands.py": "a bundle that was whole before gets another name",
    "flotilla/common/cache.py": "a result that goes",
    "flotilla/apps/imported.py": "code that goes",
}
"""Files with a rename of their own, and why it needs no sync before it."""


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was synced and renamed, in its order: the kernel's calls are watched, and made."""
    made: list[str] = []

    def watched(name: str, call: Callable[..., object], what: Callable[..., str]) -> Callable[..., object]:
        def instead(*arguments: object) -> object:
            made.append(f"{name} {what(*arguments)}")
            return call(*arguments)

        return instead

    def of(descriptor: int) -> str:
        return Path(f"/proc/self/fd/{descriptor}").readlink().name

    monkeypatch.setattr(os, "fsync", watched("fsync", os.fsync, of))
    monkeypatch.setattr(durable._libc, "syncfs", watched("syncfs", durable._libc.syncfs, of))
    monkeypatch.setattr(os, "link", watched("link", os.link, lambda _, to: Path(to).name))
    monkeypatch.setattr(Path, "replace", watched("replace", Path.replace, lambda new, to: f"{new.name} {to.name}"))
    return made


def test_a_file_is_synced_then_renamed_then_its_name_is_synced(tmp_path: Path, calls: list[str]) -> None:
    (tmp_path / "new").write_text("content")
    durable.rename(tmp_path / "new", tmp_path / "final")
    assert calls == ["fsync new", "replace new final", f"fsync {tmp_path.name}"]


def test_a_tree_is_synced_by_one_call(tmp_path: Path, calls: list[str]) -> None:
    (tmp_path / "new").mkdir()
    durable.rename(tmp_path / "new", tmp_path / "final")
    assert calls == ["syncfs new", "replace new final", f"fsync {tmp_path.name}"]


def test_files_beside_each_other_are_synced_by_one_call(tmp_path: Path, calls: list[str]) -> None:
    (tmp_path / "new").mkdir()
    for name in ("a", "b"):
        (tmp_path / "new" / name).touch()
    durable.rename_files(sorted((tmp_path / "new").iterdir()), tmp_path)
    assert calls == ["syncfs new", "replace a a", "replace b b", f"fsync {tmp_path.name}"]


def test_a_result_of_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: list[str]) -> None:
    """Seen to fail: results were renamed without a sync."""
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    cache.result("kind", "0" * 16, lambda out: (out / "file").touch())
    name = f"kind-{'0' * 16}"
    assert calls == [f"syncfs {name}.part", f"replace {name}.part {name}", "fsync cache"]


def test_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: list[str]) -> None:
    """The public half gets its name last: alone it means that the private one is elsewhere. Seen to fail: neither was
    synced."""
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    keys.make("a", "comment")
    private = ["fsync .a.new", "replace .a.new a", "fsync keys"]
    assert calls == [*private, "fsync .a.new.pub", "replace .a.new.pub a.pub", "fsync keys"]
    calls.clear()
    keys.write_once(tmp_path / "keys" / "b", "secret")
    assert calls == [f"fsync .b.{os.getpid()}", "link b", "fsync keys"]


def test_what_could_not_be_written_gets_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that fails, or is full, at the sync: the old content stays, and nothing is left beside it."""

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    durable.write(tmp_path / "file", "old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        durable.write(tmp_path / "file", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "old"


def test_a_tree_that_could_not_be_written_gets_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "new").mkdir()
    monkeypatch.setattr(durable._libc, "syncfs", lambda _: -1)
    monkeypatch.setattr(ctypes, "get_errno", lambda: errno.EIO)
    with pytest.raises(OSError, match=r"Input/output error.*/new"):
        durable.rename(tmp_path / "new", tmp_path / "final")
    assert not (tmp_path / "final").exists()


def _renames(source: str) -> list[int]:
    """Lines of a Python source that rename files: `path.rename(to)`, `path.replace(to)`, os.rename, os.replace."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and not node.keywords:
            of_os = isinstance(node.func.value, ast.Name) and node.func.value.id == "os"
            durable_ones = isinstance(node.func.value, ast.Name) and node.func.value.id == "durable"
            if node.func.attr in ("rename", "replace") and len(node.args) == 1 + of_os and not durable_ones:
                found.append(node.lineno)
    return found


@pytest.mark.parametrize("line", ["a.rename(b)", "a.replace(b)", "os.rename(a, b)", "os.replace(a, b)"])
def test_a_rename_is_found(line: str) -> None:
    assert _renames(line) == [1]
    assert _renames("durable.rename(a, b)\n'text'.replace('a', 'b')\nmoment.replace(microsecond=0)") == []


def test_every_other_rename_has_a_reason() -> None:
    """Seen to fail: none had a sync before it."""
    files = [file for place in SOURCES for file in sorted((paths.PROJECT / place).rglob("*.py"))]
    found = {str(file.relative_to(paths.PROJECT)) for file in files if _renames(file.read_text(encoding="utf-8"))}
    assert found == NOT_DURABLE.keys()
