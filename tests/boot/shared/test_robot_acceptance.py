"""`make accept` on a guest: with faults planted, each of which it names, and without.

By its name it comes after test_boot.py, which judges the kernel's messages: loads of latency may bring some.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet.model import Board, Can, Fleet, Port
from flotilla.lab.acceptance import checks, command, facts, outcome
from flotilla.lab.latency import report, run
from flotilla.lab.latency import results as latency_results
from flotilla.robot import ssh
from tests.boot.guests import sh
from tests.conftest import RobotGuest

_UNFED = "/run/systemd/system.conf.d/zz-unfed.conf"
_BYTE_OF_KERNEL = """
slot=$(findmnt -n -o SOURCE /)
first=$(python3 -c "
import sys; sys.path.insert(0, '/usr/lib/flotilla')
import update; print(512 * int(update.Slot('A').header()['KERNEL'].split('+')[0]))")
printf %s | dd of=$slot bs=1 seek=$first conv=notrunc,fsync status=none
"""
_RELOAD = "systemctl daemon-reload"  # it forgets that transient units failed, so this fault comes first
FAULTS = {
    "a watchdog that nobody feeds": (
        f"mkdir -p $(dirname {_UNFED}); printf '[Manager]\\nRuntimeWatchdogSec=0\\n' >{_UNFED}; {_RELOAD}",
        f"rm {_UNFED}; {_RELOAD}",
        "watchdog: fed: systemd does not feed it, so a hang lasts",
    ),
    "a file that does not belong to it": (
        "echo >/etc/flotilla/stray", "rm /etc/flotilla/stray",
        "description: files: /etc/flotilla/stray does not belong to the robot",
    ),
    "a unit that failed": (
        "systemd-run --quiet --unit=stumbles false; until systemctl -q is-failed stumbles; do sleep 0.1; done",
        "systemctl reset-failed stumbles",
        "description: units: stumbles.service failed",
    ),
    "a service that does not run": (
        "systemctl stop flotilla-dma-latency", "systemctl start flotilla-dma-latency",
        "description: runtime: flotilla-dma-latency.service does not run",
    ),
    "another firewall": (
        "nft add table inet stray", "nft delete table inet stray",
        "description: firewall: the rules in force are others",
    ),
    "another setting of the kernel": (
        "sysctl -q kernel.panic_on_oops=0", "sysctl -q kernel.panic_on_oops=1",
        "description: realtime: kernel.panic_on_oops = 0, not 1",
    ),
    "a battery that is flat": (
        "hwclock --noadjfile --utc --set --date '2001-01-01 00:00:00'", "hwclock --noadjfile --utc --systohc",
        r"computer: clock on battery: off by -\d+ s",
    ),
    "a jumper on another interrupt": (
        "setserial /dev/ttyS2 irq 5", "setserial /dev/ttyS2 irq 4",
        r"serial: COM3 \(ttyS2\): bytes do not come back through its own UART",
    ),
    "a card that forgets": (
        _BYTE_OF_KERNEL.replace("%s", r"'\000'"), _BYTE_OF_KERNEL.replace("%s", "M"),
        r"card: slot A: its content is [0-9a-f]{16}…, not [0-9a-f]{16}…",
    ),
    "a card that is full": (
        "fallocate -l $(($(stat -f -c '%a*%S' /data) - (20 << 20))) /data/full", "rm /data/full",
        r"card: room: \d % are free, less than 10",
    ),
}  # fmt: skip
"""What is done to the robot, what takes it back, and what is said."""
DESCRIBED = {
    "a serial card that is missing": r"serial: COM13 \(ttyS12\): its UART is unknown",
    "a CAN adapter that is missing": r"CAN: can0: .*does not exist",
    "a memory module that is missing": r"computer: memory: \d+ MiB, not 512",
}
"""Of a robot that should have more than the guest has. A card whose driver is unbound would take the interrupt that it
shares from the others, and the guest is shared, too."""


@contextmanager
def _planted(robot: RobotGuest) -> Iterator[None]:
    with ExitStack() as repairs:
        for plant, repair, _ in FAULTS.values():
            sh(robot, plant)
            repairs.callback(sh, robot, repair)
        yield


def test_each_planted_fault_is_named(pentium: RobotGuest, fleet: Fleet, tmp_path: Path) -> None:
    robot = pentium.robot.model_copy(update={"can": {"can0": Can(bitrate=1_000_000)}})
    limits = pentium.board.acceptance.model_copy(update={"memory_mib": 512})
    ports = {**pentium.board.ports, "COM13": Port(tty="ttyS12")}
    board: Board = pentium.board.model_copy(update={"acceptance": limits, "ports": ports})
    wanted = fleet.model_copy(update={"boards": {**fleet.boards, robot.board: board}})
    with _planted(pentium):
        found = facts.ask(wanted, robot, pentium.shell, tmp_path, plan=None, seconds=1)
    said = [str(each) for each in checks.judge(wanted, robot, found, "none").failures]
    expected = {name: fault[2] for name, fault in FAULTS.items()} | DESCRIBED
    unnamed = [name for name, pattern in expected.items() if not any(re.match(pattern, each) for each in said)]
    assert not unnamed, "\n".join(said)


@pytest.fixture
def reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(outcome, "directory", lambda: tmp_path)
    return tmp_path


def test_a_healthy_guest_is_accepted(
    pentium: RobotGuest,
    fleet: Fleet,
    reports: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Once all faults are repaired. How late it is depends on this host and is not judged; that it was measured is."""
    monkeypatch.setitem(run.SECONDS, "quick", 1)
    monkeypatch.setattr(ssh, "forwarded_port", lambda _: pentium.machine.ssh_port())
    command.run(argparse.Namespace(robot=pentium.robot.number, plan="quick", seconds=1, relays=False, watchdog=False))
    (file,) = reports.glob("*.json")
    made = outcome.read(file)
    assert made.failures == []
    holds = {f"{each.part}: {each.what}" for each in made.outcomes if each.state == "holds"}
    assert {"card: slot A", "serial: COM12 (ttyS11)", "network: eth0", "watchdog: fed"} <= holds
    assert "0 fail" in capsys.readouterr().out
    page = file.with_suffix(".html").read_text()
    assert "is accepted" in page
    assert "This is a guest" in page
    _latency(paths.BUILD / "latency" / f"{pentium.robot.name}-accept", reports)
    left = pentium.shell.run(["ls", "/run/latency", "/dev/robot/uart_own"], check=False)
    assert left.stderr.count("No such file") == 2, left.stdout


def _latency(out: Path, reports: Path) -> None:
    """Of the scenarios that are measured in virtual time."""
    found = latency_results.read(out / "results.json")
    samples = {
        name: outcome.latencies[next(iter(outcome.latencies))].samples for name, outcome in found.scenarios.items()
    }
    tracer = samples.pop("timerlat-everything")
    assert samples == {"idle": 1000, "scheduler": 1000, "uart-own": 33, "uart-own-everything": 33}
    # A host that is slow enough makes the tracer miss periods, which the report names.
    assert 0 < tracer <= 167
    page = report.write([found], reports).read_text()
    assert "real time" in page
    assert (f": interrupt: {tracer} of 167 samples" in page) == (tracer < 167)
