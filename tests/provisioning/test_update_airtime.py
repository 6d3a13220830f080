"""A release to several robots by multicast: guests of the shipped image, in a cell that loses a tenth of the frames.

Frames of TCP are not lost, as 802.11 repeats those. `ansible-playbook` runs on a station that is in the cell, and
reaches robots at their own addresses.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import yaml

from flotilla.common import paths
from flotilla.fleet import inventory, release_keys
from flotilla.fleet.model import Fleet, Robot
from flotilla.images import build
from flotilla.lab.containers import scale
from flotilla.lab.qemu import qemu, virtual_fleet
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.radio import Radio
from flotilla.lab.qemu.segment import free_udp_ports
from flotilla.lab.qemu.ssh import Ssh
from flotilla.robot import release
from flotilla.updates import bundle, delta, multicast
from tests.airtime import Station
from tests.figures import PROPERTY

BOARD = "smartcoret3"
TASK = "heartbeat"
PERIOD_S = 0.01
LOSS = 0.1
NEW_BYTES = 3 << 20
"""What a release has that the one before it has not."""
MEMORY_KIB = 16 << 10
RECEIVER_KIB = 4 << 10
SECONDS = 1800
"""For a play, or a boot of all guests, on a computer that has other things to do."""
KBIT_S = {2: 600, 8: 300}
"""By the number of robots. A computer that has eight guests may leave one of them without a processor for seconds, and
its cable keeps no more than 200 frames."""
AT_ONCE = 2
"""Guests that boot at the same time."""


@dataclasses.dataclass
class Cell(Station):
    """The robots, and the station that updates them."""

    fleet: Fleet
    machines: dict[str, Guest]
    shells: dict[str, Ssh]
    base: Path
    """The bundle of the release that they run."""
    releases: int = 1

    def release(self, *, moved: bool) -> Path:
        """The bundle of a new release, with `NEW_BYTES` of it. `moved`: all behind them has moved, and there is a delta
        to it from the running one; else it is where it was, and there is none."""
        self.releases += 1
        directory = self.directory / f"release{self.releases}"
        directory.mkdir()
        old = release.read(self.base)
        old.extract(directory / "old")
        content = (directory / "old").read_bytes()
        new, at = random.Random(self.releases).randbytes(NEW_BYTES), 20 << 20
        content = content[:at] + new + content[at if moved else at + NEW_BYTES :]
        (directory / "slot.img").write_bytes(content)
        header = {
            **old.header, "RELEASE": str(self.releases), "BYTES": str(len(content)),
            "BLOB": hashlib.sha256(content).hexdigest(),
        }  # fmt: skip
        (directory / "header.json").write_text(json.dumps(header))
        final = directory / f"{BOARD}.bundle"
        bundle.pack(final, directory, self.fleet.releases, {}, 0)
        if moved:
            made = delta.between(old, release.read(final))
            assert made
            assert NEW_BYTES < made.stat().st_size < NEW_BYTES + 10_000
        return final

    def sudo(self, name: str, script: str) -> str:
        return self.shells[name].script(script, timeout=SECONDS).stdout

    def staged(self, name: str) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self.sudo(name, "/usr/lib/flotilla/update.py finish"))
        return told

    def steps(self, name: str) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self.sudo(name, f"flotilla-param --status=json {TASK}"))
        return told


@contextlib.contextmanager
def cell_of(count: int, directory: Path) -> Iterator[Cell]:
    """So many robots that run a control task; description, keys and outputs are their own."""
    scale.describe(count, BOARD, directory / "inventory")
    described = yaml.safe_load((directory / "inventory/robots.yml").read_text())
    for robot in described["robots"]["children"][f"board_{BOARD}"]["hosts"].values():
        robot["control_tasks"] = [TASK]
    (directory / "inventory/robots.yml").write_text(yaml.safe_dump(described))
    fleet = inventory.load_fleet(directory / "inventory")
    robots = list(fleet.robots.values())
    guests = dict.fromkeys((robot.name for robot in robots), 0)
    lenient = yaml.safe_load(virtual_fleet.guests_inventory(guests))
    for values in lenient["guests"]["hosts"].values():
        del values["ansible_host"], values["ansible_port"]
    (directory / "reach.yml").write_text(yaml.safe_dump(lenient))
    with contextlib.ExitStack() as stack:
        # The release's key is the project's, so that the slot is, too; all that is new stays here.
        release_keys.document(fleet.releases)
        shutil.copytree(paths.KEYS, directory / "keys")
        stack.enter_context(mock.patch.object(paths, "KEYS", directory / "keys"))
        stack.enter_context(mock.patch.object(paths, "BUNDLES", directory / "build/bundles"))
        build.build(fleet, robots, directory / "images")
        made = build.board_build(fleet.boards[BOARD], fleet.releases)
        base = directory / "base.bundle"
        bundle.pack(base, made.slot, fleet.releases, {}, 0)
        ports = iter(free_udp_ports(2 * count))
        wires = {str(robot.address): qemu.Wire(next(ports), next(ports)) for robot in robots}
        station = str(fleet.stations[0].address)
        radio = stack.enter_context(Radio([station], loss=LOSS, seed=1, guests=wires))
        home = stack.enter_context(tempfile.TemporaryDirectory(prefix="ansible-"))  # paths of sockets are short
        environment = {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "ANSIBLE_HOME": home, "ANSIBLE_NOCOLOR": "1",
            "BUILD": str(directory / "build"), "KEYS": str(paths.KEYS),
        }  # fmt: skip
        cell = Cell(directory, radio, station, environment, KBIT_S[count], SECONDS, fleet, {}, {}, base)
        for first in range(0, count, AT_ONCE):
            group = robots[first : first + AT_ONCE]
            for robot in group:
                link = wires[str(robot.address)]
                options = qemu.Options(name=robot.name, mac=qemu.robot_mac(robot.number), link=link)
                image = build.image_of(robot, directory / "images")
                guest = Guest(fleet.boards[BOARD], image, directory / robot.name, options)
                cell.machines[robot.name] = stack.enter_context(guest)
                shell = Ssh(robot, str(robot.address), within=radio.nodes[station].prefix)
                cell.shells[robot.name] = stack.enter_context(shell)
                guest.on()
            for robot in group:
                wait_booted(cell, robot)
        yield cell


def wait_booted(cell: Cell, robot: Robot) -> None:
    cell.machines[robot.name].console.expect(rf"{robot.name} login: ", SECONDS)
    cell.shells[robot.name].connect(SECONDS)
    cell.shells[robot.name].script("systemctl is-system-running --wait", check=False, timeout=SECONDS)


def no_step_is_unaccounted(before: dict[str, Any], after: dict[str, Any]) -> None:
    """The task was not started again, and each period had its step or is counted as one without. How many of the latter
    there are is the host's doing: virtual time says that it is none."""
    assert after["running_s"] > before["running_s"], "the task started again"
    periods = (after["running_s"] - before["running_s"]) / PERIOD_S
    counted = sum(after[key] - before[key] for key in ("steps", "skipped"))
    assert abs(counted - periods) <= 2, (before, after)


