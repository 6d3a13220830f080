"""Every step of the manual is a command that works: each is run as it stands there, or says here why it cannot be."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from images.builder import paths, verify

pytestmark = [pytest.mark.image, pytest.mark.alone]

MANUAL = paths.PROJECT / "docs" / "manual.md"
ELSEWHERE = {
    "make boot ROBOT=3": "takes the terminal; test_boot.py boots the same machine",
    "make ssh ROBOT=3": "asks a robot that runs; test_boot.py logs into guests",
    "lsblk": "shows this computer's disks, no program of ours",
    "make flash ROBOT=3 DEV=/dev/sdX": "needs a card; into a file below, on block devices in unit/test_flash.py",
    "sudo ip address add 10.42.0.254/24 dev eth0": "changes this computer's network",
    "ping 10.42.0.3": "needs the robot",
    **dict.fromkeys(
        (
            'make provision ARGS="--check --diff"',
            "make provision",
            'make provision PLAYBOOK=tasks ARGS="-e do=stop -e task=heading"',
            "make provision PLAYBOOK=collect",
            "make provision PLAYBOOK=reboot",
        ),
        "needs the robots; test_fleet.py plays the same on guests",
    ),
    "build/venv/bin/python -m serial.tools.miniterm /dev/ttyUSB0 115200": "needs a cable",
}
"""Commands that need hardware or a terminal, with who does the like."""


def commands() -> list[str]:
    """The commands in the manual's code blocks, each once and without its comment."""
    blocks = re.findall(r"^```\n(.*?)^```$", MANUAL.read_text(), re.MULTILINE | re.DOTALL)
    lines = (line.partition("#")[0].strip() for block in blocks for line in block.splitlines())
    return list(dict.fromkeys(filter(None, lines)))


def run(command: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL")}
    done = subprocess.run(command, shell=True, cwd=paths.PROJECT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("command", [command for command in commands() if command not in ELSEWHERE])
def test_command(command: str) -> None:
    assert command.startswith("make "), "not ours to run here: say in ELSEWHERE why"
    run(command)


def test_no_reason_outlives_its_command() -> None:
    assert set(ELSEWHERE) <= set(commands())


def test_flash_into_a_file(tmp_path: Path) -> None:
    card = tmp_path / "card.img"
    run(f"make flash ROBOT=3 CARD={card}")
    assert card.read_bytes() == (paths.IMAGES / "robot3.img").read_bytes()


def test_one_more_robot(tmp_path: Path) -> None:
    """Three copied lines in a copy of the checkout, with the results that this one's builds left."""
    checkout, keys = tmp_path / "checkout", tmp_path / "keys"
    verify.copy_checkout(checkout)
    shutil.copytree(paths.KEYS, keys)
    robots = checkout / paths.INVENTORY.relative_to(paths.PROJECT) / "robots.yml"
    lines = re.search(r"^ *robot4:\n.*\n.*\n", robots.read_text(), re.MULTILINE)
    assert lines
    added = lines[0].replace("robot4", "robot5").replace("number: 4", "number: 5").replace("10.42.0.4", "10.42.0.5")
    robots.write_text(robots.read_text().replace(lines[0], lines[0] + added))
    argv = [sys.executable, "-m", "images.builder", "image", "--robot", "5"]
    environment = os.environ | {"BUILD": str(paths.BUILD), "KEYS": str(keys)}
    try:
        done = subprocess.run(argv, cwd=checkout, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert (paths.IMAGES / "robot5.img").exists()
        assert "root file system" not in done.stderr  # the board's results were of use
    finally:
        for output in paths.IMAGES.glob("robot5.*"):
            output.unlink()


def test_documented_targets_exist() -> None:
    known = set(re.findall(r"^  ([a-z-]+) ", run("make help").stdout, re.MULTILINE))
    for document in (MANUAL, paths.PROJECT / "README.md", paths.PROJECT / "ARCHITECTURE.md"):
        named = set(re.findall(r"(?:`|^)make ([a-z-]+)", document.read_text(), re.MULTILINE))
        assert named
        assert named <= known, document.name
