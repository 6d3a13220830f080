"""CAN blocks in a task of the real executive, against emulated devices on a bus of UDP sockets."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from images.builder import paths
from tests.emulators.can_bus import UdpHub
from tests.emulators.epos2 import Axis, Epos2, Epos2Server
from tests.running import PATIENCE, running

pytestmark = pytest.mark.alone

NODE = 3

DRIVE = """
period: 5 ms
priority: 0
blocks:
  drive:
    type: epos2
    in: {{target: {target}, enable: 1}}
    parameters: {{node: 3, mode: {mode}, counts: 2000, gear: 10, heartbeat: 0.2{more}}}
"""
FRAMES = """
period: 5 ms
priority: 0
blocks:
  out: {type: can-send, in: {data: 7}, parameters: {id: 0x123, length: 1}}
  back: {type: can-receive, parameters: {id: 0x123}}
"""

WATCHED = "drive.position,drive.velocity,drive.current,drive.enabled,drive.flag,drive.error,drive.abort,drive.sequence"


@pytest.fixture(scope="module")
def udp_can(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shared object that turns CAN sockets into UDP sockets."""
    library = tmp_path_factory.mktemp("udp_can") / "udp_can.so"
    source = paths.PROJECT / "runtime/tests/can/udp_can.c"
    subprocess.run(["cc", "-std=gnu11", "-shared", "-fPIC", "-o", library, source], check=True)
    return library


@pytest.fixture
def hub() -> Iterator[UdpHub]:
    hub = UdpHub()
    yield hub
    hub.close()


Link = Callable[[str], None]
"""Makes can0 what udp_can.c says: an index and `up`, `down` or `no-carrier`; nothing: there is none."""


@pytest.fixture
def link(tmp_path: Path) -> Link:
    def become(state: str) -> None:
        (tmp_path / "next").write_text(state)
        (tmp_path / "next").rename(tmp_path / "link")

    become("7 up")
    return become


@pytest.fixture
def run(flotilla_run: Path, udp_can: Path, hub: UdpHub, tmp_path: Path, link: Link) -> Callable[..., Any]:
    environment = {"LD_PRELOAD": str(udp_can), "CAN_HUB": str(hub.port), "CAN_LINK": str(tmp_path / "link")}
    return lambda text, watched=WATCHED: running(
        [flotilla_run, "--watch", watched], tmp_path / "task.yml", text, environment
    )


def drive_task(mode: str, target: float, more: str = "") -> str:
    return DRIVE.format(mode=mode, target=target, more=", " + more if more else "")


@pytest.mark.parametrize(
    ("mode", "target", "output"),
    [
        ("position", 2.0, "position"),
        ("profile-position", -2.0, "position"),
        ("velocity", 12.0, "velocity"),
        ("profile-velocity", -12.0, "velocity"),
        ("current", 0.2, "current"),
    ],
)
def test_every_mode_reaches_its_target(run: Any, hub: UdpHub, mode: str, target: float, output: str) -> None:
    drive = Epos2(NODE)
    with Epos2Server(hub, drive).running(), run(drive_task(mode, target)) as task:
        row = task.until(lambda row: abs(row[output] - target) < 0.05 * abs(target))
        assert row["enabled"] == 1
        assert row["flag"] == 1
        assert row["abort"] == 0
        assert task.end() == 0
    assert drive.axis is Axis.SWITCH_ON_DISABLED


def test_a_refused_object_keeps_the_motor_off(run: Any, hub: UdpHub) -> None:
    drive = Epos2(NODE)
    drive.wrong.refuse[0x1603, 2] = 0x06040041
    server = Epos2Server(hub, drive)
    with server.running(), run(drive_task("velocity", 1)) as task:
        assert task.until(lambda row: row["abort"])["abort"] == 0x06040041
        with server.paused():
            assert drive.axis is Axis.SWITCH_ON_DISABLED
            drive.wrong.refuse.clear()
        assert task.until(lambda row: row["enabled"])["abort"] == 0


def test_a_fault_is_told_and_stays(run: Any, hub: UdpHub) -> None:
    drive = Epos2(NODE)
    server = Epos2Server(hub, drive)
    with server.running(), run(drive_task("velocity", 5)) as task:
        task.until(lambda row: row["enabled"])
        with server.paused():
            drive.fault(0x2310)
        row = task.until(lambda row: not row["enabled"])
        assert row["flag"] == 1, "the measurements are good all the same"
        assert task.until(lambda row: row["error"])["error"] == 0x2310
        sequence = row["sequence"]
        assert task.until(lambda row: row["sequence"] > sequence + 100)["enabled"] == 0
        with server.paused():
            assert drive.axis is Axis.FAULT


