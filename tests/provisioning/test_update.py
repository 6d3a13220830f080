"""Releases over the air, on a guest of the shipped image: one that does well stays, others go back by themselves.

Releases differ by their header here, and so by their boot arguments: they are made in no time, and bad in any way.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from images.builder import build, bundle
from tests.provisioning.test_fleet import Guests, Playbook, running

ROBOT = 1
"""It has a control task."""
NAME = f"robot{ROBOT}"
MEMORY_KIB = 16 << 10
STOP = ("-e", "stop_tasks=true", "-e", "settle_s=2")

Make = Callable[..., Path]


@pytest.fixture(scope="module")
def guests(fleet: Fleet, session_artefacts: Path) -> Iterator[Guests]:
    with running(fleet, [inventory.robot(fleet, ROBOT)], session_artefacts / "update") as guests:
        yield guests


@pytest.fixture(scope="module")
def make(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """`make(2, replaced, by)`: the bundle of a release 2, with another word in the place of one boot argument."""
    made = build.board_build(fleet.boards[inventory.robot(fleet, ROBOT).board], fleet.releases)

    def make(number: int, replaced: str = "", by: str = "") -> Path:
        directory = tmp_path_factory.mktemp("release")
        os.link(made.slot / "slot.img", directory / "slot.img")
        header = json.loads((made.slot / "header.json").read_text()) | {"RELEASE": str(number)}
        assert replaced in header["ARGUMENTS"].split() or not replaced
        header["ARGUMENTS"] = " ".join(by if word == replaced else word for word in header["ARGUMENTS"].split())
        (directory / "header.json").write_text(json.dumps(header))
        bundle.pack(directory / "release.bundle", directory, fleet.releases, {}, 0)
        return directory / "release.bundle"

    return make


def state(guests: Guests) -> dict[str, Any]:
    shown: dict[str, Any] = json.loads(guests.sudo(NAME, "flotilla-slot show"))
    return shown


def runs(guests: Guests) -> tuple[str, str]:
    """Slot and release."""
    now = state(guests)
    return now["running"], now["slots"][now["running"]]["release"]


def update(guests: Guests, release: Path, *more: str) -> Playbook:
    return guests.play("-e", f"bundle={release}", *more, playbook="update")


def test_a_release_is_brought_tried_and_kept(guests: Guests, make: Make) -> None:
    """With the word of the station, and back again when told so."""
    release = make(2)
    staged = update(guests, release, "--tags", "stage")
    assert staged.status == 0, staged.said
    told = json.loads(guests.sudo(NAME, "/usr/lib/flotilla/update.py finish"))
    assert (told["staged"], told["missing"]) == (True, [])
    assert told["memory_kib"] <= MEMORY_KIB, f"the updater took {told['memory_kib']} KiB"
    assert runs(guests) == ("A", "1")

    refused = update(guests, release)
    assert refused.status != 0
    assert "runs flotilla-task@" in refused.said
    assert (runs(guests), state(guests)["trial"]) == (("A", "1"), None)

    guests.sudo(NAME, "echo kept >/etc/of-release-1")
    done = update(guests, release, *STOP)
    assert done.status == 0, done.said
    now = state(guests)
    assert (runs(guests), now["trial"], now["order"]) == (("B", "2"), None, ["B", "A"])
    again = update(guests, release, *STOP)
    assert (again.status, runs(guests)) == (0, ("B", "2")), again.said
    back = guests.play("-e", "go=back", *STOP, playbook="update")
    assert (back.status, runs(guests), state(guests)["order"]) == (0, ("A", "1"), ["A", "B"]), back.said


def test_a_release_that_does_not_start_goes_back(guests: Guests, make: Make) -> None:
    """Its first program is not there, so the kernel panics. What it changed below /etc is gone with it."""
    before = runs(guests)
    done = update(guests, make(3, "init=/usr/lib/flotilla/preinit", "init=/nonexistent"), *STOP)
    assert done.status != 0
    assert "the other one did not start" in done.said, done.said
    assert runs(guests) == before
    assert state(guests)["trial"] is None


def test_a_release_that_nobody_reaches_goes_back(guests: Guests, make: Make) -> None:
    """It has no driver of its network, so nobody can tell it so."""
    before = runs(guests)
    arguments = "module_blacklist=e100 flotilla.trial_s=10"
    done = update(guests, make(4, "quiet", f"quiet {arguments}"), *STOP)
    assert done.status != 0
    assert "the other one did not start" in done.said, done.said
    assert runs(guests) == before
    assert state(guests)["slots"]["A" if before[0] == "B" else "B"]["ok"] is False
    back = guests.play("-e", "go=back", *STOP, playbook="update")
    assert back.status != 0
    assert "there is nothing to go back to" in back.said, back.said
