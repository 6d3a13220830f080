"""A fleet outside of the tool: what `flotilla init` makes, and which files of a home count."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path, PurePosixPath

import pytest
import yaml

import flotilla.__main__ as program
from flotilla.common import paths, sources
from flotilla.common.errors import UserError
from flotilla.debian import kernel, lock
from flotilla.debian.lock import board_lock, read_lock
from flotilla.fleet import home, identity
from flotilla.fleet.model import Fleet
from flotilla.images import manifest, rootfs

NEW = "pc_uefi"
"""The board of a new home's robot."""
BOARD = "x86_64"


def flotilla(*words: str, where: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The answer of the command line in a directory, with no variable of this test's own environment."""
    kept = {name: value for name, value in os.environ.items() if name not in ("FLEET", "BUILD", "KEYS", "APPS")}
    return subprocess.run(
        [sys.executable, "-m", "flotilla", *words], cwd=where, capture_output=True, text=True, check=False,
        env=kept | {"PYTHONPATH": str(paths.PROJECT)} | environment,
    )  # fmt: skip


@pytest.fixture
def fleet_home(tmp_path: Path) -> Path:
    """A new home, whose results of Ansible lie in a directory of its own."""
    directory = tmp_path / "Rover Lab 2".replace(" ", "-")
    home.make(directory)
    return directory


@pytest.fixture
def at_home(fleet_home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A new home that this process uses."""
    monkeypatch.setattr(paths, "HOME", fleet_home)
    monkeypatch.setattr(paths, "OWN_HOME", True)
    return fleet_home


@pytest.mark.parametrize("inside", ["", "inventory/group_vars"])
def test_a_new_home_is_a_fleet(fleet_home: Path, inside: str) -> None:
    done = flotilla("check-fleet", where=fleet_home / inside)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "rover-lab-2: 1 robot, 1 station, 10.42.0.0/24 over ethernet"
    assert done.stdout.splitlines()[1].split()[:3] == ["1", "robot1", NEW]


def test_the_variable_counts_more_than_the_place(fleet_home: Path) -> None:
    done = flotilla("check-fleet", where=fleet_home, FLEET=str(paths.PROJECT))
    assert done.stdout.startswith("flotilla: "), done.stderr


def test_a_playbook_of_the_same_name_is_no_home() -> None:
    """Seen to fail without the look into the file: FLEET= was the folder of the playbooks."""
    done = flotilla("check-fleet", where=paths.PROJECT / "ansible")
    assert done.stdout.startswith("flotilla: "), done.stderr


def found(monkeypatch: pytest.MonkeyPatch, where: Path) -> str | None:
    """The home that a command in a directory is about."""
    monkeypatch.delenv("FLEET", raising=False)
    monkeypatch.chdir(where)
    program._find_home()
    return os.environ.get("FLEET")


def test_a_home_of_somebody_else_chooses_no_fleet(fleet_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as one in a common directory, above the one that a command runs in. Seen to fail without the comparison."""
    (fleet_home / "mine").mkdir()
    assert found(monkeypatch, fleet_home / "mine") == str(fleet_home)
    if os.geteuid() == 0:
        os.chown(fleet_home / "fleet.yml", 4242, 4242)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 4242)
    assert found(monkeypatch, fleet_home / "mine") is None


def test_the_tools_checkout_inside_a_home_is_the_example_fleet(
    fleet_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a submodule, for instance. Seen to fail: make in the checkout was about the home's robots."""
    checkout = fleet_home / "flotilla"
    checkout.mkdir()
    monkeypatch.setattr(program, "__file__", str(checkout / "flotilla/__main__.py"))
    assert found(monkeypatch, checkout) is None
    assert found(monkeypatch, fleet_home) == str(fleet_home)


def test_a_directory_that_is_no_home_is_refused(tmp_path: Path) -> None:
    done = flotilla("check-fleet", where=tmp_path, FLEET=str(tmp_path))
    assert done.returncode == 1
    assert f"error: FLEET={tmp_path}: has no fleet.yml; " in done.stderr
    assert f"make init FLEET={tmp_path}" in done.stderr


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("flotilla: 99.0.0\n", "flotilla: 99.0.0: this is version "),
        ("flotilla: newest\n", "fleet.yml:1: flotilla: newest: "),
        ("flotilla: 0.1.0\nbords: []\n", "fleet.yml:2: bords: "),
    ],
)
def test_a_home_of_another_version_is_refused(fleet_home: Path, content: str, error: str) -> None:
    (fleet_home / "fleet.yml").write_text(content)
    done = flotilla("check-fleet", where=fleet_home)
    assert done.returncode == 1
    assert error in done.stderr


