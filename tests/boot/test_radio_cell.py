"""Cards with `link: ibss`: guests whose only way to each other and to the station is an emulated 802.11 adapter.

Two computers, between which the scenarios' control loop goes over the air. What happens to the cell is in order; each
test leaves all in it. `flotilla/lab/qemu/air.py` says what the air is.
"""

from __future__ import annotations

import functools
import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from unittest import mock

import pytest
import yaml

from flotilla.apps import assigned
from flotilla.common import paths
from flotilla.fleet import inventory
from flotilla.fleet.model import Robot
from flotilla.images import build
from flotilla.lab.containers import scale
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.radio_segment import RadioSegment, segment_of
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import Deadline
from flotilla.lab.scenarios import guests, virtual
from flotilla.lab.scenarios.guests import GuestFleet
from flotilla.lab.scenarios.plans import TESTED_SIDE_M
from flotilla.lab.scenarios.virtual import Plan
from flotilla.robot import ssh
from flotilla.station import services
from tests.figures import PROPERTY
from tests.provisioning.test_fleet import ANSIBLE, ENVIRONMENT, Guests

SECONDS = 900
"""For what takes a few on an idle host."""
BOARD = "smartcoret3"
ONE = "robot2"
"""Whose place in the cell is disturbed."""
pytestmark = pytest.mark.nightly  # each time, test_scenarios.py flies over the air, shared/test_radio.py joins a cell
CUT_SHARE, WELL_SHARE = 0.02, 0.1
"""Of steps that come all the way round: without a link the last one is repeated, and a busy computer loses some."""
RMS_M = 0.019
AT_ONCE = 2
"""Of twelve guests, those that boot at the same time."""
OTHER = "02:ca:ff:ee:10:43"


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An inventory: that of the scenarios, with all that thinks on one computer, and what Ansible needs to reach it."""
    directory = tmp_path_factory.mktemp("fleet") / "inventory"
    shutil.copytree(virtual.INVENTORY, directory)
    shutil.copy(paths.INVENTORY / "group_vars/robots.yml", directory / "group_vars")
    robots = yaml.safe_load((directory / "robots.yml").read_text())
    hosts = robots["robots"]["children"][f"board_{BOARD}"]["hosts"]
    hosts[ONE]["control_tasks"] += hosts.pop("robot3")["control_tasks"] + hosts.pop("robot4")["control_tasks"]
    (directory / "robots.yml").write_text(yaml.safe_dump(robots))
    our_kernel(directory)
    return directory


def our_kernel(directory: Path) -> None:
    """It boots in a third of the time."""
    board = directory / f"group_vars/board_{BOARD}.yml"
    said = board.read_text()
    assert "kernel: debian" in said
    board.write_text(said.replace("kernel: debian", "kernel: lean"))


@pytest.fixture(scope="module")
def lab(described: Path, session_artefacts: Path) -> Iterator[GuestFleet]:
    """All booted, and the control loop goes round."""
    plan = Plan("udp", "in the cell", 0)
    fleet = inventory.load_fleet(described)
    with guests.guest_fleet(plan, session_artefacts / "radio-cell", described=fleet) as lab:
        yield lab


@pytest.fixture(scope="module")
def segment(lab: GuestFleet) -> RadioSegment:
    assert isinstance(lab.segment, RadioSegment)
    return lab.segment


def robots(lab: GuestFleet) -> dict[str, Robot]:
    return {robot.name: robot for robot in lab.fleet.robots.values()}


def sh(lab: GuestFleet, name: str, script: str, *, check: bool = True) -> str:
    return lab.shells[name].script(script, check=check, timeout=SECONDS).stdout.strip()


def until(lab: GuestFleet, script: str, name: str = ONE) -> None:
    """A condition in a robot's shell. It is reached by the air, so it may not be at all for a while."""
    deadline = Deadline(SECONDS)
    while True:
        lab.shells[name].connect(deadline.left)
        if sh(lab, name, f"{script} && echo so", check=False).endswith("so"):
            return
        assert not deadline.expired, f"{script}: {sh(lab, name, 'cat /run/flotilla/cell; iw dev wlan0 link')}"


def is_cut(lab: GuestFleet) -> None:
    """No step comes all the way round, from now on."""
    lab.forget()
    lab.until(lambda: lab.round_share < CUT_SHARE, SECONDS)


def is_well(lab: GuestFleet) -> None:
    """Steps come all the way round, from now on."""
    lab.forget()
    lab.until(lambda: lab.round_share > WELL_SHARE, SECONDS)


