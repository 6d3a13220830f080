"""A release that is bad, and a station that says nothing: the robot is back with its former release by itself.

In virtual time, which the host's load does not stretch. The release is on the card already, on trial for the next
start; how it comes there, and what the station makes of it, is in tests/provisioning/test_update.py.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.images import build, card, environment_block
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.guest import Guest
from tests.figures import PROPERTY
from tests.releases import Content, successor

ROBOT = 4
BACK_S = 15 * 60
"""Of the robot's time: from power on with the bad release until the former one has started, and says so."""
TRIAL_S = 10 * 60
DAY_S = 24 * 60 * 60
"""Where virtual time may jump to: while the watchdog resets an idle guest, only the battery clock's own timer is due,
at midnight."""
WATCHDOG_S = 30
"""Until it bites after it was fed last; the IB700 has no more."""
SECONDS = 900
"""Of the host's, for either start."""
STARTED = r"Reached target .*multi-user"
"""On the console, behind flotilla-mark-good: the running slot has started, and the boot state says so."""


@pytest.fixture(scope="module")
def content(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Content:
    made = build.board_build(fleet.boards[inventory.robot(fleet, ROBOT).board], fleet.releases)
    return successor(made, fleet.releases, tmp_path_factory.mktemp("content"))


def card_with(fleet: Fleet, bad: Content, to: Path) -> Path:
    """The robot's card with a release on trial in slot B. Slot A's tells the console what it starts."""
    image = build.image_of(inventory.robot(fleet, ROBOT))
    subprocess.run(["cp", "--sparse=always", str(image), str(to)], check=True)
    a, b = card.SLOTS
    with to.open("r+b") as file:
        file.seek(a.end - card.HEADER_ROOM)
        present = environment_block.values(file.read(card.HEADER_BYTES))
        words = [word for word in present["ARGUMENTS"].split() if word != "quiet"]
        for place, header in ((a, present | {"ARGUMENTS": " ".join(words)}), (b, bad.header)):
            file.seek(place.end - card.HEADER_ROOM)
            file.write(environment_block.make(header, card.HEADER_BYTES))
        file.seek(b.start)
        file.write((bad.directory / "slot.img").read_bytes())
        for copy in card.COPIES:
            file.seek(card.STATE.start + copy)
            file.write(card.state_copy(2, good="A", trial="B"))
    return to


@pytest.mark.parametrize(
    ("fault", "sign", "bites"),
    [
        ("panic", "Kernel panic", False),
        pytest.param("hang before systemd", "", True, marks=pytest.mark.nightly),
        # systemd freezes: it lets go of the watchdog, which it has fed until then, and says so to nobody.
        pytest.param("service manager hangs", "WDT device closed unexpectedly", True, marks=pytest.mark.nightly),
        pytest.param("", "login: ", False, id="nobody-confirms", marks=pytest.mark.nightly),
    ],
)
def test_the_former_release_is_back_by_itself(
    fault: str, sign: str, bites: bool, fleet: Fleet, content: Content, flotilla_slot: Path, artefacts: Path,
    tmp_path: Path, record_property: Callable[[str, object], None],
) -> None:  # fmt: skip
    (tmp_path / "bad").mkdir()
    image = card_with(fleet, content.release(2, tmp_path / "bad", fault), tmp_path / "card")
    robot = inventory.robot(fleet, ROBOT)
    options = qemu.Options(name=robot.name, virtual_time=True, watchdog="reset")
    with Guest(fleet.boards[robot.board], image, artefacts / "guest", options) as guest:
        guest.on()
        if sign:
            guest.console.expect(sign, SECONDS)
        seen = qemu.virtual_s(guest.execute)
        if bites:
            guest.wait_event("WATCHDOG", SECONDS)
        tried = qemu.virtual_s(guest.execute)
        guest.console.expect(STARTED, SECONDS)
        taken = qemu.virtual_s(guest.execute)
        if taken > DAY_S:
            assert bites, taken
            tried = seen + WATCHDOG_S
            taken = tried + taken % DAY_S
        guest.cut()
        after, overlay = tmp_path / "after", guest.directory / "card.qcow2"
        subprocess.run([qemu.find_tool("qemu-img"), "convert", "-O", "raw", str(overlay), str(after)], check=True)
    record_property(PROPERTY, f"{fault or 'nobody confirms'}: {tried:.0f} s to the fault, back after {taken:.0f} s")
    state = shown(flotilla_slot, after)
    assert (state["order"], state["trial"], state["slots"]["B"]["ok"]) == (["A", "B"], None, False), state
    assert taken < BACK_S
    assert fault or taken > TRIAL_S, "the station was not waited for"


def shown(program: Path, image: Path) -> dict[str, Any]:
    """What the card's boot state says."""
    said = subprocess.run([program, "--disk", image, "--running", "A", "show"], capture_output=True, check=True)
    state: dict[str, Any] = json.loads(said.stdout)
    return state
