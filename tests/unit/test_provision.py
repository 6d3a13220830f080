"""The builder's half of provisioning: which files a robot has, and which role looks after each."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.identity import render
from flotilla.robot import playbook, provision

ROLES = paths.PROJECT / "ansible" / "roles"


def test_files_are_those_of_the_card_image() -> None:
    fleet, robot = provision.robot(paths.INVENTORY, "robot1")
    files = provision.files(paths.INVENTORY, "robot1")
    assert files == {str(path): file for path, file in render(fleet, robot).items()}
    assert files["/etc/hostname"] == (b"robot1\n", 0o644)


@pytest.mark.parametrize(
    ("path", "role"),
    [
        ("/etc/hostname", "identity"),
        ("/etc/systemd/network/10-fleet.network", "network"),
        ("/etc/systemd/system/chrony.service.d/more.conf", "runtime"),
        ("/etc/systemd/system/sysinit.target.d/tasks.conf", "control_tasks"),
        ("/etc/systemd/system/flotilla-task@valves.service.d/io-ports.conf", "control_tasks"),
        ("/etc/flotilla/message-keys", "control_tasks"),
        ("/etc/flotilla/dds-security.xml", "control_tasks"),
        ("/etc/chrony/chrony.keys", "time"),
        ("/etc/hosts.allow", "identity"),
    ],
)
def test_the_longest_path_decides_which_role_mends_a_file(path: str, role: str) -> None:
    """Seen to fail with the table in its own order."""
    assert provision.role_of(path) == role


def test_what_no_role_looks_after_is_an_error() -> None:
    with pytest.raises(UserError, match=r"/usr/bin/sh: no role.*ansible/files.yml"):
        provision.role_of("/usr/bin/sh")


def test_every_role_is_there_and_played() -> None:
    named = set(yaml.safe_load(provision.ROLES.read_text()))
    (play,) = yaml.safe_load((paths.PROJECT / "ansible" / "fleet.yml").read_text())
    (repaired,) = play["tasks"]
    assert named == set(repaired["loop"]) == {path.name for path in ROLES.iterdir()}
    assert all((ROLES / name / "meta" / "argument_specs.yml").exists() for name in named)


def test_a_stranger_is_an_error() -> None:
    with pytest.raises(UserError, match="robot9 is not a robot of ansible/inventory"):
        provision.robot(paths.INVENTORY, "robot9")


def test_the_playbook_rotates_keys_by_a_command_that_there_is() -> None:
    """Seen to fail with the builder's package, which was the command line once."""
    plays = yaml.safe_load((paths.PROJECT / "ansible" / "replace.yml").read_text())
    (argv,) = (task["vars"]["rotate_key"] for task in plays[0]["tasks"] if "vars" in task)
    assert argv[0] == "{{ ansible_playbook_python }}"
    for words in (["3"], ["3", "--retire"]):
        whole = [sys.executable, *argv[1:], *words, "--help"]
        done = subprocess.run(whole, cwd=paths.PROJECT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], dict[str, str]]]:
    """Words and environment of what would run instead of Ansible."""
    runs: list[tuple[list[str], dict[str, str]]] = []
    monkeypatch.setattr(os, "chdir", lambda _: None)
    monkeypatch.setattr(os, "execve", lambda _, argv, environment: runs.append((argv, environment)))
    return runs


def test_a_robot_has_the_name_that_the_inventory_gives_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, played: list[tuple[list[str], dict[str, str]]]
) -> None:
    """Robot 3 was once taken for `robot3`, and Ansible found no such host."""
    shutil.copytree(paths.INVENTORY, tmp_path / "inventory")
    robots = tmp_path / "inventory" / "robots.yml"
    robots.write_text(robots.read_text().replace("robot3:", "alpha:"))
    monkeypatch.setattr(paths, "INVENTORY", tmp_path / "inventory")
    playbook.play("fleet", robot=3, guests=False, words=["--check"])
    ((argv, _),) = played
    assert argv[1:] == ["-i", str(tmp_path / "inventory"), "-l", "alpha", "--check", "fleet.yml"]
    with pytest.raises(UserError, match=r"robot 9: no such robot in .*; robots are 1, 2, 3, 4"):
        playbook.play("fleet", robot=9, guests=False, words=[])


def test_a_playbook_has_the_configuration_of_this_project(
    monkeypatch: pytest.MonkeyPatch, played: list[tuple[list[str], dict[str, str]]]
) -> None:
    """Once the user's variables changed how robots were reached."""
    for name, value in (("ANSIBLE_CONFIG", "/elsewhere.cfg"), ("ANSIBLE_FORKS", "1"), ("LC_ALL", "de_DE.ISO-8859-1")):
        monkeypatch.setenv(name, value)
    playbook.play("fleet", robot=None, guests=False, words=[])
    ((_, environment),) = played
    configured = {name: value for name, value in environment.items() if name.startswith(("ANSIBLE_", "LC_"))}
    assert configured == {"ANSIBLE_CONFIG": str(paths.PROJECT / "ansible/ansible.cfg"), "LC_ALL": "C.UTF-8"}
    assert environment["HOME"] == os.environ["HOME"]