def test_addresses_are_on_the_radio(lab: GuestFleet) -> None:
    """SSH came by it already: nothing else is plugged in."""
    cell = lab.fleet.network.ibss
    assert cell
    for name, robot in robots(lab).items():
        shown = json.loads(sh(lab, name, "ip -json -4 address show scope global"))
        addresses = {one["ifname"]: [each["local"] for each in one["addr_info"]] for one in shown}
        assert addresses == {cell.interface: [str(robot.address)]}
        link = sh(lab, name, f"iw dev {cell.interface} link")
        assert f"Joined IBSS {cell.bssid}" in link
        assert f"freq: {cell.frequency_mhz}" in link
        driver = sh(lab, name, f"basename $(readlink /sys/class/net/{cell.interface}/device/driver)")
        assert driver == "rt73usb"
        assert sh(lab, name, "cat /run/flotilla/cell") == "in the cell"


def test_provisioning_over_the_air_changes_nothing(lab: GuestFleet, described: Path, tmp_path: Path) -> None:
    ports = {name: lab.segment.ssh_port(robot.address) for name, robot in robots(lab).items()}
    there = Guests(robots(lab), dict(lab.machines), dict(lab.shells), ports, tmp_path)
    done = subprocess.run(
        there.argv(inventory=described), cwd=ANSIBLE, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        env=ENVIRONMENT | {"KEYS": str(paths.KEYS), "BUILD": str(tmp_path / "build")},
        timeout=4 * SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "build/reports/fleet.json").read_text())
    assert {name: robot["outcome"] for name, robot in report["robots"].items()} == dict.fromkeys(ports, "up to date")


def later(lab: GuestFleet, name: str, script: str) -> None:
    """Run it as root after the connection that asks for it has nothing more to say."""
    lab.shells[name].run(
        ["sudo", "systemd-run", "--on-active=1", "--timer-property=AccuracySec=100ms", "sh", "-c", script]
    )


@pytest.mark.parametrize(
    ("drift", "because"),
    [
        ("", "it had left it"),
        (
            f"iw dev wlan0 ibss join flotilla 2412 fixed-freq {OTHER}",
            f"it was in another one, BSSID {OTHER}",
        ),
        ("iw dev wlan0 ibss join flotilla 2437 fixed-freq 02:ca:ff:ee:10:42", "it was on another channel, 2437 MHz"),
    ],
    ids=["left", "another-cell", "another-channel"],
)
def test_what_drifts_is_named_and_mended(lab: GuestFleet, drift: str, because: str) -> None:
    """By the robot itself, whom nobody reaches meanwhile."""
    later(lab, ONE, f"iw dev wlan0 ibss leave; {drift}")
    until(lab, f"grep -q 'last because {because}$' /run/flotilla/cell")
    is_well(lab)


