"""Power cuts of an update as a whole robot makes it, in QEMU: recorded, and replayed."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flotilla.fleet.model import Fleet
from flotilla.lab.power_cuts import command, guest, scenario
from flotilla.lab.power_cuts.crash_states import CrashState, all_states
from flotilla.lab.power_cuts.replay import POWER_ONS, Recording, replay
from flotilla.lab.power_cuts.timeline import Timeline
from flotilla.lab.power_cuts.write_log import WriteLog
from flotilla.lab.qemu.saved import BOOT_SECONDS
from tests.boot.guests import PENTIUM, SECONDS, boot_state, sh
from tests.conftest import GuestFactory
from tests.figures import PROPERTY

BOOTS_OF_A_PHASE = 2
"""States without damage that Linux starts from; one with damage is added."""
BOOT_LOADER_STARTS = r"\x1b\[H\x1b\[J"
"""The boot loader clears the screen once."""
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


def faults_of_data(recording: Recording, directory: Path) -> Iterator[str]:
    """Of some states at random."""
    with WriteLog(recording.log) as log, Timeline(recording.base, log, recording.layout, {}) as timeline:
        states = guest.states_of_data(log, (state for state in states_of(recording) if not state.damage))
        chosen = sorted(random.Random(1).sample(states, DATA_STATES), key=lambda state: state.upto)
        yield from guest.faults_of_data(command.builder_tools(), timeline, chosen, recording.base, directory)


def test_data_is_sound_after_its_journal_is_replayed(recording: Recording, tmp_path: Path) -> None:
    """Seen to fail with a data partition that has no journal."""
    assert not list(faults_of_data(recording, tmp_path))


def test_data_without_flushes_is_not(recording: Recording, tmp_path: Path) -> None:
    """The negative control of the test above."""
    assert next(faults_of_data(scenario.without_flushes(recording), tmp_path), None)


def test_linux_comes_up_within_four_power_ons(recording: Recording, fresh_guest: GuestFactory, tmp_path: Path) -> None:
    """Some states at random through to SSH: of each phase of the update, and of a damaged boot state."""
    with (
        WriteLog(recording.log) as log,
        Timeline(recording.base, log, recording.layout, recording.releases) as timeline,
    ):
        for number, state in enumerate(chosen_to_boot(recording)):
            image = guest.card_of(timeline, state, recording.base, tmp_path / "card")
            allowed = [names for start, names in recording.phases if start <= state.upto][-1]
            robot = fresh_guest(PENTIUM, image=image, label=f"state{number}", boot=False)
            robot.machine.on()
            # Each start of the boot loader is a power-on: a panic starts the computer again by itself.
            one_more = rf"(?s:(?:{BOOT_LOADER_STARTS}.*?){{{POWER_ONS + 1}}})"
            found = robot.machine.console.expect(rf"{robot.robot.name} login: |{one_more}", POWER_ONS * BOOT_SECONDS)
            assert "login" in found[0], f"{state}: not up after {POWER_ONS} power-ons\n{found[0]}"
            robot.shell.connect()
            running = boot_state(robot)["running"]
            assert {"A": "old", "B": "new"}[running] in allowed, f"{state}: slot {running} runs"
            assert sh(robot, "findmnt -n -o OPTIONS /data").startswith("rw"), str(state)
            robot.machine.cut()


def chosen_to_boot(recording: Recording) -> list[CrashState]:
    """Of each phase some states, in one of which a part of the boot state is damaged; in their order."""
    states = [state for state in states_of(recording) if all(each.fill != "unreadable" for each in state.damage)]
    starts = [start for start, _ in recording.phases]
    chance = random.Random(2)
    chosen = []
    for start, end in itertools.pairwise([*starts, states[-1].upto + 1]):
        phase = [state for state in states if start <= state.upto < end]
        chosen += chance.sample([state for state in phase if not state.damage], BOOTS_OF_A_PHASE)
        chosen += chance.sample([state for state in phase if state.damage], 1)
    return sorted(chosen, key=lambda state: state.upto)
