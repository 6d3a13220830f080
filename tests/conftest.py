"""Fixtures that all tests share: the fleet, its guests in QEMU, and a place for evidence.

A guest runs the very image that `make flash` would write, and nothing enters it but through its connectors:

    def test_root_is_read_only(guest: GuestFactory) -> None:
        robot = guest(3)                                     # booted once per session, shared by all tests
        assert "ro" in robot.shell.run(["findmnt", "-no", "OPTIONS", "/"]).stdout.split(",")

    def test_survives_power_cut(fresh_guest: GuestFactory) -> None:
        robot = fresh_guest(3)                               # this test's own; may be broken
        robot.machine.cut()
        robot.machine.on()
        robot.wait_booted()

A fresh guest begins booted, restored from what was saved of the first one like it; `cold=True` has it boot.
Check as much as possible on a shared guest, and leave it as you found it.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.fleet import inventory
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.images.build import build, image_of
from flotilla.lab.qemu import qemu, saved
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.saved import BOOT_SECONDS
from flotilla.lab.qemu.segment import Segment, station_address
from flotilla.lab.qemu.ssh import Ssh

pytest_plugins = ["tests.artefacts", "tests.figures", "tests.tiers", "tests.costs", "tests.suite"]


def pytest_configure() -> None:
    """Let SIGINT interrupt what tests start: a shell makes what it starts in the background ignore it, children too.

    A make that a test starts is the first one: it has no part in the jobs of the make that started the tests.
    """
    for name in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL"):
        os.environ.pop(name, None)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@dataclass(frozen=True)
class RobotGuest:
    """A robot of the fleet as a guest in QEMU."""

    robot: Robot
    board: Board
    """The inventory's, but for the kernel where a test asked for another."""
    image: Path
    machine: Guest
    """Power, console, serial ports, cable, QMP."""
    shell: Ssh
    """Commands and files, as user `robot`."""

    def wait_booted(self, timeout: float = BOOT_SECONDS) -> None:
        """Wait for the login prompt of a boot that was started by `machine.on()`, `machine.reset()` or the guest."""
        saved.await_login(self.machine, self.robot, timeout)
        self.shell.connect()


GuestFactory = Callable[..., RobotGuest]
"""`guest(number)`: the robot's guest, booted, with SSH connected; `kernel=` for another than its board's.

`fresh_guest` also takes `cold=True` to have it boot, `disk=` for another bus of the card, the arguments of `Guest`
(`card_bytes=`, `capture=True`), `qemu_options=` (a dict of fields of `qemu.Options`), `segment=segment` to put it on a
network with others, `boot=False` to power it on oneself, and `image=` with a `label=` for another card."""


@pytest.fixture(scope="session")
def fleet() -> Fleet:
    """The fleet that `ansible/inventory/` describes."""
    return inventory.load_fleet()


