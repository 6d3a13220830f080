"""Power cuts of an update as a whole robot makes it, in QEMU: recorded, and replayed."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.fleet.model import Fleet
from lab.power_cuts import command, guest
from lab.power_cuts.crash_states import CrashState, all_states
from lab.power_cuts.replay import Recording, replay
from lab.power_cuts.timeline import Timeline
from lab.power_cuts.write_log import WriteLog
from tests.boot.guests import PENTIUM, SECONDS, sh
from tests.conftest import GuestFactory
from tests.figures import PROPERTY

LINUX_BOOTS = 4
DATA_STATES = 200

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def grown(fleet: Fleet, module_guest: GuestFactory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Robot 3's card after its first start, which made the data partition as large as the card."""
    robot = module_guest(PENTIUM)
    sh(robot, "systemctl is-system-running --wait", check=False)
    sh(robot, "systemctl --no-block poweroff", check=False)
    robot.machine.wait_off(SECONDS)
    return guest.flattened(robot.machine, tmp_path_factory.mktemp("grown") / "card")


@pytest.fixture(scope="module")
def recording(grown: Path, module_guest: GuestFactory, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The update of that robot, every write of which is logged."""
    directory = tmp_path_factory.mktemp("recording")
    log = directory / "writes.log"
    robot = module_guest(PENTIUM, boot=False, image=grown, label="recorded", qemu_options={"log_writes": log})
    updated = guest.Updated(robot.machine, robot.shell, robot.wait_booted, grown, log)
    return updated.update(directory / "release")


def states_of(recording: Recording) -> list[CrashState]:
    with WriteLog(recording.log) as log:
        return list(all_states(log.entries, recording.layout.damaged, seed=1, per_cut=command.GUEST_PER_CUT))


def test_no_cut_bricks_or_starts_a_wrong_release(
    fleet: Fleet, recording: Recording, session_artefacts: Path, record_property: Callable[[str, object], None]
) -> None:
    verdict = replay(
        fleet.boards["smartcoret3"],
        recording,
        session_artefacts / "power-cuts-guest",
        per_cut=command.GUEST_PER_CUT,
        sample=command.GUEST_SAMPLE,
    )
    record_property(PROPERTY, f"power cuts of a guest: {verdict.states} states, {verdict.groups} groups")
    assert verdict.sound, command.describe("guest", verdict)
    assert verdict.states >= 15_000  # of this one update; test_power_cuts.py has 20,000 and more
    assert {"old in A", "new in B"} == set(verdict.started)


def test_data_is_made_good_from_its_journal(recording: Recording, tmp_path: Path) -> None:
    """Linux replays the journal when it mounts the partition."""
    states = [state for state in states_of(recording) if not state.damage]
    chosen = sorted(random.Random(1).sample(states, DATA_STATES), key=lambda state: state.upto)
    with WriteLog(recording.log) as log, Timeline(recording.base, log, recording.layout, {}) as timeline:
        assert not guest.check_data(command.builder_tools(), timeline, chosen, recording.base, tmp_path)


def test_linux_comes_up_as_the_boot_loader_says(
    recording: Recording, fresh_guest: GuestFactory, tmp_path: Path
) -> None:
    """Some states at random through to SSH, within as many power-ons as there are tries."""
    phases = [start for start, _ in recording.phases]
    states = [state for state in states_of(recording) if not state.damage]
    chosen = sorted(random.Random(2).sample(states, LINUX_BOOTS), key=lambda state: state.upto)
    chosen += [CrashState(phases[-1])]
    with (
        WriteLog(recording.log) as log,
        Timeline(recording.base, log, recording.layout, recording.releases) as timeline,
    ):
        for number, state in enumerate(chosen):
            image = guest.card_of(timeline, state, recording.base, tmp_path / "card")
            allowed = [names for start, names in recording.phases if start <= state.upto][-1]
            robot = fresh_guest(PENTIUM, image=image, label=f"state{number}")
            slot = json.loads(sh(robot, "flotilla-slot show"))["running"]
            assert {"A": "old", "B": "new"}[slot] in allowed, f"{state}: slot {slot} runs"
            assert sh(robot, "findmnt -n -o OPTIONS /data").startswith("rw"), str(state)
            robot.machine.cut()