def test_make_top_names_it(lab: GuestFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the test before left, as the station asks for it."""
    shell, robot = lab.shells[ONE], robots(lab)[ONE]
    monkeypatch.setattr(ssh, "command", lambda _: shell.command)
    with closing(services.ask(robot)) as answers:
        answer = next(answers)
    lost = "in the cell; joined again 3 times, last because it was on another channel, 2437 MHz"
    assert answer.notes == (f"radio {lost}",)
    assert answer.tasks["navigation"].good


def test_an_adapter_may_be_pulled_and_come_back(lab: GuestFleet, segment: RadioSegment) -> None:
    boot = sh(lab, ONE, "cat /proc/sys/kernel/random/boot_id")
    segment.air.plug(ONE, plugged=False)
    is_cut(lab)
    segment.air.plug(ONE, plugged=True)
    until(lab, "grep -qx 'in the cell' /run/flotilla/cell")
    assert sh(lab, ONE, "cat /proc/sys/kernel/random/boot_id") == boot
    is_well(lab)


def test_missing_firmware_is_named_on_the_console(lab: GuestFleet, segment: RadioSegment) -> None:
    """And the robot joins as soon as it is there."""
    sh(lab, ONE, "mkdir -p /run/nothing; mount --bind /run/nothing /usr/lib/firmware")
    there_again = "until grep -q firmware /run/flotilla/cell; do sleep 1; done; umount /usr/lib/firmware"
    lab.shells[ONE].run(["sudo", "systemd-run", "sh", "-c", there_again])
    segment.air.plug(ONE, plugged=False)
    segment.air.plug(ONE, plugged=True)
    said = rf"{ONE}: not in the cell: wlan0 does not start: firmware rt73\.bin is missing"
    lab.machines[ONE].console.expect(said, SECONDS)
    until(lab, "grep -qx 'in the cell' /run/flotilla/cell")
    is_well(lab)


def test_a_computer_out_of_range_is_missed_until_it_is_back(lab: GuestFleet, segment: RadioSegment) -> None:
    assert lab.robot.board.wait_relays(on=False, timeout=SECONDS)
    segment.air.reach(ONE, reached=False)
    is_cut(lab)
    segment.air.reach(ONE, reached=True)
    is_well(lab)
    assert sh(lab, ONE, "cat /run/flotilla/cell") == "in the cell", "it had been in the cell, with nobody in its range"


def test_who_joins_late_is_let_in(lab: GuestFleet) -> None:
    lab.machines[ONE].cut()
    is_cut(lab)
    lab.machines[ONE].on()
    is_well(lab)


@pytest.mark.parametrize("loss", [0, 0.01, 0.05, 0.1])
def test_the_square_is_flown_with_loss(
    lab: GuestFleet, segment: RadioSegment, loss: float, record_property: Callable[[str, object], None]
) -> None:
    """Of each attempt of a frame; an adapter makes several. The bound is that of test_scenarios_guests.py."""
    lab.restart_with(virtual.square("udp", "the square", TESTED_SIDE_M))
    lab.hold()
    segment.air.loss = loss
    try:
        lab.wait_connected()
        lab.begin()
        lab.until(lambda: lab.done, 2 * SECONDS)
        flight = lab.flight()
    finally:
        segment.air.loss = 0
    said = f"loss {loss}: {flight.lost()} of {len(flight.arrived)} steps lost, RMS {flight.error().rms_m * 1000:.1f} mm"
    record_property(PROPERTY, f"{said}; four hops {flight.latency().percentiles_us} µs")
    assert flight.error().rms_m <= RMS_M
    assert flight.lost() <= 0.01 * len(flight.arrived)


@pytest.fixture
def twelve(tmp_path: Path) -> Path:
    """The description of twelve robots in another subnet and on another channel: lines of an inventory, no code."""
    directory = tmp_path / "inventory"
    scale.describe(12, BOARD, directory)
    robots = yaml.safe_load((directory / "robots.yml").read_text())
    for robot in robots["robots"]["children"][f"board_{BOARD}"]["hosts"].values():
        robot["address"] = f"172.20.7.{100 + robot['number']}"
    robots["stations"]["hosts"] = {"desk": {"address": "172.20.7.1"}}
    (directory / "robots.yml").write_text(yaml.safe_dump(robots))
    file = directory / "group_vars/all.yml"
    shared = yaml.safe_load(file.read_text())
    cell = {"ssid": "dozen", "frequency_mhz": 2462, "bssid": "02:00:00:00:00:12", "interface": "wlan0"}
    shared["network"] |= {"subnet": "172.20.7.0/24", "link": "ibss", "ibss": cell}
    file.write_text(yaml.safe_dump(shared))
    our_kernel(directory)
    return directory


def test_twelve_robots_on_another_subnet_and_channel(twelve: Path, tmp_path: Path) -> None:
    """Each reaches each other and the station. What `check-fleet` asks first, is asked first."""
    fleet = inventory.load_fleet(twelve)
    assigned.check(fleet, fleet.robots.values())
    robots = list(fleet.robots.values())
    assert len(robots) == 12
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(paths, "KEYS", tmp_path / "keys"))
        build.build(fleet, robots, tmp_path / "images")
        segment = stack.enter_context(segment_of(fleet, robots, tmp_path / "segment"))
        machines, shells = {}, {}
        for robot in robots:
            image = build.image_of(robot, tmp_path / "images")
            guest = Guest(fleet.boards[robot.board], image, tmp_path / robot.name, segment.options(robot))
            machines[robot.name] = stack.enter_context(guest)
            port = functools.partial(segment.ssh_port, robot.address)
            shells[robot.name] = stack.enter_context(Ssh(robot, "127.0.0.1", port))
        for group in zip(*[iter(robots)] * AT_ONCE, strict=True):
            for robot in group:
                machines[robot.name].on()
            for robot in group:
                machines[robot.name].console.expect(rf"{robot.name} login: ", 4 * SECONDS)
                shells[robot.name].connect(4 * SECONDS)
        peers = " ".join(str(one.address) for one in [*robots, *fleet.stations])
        for robot in robots:
            shell = shells[robot.name]
            shell.script(f"for peer in {peers}; do ping -q -c 1 -w {SECONDS} $peer || exit; done", timeout=4 * SECONDS)
            assert "freq: 2462" in shell.script("iw dev wlan0 link").stdout
            assert str(robot.address) in shell.script("ip -4 address show dev wlan0").stdout