@pytest.fixture(scope="session")
def flotilla_run() -> Path:
    """The runtime's program, built for this computer; flotilla-blocks lies beside it."""
    done = subprocess.run(["make", "-C", str(paths.PROJECT), "runtime"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return paths.BUILD / "runtime" / "flotilla-run"


@pytest.fixture(scope="session")
def flotilla_slot(flotilla_run: Path) -> Path:
    """The program of the boot state, built for this computer."""
    return flotilla_run.with_name("flotilla-slot")


@pytest.fixture(scope="session")
def guest(fleet: Fleet, session_artefacts: Path) -> Iterator[GuestFactory]:
    """`guest(3)`: robot 3, which boots when a test first asks and is shared by all that ask later. `guest(3, "debian")`
    is the same robot with another kernel than its board's.

    A boot that failed is not tried again: every test that needs it fails at once, with the first cause.
    """
    booted: dict[tuple[int, str], RobotGuest | BaseException] = {}
    with ExitStack() as cleanup:

        def shared(number: int, kernel: str | None = None) -> RobotGuest:
            key = number, kernel or fleet.boards[inventory.robot(fleet, number).board].kernel
            if key not in booted:
                directory = session_artefacts / "robot{}-{}".format(*key)
                try:
                    booted[key] = _boot(fleet, number, directory, cleanup, kernel=kernel, cold=True)
                except BaseException as error:
                    booted[key] = error
            found = booted[key]
            if isinstance(found, BaseException):
                raise found.with_traceback(None)  # each raise would lengthen it
            return found

        yield shared


@pytest.fixture
def fresh_guest(fleet: Fleet, artefacts: Path) -> Iterator[GuestFactory]:
    """`fresh_guest(3)`: robot 3 with a card as flashed, for this test alone and to be broken by it.

    With `boot=False` it comes switched off; then `machine.on()` and `wait_booted()` are the test's to call.
    """
    with ExitStack() as cleanup:
        yield lambda number, **arguments: _boot(fleet, number, artefacts / f"robot{number}", cleanup, **arguments)


@pytest.fixture(scope="module")
def module_guest(fleet: Fleet, request: pytest.FixtureRequest, session_artefacts: Path) -> Iterator[GuestFactory]:
    """Like `fresh_guest`, for all tests of a module."""
    with ExitStack() as cleanup:
        place = session_artefacts / request.node.name.removesuffix(".py").replace("/", "-")
        yield lambda number, **arguments: _boot(fleet, number, place / f"robot{number}", cleanup, **arguments)


@pytest.fixture
def segment(fleet: Fleet, artefacts: Path) -> Iterator[Segment]:
    """An Ethernet segment with a cable for each robot of the fleet, for `fresh_guest(3, segment=segment)`.

    A fresh guest without one is alone with the station.
    """
    robots = [robot.address for robot in fleet.robots.values()]
    with Segment(fleet.network, robots, station_address(fleet), artefacts / "segment") as segment:
        yield segment


def _boot(
    fleet: Fleet,
    number: int,
    directory: Path,
    cleanup: ExitStack,
    *,
    kernel: str | None = None,
    disk: str | None = None,
    boot: bool = True,
    cold: bool = False,
    segment: Segment | None = None,
    qemu_options: dict[str, Any] | None = None,
    image: Path | None = None,
    of: Fleet | None = None,
    label: str = "",
    **arguments: Any,
) -> RobotGuest:
    fleet = of or fleet
    robot = inventory.robot(fleet, number)
    board = fleet.boards[robot.board]
    if kernel and kernel != board.kernel:
        board, image = _with_kernel(fleet, robot, kernel)
    if disk:
        board = board.model_copy(update={"qemu": board.qemu.model_copy(update={"disk": disk})})
    image = image or image_of(robot)
    if not image.exists():
        pytest.fail(f"{paths.shown(image)} is missing; build it: make image ROBOT={number}", pytrace=False)
    link: qemu.UserLink | qemu.Wire
    if segment:
        link = segment.link(robot.address)
    else:
        link = qemu.UserLink(subnet=fleet.network.subnet, guest=robot.address, station=station_address(fleet))
    options = qemu.Options(**{"name": robot.name, "mac": qemu.robot_mac(number), "link": link, **(qemu_options or {})})
    machine = cleanup.enter_context(Guest(board, image, directory / label, options, **arguments))
    port = (lambda: segment.ssh_port(robot.address)) if segment else machine.ssh_port
    guest = RobotGuest(robot, board, image, machine, cleanup.enter_context(Ssh(robot, "127.0.0.1", port)))
    if boot:
        saved.begin(machine, robot, guest.shell, cold=cold)
    return guest


def _with_kernel(fleet: Fleet, robot: Robot, kernel: str) -> tuple[Board, Path]:
    """The robot's board and image as if the inventory named another kernel."""
    board = fleet.boards[robot.board].model_copy(update={"kernel": kernel})
    other = fleet.model_copy(update={"boards": fleet.boards | {robot.board: board}})
    (image,) = build(other, [robot], paths.IMAGES / kernel)
    return board, image
