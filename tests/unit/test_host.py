"""The checks before a build, each made to speak."""

from __future__ import annotations

import os
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from flotilla.common import host, paths
from flotilla.common.errors import UserError

_Usage = namedtuple("_Usage", "total used free")


def test_this_computer_can_build() -> None:
    host.check()


def test_all_missing_tools_are_named_at_once_with_the_line_that_installs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    present = shutil.which
    monkeypatch.setattr(
        shutil, "which", lambda name, path=None: None if name in ("unshare", "dpkg-deb", "setpriv") else present(name)
    )
    with pytest.raises(UserError) as error:
        host.check()
    assert "missing on this computer: dpkg-deb, setpriv, unshare" in str(error.value)
    assert "`sudo apt-get install --no-install-recommends dpkg util-linux`" in str(error.value)


def test_an_ordinary_user_also_needs_newuidmap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(shutil, "which", lambda name, path=None: None if name.startswith("new") else f"/usr/bin/{name}")
    with pytest.raises(UserError, match=r"newgidmap, newuidmap; install with .* uidmap"):
        host.check()


def test_a_full_disk_is_refused_before_the_build(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: _Usage(1 << 40, 1 << 40, 100 << 20))
    with pytest.raises(
        UserError, match=r"100\.0 MiB free on its disk, a build needs 1\.0 GiB; make room, or .* BUILD="
    ):
        host.check()


def test_too_little_memory_is_refused(tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 900000 kB\nMemAvailable: 500000 kB\nSwapFree: 0 kB\n")
    assert "488.3 MiB of memory available, a build needs 1.0 GiB" in host._missing_memory(meminfo)[0]
    meminfo.write_text("MemTotal: 900000 kB\nMemAvailable: 500000 kB\nSwapFree: 900000 kB\n")
    assert host._missing_memory(meminfo) == []
