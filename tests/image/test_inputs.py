"""What enters an image is what its manifest counts: files planted in a checkout, and images built there.

Every place that images are made of, without building: tests/unit/test_sources.py.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from flotilla.common import namespace, paths
from flotilla.debian import tools
from flotilla.debian.lock import read_lock
from flotilla.fleet.model import Fleet
from flotilla.images import manifest, verify
from flotilla.images.build import build

ROBOT = 3
LEFT_BEHIND = (
    "rootfs_overlay/usr/lib/flotilla/__pycache__/update.cpython-311.pyc", "rootfs_overlay/etc/fstab~",
    "rootfs_overlay/etc/.#hosts.j2", "rootfs_overlay/etc/ssh/.sshd_config.swp", "images/rootfs/exclude.list.orig",
    "images/boot/__pycache__/card.pyc", "runtime/core/#ring.c#", "runtime/include/flotilla/block.h~",
    "kernel/fragments/net.config.rej", "ansible/control_tasks/control.yml~",
)  # fmt: skip
UNTRACKED = "rootfs_overlay/etc/new folder/untracked.conf"
CAPABILITIES = ",".join(name.removeprefix("CAP_").lower() for name in namespace._CAPABILITIES)


def plant(checkout: Path, names: Sequence[str]) -> None:
    for name in names:
        (checkout / name).parent.mkdir(exist_ok=True)
        (checkout / name).write_text("planted\n")


@pytest.mark.nightly  # a whole build
def test_planted_files_are_in_the_image_and_counted_or_neither(tmp_path: Path, fleet: Fleet) -> None:
    """Seen to fail: bytecode was in the root, with the inputs and the cache's key of a checkout without.

    What is made anew is made by root that has no capability but those which `namespace.check` asks for.
    """
    (real,) = build(fleet, [fleet.robots[ROBOT]])
    checkout, own = tmp_path / "checkout", tmp_path / "build"
    verify.copy_checkout(checkout)
    shutil.copytree(paths.KEYS, tmp_path / "keys")
    shutil.copytree(paths.POOL, own / "pool", ignore=shutil.ignore_patterns(".*"))
    shutil.copytree(paths.CACHE, own / "cache", symlinks=True, ignore=shutil.ignore_patterns(".*", "*.part"))
    git = ["git", "-C", str(checkout), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"]):
        subprocess.run([*git, *command], check=True)

    def made() -> tuple[str, manifest.Manifest]:
        mapped = [] if os.geteuid() == 0 else ["unshare", "--user", "--map-auto", "--map-root-user"]
        less = ["setpriv", f"--bounding-set=-all,+{CAPABILITIES.replace(',', ',+')}", "--inh-caps=-all"]
        environment = os.environ | {"BUILD": str(own), "KEYS": str(tmp_path / "keys"), "PYTHONPATH": str(checkout)}
        argv = [*mapped, *less, sys.executable, "-m", "flotilla", "image", str(ROBOT)]
        done = subprocess.run(argv, env=environment, cwd=checkout, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        image = own / "images" / real.name
        return image.with_suffix(".sha256").read_text(), manifest.read(image, "make image")

    plant(checkout, LEFT_BEHIND)
    sha256, described = made()
    first = manifest.read(real, "make image")
    assert sha256 == real.with_suffix(".sha256").read_text()
    assert described.inputs == first.inputs
    assert described.source is not None
    assert not described.source.dirty

    plant(checkout, [UNTRACKED])
    sha256, described = made()
    assert sha256 != real.with_suffix(".sha256").read_text()
    assert described.inputs != first.inputs
    assert described.source is not None
    assert described.source.dirty
    toolset = tools.Tools(tools.tree(read_lock("tools")), 0)
    (new,) = (root for root in (own / "cache").glob("rootfs-*") if not (paths.CACHE / root.name).exists())
    listing = toolset.run("usr/bin/unsquashfs", "-l", "-d", "", new / "root.squashfs").splitlines()
    real_root = next(root for root in paths.CACHE.glob("rootfs-*") if _holds(root, first))
    before = toolset.run("usr/bin/unsquashfs", "-l", "-d", "", real_root / "root.squashfs").splitlines()
    inside = "/" + UNTRACKED.removeprefix("rootfs_overlay/")
    assert sorted(set(listing) ^ set(before)) == [str(Path(inside).parent), inside]


def _holds(root: Path, described: manifest.Manifest) -> bool:
    """Whether it is the root of an image."""
    file = root / "root.squashfs"
    return file.exists() and any(
        part == manifest.part(file.name, file, 0, file.stat().st_size) for part in described.parts
    )