def test_automatic_reset_clears_a_fault(run: Any, hub: UdpHub) -> None:
    drive = Epos2(NODE)
    server = Epos2Server(hub, drive)
    with server.running(), run(drive_task("velocity", 5, "fault_reset: automatic")) as task:
        task.until(lambda row: row["enabled"])
        with server.paused():
            drive.fault(0x8611)
        task.until(lambda row: not row["enabled"])
        assert task.until(lambda row: row["enabled"])["error"] == 0


def test_a_drive_that_lost_its_power_comes_back(run: Any, hub: UdpHub) -> None:
    drive = Epos2(NODE)
    server = Epos2Server(hub, drive)
    with server.running(), run(drive_task("velocity", 5)) as task:
        task.until(lambda row: row["enabled"])
        with server.paused():
            drive.power_off()
        task.until(lambda row: not row["flag"])
        with server.paused():
            drive.power_on()
        task.until(lambda row: row["enabled"] and row["velocity"] > 4.5)


MISSING = "drive: there is no CAN interface can0: plug it in, and name it under `can:` in the inventory; waiting for it"
DOWN = "drive: CAN interface can0 is down: name it under `can:` in the inventory, with the bus's bit rate"
UP = "drive: CAN interface can0 is up"


def test_waits_for_its_interface(run: Any, hub: UdpHub, link: Link, capfd: pytest.CaptureFixture[str]) -> None:
    """An adapter is plugged in, set up, pulled out and plugged in again; each is said once."""
    drive = Epos2(NODE)
    said = ""
    link("")
    with Epos2Server(hub, drive).running(), run(drive_task("velocity", 5)) as task:
        rows = task.rows()
        assert not any(next(rows)["flag"] for _ in range(100)), "it steps, and has nothing to say"
        link("7 down")
        assert not any(next(rows)["flag"] for _ in range(100))
        for state in ("7 up", "8 up"):
            link(state)
            task.until(lambda row: row["flag"])
            said += capfd.readouterr().err
            told = said.count(MISSING)
            link("")
            while said.count(MISSING) == told:
                next(rows)
                said += capfd.readouterr().err
            task.until(lambda row: not row["flag"])
        assert task.end() == 0
    assert [line for line in said.splitlines() if "interface" in line] == [
        MISSING, DOWN, UP, MISSING, UP, MISSING,
    ]  # fmt: skip


def test_a_stopped_task_stops_the_motor(run: Any, hub: UdpHub) -> None:
    """SIGSTOP: nothing of the task runs any more, so the drive misses its heartbeats."""
    drive = Epos2(NODE)
    server = Epos2Server(hub, drive)
    with server.running(), run(drive_task("velocity", 5)) as task:
        task.until(lambda row: row["velocity"] > 4.5)
        task.signal(signal.SIGSTOP)
        deadline = time.monotonic() + PATIENCE
        while True:
            with server.paused():
                if drive.axis is Axis.FAULT:
                    break
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert drive.errors == [0x8130]
        assert abs(drive.motor.rpm) < 5


def test_survives_a_bad_bus(run: Any, hub: UdpHub) -> None:
    """Frames lost, and frames of random content under the drive's own identifiers."""
    drive = Epos2(NODE, seed=4)
    drive.wrong.loss = 0.02
    drive.wrong.nonsense = 0.02
    with Epos2Server(hub, drive).running(), run(drive_task("velocity", 5, "fault_reset: automatic")) as task:
        task.until(lambda row: row["enabled"] and abs(row["velocity"] - 5) < 0.5)
        task.until(lambda row: row["sequence"] > 500)


def test_a_silent_drive_makes_the_flag_0(run: Any, hub: UdpHub) -> None:
    drive = Epos2(NODE)
    server = Epos2Server(hub, drive)
    with server.running(), run(drive_task("velocity", 5)) as task:
        task.until(lambda row: row["flag"])
        with server.paused():
            drive.wrong.silent = True
        task.until(lambda row: not row["flag"])
        with server.paused():
            drive.wrong.silent = False
        task.until(lambda row: row["flag"])


def test_frames_pass_between_two_blocks(run: Any, hub: UdpHub) -> None:
    with (
        Epos2Server(hub).running(),  # without a drive: the hub passes frames on while it is read
        run(FRAMES, "out.sent,out.flag,back.data,back.length,back.flag,back.sequence") as task,
    ):
        row = task.until(lambda row: row["back.sequence"] > 5)
        assert row["back.data"] == [7, 0, 0, 0, 0, 0, 0, 0]
        assert row["back.length"] == 1
        assert row["back.flag"] == row["out.flag"] == 1
        assert row["out.sent"] >= row["back.sequence"]
