"""The Python package of this tool: `make wheel` builds it, and it needs no checkout."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.images import manifest, verify
from tests.image.homes import share_outputs

DATA = ("ansible", "examples", "images", "kernel", "rootfs_overlay", "runtime")
"""Folders of the checkout that the package has in flotilla/tool."""
LEFT_OUT = re.compile(r"runtime/(bench/|tests/|tidy\.py)|.*/\.(ansible-lint|clang-tidy)$")


def built(checkout: Path, directory: Path) -> Path:
    """The wheel of a checkout."""
    argv = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(directory)]
    done = subprocess.run(argv, cwd=checkout, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = directory.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("dist")
    argv = ["make", "-C", str(paths.PROJECT), "wheel", f"OUT={directory}"]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=directory, check=True)
    (wheel,) = directory.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program of an environment with nothing but the package and its dependencies."""
    directory = tmp_path_factory.mktemp("installed")
    uv = [sys.executable, str(paths.PROJECT / "images/pip_settings.py"), str(Path(sys.prefix, "bin/uv"))]
    environment = directory / "environment"
    for words in (
        ["venv", "--quiet", "--python", sys.executable, str(environment)],
        ["pip", "install", "--quiet", "--python", str(environment / "bin/python"), "--constraint",
         str(wheel.with_name("constraints.txt")), f"flotilla[station] @ file://{wheel}"],
    ):  # fmt: skip
        done = subprocess.run([*uv, *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    return environment / "bin/flotilla"


def run(program: Path, *words: str, where: Path) -> subprocess.CompletedProcess[str]:
    """The tool as its user starts it, who has no checkout."""
    ours = ("APPS", "BUILD", "FLEET", "INVENTORY", "KEYS", "PYTHONPATH")
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    return subprocess.run([program, *words], cwd=where, env=kept, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def lab(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home that the installed tool made; its outputs share what is named by its content."""
    directory = tmp_path_factory.mktemp("homes") / "lab"
    done = run(installed, "init", str(directory), where=directory.parent)
    assert (
        done.stdout
        == f"{directory} is the home of the fleet lab; build its robot's card: cd {directory} && flotilla image 1\n"
    )
    share_outputs(directory)
    return directory


def test_the_package_has_the_files_of_the_checkout_and_no_others(wheel: Path) -> None:
    """Seen to fail with a key in ansible/keys, when folders were included whatever git ignores."""
    argv = ["git", "ls-files", "flotilla", *DATA, "requirements/build.lock"]
    listed = subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, check=True).stdout.split()
    kept = [name for name in listed if not LEFT_OUT.match(name)]
    wanted = {name if name.startswith("flotilla/") else f"flotilla/tool/{name}" for name in kept}
    found = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert found == wanted


def test_the_package_repeats_to_the_byte(wheel: Path, tmp_path: Path) -> None:
    """From a copy elsewhere, with other times and modes of its files."""
    verify.copy_checkout(tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy/.git", ignore_errors=True)
    again = built(tmp_path / "copy", tmp_path / "dist")
    assert hashlib.sha256(again.read_bytes()).digest() == hashlib.sha256(wheel.read_bytes()).digest()


def test_without_a_home_a_command_names_the_remedy(installed: Path, tmp_path: Path) -> None:
    """Seen to fail: the directory in which the tool is installed was the home."""
    done = run(installed, "check-fleet", where=tmp_path)
    remedy = f"FLEET={tmp_path}: has no fleet.yml; name a fleet's directory, or make one: flotilla init DIRECTORY"
    assert (done.returncode, done.stderr) == (1, f"error: {remedy}\n")
    assert list(tmp_path.iterdir()) == []


def test_make_in_the_home_runs_the_installed_tool(installed: Path, lab: Path) -> None:
    kept = {name: value for name, value in os.environ.items() if name not in ("BUILD", "FLEET", "INVENTORY", "KEYS")}
    environment = kept | {"PATH": f"{installed.parent}:{kept['PATH']}"}
    for words, said in ((["check-fleet"], "lab: 1 robot"), (["help", "TARGET=flash"], "make flash ROBOT=3")):
        done = subprocess.run(["make", *words], cwd=lab, env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, said in done.stdout) == (0, True), done.stdout + done.stderr


def test_an_installed_tool_makes_the_card_that_the_checkout_makes(installed: Path, lab: Path) -> None:
    done = run(installed, "image", "1", where=lab)
    assert done.returncode == 0, done.stderr
    image = lab / "build/images/robot1.img"
    card = hashlib.sha256(image.read_bytes()).hexdigest()
    assert manifest.read(image, "flotilla image").source_unknown.startswith("installed: flotilla ")
    image.unlink()
    checkout = Path(sys.executable).with_name("flotilla")
    done = run(checkout, "image", "1", where=lab)
    assert done.returncode == 0, done.stderr
    assert hashlib.sha256(image.read_bytes()).hexdigest() == card
