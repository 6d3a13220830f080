"""The one sender of a station: who may command a robot, and what leaves for it, by a clock that the tests turn."""

from __future__ import annotations

import hmac
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import message_keys
from flotilla.fleet.model import Fleet
from flotilla.lab.wheeled import by_wires
from flotilla.station import driving
from flotilla.station.driving import Driving, HeldError, Motion, Operator, Refused

ANNA, BEN = Operator("anna-1", "Anna"), Operator("ben-1", "Ben")
ROVER = "rover"
AHEAD, REST = Motion(0.3, 0.2, 0.1, True), Motion(0, 0, 0, True)


@dataclass
class Bench:
    """A sender, its time in s, and what left: time, number, sequence and motion."""

    locks: Path
    fleet: Fleet
    now_s: float = 100.0
    sent: list[tuple[float, int, int, Motion]] = field(default_factory=list)
    datagrams: list[bytes] = field(default_factory=list)
    lost: OSError | None = None

    def __post_init__(self) -> None:
        self.driving = Driving(self.fleet, clock=lambda: self.now_s, send=self._take, locks=self.locks)

    def _take(self, datagram: bytes, to: tuple[str, int]) -> None:
        assert to == ("10.43.0.1", 5030)
        if self.lost:
            raise self.lost
        number, sequence, v, omega, boom, enable = driving.COMMAND.unpack(datagram[: driving.COMMAND.size])
        self.datagrams.append(datagram)
        self.sent.append((self.now_s, number, sequence, Motion(v, omega, boom, enable)))

    def passes(self, seconds: float, operator: Operator | None = None, motion: Motion = REST) -> None:
        """In steps of 10 ms, a tick each tenth of a second; an operator gives its input in each step."""
        for _ in range(round(seconds * 100)):
            self.now_s = round(self.now_s + 0.01, 2)
            if operator:
                self.driving.drive(ROVER, operator.id, motion.v, motion.omega, motion.boom, motion.enable)
            if round(self.now_s * 100) % 10 == 0:
                self.driving.tick()

    def motions(self) -> list[Motion]:
        return [motion for *_, motion in self.sent]


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return by_wires.fleet()