@pytest.mark.parametrize("there", ["file", "empty", "full"])
def test_init_overwrites_nothing(tmp_path: Path, there: str) -> None:
    place = tmp_path / "lab"
    if there == "file":
        place.write_text("mine")
    else:
        place.mkdir()
    if there == "full":
        (place / "mine").write_text("mine")
    done = flotilla("init", str(place), where=tmp_path)
    assert done.returncode == (there != "empty"), done.stderr
    if there != "empty":
        assert f"error: {place}: is there already" in done.stderr
        assert (place if there == "file" else place / "mine").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["lab"]


def test_a_name_that_no_fleet_can_have_is_refused(tmp_path: Path) -> None:
    done = flotilla("init", "7", where=tmp_path)
    assert (done.returncode, list(tmp_path.iterdir())) == (1, [])
    assert "its name becomes the fleet's, which begins with a letter" in done.stderr


def test_a_new_home_has_all_its_files_by_git(fleet_home: Path) -> None:
    """A file that git ignores would be missing in a clone. Seen to fail with `/inventory/` in .gitignore."""
    subprocess.run(["git", "init", "-q", fleet_home], check=True)
    argv = ["git", "-C", str(fleet_home), "ls-files", "--others", "--exclude-standard"]
    listed = subprocess.run(argv, capture_output=True, text=True, check=True).stdout.split()
    there = [str(path.relative_to(fleet_home)) for path in fleet_home.rglob("*") if path.is_file()]
    assert sorted(listed) == sorted(path for path in there if not path.startswith(".git/"))


PROGRAM = f"""#!/bin/sh
PYTHONPATH={paths.PROJECT} exec {sys.executable} -m flotilla "$@"
"""


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["check-fleet"], 0, "rover-lab-2: 1 robot, 1 station"),
        ([], 0, "  image        build the card image of one robot\n"),
        (["help", "TARGET=flash"], 0, "example: make flash ROBOT=3 DEV=/dev/sdX\n"),
        (["image", "ROBT=1"], 2, "make image ROBT=…: there is no such variable; the nearest is ROBOT"),
        (["check-fleet", "image", "ROBOT=$HOME'\"`"], 2, "invalid int value: '$HOME\\'\"`'"),
        (["kernel", "BOARD=none"], 2, "none"),  # although the home may have a folder of this name
        (["imgae"], 2, "error: make imgae: there is no such target; the nearest is image"),
    ],
)
def test_make_in_a_home_hands_targets_to_the_installed_program(
    fleet_home: Path, tmp_path: Path, words: list[str], status: int, said: str
) -> None:
    """Without a checkout. Seen to fail with values that make expands, and with a folder `kernel` that is up to date."""
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "flotilla").write_text(PROGRAM)
    (programs / "flotilla").chmod(0o755)
    (fleet_home / "kernel").mkdir()
    ours = ("FLEET", "BUILD", "KEYS", "APPS", "INVENTORY")
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    environment = kept | {"PATH": f"{programs}:{kept['PATH']}"}
    done = subprocess.run(
        ["make", *words], cwd=fleet_home, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, said in done.stdout + done.stderr) == (status, True), done.stdout + done.stderr


def test_a_file_of_the_home_takes_the_place_of_the_tools(at_home: Path) -> None:
    name = PurePosixPath("etc/flotilla/irq-priorities")
    before = sources.layered(paths.OVERLAY)
    assert before[name] == paths.OVERLAY / name
    own = at_home / "overlay" / name
    own.parent.mkdir(parents=True)
    own.write_text("serial 61\n")
    (at_home / "overlay/etc/motd").write_text("welcome\n")
    after = sources.layered(paths.OVERLAY)
    assert {path: file for path, file in after.items() if before.get(path) != file} == {
        name: own, PurePosixPath("etc/motd"): at_home / "overlay/etc/motd",
    }  # fmt: skip
    assert identity.interrupt_priorities() == {"serial": 61}


def test_what_the_home_adds_is_an_input_of_the_root(at_home: Path, fleet: Fleet) -> None:
    """Seen to fail with the overlay of the tool alone in the key: the cache returned the root without the file."""
    board = fleet.boards[BOARD]
    locks = board_lock(board), read_lock("tools")
    before = rootfs.key(board, *locks), manifest.inputs_of_board(board, locks)
    (at_home / "overlay").mkdir()
    assert (rootfs.key(board, *locks), manifest.inputs_of_board(board, locks)) == before
    (at_home / "overlay/motd").write_text("welcome\n")
    after = rootfs.key(board, *locks), manifest.inputs_of_board(board, locks)
    assert not {*before} & {*after}


