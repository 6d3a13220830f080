"""Guests that all tests of this folder share, and what is measured on them.

Checks that any robot must pass run on one guest of each board and kernel; what only one board has, on that board's.
Every measure of time is printed; none is judged, because the host is shared. What a guest is asked runs in one process,
so that it boots once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from flotilla.debian import kernel
from flotilla.fleet import inventory
from flotilla.fleet.model import Board
from flotilla.images import card
from tests import figures
from tests.boot.guests import PENTIUM, label, sh
from tests.conftest import GuestFactory, RobotGuest

_FLEET = inventory.load_fleet()
_STANDING = {robot.board: robot.number for robot in reversed(_FLEET.robots.values())}
_STANDING[_FLEET.robots[PENTIUM].board] = PENTIUM
"""The robots that stand for their boards: the first one each, but for that one."""
SYSTEMS = [
    pytest.param((number, "debian"), id=f"{board}-debian")
    for board, number in sorted(_STANDING.items())
] + [  # after those whose kernel has not to be built, which takes ten minutes
    pytest.param((number, "lean"), id=f"{board}-lean", marks=pytest.mark.nightly)
    for board, number in sorted(_STANDING.items()) if board in kernel.names()
]  # fmt: skip
"""Boards and kernels that every image must boot with."""


class Report:
    """Figures of guests, for the test that measured them."""

    def __init__(self) -> None:
        self._new: list[str] = []

    def add(self, board: str, **figures: float) -> None:
        self._new += [f"{board}: {name} {value:.4g}" for name, value in figures.items()]

    def take(self) -> list[str]:
        """What was added since the last call, a line each."""
        new, self._new = self._new, []
        return new


@pytest.fixture(scope="session")
def report() -> Report:
    return Report()


@pytest.fixture(autouse=True)
def _figures(report: Report, record_property: Callable[[str, object], None]) -> Iterator[None]:
    yield
    for line in report.take():
        record_property(figures.PROPERTY, line)


def _settled(guest: GuestFactory, number: int, report: Report, kernel: str | None = None) -> RobotGuest:
    """The shared guest once everything that starts at boot has started."""
    robot = guest(number, kernel)
    sh(robot, "systemctl is-system-running --wait", check=False)
    prompt = rf"{robot.robot.name} login: "
    login = robot.machine.seconds_to(prompt)
    power_on = robot.machine.console.arrival(prompt) - login
    assert robot.shell.first_connected
    report.add(label(robot), login_s=login, ssh_s=robot.shell.first_connected - power_on)
    shown = sh(robot, "systemctl show -p UserspaceTimestampMonotonic -p FinishTimestampMonotonic")
    stamps = {name: int(value) / 1e6 for name, value in (line.split("=") for line in shown.splitlines())}
    begun, finish = stamps["UserspaceTimestampMonotonic"], stamps["FinishTimestampMonotonic"]
    report.add(label(robot), kernel_s=begun, userspace_s=finish - begun)
    with robot.image.open("rb") as image:
        image.seek(card.SLOTS[0].start + 40)  # `bytes_used` of the squashfs
        report.add(label(robot), root_mb=int.from_bytes(image.read(8), "little") / 1e6)
    return robot


@pytest.fixture(scope="session")
def pentium(guest: GuestFactory, report: Report) -> RobotGuest:
    """With the kernel that the inventory gives the board."""
    return _settled(guest, PENTIUM, report)


@pytest.fixture(scope="session", params=SYSTEMS)
def robot(request: pytest.FixtureRequest, guest: GuestFactory, report: Report) -> RobotGuest:
    return _settled(guest, request.param[0], report, request.param[1])


@pytest.fixture
def board(robot: RobotGuest) -> Board:
    return robot.board