@pytest.fixture
def bench(tmp_path: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    message_keys.write_secret(bytes(32))
    bench = Bench(tmp_path / "run", fleet)
    yield bench
    bench.driving.close()


def test_the_newest_input_leaves_ten_times_a_second(bench: Bench) -> None:
    """Whatever the rate of inputs. Seen to fail with a sender that sends each input."""
    bench.driving.take(ROVER, ANNA)
    for _ in range(10):
        for index in range(1000):
            bench.driving.drive(ROVER, ANNA.id, 0.1 + index / 10_000, 0, 0, True)
        bench.passes(0.1)
    assert [sequence for _, _, sequence, _ in bench.sent] == list(range(1, 11))
    assert {motion.v for motion in bench.motions()} == {0.1 + 999 / 10_000}
    assert len({number for _, number, *_ in bench.sent} - {0}) == 1


def test_an_old_input_moves_nothing(bench: Bench) -> None:
    """The dead man's switch of the sender: a page that hangs, a lid that is closed. The boom stays, the motors stay on.
    Seen to fail with `_due` that knows no age."""
    bench.driving.take(ROVER, ANNA)
    bench.passes(0.5, ANNA, AHEAD)
    assert bench.motions() == [AHEAD] * 5
    bench.passes(1)
    assert bench.motions()[5:] == [AHEAD] * 3 + [AHEAD.resting] * 7
    assert bench.driving.state(ROVER).note == "no fresh input: at rest"
    bench.passes(0.1, ANNA, AHEAD)
    assert bench.motions()[-1] == AHEAD


def test_a_silent_holder_is_dropped(bench: Bench) -> None:
    """Then nothing is sent, and others may take the robot. Seen to fail with a limit of a minute."""
    bench.driving.take(ROVER, ANNA)
    bench.passes(0.5, ANNA, AHEAD)
    bench.passes(driving.SILENT_S + 0.2)
    count = len(bench.sent)
    bench.passes(1)
    assert len(bench.sent) == count
    assert bench.motions()[-1] == AHEAD.resting
    state = bench.driving.state(ROVER)
    assert (state.holder, state.sending, state.note) == (None, None, "Anna was silent for 5 s and lost control")
    with pytest.raises(Refused, match="nobody commands it: Anna was silent for 5 s"):
        bench.driving.drive(ROVER, ANNA.id, 0.3, 0, 0, True)
    bench.driving.take(ROVER, BEN)


def test_who_never_gave_an_input_is_dropped_too(bench: Bench) -> None:
    bench.driving.take(ROVER, ANNA)
    bench.passes(driving.SILENT_S + 0.2)
    assert bench.driving.state(ROVER).holder is None
    assert bench.sent == []


def test_one_operator_holds_it(bench: Bench) -> None:
    """Seen to fail with `take` that replaces the holder, and with inputs of anybody."""
    bench.driving.take(ROVER, ANNA)
    with pytest.raises(HeldError, match="rover: Anna commands it") as refused:
        bench.driving.take(ROVER, BEN)
    assert (refused.value.robot, refused.value.holder) == (ROVER, "Anna")
    acts: list[Callable[[], None]] = [
        lambda: bench.driving.drive(ROVER, BEN.id, 0.5, 0, 0, True),
        lambda: bench.driving.release(ROVER, BEN.id),
        lambda: bench.driving.offer(ROVER, BEN.id, BEN),
    ]
    for act in acts:
        with pytest.raises(HeldError, match="rover: Anna commands it"):
            act()
    bench.driving.take(ROVER, ANNA)  # it goes on
    bench.passes(0.2)
    assert bench.sent == []


def test_a_handover_takes_both(bench: Bench) -> None:
    """Until Ben accepts, Anna commands; then nothing moves until his input, which leaves under another number once the
    robot has forgotten hers. Seen to fail with a hold that keeps its input, and with one that sends at once."""
    bench.driving.take(ROVER, ANNA)
    bench.passes(0.5, ANNA, AHEAD)
    with pytest.raises(Refused, match="not offered to ben-1: Anna commands it"):
        bench.driving.accept(ROVER, BEN.id)
    bench.driving.offer(ROVER, ANNA.id, BEN)
    bench.passes(0.5, ANNA, AHEAD)
    assert bench.driving.state(ROVER).offered == BEN
    with pytest.raises(Refused, match="not offered to anna-1"):
        bench.driving.accept(ROVER, ANNA.id)
    bench.driving.accept(ROVER, BEN.id)
    handed_s, hers = bench.now_s, bench.sent[-1]
    assert hers[3] == AHEAD.resting
    with pytest.raises(HeldError, match="Ben commands it"):
        bench.driving.drive(ROVER, ANNA.id, 0.3, 0, 0, True)
    bench.passes(3)
    assert bench.sent[-1] == hers
    assert bench.driving.state(ROVER).note == "waits for the first input"
    bench.passes(0.5, BEN, AHEAD)
    his = [each for each in bench.sent if each[0] > handed_s]
    assert {number for _, number, *_ in his} == {bench.driving.state(ROVER).number}
    assert hers[1] != his[0][1]
    assert [sequence for _, _, sequence, _ in his] == [1, 2, 3, 4, 5]
    bench.driving.offer(ROVER, BEN.id, ANNA)
    bench.driving.offer(ROVER, BEN.id, None)
    with pytest.raises(Refused, match="not offered to anna-1"):
        bench.driving.accept(ROVER, ANNA.id)
    bench.driving.offer(ROVER, BEN.id, ANNA)
    bench.driving.accept(ROVER, ANNA.id)
    bench.passes(3, ANNA, AHEAD)
    again = [each for each in bench.sent if each[1] == bench.driving.state(ROVER).number]
    his_last = [each for each in bench.sent if each[1] == his[0][1]][-1]
    assert again[0][0] - his_last[0] >= driving.APART_S - 1e-9
    assert again[0][0] - his_last[0] < driving.APART_S + 0.11
    with pytest.raises(Refused, match="Anna commands it already"):
        bench.driving.offer(ROVER, ANNA.id, ANNA)


def test_a_release_stops_at_once(bench: Bench) -> None:
    bench.driving.take(ROVER, ANNA)
    bench.passes(0.5, ANNA, AHEAD)
    bench.driving.release(ROVER, ANNA.id)
    assert bench.motions() == [AHEAD] * 5 + [AHEAD.resting]
    bench.passes(1)
    assert len(bench.sent) == 6
    with pytest.raises(Refused, match="nobody commands it; take it"):
        bench.driving.release(ROVER, ANNA.id)


def test_a_stop_switches_motors_off_at_once_whoever_commands(bench: Bench) -> None:
    """By the holder's number, which the robot obeys already; again and again, until somebody takes the robot. Seen to
    fail with a release: nothing was sent where nobody here held it, and motors stayed on."""
    off = Motion(0, 0, 0, False)
    bench.driving.stop(ROVER)
    assert bench.motions() == [off], "nobody held it here; another program may"
    bench.passes(0.5)
    assert bench.motions() == [off] * 6
    bench.driving.take(ROVER, ANNA)
    bench.passes(driving.APART_S + 0.5, ANNA, AHEAD)
    assert bench.motions()[-1] == AHEAD
    _, number, sequence, _ = bench.sent[-1]
    bench.driving.stop(ROVER)
    assert bench.sent[-1][1:3] == (number, sequence + 1)
    assert bench.motions()[-1] == Motion(0, 0, AHEAD.boom, False)
    assert bench.driving.state(ROVER).holder is None
    bench.passes(driving.STOP_S + 1)
    count = len(bench.sent)
    bench.passes(1)
    assert len(bench.sent) == count


def test_the_end_of_the_program_stops_it(bench: Bench) -> None:
    bench.driving.take(ROVER, ANNA)
    bench.passes(0.5, ANNA, AHEAD)
    bench.driving.close()
    assert bench.motions()[-1] == AHEAD.resting
    assert bench.driving.state(ROVER).holder is None


@pytest.mark.parametrize(
    "change",
    [{"v": math.nan}, {"omega": math.inf}, {"boom": -math.inf}, {"v": "1"}, {"v": True}, {"omega": None},
     {"enable": 1}],
    ids=str,
)  # fmt: skip
def test_what_is_no_number_is_refused(bench: Bench, change: dict[str, Any]) -> None:
    """And the input before it stays. A datagram with it would be the robot's to judge."""
    bench.driving.take(ROVER, ANNA)
    bench.passes(0.1, ANNA, AHEAD)
    values: dict[str, Any] = {"v": 0.1, "omega": 0.0, "boom": 0.0, "enable": True} | change
    (name,) = change
    with pytest.raises(Refused, match=f"rover: {name}: .* give one"):
        bench.driving.drive(ROVER, ANNA.id, **values)
    bench.passes(0.1)
    assert bench.motions() == [AHEAD] * 2


def test_inputs_are_clipped_to_the_robots_limits(bench: Bench) -> None:
    """Those of drive.yml: it does not go back."""
    bench.driving.take(ROVER, ANNA)
    for v, omega, boom in ((9, 9, 9), (-9, -9, -9)):
        bench.driving.drive(ROVER, ANNA.id, v, omega, boom, True)
        bench.passes(0.1)
    assert bench.motions() == [Motion(0.5, 1.5, 0.5, True), Motion(0, -1.5, 0, True)]


def test_a_datagram_that_cannot_be_sent_is_shown(bench: Bench) -> None:
    bench.driving.take(ROVER, ANNA)
    bench.lost = OSError(101, "Network is unreachable")
    bench.passes(0.2, ANNA, AHEAD)
    assert bench.driving.state(ROVER).error == "10.43.0.1: Network is unreachable"
    bench.lost = None
    bench.passes(0.2, ANNA, AHEAD)
    assert bench.driving.state(ROVER).error == ""
    assert [sequence for _, _, sequence, _ in bench.sent] == [3, 4]


def test_sequence_numbers_begin_again_after_the_largest(bench: Bench) -> None:
    bench.driving.take(ROVER, ANNA)
    hold = bench.driving._channels[ROVER].hold
    assert hold
    hold.sequence = 2**32 - 2
    bench.passes(0.3, ANNA, AHEAD)
    assert [sequence for _, _, sequence, _ in bench.sent] == [2**32 - 1, 0, 1]


def test_one_program_of_a_computer_sends_to_a_robot(bench: Bench, fleet: Fleet) -> None:
    """Two of them, as two processes are: the kernel keeps the locks of open files apart. Seen to fail without flock."""
    bench.driving.take(ROVER, ANNA)
    other = Bench(bench.locks, fleet)
    with pytest.raises(HeldError, match=r"Anna \(process \d+\) commands it; end that program"):
        other.driving.take(ROVER, BEN)
    bench.driving.offer(ROVER, ANNA.id, Operator("eve-1", "Eve"))
    bench.driving.accept(ROVER, "eve-1")
    with pytest.raises(HeldError, match=r"Eve \(process \d+\)"):
        other.driving.take(ROVER, BEN)
    bench.driving.release(ROVER, "eve-1")
    other.driving.take(ROVER, BEN)
    other.driving.close()


def test_robots_that_cannot_be_driven_are_refused(bench: Bench) -> None:
    assert [each.robot for each in bench.driving.vehicles] == [ROVER]
    with pytest.raises(UserError, match="rove: is no robot that can be driven; did you mean rover"):
        bench.driving.take("rove", ANNA)
    assert [state.robot for state in bench.driving.states] == [ROVER]


def test_without_the_fleets_secret_nobody_can_hold_it(bench: Bench) -> None:
    message_keys.secret_file().unlink()
    with pytest.raises(UserError, match=r"fleet_secret: is missing, so rover would take no command; .*KEYS="):
        bench.driving.take(ROVER, ANNA)
    assert bench.driving.state(ROVER).holder is None


def test_a_computer_that_is_no_station_is_refused(bench: Bench, fleet: Fleet) -> None:
    other = Driving(fleet, "127.0.0.1", send=lambda *_: None, locks=bench.locks)
    with pytest.raises(UserError, match=r"127\.0\.0\.1: is no station's; rover obeys station 10\.43\.0\.254"):
        other.take(ROVER, ANNA)


@pytest.mark.parametrize("address", ["10.43.0.1", "10.43.0.2"])
def test_a_challenge_of_the_robot_is_met(bench: Bench, address: str) -> None:
    """By the next command; what another computer sends is not looked at."""

    def answer() -> int:
        return int.from_bytes(bench.datagrams[-1][driving.COMMAND.size :][16:24], "little")

    bench.driving.take(ROVER, ANNA)
    bench.passes(0.1, ANNA, AHEAD)
    session, counter = bench.datagrams[-1][driving.COMMAND.size :][:8], (1).to_bytes(8, "little")
    numbers = session + counter + (4711).to_bytes(8, "little")
    key = bytes.fromhex(message_keys.read().between(bench.fleet.stations[0], bench.fleet.robots[1]))
    tag = hmac.digest(key, b"C" + (5030).to_bytes(2, "little") + numbers, "sha256")[:16]
    assert answer() == 0
    bench.driving.hear(numbers + tag, address)
    bench.passes(0.1, ANNA, AHEAD)
    assert answer() == (4711 if address == "10.43.0.1" else 0)
