"""The cards of a fleet with a home of its own, made by the tool's front door."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet import home
from flotilla.fleet.model import Fleet
from flotilla.images import manifest
from flotilla.images.build import image_of
from tests.image.homes import share_outputs


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new home; its outputs share what is named by its content."""
    directory = tmp_path_factory.mktemp("homes") / "lab"
    home.make(directory)
    share_outputs(directory)
    return directory


def make(lab: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run make in the checkout for the home; as a user does, but with the environment of this test."""
    kept = {name: value for name, value in os.environ.items() if name not in ("BUILD", "KEYS", "APPS", "INVENTORY")}
    return subprocess.run(
        ["make", "-C", str(paths.PROJECT), f"FLEET={lab}", *words],
        env=kept,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_home_without_files_for_the_root_has_the_tools_root(lab: Path, fleet: Fleet) -> None:
    """A board of the tool's that has the packages of an example's board also has the bytes of its root."""
    done = make(lab, "image", "ROBOT=1")
    assert done.returncode == 0, done.stderr
    image = lab / "build/images/robot1.img"
    made = manifest.read(image, "make image")
    example = next(robot for robot in fleet.robots.values() if robot.board == "x86_64")
    shared = {part.name: part.sha256 for part in manifest.read(image_of(example), "make image").parts}
    assert (made.robot.board, made.hostvars["fleet_name"]) == ("pc_uefi", "lab")
    same = {part.name for part in made.parts if part.sha256 == shared[part.name]}
    assert same >= {"vmlinuz", "initrd.img", "root.squashfs"}
    assert (lab / "keys/operator_ed25519").is_file()


@pytest.mark.nightly
def test_a_file_of_the_home_is_in_the_root(lab: Path) -> None:
    """It builds a root of its own, on the robot as it stands in the home, and the same a second time elsewhere."""
    (lab / "overlay/etc").mkdir(parents=True)
    (lab / "overlay/etc/motd").write_text("welcome\n")
    done = make(lab, "image", "ROBOT=1")
    assert done.returncode == 0, done.stderr
    made = manifest.read(lab / "build/images/robot1.img", "make image")
    (root,) = (part for part in made.parts if part.name == "root.squashfs")
    found = [
        file
        for file in (paths.CACHE).glob("rootfs-*/root.squashfs")
        if file.stat().st_size == root.bytes
        and subprocess.run(["unsquashfs", "-cat", file, "etc/motd"], capture_output=True, check=False).stdout
        == b"welcome\n"
    ]
    assert len(found) == 1
    done = make(lab, "verify", "ROBOT=1")
    assert done.returncode == 0, done.stdout + done.stderr
