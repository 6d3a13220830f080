"""What the templates of rootfs_overlay/ become for a robot."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, message_keys, privileges
from flotilla.fleet.inventory import load_fleet
from flotilla.fleet.model import Acceptance, Device, Fleet, Ibss, IsaResources, Robot
from flotilla.images import data_partition
from flotilla.lab.scenarios import virtual
from flotilla.station import telemetry
from flotilla.updates import multicast


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return load_fleet()


@pytest.fixture(autouse=True)
def _keys(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    # One directory for all tests: keys are made once.
    monkeypatch.setattr(paths, "KEYS", tmp_path_factory.getbasetemp() / "keys")


def _text(fleet: Fleet, robot: Robot, path: str) -> str:
    return identity.render(fleet, robot)[PurePosixPath(path)][0].decode()


def test_robots_differ_where_they_should(fleet: Fleet) -> None:
    three, four = (identity.render(fleet, fleet.robots[number]) for number in (3, 4))
    differing = {str(path) for path in three | four if three.get(path) != four.get(path)}
    assert differing == {
        "/etc/chrony/chrony.conf", "/etc/chrony/chrony.keys", "/etc/flotilla/cyclonedds.xml",
        "/etc/flotilla/message-keys", "/etc/hostname", "/etc/machine-id",
        "/etc/ssh/ssh_host_ed25519_key", "/etc/ssh/ssh_host_ed25519_key.pub",
        "/etc/systemd/network/10-fleet.network", "/etc/udev/rules.d/70-robot.rules",
    }  # fmt: skip


def test_tasks_start_with_the_robot(fleet: Fleet) -> None:
    assert "\nWants=flotilla-task@heading.service\n" in _text(
        fleet, fleet.robots[1], "/etc/systemd/system/sysinit.target.d/tasks.conf"
    )
    assert "period: 10 ms" in _text(fleet, fleet.robots[1], "/etc/flotilla/tasks/heading.yml")


@pytest.mark.parametrize("transport", ["udp", "dds"])
def test_only_what_drives_io_ports_may(transport: str) -> None:
    """Seen to fail with the privilege in the template of all services, and with `udp-receive` in the table."""
    flying = virtual.fleet(transport)
    rendered = {path for robot in flying.robots.values() for path in identity.render(flying, robot)}
    allowed = {path.parent.name for path in rendered if path.name == "io-ports.conf"}
    assert allowed == {"flotilla-task@valves.service.d"}
    shared = (paths.PROJECT / "runtime" / "systemd" / "flotilla-control@.service.in").read_text().splitlines()
    assert "CapabilityBoundingSet=" in shared
    assert not any(line.startswith("AmbientCapabilities") for line in shared)


def test_control_tasks_have_users_of_their_own_and_their_devices_alone(fleet: Fleet) -> None:
    """Seen to fail with the groups of all devices for each, and with AF_CAN for all."""
    wheeled = load_fleet(paths.PROJECT / "flotilla/lab" / "wheeled" / "inventory")
    (robot,) = wheeled.robots.values()
    for number, (task, can) in enumerate({"drive": True, "perceive": False}.items()):
        assert robot.control_tasks[number] == task
        lines = _text(wheeled, robot, f"/etc/systemd/system/flotilla-task@{task}.service.d/user.conf").splitlines()
        assert f"User=control{number + 1}" in lines
        assert "SupplementaryGroups=realtime control" in lines, "no dialout, no video"
        assert ("RestrictAddressFamilies=~AF_CAN" in lines) is not can
    rules = [_text(fleet, fleet.robots[number], "/etc/udev/rules.d/70-robot.rules") for number in (1, 3)]
    gyro, of_no_task = (next(line for line in text.splitlines() if "robot/gyro" in line) for text in rules)
    assert 'OWNER="control1"' in gyro
    assert "OWNER" not in of_no_task


@pytest.mark.parametrize(
    ("block", "groups", "can"),
    [
        ({"type": "epos2"}, "realtime control", True),
        ({"type": "can-send", "parameters": {"interface": "can1"}}, "realtime control", True),
        ({"type": "dsp3000", "parameters": {"device": "/dev/robot/gyro"}}, "realtime control", False),
        ({"type": "dsp3000", "parameters": {"device": "/dev/ttyS5"}}, "realtime control dialout", False),
        ({"type": "frame-grabber-v4l2"}, "realtime control video", False),
        ({"type": "frame-grabber-iidc", "parameters": None}, "realtime control video", False),
    ],
)
def test_a_task_gets_what_its_blocks_need(block: dict[str, Any], groups: str, can: bool) -> None:
    """Seen to fail with each of the groups left out."""
    lines = privileges.user(15, {"blocks": {"any": block}}).splitlines()
    assert "User=control16" in lines
    assert f"SupplementaryGroups={groups}" in lines
    assert ("RestrictAddressFamilies=~AF_CAN" in lines) is not can


def test_a_device_of_two_tasks_is_an_error() -> None:
    tasks = {name: {"blocks": {"any": {"parameters": {"device": "/dev/robot/gyro"}}}} for name in ("first", "second")}
    ((task, problem),) = privileges.shared_devices(tasks)
    assert task == "second"
    assert "/dev/robot/gyro is open in first too: read it in one task" in problem


def test_a_task_talks_to_the_one_robot_that_has_the_other(fleet: Fleet) -> None:
    def rendered(tasks: dict[int, list[str]], transport: str) -> str:
        robots = {number: fleet.robots[number].model_copy(update={"control_tasks": tasks[number]}) for number in tasks}
        network = fleet.network.model_copy(update={"transport": transport})
        several = fleet.model_copy(update={"robots": robots, "network": network})
        return _text(several, robots[3], "/etc/flotilla/tasks/sensors.yml")

    two = {3: ["sensors"], 4: ["navigation"]}
    assert (
        f"type: udp-send\n    in: {{ data: message.out }}\n    parameters: {{ address: {fleet.robots[4].address},"
        in (rendered(two, "udp"))
    )
    assert "type: dds-publish\n" in rendered(two, "dds")
    for number, words in {1: "robot4 and robot1 has it", 4: "no robot has it"}.items():
        tasks = {3: ["sensors"], 4: ["navigation"], 1: []} | {number: ["navigation"] if number == 1 else []}
        with pytest.raises(UserError, match=rf"sensors\.yml: control task navigation: {words}"):
            rendered(tasks, "udp")


def test_rendering_repeats(fleet: Fleet) -> None:
    assert identity.render(fleet, fleet.robots[3]) == identity.render(fleet, fleet.robots[3])


def test_reading_a_description_pins_no_keys(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail when tasks were read as part of all files: a station of another fleet unpinned this one's robots."""
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    flying = virtual.fleet("udp")
    assert {stream.port for stream in telemetry.streams(flying)} == {5020, 5021}
    for robot in flying.robots.values():
        files = {f"{name}.yml": task for name, task in identity.control_tasks(flying, robot).items()}
        assert not paths.KEYS.exists()
        rendered = identity.render(flying, robot)
        assert files == {path.name: task for path, (task, _) in rendered.items() if path.parent == identity.TASKS}
        shutil.rmtree(paths.KEYS)


