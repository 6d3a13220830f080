"""Recorder files of a robot, by a shell of this computer in the place of ssh."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Fleet, Robot
from flotilla.robot import fetch, ssh
from flotilla.station import convert
from tests.recorder_files import content, ring

Fetch = Callable[[], str]


@pytest.fixture
def robot(fleet: Fleet) -> Robot:
    return fleet.robots[1]


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The task's folder on the robot, with three files."""
    monkeypatch.setattr(fetch, "ROOTS", (str(tmp_path / "none"), str(tmp_path / "robot")))
    monkeypatch.setattr(ssh, "command", lambda _: ["sh", "-c"])
    ring(tmp_path / "robot" / "heading")
    return tmp_path / "robot" / "heading"


@pytest.fixture
def here(tmp_path: Path) -> Path:
    return tmp_path / "here"


@pytest.fixture
def bring(robot: Robot, there: Path, here: Path) -> Fetch:
    return lambda: fetch.fetch(robot, "heading", here)


def contents(place: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in place.iterdir()}


def cut(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, after: int) -> None:
    """From now on a connection breaks off after so many bytes of a file; lists come whole."""
    fake = tmp_path / "ssh"
    fake.write_text(
        f'#!/bin/sh\ncase "$1" in *"for file in"*) exec sh -c "$1";; esac\nsh -c "$1" | head -c {after}\n'
        "echo lost >&2; exit 255\n"
    )
    fake.chmod(0o755)
    monkeypatch.setattr(ssh, "command", lambda _: [str(fake)])


def test_files_come_once_and_what_has_grown_comes_alone(bring: Fetch, there: Path, here: Path) -> None:
    assert bring().startswith("robot1: 3 files fetched, 14.7 KiB; 0 were there already")
    assert contents(here) == contents(there)
    before = (here / "log-000001.rec").stat()
    last = there / "log-000003.rec"
    grown = content([(step, 0, True, 0) for step in range(50)], first=300)
    with last.open("ab") as file:
        file.write(grown[-50 * 45 :])
    (there / "log-000004.rec").write_bytes(grown)
    (there / "log-000005.rec").touch()
    (there / "note.txt").write_text("no recording")
    more = 50 * 45 + len(grown)
    assert f"2 files fetched, {more / 1024:.1f} KiB; 2 were there already" in bring()
    assert (here / "log-000001.rec").stat() == before
    assert sorted(contents(here)) == [f"log-{number:06}.rec" for number in (1, 2, 3, 4)]
    assert (here / "log-000003.rec").read_bytes() == last.read_bytes()
    assert "0 files fetched, 0 B; 4 were there already" in bring()


def test_the_robots_own_removal_removes_nothing_here(bring: Fetch, there: Path, here: Path) -> None:
    bring()
    (there / "log-000001.rec").unlink()
    assert "0 files fetched" in bring()
    assert len(contents(here)) == 3


def test_a_fetch_that_broke_off_goes_on(
    bring: Fetch, there: Path, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to fail with the name of the whole file for the half one."""
    cut(monkeypatch, tmp_path, 2000)
    with pytest.raises(UserError, match="robot1 did not answer: lost"):
        bring()
    assert list(contents(here)) == ["log-000001.rec.part"]
    assert (here / "log-000001.rec.part").stat().st_size == 2000
    monkeypatch.setattr(ssh, "command", lambda _: ["sh", "-c"])
    (here / "log-000002.rec.part").write_bytes((there / "log-000002.rec").read_bytes())  # just before it was renamed
    whole = sum(len(each) for name, each in contents(there).items() if name != "log-000002.rec")
    assert f"2 files fetched, {(whole - 2000) / 1024:.1f} KiB; 1 were there already" in bring()
    assert contents(here) == contents(there)


def test_half_of_another_file_is_begun_anew(
    bring: Fetch, there: Path, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(monkeypatch, tmp_path, 2000)
    with pytest.raises(UserError):
        bring()
    monkeypatch.setattr(ssh, "command", lambda _: ["sh", "-c"])
    ring(there, wall_ns=1)
    bring()
    assert contents(here) == contents(there)


def test_another_recording_of_the_same_name_is_kept(bring: Fetch, there: Path, here: Path) -> None:
    """It has the same size. Seen to fail without a look at the header: the new one is taken for the old."""
    bring()
    before = contents(here)
    ring(there, wall_ns=1_777_777_777_777_777_777)
    with pytest.raises(UserError, match=r"here/log-000001\.rec: is another recording .* name another place: OUT="):
        bring()
    assert contents(here) == before


def test_a_file_that_the_ring_removed_meanwhile_is_named(
    bring: Fetch, there: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = fetch._listed

    def then_remove(robot: Robot, task: str) -> list[fetch._Remote]:
        found = listed(robot, task)
        (there / "log-000001.rec").unlink()
        return found

    monkeypatch.setattr(fetch, "_listed", then_remove)
    said = bring()
    assert "robot1: log-000001.rec: the recorder has removed it meanwhile" in said
    assert "robot1: 2 files fetched" in said
    assert (here / "log-000003.rec").exists()


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        ("hover", "robot1: hover has recorded nothing: no *.rec in "),
        ("../heading", "TASK=../heading: is no name of a task; make top ASK=1 shows"),
        ("a; rm -r x", "TASK=a; rm -r x: is no name of a task"),
    ],
)
def test_a_task_that_recorded_nothing_is_named(robot: Robot, there: Path, here: Path, task: str, reason: str) -> None:
    with pytest.raises(UserError, match=re.escape(reason)):
        fetch.fetch(robot, task, here)
    assert not here.exists()


def test_what_cannot_be_written_is_named(bring: Fetch, here: Path) -> None:
    here.write_text("no folder")
    with pytest.raises(UserError, match=r"here/log-000001\.rec: .*; make room, or name another place: OUT="):
        bring()


def test_files_go_where_convert_finds_whose_they_are(
    robot: Robot, there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paths, "BUILD", tmp_path / "build")
    fetch.fetch(robot, "heading")
    place = tmp_path / "build" / "recordings" / "robot1" / "heading"
    assert contents(place) == contents(there)
    assert convert.convert([place], tmp_path / "run.csv")[1].startswith("/log: 300 records of 3 files")
