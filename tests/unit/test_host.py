"""The checks before a build, each made to speak."""

from __future__ import annotations

import errno
import os
import shutil
import threading
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
    host.check()
    host.check_space(100 << 20)
    for check in (host.check, host.check_space):
        with pytest.raises(
            UserError, match=r"100\.0 MiB free on its disk, a build needs 101\.0 MiB; make room, or .* BUILD="
        ):
            check(101 << 20)


@pytest.mark.parametrize(
    ("error", "full"),
    [
        (OSError(errno.ENOSPC, "x"), True),
        (OSError(errno.EDQUOT, "x"), True),
        (UserError("mke2fs failed: No space left on device"), True),
        (OSError(errno.EIO, "x"), False),
        (UserError("mke2fs failed: something else"), False),
    ],
)
def test_a_full_disk_is_said_though_there_is_room_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception, full: bool
) -> None:
    """What was being written is removed first. Seen to fail: the error came as a traceback."""
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: _Usage(1 << 40, 1 << 39, 1 << 30))
    monkeypatch.setattr(host, "_was_full", threading.Event())
    with pytest.raises(UserError if full else type(error)) as caught, host.explaining_a_full_disk():
        raise error
    said = f"{tmp_path}: no space left on its disk, 1.0 GiB free, so the build failed; the last good images are"
    assert str(caught.value).startswith(said) == full


def test_too_little_memory_is_refused(tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 900000 kB\nMemAvailable: 500000 kB\nSwapFree: 0 kB\n")
    assert "488.3 MiB of memory available, a build needs 1.0 GiB" in host._missing_memory(meminfo)[0]
    meminfo.write_text("MemTotal: 900000 kB\nMemAvailable: 500000 kB\nSwapFree: 900000 kB\n")
    assert host._missing_memory(meminfo) == []