def test_a_robot_that_stands_by_is_sent_to_and_listened_to() -> None:
    """By both transports; a task that other tasks do not expect twice is refused."""

    def rendered(transport: str, task: str, standby: dict[str, str]) -> dict[str, Any]:
        flying = virtual.fleet(transport, standby)
        robot = flying.robots_with(task)[0]
        return dict(yaml.safe_load(identity.control_tasks(flying, robot)[task])["blocks"])

    both = {"robot2": "control"}
    assert rendered("udp", "navigation", both)["to_control"]["parameters"]["address"] == ["170.160.1.3", "170.160.1.2"]
    assert rendered("udp", "thruster-mapping", both)["wrench"]["parameters"]["from"] == ["170.160.1.3", "170.160.1.2"]
    assert rendered("dds", "thruster-mapping", both)["wrench"]["parameters"]["robot"] == [3, 2]
    for transport in ("udp", "dds"):
        assert rendered(transport, "control", both)["to_mapping"]["in"]["withhold"] == "silent.out"
        assert "withhold" not in rendered(transport, "control", {})["to_mapping"]["in"]
        assert rendered(transport, "control", {})["to_mapping"]["in"]["sequence"] == "state.sequence"
        assert "sequence" not in rendered(transport, "sensors", {})["to_navigation"]["in"]
    with pytest.raises(UserError, match=r"navigation: no robot can be its hot standby, and robot4 is"):
        rendered("udp", "control", {"robot4": "navigation"})