def test_the_home_has_locks_lists_and_kernels_of_its_own(at_home: Path) -> None:
    for folder in ("packages", "locks", "kernel"):
        (at_home / folder).mkdir()
    (at_home / "packages/x86_64.list").write_text("kernel linux-image-rt-amd64 # real time\nhtop # to look\n")
    assert [request.package for request in lock.read_list(BOARD)] == ["linux-image-rt-amd64", "htop"]
    assert lock.read_list("robot")
    text = (paths.LOCKS / "x86_64.lock").read_text()
    (at_home / "locks/x86_64.lock").write_text(text)
    assert lock.lock_file(BOARD) == at_home / "locks/x86_64.lock"
    assert lock.lock_file("tools") == paths.LOCKS / "tools.lock"
    assert lock.own_lock_file("tools") == at_home / "locks/tools.lock"
    shutil.copyfile(paths.KERNELS / "x86_64.yml", at_home / "kernel/rover.yml")
    assert {"rover", BOARD} <= {*kernel.names()}


def test_a_package_of_the_fleet_is_in_the_lock_of_each_board(at_home: Path, fleet: Fleet) -> None:
    """Seen to fail: a list with a further line changed nothing, and `make image` gave no reason."""
    board = fleet.boards[BOARD]
    tools = lock.board_lock(board)
    (at_home / "packages").mkdir()
    (at_home / "packages/fleet.list").write_text("htop # shows processes\n")
    recipe = lock.recipes([board])[BOARD]
    asked = {each.package for each in lock.requests(recipe) if not each.kernel}
    assert asked - {each.name for each in tools.packages} == {"htop"}
    remedy = f"fleet.list: htop: not in .*{BOARD}.lock yet; run `make lock ONLY={BOARD}`"
    with pytest.raises(UserError, match=remedy):
        lock.board_lock(board)
    (at_home / "locks").mkdir()
    line = "package htop 3.2.2-2 amd64 userland debian 1 " + 64 * "0" + " pool/main/h/htop/htop_3.2.2-2_amd64.deb\n"
    (at_home / f"locks/{BOARD}.lock").write_text((paths.LOCKS / f"{BOARD}.lock").read_text() + line)
    assert len(lock.board_lock(board).packages) == len(tools.packages) + 1


def test_a_board_of_the_home(fleet_home: Path) -> None:
    """A further computer: all its files are in the home, and what is missing is named there."""
    described = yaml.safe_load((paths.BOARDS / f"group_vars/board_{BOARD}.yml").read_text())
    (fleet_home / "inventory/group_vars/board_rover.yml").write_text(yaml.safe_dump(described))
    robots = fleet_home / "inventory/robots.yml"
    robots.write_text(robots.read_text().replace(f"board_{NEW}:", "board_rover:"))
    done = flotilla("check-fleet", where=fleet_home)
    assert done.returncode == 1
    assert f"has no package list {fleet_home}/packages/rover.list" in done.stderr
    (fleet_home / "packages").mkdir()
    shutil.copyfile(paths.PACKAGES / f"{BOARD}.list", fleet_home / "packages/rover.list")
    done = flotilla("check-fleet", where=fleet_home)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[1].split()[:3] == ["1", "robot1", "rover"]


def test_values_of_the_home_win_over_the_tools(fleet_home: Path) -> None:
    described = yaml.safe_load((paths.BOARDS / f"group_vars/board_{NEW}.yml").read_text())
    described["board"]["suite"] = "sid"
    file = fleet_home / f"inventory/group_vars/board_{NEW}.yml"
    file.write_text(yaml.safe_dump(described))
    done = flotilla("check-fleet", where=fleet_home)
    assert done.returncode == 1
    assert f"{file}:" in done.stderr
    assert "suite: sid" in done.stderr


def test_the_home_says_which_commit_its_images_are_of(at_home: Path) -> None:
    assert isinstance(manifest.of_home(), str)
    git = ["git", "-C", str(at_home), "-c", "user.name=t", "-c", "user.email=t@example.org"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-q", "-m", "home: begin"]):
        subprocess.run([*git, *words], check=True)
    made = manifest.of_home()
    assert isinstance(made, manifest.Source)
    assert not made.dirty
    (at_home / "control_tasks/second.yml").write_text("period: 10 ms\n")
    made = manifest.of_home()
    assert isinstance(made, manifest.Source)
    assert made.dirty


def test_the_tool_in_its_own_checkout_has_no_home() -> None:
    assert manifest.of_home() == ""
    assert sources.layers(paths.OVERLAY) == [paths.OVERLAY]
