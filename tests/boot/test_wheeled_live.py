"""The wheeled robot's shipped image in real time, in a room: a station on this computer drives it, and its own tasks,
its drives and its scanner do the rest. How fast that goes depends on the host, so only what comes of it is judged.

One robot for all tests: each begins where the one before left it, and leaves it at rest.
"""

from __future__ import annotations

import math
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from flotilla.lab.qemu.timing import Deadline
from flotilla.lab.wheeled import live
from flotilla.lab.wheeled.live import Live
from flotilla.station import driving, receiver, station_keys, telemetry
from flotilla.station.authentication import Signer
from flotilla.station.driving import RATE_HZ, Driving

# Each time, test_station_page.py drives the same robot, and test_wheeled_virtual.py in exact time.
pytestmark = pytest.mark.nightly

PATIENCE_S = 300
"""Until something comes of a command; only finite."""
ME = driving.Operator("test", "test")
ANSWER_S = 0.1
"""For the robot to answer a command, which it does not."""
MARGIN_M = 0.11
"""Before a wall, where it stops by the manual."""


class Operator:
    """Gives the station's sender the same input until told otherwise."""

    def __init__(self, there: Live, locks: Path) -> None:
        """Its commands are proved by the keys that the robot's card was made with."""
        self._driving = Driving(there.fleet, there.station_address, locks=locks)
        self._says: dict[str, Any] | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self._driving.take("rover", ME)
        self._thread.start()

    def say(self, v: float = 0, omega: float = 0, boom: float = 0, *, enable: bool = True) -> None:
        self._says = {"v": v, "omega": omega, "boom": boom, "enable": enable}

    def silence(self) -> None:
        self._says = None

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self._driving.close()

    def _send(self) -> None:
        while not self._end.wait(1 / RATE_HZ):
            if self._says:
                self._driving.drive("rover", ME.id, **self._says)
                self._driving.tick()


@pytest.fixture(scope="module")
def there(session_artefacts: Path) -> Iterator[Live]:
    with live.robots(1, "corner", session_artefacts / "wheeled-live") as there:
        yield there


@pytest.fixture(scope="module")
def operator(there: Live, session_artefacts: Path) -> Iterator[Operator]:
    """The motors are on."""
    operator = Operator(there, session_artefacts)
    try:
        operator.say(enable=False)
        there.until(lambda: there.report()["command"], PATIENCE_S, "a command arrives")
        operator.say()
        there.until(lambda: all(there.report()[name] for name in MOTORS), PATIENCE_S, "the motors are on")
        yield operator
    finally:
        operator.close()


MOTORS = ("left", "right", "boom_enabled")


def wait_at_rest(there: Live) -> None:
    """Until it has not moved for a second of its own."""
    since, pose = there.report()["step"], there.truth()["pose"]

    def rested() -> bool:
        nonlocal since, pose
        if there.truth()["pose"] != pytest.approx(pose, abs=0.002):
            since, pose = there.report()["step"], there.truth()["pose"]
        return bool(there.report()["step"] > since + 100)

    there.until(rested, PATIENCE_S, "it is at rest")


def test_it_goes_where_it_is_told_and_reports_it(there: Live, operator: Operator) -> None:
    operator.say(0.3, 0)
    there.until(lambda: there.truth()["pose"][0] > 0.5, PATIENCE_S, "it goes ahead")
    operator.say(0, 0.5)
    there.until(lambda: there.truth()["pose"][2] > 0.5, PATIENCE_S, "it turns to the left")
    operator.say(0, -0.5)
    there.until(lambda: there.truth()["pose"][2] < 0.1, PATIENCE_S, "it turns to the right")
    operator.say()
    wait_at_rest(there)
    assert there.report()["alive"]
    assert there.report()["pose"] == pytest.approx(there.truth()["pose"], abs=0.05), "its odometry is wrong"


def test_without_commands_it_stops_and_goes_on_with_the_next(there: Live, operator: Operator) -> None:
    operator.say(0, 0.5)
    there.until(lambda: there.truth()["motion"][1] > 0.4, PATIENCE_S, "it turns")
    operator.silence()
    there.until(lambda: not there.report()["alive"], PATIENCE_S, "it misses its operator")
    wait_at_rest(there)
    operator.say(0, -0.5)
    there.until(lambda: there.truth()["motion"][1] < -0.4, PATIENCE_S, "it goes on")
    there.until(lambda: abs(there.truth()["pose"][2]) < 0.1, PATIENCE_S, "it looks ahead")
    operator.say()
    wait_at_rest(there)


def test_who_has_no_key_does_not_move_it(there: Live, operator: Operator) -> None:
    """From the station's address: commands without a proof, and by another key. They neither move it nor disturb its
    operator. Seen to fail with the station's key."""
    operator.say()
    wait_at_rest(there)
    heard, before = there.report()["command"], there.truth()["pose"]
    signer = Signer("17" * 32, there.robots[0].command_address[1])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.settimeout(ANSWER_S)
        for sequence in range(40):
            command = driving.COMMAND.pack(4711, sequence + 1, 0, 1.0, 0, True)
            for datagram in (command, signer.sign(command), command + bytes(40)):
                stranger.sendto(datagram, there.robots[0].command_address)
            with suppress(TimeoutError):
                signer.challenged(stranger.recv(100))
            report = there.report()
            assert (report["conflict"], report["other"]) == (False, 0), report
    there.until(lambda: there.report()["command"] > heard + 5, PATIENCE_S, "it hears its operator")
    assert there.report()["alive"]
    assert there.truth()["pose"] == pytest.approx(before, abs=0.01)


def test_it_stops_before_the_wall_that_its_scanner_sees(there: Live, operator: Operator) -> None:
    before = there.truth()["scans"]
    operator.say(0.5, 0)
    there.until(lambda: there.report()["limited"], PATIENCE_S, "it sees the wall")
    wait_at_rest(there)
    truth = there.truth()
    assert truth["contacts"] == 0
    assert 0 < truth["least"] < 3 * MARGIN_M, truth
    assert truth["pose"][0] > 3, "it stopped before something else"
    assert truth["scans"] > before
    operator.say()


def test_the_boom_goes_out_and_in(there: Live, operator: Operator) -> None:
    operator.say(boom=0.05)
    there.until(lambda: abs(there.report()["boom"] - 0.05) < 0.001, PATIENCE_S, "the boom is out")
    there.until(lambda: abs(there.truth()["position"][2] - 5 * math.tau) < 0.5, PATIENCE_S, "after five turns")
    operator.say()
    there.until(lambda: there.report()["boom"] < 0.002, PATIENCE_S, "the boom is in")


def test_what_it_reports_reaches_a_station_on_this_computer(there: Live, operator: Operator) -> None:
    """As `make top` and others receive it: from the robot's address, by the inventory of the lab."""
    heard = receiver.Receiver(telemetry.streams(there.fleet), station_keys.of_telemetry(there.fleet))
    deadline = Deadline(PATIENCE_S)
    (here,) = receiver.listen([there.report_port], there.station_address)
    with here:
        while heard.counts["/rover/drive/report"].received < 5:
            assert not deadline.expired, heard.summary
            select.select([here], [], [], deadline.left)
            receiver.drain(here, heard)
    assert heard.strangers == 0
    assert heard.counts["/rover/drive/report"].refused == 0