def test_stations_hear_all_and_the_first_says_where_the_robot_is() -> None:
    """And a station proves that it does. Seen to fail when a stream was looked for by one address, and without keys."""
    flying = virtual.fleet("udp", second_station=True)
    sensors, valves = (
        yaml.safe_load(identity.control_tasks(flying, flying.robot_with(task))[task])["blocks"]
        for task in ("sensors", "valves")
    )
    both = ["170.160.1.254", "170.160.1.252"]
    assert sensors["igps"]["parameters"]["keys"] == message_keys.CREDENTIAL
    assert sensors["igps"]["parameters"]["from"] == valves["to_station"]["parameters"]["address"] == both
    assert {stream.port for stream in telemetry.streams(flying)} == {5020, 5021}


def test_dds_looks_for_other_robots_tasks_and_one_program_more() -> None:
    described = virtual.fleet("dds")
    first = 7400 + 250 * described.network.dds_domain + 10
    for robot in described.robots.values():
        there = re.findall('<Peer Address="(.*?)"', _text(described, robot, "/etc/flotilla/cyclonedds.xml"))
        of = {str(other.address): len(other.control_tasks) for other in described.robots.values() if other != robot}
        ports = [f"{address}:{first + 2 * n}" for address, tasks in of.items() for n in range(tasks + 1)]
        assert there == [str(robot.address), *ports]
        assert len(ports) == 9 - (len(robot.control_tasks) + 1)


def test_every_port_in_use_gets_its_name_and_baud_rate(fleet: Fleet) -> None:
    rules = _text(fleet, fleet.robots[1], "/etc/udev/rules.d/70-robot.rules")
    for name, device in fleet.robots[1].devices.items():
        (line,) = (line for line in rules.splitlines() if f'SYMLINK+="robot/{name}"' in line)
        assert f'KERNEL=="{fleet.boards["smartcoret3"].ports[device.port].tty}"' in line
        assert f" {device.baud} raw" in line
    assert "setserial" not in rules


def test_a_device_on_usb_is_known_by_who_it_is(fleet: Fleet) -> None:
    """In whichever socket, and by its serial number where one is given."""
    usb = {
        "laser": Device(usb="15d1:0000", baud=115200),
        "gps": Device(usb="0403:6001/A9XYZ", baud=4800),
    }
    robot = fleet.robots[1].model_copy(update={"devices": usb})
    rules = _text(fleet, robot, "/etc/udev/rules.d/70-robot.rules").splitlines()
    laser, gps = (next(line for line in rules if f'SYMLINK+="robot/{name}"' in line) for name in usb)
    for line, vendor, product in (laser, "15d1", "0000"), (gps, "0403", "6001"):
        assert line.startswith('SUBSYSTEM=="tty", SUBSYSTEMS=="usb", ')
        assert f'ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}", ' in line
        assert "KERNEL==" not in line
    assert "ATTRS{serial}" not in laser
    assert 'ATTRS{serial}=="A9XYZ", ' in gps
    assert "/bin/stty -F /dev/%k 4800 raw" in gps


def test_a_port_with_jumpers_is_declared_before_it_is_used(fleet: Fleet) -> None:
    board = fleet.boards["smartcoret3"]
    port = board.ports["COM5"].model_copy(update={"isa": IsaResources(io=0x100, irq=5)})
    board = board.model_copy(update={"ports": board.ports | {"COM5": port}})
    jumpers = fleet.model_copy(update={"boards": fleet.boards | {"smartcoret3": board}})
    rules = _text(jumpers, jumpers.robots[3], "/etc/udev/rules.d/70-robot.rules")
    assert "/bin/setserial /dev/%k port 0x100 irq 5 uart 16550A" in rules
    assert rules.index("setserial") < rules.index("robot/gyro")


def test_an_ad_hoc_cell_moves_the_address_to_the_radio(fleet: Fleet) -> None:
    ibss = Ibss(ssid="fleet", frequency_mhz=2412, bssid="02:11:22:33:44:55")
    network = fleet.network.model_copy(update={"link": "ibss", "ibss": ibss})
    radio = fleet.model_copy(update={"network": network})
    assert "Name=wlan0" in _text(radio, radio.robots[3], "/etc/systemd/network/10-fleet.network")
    assert "BSSID=02:11:22:33:44:55" in _text(radio, radio.robots[3], "/etc/flotilla/ibss.conf")
    assert "flotilla-ibss@" in _text(radio, radio.robots[3], "/etc/udev/rules.d/70-robot.rules")
    assert PurePosixPath("/etc/flotilla/ibss.conf") not in identity.render(fleet, fleet.robots[3]), (
        "not with a wired port"
    )