@pytest.fixture(scope="module")
def cell(request: pytest.FixtureRequest, session_artefacts: Path) -> Iterator[Cell]:
    """Of `request.param` robots."""
    with cell_of(request.param, session_artefacts / f"airtime{request.param}") as cell:
        yield cell


@pytest.mark.nightly  # each time, eight namespaces get one by the same programs: tests/runtime/test_airtime.py
@pytest.mark.parametrize("cell", [2, 8], indirect=True, ids="{}-robots".format)
def test_robots_get_a_delta_at_once(cell: Cell, record_property: Callable[[str, object], None]) -> None:
    """By multicast alone, by at most 1.25 times the delta's bytes, while control tasks run."""
    new = cell.release(moved=True)
    blobs = [release.read(file).header["BLOB"] for file in (cell.base, new)]
    size = release.delta_of(*blobs).stat().st_size
    names = [robot.name for robot in cell.fleet.robots.values()]
    before = {name: cell.steps(name) for name in names}
    sent = cell.radio.lossy_bytes(multicast.PORT)
    play = cell.start(new)
    cell.wait_for_symbols(NEW_BYTES // 2 // multicast.SYMBOL)
    status = "cat /proc/$(systemctl show -P MainPID flotilla-receive)/status; chrt -p $(pidof flotilla-receive)"
    receiver = cell.sudo(names[0], status)
    said = cell.said(play)
    sent = cell.radio.lossy_bytes(multicast.PORT) - sent
    print(f"receiver: {receiver}; {cell.radio.overrun} frames had no room")
    record_property(PROPERTY, f"{len(names)} robots: {sent} bytes sent for {size}, {sent / size:.3f} times as many")
    assert f"{len(names)} of {len(names)} robots have it" in said
    assert "by SSH" not in said
    assert sent <= 1.25 * size
    assert "SCHED_IDLE" in receiver
    assert int(receiver.partition("VmHWM:")[2].split()[0]) <= RECEIVER_KIB
    for name in names:
        after = cell.steps(name)
        counted = {key: after[key] - before[name][key] for key in ("steps", "overruns", "skipped")}
        record_property(PROPERTY, f"{name}: {counted}")
        if len(names) <= AT_ONCE:  # more guests are too slow for their tasks, which the executive then gives up
            no_step_is_unaccounted(before[name], after)
        told = cell.staged(name)
        assert (told["staged"], told["missing"]) == (True, [])
        assert told["memory_kib"] <= MEMORY_KIB
        assert cell.sudo(name, "ls /data/update").split() == ["release"], "the spool is left"
        service = "systemctl show --property=ActiveState,ConditionResult flotilla-receive"
        # By that `robot_state` knows a service that has nothing to do from one that has to be started.
        assert cell.sudo(name, service).split() == ["ActiveState=inactive", "ConditionResult=no"]


def staged_all_of_it(cell: Cell, name: str) -> None:
    told = cell.staged(name)
    assert (told["staged"], told["missing"]) == (True, [])


@pytest.mark.nightly
@pytest.mark.parametrize("cell", [2], indirect=True, ids="{}-robots".format)
def test_what_is_cut_off_goes_on(cell: Cell) -> None:
    """A receiver is killed, then the station, then a robot's power is cut: each goes on where it was. There is no delta
    to the release here, so what comes are chunks."""
    new = cell.release(moved=False)
    first, second = cell.machines
    before = {name: cell.steps(name) for name in cell.machines}
    sent = cell.radio.lossy_bytes(multicast.PORT)
    play = cell.start(new)
    cell.wait_for_symbols(NEW_BYTES // 3 // multicast.SYMBOL)
    cell.sudo(first, "systemctl kill --signal=KILL flotilla-receive")
    cell.wait_for_symbols(NEW_BYTES // 6 // multicast.SYMBOL)
    cell.kill(play)
    play = cell.start(new)
    cell.wait_for_symbols(NEW_BYTES // 6 // multicast.SYMBOL)
    cell.sudo(second, "sync")  # what is written back within half a minute anyway
    cell.machines[second].cut()
    assert "unreachable=1" in cell.said(play, status=4)
    block = multicast.BLOCK * multicast.SYMBOL
    # Blocks that went out when the receiver was killed may be needed once more.
    assert cell.radio.lossy_bytes(multicast.PORT) - sent <= 1.25 * (NEW_BYTES + 2 * block)
    staged_all_of_it(cell, first)
    no_step_is_unaccounted(before[first], cell.steps(first))

    cell.machines[second].on()
    wait_booted(cell, next(robot for robot in cell.fleet.robots.values() if robot.name == second))
    assert cell.sudo(second, "systemctl show --property=SubState --value flotilla-receive").strip() == "running"
    sent = cell.radio.lossy_bytes(multicast.PORT)
    said = cell.said(cell.start(new, "-e", "by=multicast"))
    assert "1 of 1 robots have it" in said
    assert cell.radio.lossy_bytes(multicast.PORT) - sent < NEW_BYTES, "it was received from the beginning"
    staged_all_of_it(cell, second)
