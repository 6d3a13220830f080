"""`make size`: reading unsquashfs' listing, and whose the bytes are."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import pytest

from flotilla.common.errors import UserError
from flotilla.images import size

LISTING = """drwxr-xr-x root/root               268 2026-11-19 02:12 squashfs-root
lrwxrwxrwx root/root                 7 2026-11-19 02:12 squashfs-root/bin -> usr/bin
-rw-r--r-- root/root              3040 2026-11-19 02:12 squashfs-root/etc/with blanks
-rwxr-xr-x root/root               100 2026-11-19 02:12 squashfs-root/usr/bin/tool
-rw-r----- root/shadow              20 2026-11-19 02:12 squashfs-root/usr/lib/modules/6.1/kernel/x.ko
"""
TOOL = PurePosixPath("/usr/bin/tool")
MODULE = PurePosixPath("/usr/lib/modules/6.1/kernel/x.ko")
OWN = PurePosixPath("/etc/with blanks")


def test_listing() -> None:
    assert size.regular_files(LISTING) == {OWN: 3040, TOOL: 100, MODULE: 20}


def test_packages_by_old_and_new_places() -> None:
    lists = {"tool": "/.\n/bin\n/bin/tool\n/usr/share/doc/gone\n", "kernel": f"/lib/modules/6.1/kernel\n{MODULE}\n"}
    sizes = size.by_package(size.regular_files(LISTING), lists)
    assert sizes == {"tool": 100, "kernel": 20, "(made by the build)": 3040}
    assert size.by_package(size.regular_files(LISTING), {})["(made by the build)"] == 3160


def test_directories_to_a_depth() -> None:
    sizes = size.by_directory(size.regular_files(LISTING), depth=2)
    assert sizes == {"/etc": 3040, "/usr": 120, "/usr/bin": 100, "/usr/lib": 20}


def test_missing_image(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is missing; `make image ROBOT=3`"):
        size.report(tmp_path / "robot3.img", "make image ROBOT=3")