def test_the_firewall_admits_the_fleet_alone(fleet: Fleet) -> None:
    rules = _text(fleet, fleet.robots[3], "/etc/nftables.conf")
    assert "policy drop" in rules
    assert f"ip saddr != {fleet.network.subnet} drop" in rules
    first = 7400 + 250 * fleet.network.dds_domain
    assert f"{first}-{first + 249}" in rules


def test_the_firewall_admits_files_from_stations_alone(fleet: Fleet) -> None:
    """Seen to fail: another port in the template; a rule for the whole subnet."""
    rules = _text(fleet, fleet.robots[3], "/etc/nftables.conf")
    (rule,) = [line.strip() for line in rules.splitlines() if f"udp dport {multicast.PORT} " in line]
    (station,) = fleet.stations
    assert rule == f"ip saddr {{ {station.address} }} ip daddr {multicast.GROUP} udp dport {multicast.PORT} accept"
    nobody = fleet.model_copy(update={"stations": []})
    assert str(multicast.PORT) not in _text(nobody, nobody.robots[3], "/etc/nftables.conf")


def test_parents_come_before_children(fleet: Fleet) -> None:
    seen = {PurePosixPath("/")}
    for node in data_partition.nodes(fleet, fleet.robots[3]):
        assert node.path.parent in seen, node.path
        seen.add(node.path)


def test_a_template_outside_etc_is_refused(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "usr").mkdir()
    (tmp_path / "usr/file.j2").write_text("{{ robot.name }}\n")
    monkeypatch.setattr(paths, "OVERLAY", tmp_path)
    identity._environment.cache_clear()
    with pytest.raises(UserError, match=r"rootfs_overlay/usr/file\.j2: templates lie below etc/"):
        data_partition.nodes(fleet, fleet.robots[3])
    identity._environment.cache_clear()


def test_a_mistake_in_a_template_names_the_file(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/file.j2").write_text("{{ robot.nmae }}\n")
    monkeypatch.setattr(paths, "OVERLAY", tmp_path)
    identity._environment.cache_clear()
    with pytest.raises(UserError, match=r"etc/file\.j2: .*nmae"):
        identity.render(fleet, fleet.robots[3])
    identity._environment.cache_clear()


def test_the_fleet_model_survives_a_round_trip(fleet: Fleet) -> None:
    """Limits of acceptance stay behind: no image depends on them."""
    again = Fleet.model_validate(json.loads(fleet.model_dump_json()))
    assert again.model_dump() == fleet.model_dump()
    assert {name: board.acceptance for name, board in again.boards.items()} == dict.fromkeys(fleet.boards, Acceptance())


def test_rates_run_below_the_interrupts_that_serve_devices() -> None:
    """A rate computes for tens of ms. Under a task with 80 they had 78 and less, above serial ports and CAN."""
    served = [value for pattern, value in identity.interrupt_priorities().items() if "ata" not in pattern]
    (below,) = re.findall(r"RATES_BELOW = (\d+)", (paths.PROJECT / "runtime/executive/rates.h").read_text())
    assert int(below) == min(served)


@pytest.mark.parametrize(("priority", "refused"), [(70, "irq/*-serial*, irq/*-ttyS*, tty-flip"), (65, "irq/*-can*")])
def test_a_task_has_no_interrupts_priority(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, priority: int, refused: str
) -> None:
    """Seen to fail: `perceive` had that of its laser's interrupt, which waited for each of its steps."""
    monkeypatch.setattr(paths, "TASKS", tmp_path)
    robot = fleet.robots[3].model_copy(update={"control_tasks": ["slow"]})
    text = "period: 100 ms\npriority: {}\nblocks: {{one: {{type: clock}}}}\n"
    (tmp_path / "slow.yml").write_text(text.format(priority - 1))
    identity.control_tasks(fleet, robot)
    (tmp_path / "slow.yml").write_text(text.format(priority))
    with pytest.raises(
        UserError, match=re.escape(f"priority: {priority}: threads of interrupts have it, too ({refused})")
    ):
        identity.control_tasks(fleet, robot)
