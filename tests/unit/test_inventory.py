"""Every check of the inventory has an edit of the real one here that makes it speak, once and at the right place."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from flotilla.common import paths, yaml_file
from flotilla.common.errors import Problem, ProblemsError, UserError
from flotilla.fleet import inventory

ROBOTS = "robots.yml"
ALL = "group_vars/all.yml"
PC104 = "group_vars/board_smartcoret3.yml"
X86_64 = "group_vars/board_x86_64.yml"

ROBOT4 = "robot4:\n          number: 4\n          address: 10.42.0.4\n"
GYRO3 = "robot3:\n          number: 3\n          address: 10.42.0.3\n          devices:\n            gyro:"
PORT3 = GYRO3 + "\n              port: COM5"
X86_64_GROUP = "board_x86_64:\n      hosts:"


class Case(NamedTuple):
    """An edit (`old` → `new`, first occurrence), and where the one problem must be with which words."""

    file: str
    old: str
    new: str
    key: str
    words: str
    """In message and remedy, in this order, `…` between."""
    at: str = ""
    """In the line that is named; the key's last part unless given."""
    reported: str = ""
    """File that is named, if another than the edited one."""
    also: int = 0
    """Further problems of the same edit: a misspelt key is also a missing one."""


CASES = {
    # Robots against each other
    "number twice": Case(ROBOTS, "number: 4", "number: 3", "robot4.number", "is robot3's number…next free one is 4"),
    "address twice": Case(
        ROBOTS, "10.42.0.4", "10.42.0.3", "robot4.address", "is robot3's address…free one is 10.42.0.4"
    ),
    "address of the station": Case(
        ROBOTS, "10.42.0.254", "10.42.0.1", "station.address", "is robot1's address…10.42.0.5"
    ),
    "copied without a new name": Case(
        ROBOTS, ROBOT4, ROBOT4 + "        " + ROBOT4, "robot4", "stands twice, first in line 65…another name"
    ),
    # One robot
    "number 0": Case(ROBOTS, "number: 4", "number: 0", "robot4.number", "out of range…1 to 250"),
    "CAN interface": Case(
        ROBOTS,
        "number: 4",
        "number: 4\n          can: { vcan0: { bitrate: 500000 } }",
        "robot4.can.vcan0",
        "CAN interface's name…can0 to can9",
    ),
    "CAN bit rate": Case(
        ROBOTS,
        "number: 4",
        "number: 4\n          can: { can0: { bitrate: 512000 } }",
        "robot4.can.can0.bitrate",
        "standard rate…500000, 800000, 1000000",
    ),
    "CAN restart": Case(
        ROBOTS,
        "number: 4",
        "number: 4\n          can: { can0: { bitrate: 500000, restart_ms: 0 } }",
        "robot4.can.can0.restart_ms",
        "out of range…1 to 60000",
    ),
    "CAN interface twice": Case(
        ROBOTS,
        "number: 4",
        "number: 4\n          can:\n            can0: { bitrate: 500000 }\n            can0: { bitrate: 250000 }",
        "robot4.can.can0",
        "stands twice…",
    ),
    "CAN without rate": Case(
        ROBOTS,
        "number: 4",
        "number: 4\n          can: { can0: {} }",
        "robot4.can.can0.bitrate",
        "is missing…",
        "can0",
    ),
    "watchdog's port": Case(
        PC104, "port: 0x443", "port: 0x10443", "board.watchdog.start.port", "out of range…0 to 65535"
    ),
    "number 251": Case(ROBOTS, "number: 4", "number: 251", "robot4.number", "out of range…1 to 250"),
    "number in words": Case(ROBOTS, "number: 4", "number: four", "robot4.number", "not a whole number…digits"),
    "number in quotes": Case(ROBOTS, "number: 4", "number: '4'", "robot4.number", "not a whole number…without quotes"),
    "number true": Case(ROBOTS, "number: 4", "number: true", "robot4.number", "not a whole number"),
    "no number": Case(ROBOTS, "          number: 4\n", "", "robot4.number", "is missing…add it", "robot4:"),
    "address outside": Case(
        ROBOTS, "10.42.0.4", "10.42.1.4", "robot4.address", "outside…10.42.0.0/24…10.42.0.1 to 10.42.0.254"
    ),
    "network address": Case(ROBOTS, "10.42.0.4", "10.42.0.0", "robot4.address", "network address…10.42.0.1 to"),
    "broadcast address": Case(ROBOTS, "10.42.0.4", "10.42.0.255", "robot4.address", "broadcast address…10.42.0.1 to"),
    "no address at all": Case(ROBOTS, "10.42.0.4", "10.42.0", "robot4.address", "not an IPv4 address…four numbers"),
    "address misspelt": Case(
        ROBOTS, "address: 10.42.0.254", "adress: 10.42.0.254", "station.adress", "mean address", also=1
    ),
    "template": Case(ROBOTS, "10.42.0.4", '"10.42.0.{{ number }}"', "robot4.address", "template…value itself"),
    "host name": Case(ROBOTS, "robot4:", "Robot_4:", "Robot_4", "not a valid host name…hyphens"),
    # Its devices
    "port taken": Case(
        ROBOTS, "port: COM6", "port: COM5", "robot1.devices.magnetometer.port", "gyro is plugged…free are COM2, COM3"
    ),
    "no such port": Case(
        ROBOTS, "COM6", "COM13", "robot1.devices.magnetometer.port", "smartcoret3 has no such port…COM12"
    ),
    "port of the other board": Case(
        ROBOTS,
        "address: 10.42.0.2\n",
        "address: 10.42.0.2\n          devices: {gyro: {port: COM5, baud: 38400}}\n",
        "robot2.devices.gyro.port",
        "x86_64 has no such port…free are COM2",
    ),
    "console's port": Case(ROBOTS, "COM6", "COM1", "robot1.devices.magnetometer.port", "console's port (ttyS0)…COM2"),
    "port and usb": Case(
        ROBOTS,
        "port: COM6",
        "port: COM6\n              usb: '0403:6001'",
        "robot1.devices.magnetometer",
        "both at a port and on USB…either port",
    ),
    "neither port nor usb": Case(
        ROBOTS,
        "              port: COM6\n",
        "",
        "robot1.devices.magnetometer",
        "port is missing…either port",
    ),
    "usb": Case(
        ROBOTS,
        "port: COM6",
        "usb: Hokuyo",
        "robot1.devices.magnetometer.usb",
        "is not who a USB…15d1:0000",
        "Hokuyo",
        also=1,
    ),
    "usb twice": Case(
        ROBOTS,
        "              port: COM6\n              baud: 9600\n            battery: # OceanServer battery controller\n"
        "              port: COM7",
        "              usb: '0403:6001/A1'\n              baud: 9600\n            battery:\n"
        "              usb: '0403:6001'",
        "robot1.devices.magnetometer.usb",
        "is also battery's…serial number",
    ),
    "unusual baud": Case(
        ROBOTS, "baud: 9600", "baud: 9601", "robot1.devices.magnetometer.baud", "standard…9600, 19200"
    ),
    "no baud": Case(
        ROBOTS, PORT3 + "\n              baud: 38400", PORT3, "robot3.devices.gyro.baud", "is missing", "gyro:"
    ),
    "device name": Case(
        ROBOTS, GYRO3, GYRO3.replace("gyro", "Gyro-1"), "robot3.devices.Gyro-1", "valid device name…/dev/robot/NAME"
    ),
    "device's key": Case(
        ROBOTS, PORT3, PORT3.replace("port:", "prot:"), "robot3.devices.gyro.prot", "not known…mean port?", also=1
    ),
    "no such task": Case(
        ROBOTS, "[heading]", "[haeding]", "robot1.control_tasks.0", "no file…one of control…heading", "haeding"
    ),
    "overruns by the thousand": Case(
        ALL, "overruns_percent: 1", "overruns_percent: 1000", "health.overruns_percent", "out of range…0 to 100"
    ),
    "overruns in words": Case(
        ALL, "overruns_percent: 1", "overruns_percent: few", "health.overruns_percent", "not a number…digits"
    ),
    "sensor of no task": Case(
        ALL,
        "required_sensors: []",
        "required_sensors: [gyro]",
        "health.required_sensors.0",
        "not TASK.BLOCK…heading.gyro",
        "gyro",
        also=1,
    ),
    "sensor of a task that no robot has": Case(
        ALL,
        "required_sensors: []",
        "required_sensors: [valves.command]",
        "health.required_sensors.0",
        "no robot has a control task valves…sensor of heading",
        "valves",
    ),
    "health misspelt": Case(
        ALL, "overruns_percent: 1", "overrun_percent: 1", "health.overrun_percent", "mean overruns_percent"
    ),
    "tasks without users": Case(
        ROBOTS,
        "[heading]",
        f"[{', '.join(['heading'] * 17)}]",
        "robot1.control_tasks",
        "has 17 tasks…16 at most",
        also=16,
    ),
    "task twice": Case(ROBOTS, "[heading]", "[heading, heading]", "robot1.control_tasks.1", "already…once", "heading"),
    "stands by for a task it has not": Case(
        ROBOTS,
        "[heading]",
        "[heading]\n          standby: [control]",
        "robot1.standby.0",
        "none of robot1's…control_tasks",
        "standby",
    ),
    "all stand by": Case(
        ROBOTS,
        "[heading]",
        "[heading]\n          standby: [heading]",
        "robot1.standby.0",
        "no robot has heading first",
        "standby",
    ),
    "stands by twice": Case(
        ROBOTS,
        "[heading]",
        "[heading]\n          standby: [heading, heading]",
        "robot1.standby.1",
        "listed already",
        "standby",
        also=2,
    ),
    "task's name": Case(
        ROBOTS, "[heading]", "[Head.ing]", "robot1.control_tasks.0", "not a task's name", "Head", also=1
    ),
    "no such app": Case(
        ROBOTS,
        "10.42.0.4\n",
        "10.42.0.4\n          apps: [hover, hoover]\n",
        "robot4.apps.1",
        "there is no…apps/hoover/app.yml…one of heading, hover, wide, or `make new-app KIND=block NAME=hoover`",
        "hoover",
    ),
    "app of a board's robots": Case(
        X86_64, "board:\n", "apps: [hoover]\nboard:\n", "robot2.apps.0", "there is no…apps/hoover", "apps"
    ),
    "app twice": Case(
        ROBOTS,
        "10.42.0.4\n",
        "10.42.0.4\n          apps: [hover, hover]\n",
        "robot4.apps.1",
        "hover is listed already…once",
        "hover",
    ),
    "app for another board": Case(
        ROBOTS,
        "10.42.0.4\n",
        "10.42.0.4\n          apps: [wide]\n",
        "robot4.apps.0",
        "wide is for the board x86_64, and robot4 is a smartcoret3…apps/wide/app.yml",
        "wide",
    ),
    "app with a task's name": Case(
        ROBOTS,
        "[heading]\n",
        "[heading]\n          apps: [heading]\n",
        "robot1.apps.0",
        "one of robot1's control tasks…rename…apps/heading",
        "heading",
    ),
    "app's name": Case(
        ROBOTS,
        "10.42.0.4\n",
        "10.42.0.4\n          apps: [../hover]\n",
        "robot4.apps.0",
        "is not an app's name…apps/hover",
        "hover",
        also=1,
    ),
    "apps as a word": Case(
        ROBOTS, "10.42.0.4\n", "10.42.0.4\n          apps: hover\n", "robot4.apps", "not a list…- item"
    ),
    "devices empty": Case(
        ROBOTS, "10.42.0.4", "10.42.0.4\n          devices:", "robot4.devices", "is not a mapping…or remove it"
    ),
    "devices misspelt": Case(
        ROBOTS, "devices:\n            gyro: #", "device:\n            gyro: #", "robot1.device", "mean"
    ),
    # Groups
    "no board": Case(
        ROBOTS,
        "  children:\n",
        "  hosts:\n    robot9:\n      number: 9\n      address: 10.42.0.9\n  children:\n",
        "robot9",
        "in no board group…board_smartcoret3, board_x86_64",
    ),
    "two boards": Case(
        ROBOTS, X86_64_GROUP, X86_64_GROUP + "\n        robot4:", "robot4", "several board groups…leave it in one"
    ),
    "board without description": Case(
        ROBOTS, "board_x86_64:", "board_new:", "board", "not described…copy another board's file", "", "board_new.yml"
    ),
    "board outside the robots": Case(
        ROBOTS,
        "robots:\n  children:\n    board_smartcoret3:",
        "robots: {hosts: {robot1: , robot2: , robot3: }}\ncomputers:\n  children:\n    board_smartcoret3:",
        "robot4",
        "board_smartcoret3, which is not below robots…robots' children",
    ),
    "robot and station": Case(
        ROBOTS, "    station:\n", "    robot4:\n    station:\n", "robot4", "robot and station…one of the groups"
    ),
    "neither robot nor station": Case(
        ROBOTS, "stations:", "computers:", "station", "neither robot nor station…stations"
    ),
    "hosts misspelt": Case(
        ROBOTS, "stations:\n  hosts:", "stations:\n  host:", "stations.host", "Ansible ignores it…mean hosts?"
    ),
    "network set for one robot": Case(
        ROBOTS,
        "number: 4",
        "number: 4\n          network: {}",
        "robot4.network",
        "only a part…group_vars/all.yml",
    ),
    # Network
    "no fleet name": Case(ALL, "fleet_name: flotilla", "", "fleet_name", "is missing", "network"),
    "fleet name": Case(ALL, "fleet_name: flotilla", "fleet_name: My Fleet", "fleet_name", "host name"),
    "subnet": Case(ALL, "10.42.0.0/24", "10.42.0.1/24", "network.subnet", "not an IPv4 network…zeros"),
    "subnet without length": Case(ALL, "10.42.0.0/24", "10.42.0.0", "network.subnet", "no room…length 8 to 30"),
    "link": Case(ALL, "link: ethernet", "link: wifi", "network.link", "not known…one of 'ethernet' or 'ibss'"),
    "dds domain": Case(ALL, "dds_domain: 42", "dds_domain: 233", "network.dds_domain", "out of range…0 to 232"),
    "udp port": Case(ALL, "5000-5099", "65536", "network.udp_ports.0", "a range…65535", "65536"),
    "udp range": Case(ALL, "5000-5099", "5099-5000", "network.udp_ports.0", "a range…5000-5099", "5099-5000"),
    "udp ports": Case(ALL, "udp_ports:\n    - 5000-5099", "udp_ports: 5000", "network.udp_ports", "not a list…- item"),
    "network's key": Case(ALL, "udp_ports:", "udp_port:", "network.udp_port", "not known…mean udp_ports?", also=1),
    "link without a cell": Case(  # what follows the link goes to a variable of its own
        ALL,
        "  link: ethernet\n",
        "  link: ibss\n  dds_domain: 1\n  udp_ports: []\nradio:\n",
        "network.ibss",
        "missing, and the link is ibss…ssid",
        "network:",
    ),
    "nothing to read": Case(
        ALL, "network:", "networks:", "networks", "not a variable of the fleet…mean network", also=1
    ),
    # Radio
    "ssid": Case(ALL, "ssid: flotilla", f"ssid: {'ü' * 17}", "network.ibss.ssid", "network name…1 to 32 bytes"),
    "frequency": Case(ALL, "2412", "2413", "network.ibss.frequency_mhz", "centre of an 802.11 channel…2412, 2417"),
    "bssid": Case(ALL, "02:ca:ff:ee:10:42", "02:ca:ff:ee:10", "network.ibss.bssid", "not a BSSID…six pairs"),
    "bssid multicast": Case(ALL, '"02:ca', '"03:ca', "network.ibss.bssid", "multicast…second digit even"),
    "bssid zero": Case(ALL, "02:ca:ff:ee:10:42", "00:00:00:00:00:00", "network.ibss.bssid", "zero address"),
    "radio interface": Case(
        ALL, "interface: wlan0", "interface: wlan/0", "network.ibss.interface", "wlan0, at most 15"
    ),
    # Boards
    "architecture": Case(PC104, "architecture: i386", "architecture: i686", "board.architecture", "'i386' or 'amd64'"),
    "kernel": Case(PC104, "kernel: debian", "kernel: stock", "board.kernel", "not known…'debian' or 'lean'"),
    "kernel argument": Case(
        PC104, "- irqpoll", "- irqpoll quiet", "board.kernel_arguments.0", "blanks…one word", "irqp"
    ),
    "too few uarts": Case(
        PC104, "    - 8250.nr_uarts=16", "    #", "board.kernel_arguments", "only ttyS0 to ttyS3…8250.nr_uarts=16"
    ),
    "tty twice": Case(PC104, "ttyS7", "ttyS6", "board.ports.COM8.tty", "belongs to port COM7 already", "COM8"),
    "tty with folder": Case(PC104, "ttyS7", "/dev/ttyS7", "board.ports.COM8.tty", "kernel name…ttyS4", "COM8"),
    "isa base": Case(
        PC104,
        "tty: ttyS7",
        "tty: ttyS7, isa: {io: 0x3E9, irq: 4}",
        "board.ports.COM8.isa.io",
        "base address…0x3E8",
        "COM8",
    ),
    "isa base twice": Case(
        PC104,
        "{ tty: ttyS6 }\n    COM8: { tty: ttyS7 }",
        "{tty: ttyS6, isa: {io: 0x100, irq: 5}}\n    COM8: {tty: ttyS7, isa: {io: 0x100, irq: 5}}",
        "board.ports.COM8.isa.io",
        "belongs to port COM7",
        "COM8",
    ),
    "isa irq": Case(
        PC104, "tty: ttyS7", "tty: ttyS7, isa: {io: 0x3E8, irq: 16}", "board.ports.COM8.isa.irq", "3 to 15", "COM8"
    ),
    "console": Case(PC104, "tty: ttyS0\n", "tty: ttyS4\n", "board.console.tty", "ttyS0 to ttyS3: GRUB"),
    "console's baud": Case(PC104, "baud: 115200", "baud: 921600", "board.console.baud", "not a console's rate…115200"),
    "interface": Case(PC104, "eth0", "eth 0", "board.network_interface", "not a network interface's name…eth0"),
    "disk module": Case(PC104, "- sd_mod", "- sd_mod.ko", "board.disk_modules.2", "without .ko", "sd_mod.ko"),
    "board's name": Case(PC104, "board:\n", "board:\n  name: pc104\n", "board.name", "remove it…smartcoret3"),
    "board's key": Case(
        PC104, "  kernel: debian", "  kernel: debian\n  kernels: lean", "board.kernels", "mean kernel?"
    ),
    "release without a kernel": Case(
        PC104, "architecture: i386", "architecture: i386\n  suite: trixie", "board.suite", "no kernel for i386…bookworm"
    ),
    "firmware without a boot loader": Case(
        PC104, "architecture: i386", "architecture: i386\n  firmware: uefi", "board.firmware", "is for amd64…bios"
    ),
    "isolated processor": Case(
        X86_64,
        "isolated_processors: [1]",
        "isolated_processors: [2]",
        "board.isolated_processors.0",
        "processors 0 to 1…`processors:`",
        "[2]",
    ),
    "first processor isolated": Case(
        X86_64,
        "isolated_processors: [1]",
        "isolated_processors: [0]",
        "board.isolated_processors.0",
        "1 to 1023",
        "[0]",
    ),
    "firmware": Case(X86_64, "firmware: uefi", "firmware: efi", "board.firmware", "'bios' or 'uefi'"),
    "qemu system": Case(X86_64, "system: x86_64", "system: i386", "board.qemu.system", "cannot run amd64…x86_64"),
    "qemu memory": Case(X86_64, "memory_mib: 512", "memory_mib: 32", "board.qemu.memory_mib", "64 to 65536"),
    "qemu key": Case(X86_64, "    disk: ahci", "    disk: ahci\n    disks: 2", "board.qemu.disks", "mean disk?"),
    "value twice": Case(
        X86_64, "  kernel: debian", "  kernel: debian\n  kernel: lean", "board.kernel", "stands twice, first in line …"
    ),
    "shared value in the wrong file": Case(
        X86_64, "board:\n", "network: {}\nboard:\n", "network", "a part of those who share it…group_vars/all.yml"
    ),
}


# What `ansible-inventory --list` does, for many inventories in one process: each start would take a second.
ANSIBLE = """
import pathlib, sys
from ansible.cli.inventory import InventoryCLI
from ansible.inventory.manager import InventoryManager
from ansible.parsing.dataloader import DataLoader
from ansible.plugins.loader import init_plugin_loader
from ansible.vars.manager import VariableManager

cli = InventoryCLI(["ansible-inventory", "--list"])
cli.parse()
init_plugin_loader()
for directory in sys.argv[1:]:
    cli.loader = DataLoader()
    cli.inventory = InventoryManager(cli.loader, [directory])
    cli.vm = VariableManager(cli.loader, cli.inventory)
    listed = cli.dump(cli.json_inventory(cli.inventory.groups["all"]))
    pathlib.Path(directory + ".json").write_text(listed)
"""


def edited(directory: Path, *edits: tuple[str, str, str]) -> Path:
    """A copy of the real inventory with `(file, old, new)` edits."""
    shutil.copytree(paths.INVENTORY, directory)
    for name, old, new in edits:
        text = (directory / name).read_text()
        assert old in text, f"{name} has no {old!r} to edit"
        (directory / name).write_text(text.replace(old, new, 1))
    return directory


def problems_of(directory: Path) -> list[Problem]:
    """What `validate` says about an inventory that went through Ansible already."""
    with pytest.raises(ProblemsError) as caught:
        inventory.validate(
            json.loads(directory.with_name(directory.name + ".json").read_text()), inventory.Sources(directory)
        )
    return caught.value.problems


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The inventory of each case, with Ansible's output beside it."""
    top = tmp_path_factory.mktemp("cases")
    made = {name: edited(top / re.sub(r"\W+", "-", name), (c.file, c.old, c.new)) for name, c in CASES.items()}
    argv = [sys.executable, "-c", ANSIBLE, *map(str, made.values())]
    subprocess.run(argv, check=True, capture_output=True)
    return made


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "CACHE", tmp_path_factory.mktemp("cache"))
        yield


@pytest.fixture(autouse=True, scope="module")
def own_apps(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "APPS", tmp_path_factory.mktemp("own") / "apps")
        for name, more in (("hover", ""), ("wide", "board: x86_64\n"), ("heading", "")):
            (paths.APPS / name).mkdir(parents=True)
            (paths.APPS / name / "app.yml").write_text(f"kind: block\n{more}")
        yield


@pytest.mark.parametrize("name", CASES)
def test_check(name: str, merged: dict[str, Path]) -> None:
    case, directory = CASES[name], merged[name]
    problems = problems_of(directory)
    assert len(problems) == 1 + case.also, "\n".join(map(str, problems))
    problem = next(problem for problem in problems if problem.key == case.key)
    file, _, line = problem.file.partition(":")
    assert file.endswith(case.reported or case.file)
    if not case.reported:
        assert (case.at or case.key.split(".")[-1]) in Path(file).read_text().splitlines()[int(line) - 1]
    said = f"{problem.message}; {problem.remedy}"
    assert re.search(".*".join(map(re.escape, case.words.split("…"))), said), said


def test_the_real_fleet() -> None:
    fleet = inventory.load_fleet()
    assert list(fleet.robots) == [1, 2, 3, 4]
    assert {fleet.robots[number].board for number in (1, 3, 4)} == {"smartcoret3"}
    assert fleet.robots[2].board == "x86_64"
    assert list(fleet.boards["smartcoret3"].ports) == [f"COM{number}" for number in range(1, 13)]
    assert fleet.interface(fleet.robots[1]) == "eth0"
    for board in fleet.boards.values():  # whatever the guest is attached to is a connector of the board
        named = re.findall(r"=port(\d+)", " ".join(board.qemu.devices))
        assert [int(index) for index in named] == list(range(1, len(board.ports)))


def test_every_robot_is_in_the_summary() -> None:
    fleet = inventory.load_fleet()
    lines = inventory.summary(fleet).splitlines()
    assert lines[0] == "flotilla: 4 robots, 1 station, 10.42.0.0/24 over ethernet"
    assert [line.split()[:4] for line in lines[1:]] == [
        [str(number), robot.name, robot.board, str(robot.address)] for number, robot in fleet.robots.items()
    ]
    assert "gyro on COM5" in lines[1]


def test_robot_by_number() -> None:
    fleet = inventory.load_fleet()
    assert inventory.robot(fleet, 3).name == "robot3"
    with pytest.raises(UserError) as caught:
        inventory.robot(fleet, 9)
    assert str(caught.value) == "robot 9: no such robot in ansible/inventory/robots.yml; robots are 1, 2, 3, 4"


def test_robot_5_is_three_copied_lines(tmp_path: Path) -> None:
    directory = edited(tmp_path / "inventory")
    file = directory / ROBOTS
    lines = file.read_text().splitlines(keepends=True)
    start = next(number for number, line in enumerate(lines) if line.strip() == "robot4:")
    changes = (("robot4", "robot5"), ("number: 4", "number: 5"), ("10.42.0.4", "10.42.0.5"))
    copied = [line.replace(*change) for line, change in zip(lines[start : start + 3], changes, strict=True)]
    file.write_text("".join(lines[: start + 3] + copied + lines[start + 3 :]))
    fleet = inventory.load_fleet(directory)
    four, five = fleet.robots[4], fleet.robots[5]
    assert (five.name, str(five.address), five.board) == ("robot5", "10.42.0.5", four.board)


def test_all_problems_at_once(tmp_path: Path) -> None:
    directory = edited(
        tmp_path / "inventory",
        (ROBOTS, "number: 4", "number: 3"),
        (ROBOTS, "10.42.0.4", "10.43.0.4"),
        (ROBOTS, "COM6", "COM13"),
        (ROBOTS, "baud: 9600", "baud: 9601"),
        (ALL, "dds_domain: 42", "dds_domain: 420"),
        (PC104, "ttyS7", "ttyS6"),
        (X86_64, "  kernel: debian", "  kernel: debian\n  kernel: lean"),
    )
    with pytest.raises(ProblemsError) as caught:
        inventory.load_fleet(directory)
    assert {problem.key for problem in caught.value.problems} == {
        "robot4.number",
        "robot4.address",
        "robot1.devices.magnetometer.port",
        "robot1.devices.magnetometer.baud",
        "network.dds_domain",
        "board.ports.COM8.tty",
        "board.kernel",
    }
    assert str(caught.value).count("\n") == 6


@pytest.mark.parametrize(
    ("line", "secured"),
    [("udp", False), ("dds", True), ("dds\n  dds_security: false", False), ("dds\n  dds_security: true", True)],
)
def test_messages_by_dds_are_authenticated_unless_a_line_opens_them(tmp_path: Path, line: str, secured: bool) -> None:
    """Seen to fail with `dds` alone: anybody in the cell could publish them."""
    directory = edited(tmp_path / "inventory", (ALL, "transport: udp", f"transport: {line}"))
    assert inventory.load_fleet(directory).network.dds_security is secured


def test_radio_carries_the_address() -> None:
    fleet = inventory.load_fleet()
    radio = fleet.model_copy(update={"network": fleet.network.model_copy(update={"link": "ibss"})})
    assert radio.interface(radio.robots[1]) == "wlan0"


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Paths of everything inside nested mappings and lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in inner:
        yield (*path, key)
        yield from places(child, (*path, key))


@pytest.mark.parametrize("odd", [None, 5, "x", {}], ids=repr)
def test_no_odd_value_confuses_the_checks(odd: object) -> None:
    """Whatever stands in whatever place, the answer is a fleet or problems with remedies, never another exception."""
    sources = inventory.Sources(paths.INVENTORY)
    listed = inventory._merged([paths.INVENTORY])
    problems: list[Problem] = []
    for host in ("robot1", "robot2", "station"):
        variables = listed["_meta"]["hostvars"][host]
        for *above, last in list(places(variables)):
            changed = copy.deepcopy(listed)
            inside = changed["_meta"]["hostvars"][host]
            for step in above:
                inside = inside[step]
            inside[last] = odd
            try:
                inventory.validate(changed, sources)
            except ProblemsError as error:
                problems += error.problems
    assert len(problems) > 50
    assert not [problem for problem in problems if problem.remedy == yaml_file.UNEXPLAINED]


def test_second_load_asks_no_ansible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = edited(tmp_path / "inventory")
    first = inventory.load_fleet(directory)
    asked: list[Path] = []

    def ansible(places: Sequence[Path]) -> str:
        asked.extend(places)
        return "{}"

    monkeypatch.setattr(inventory, "_ansible_inventory", ansible)
    assert inventory.load_fleet(directory) == first
    assert not asked
    (directory / ROBOTS).write_text((directory / ROBOTS).read_text() + "# changed\n")
    with pytest.raises(ProblemsError, match="there are no robots"):
        inventory.load_fleet(directory)
    assert asked == [directory]


def test_users_ansible_settings_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ANSIBLE_INVENTORY_ENABLED", "ini")
    (tmp_path / "ansible.cfg").write_text("[defaults]\nhash_behaviour = nonsense\n")
    monkeypatch.chdir(tmp_path)
    assert json.loads(inventory._ansible_inventory([paths.INVENTORY]))["robots"]


@pytest.mark.parametrize("name", [ROBOTS, ALL, PC104])
def test_syntax_error(name: str, tmp_path: Path) -> None:
    directory = edited(tmp_path / "inventory")
    (directory / name).write_text((directory / name).read_text() + "x: [1\ny: 2\n")
    with pytest.raises(ProblemsError) as caught:
        inventory.load_fleet(directory)
    [problem] = caught.value.problems
    lines = (directory / name).read_text().count("\n")
    assert re.search(rf"{name}:({lines}|{lines + 1})$", problem.file)
    assert problem.message.startswith("is not YAML: ")


def test_what_only_ansible_refuses(tmp_path: Path) -> None:
    directory = edited(tmp_path / "inventory")
    (directory / ALL).write_text("- flotilla\n")
    with pytest.raises(UserError, match=r"Ansible cannot read the inventory:(.|\n)*all\.yml") as caught:
        inventory.load_fleet(directory)
    assert "Traceback" not in str(caught.value)


def test_a_board_behind_a_link_is_read_anew_when_it_changes(tmp_path: Path) -> None:
    """Seen to fail with links known by where they lead: flights were accepted with an earlier board."""
    directory, board = tmp_path / "inventory", tmp_path / "board.yml"
    shutil.copytree(paths.INVENTORY, directory)
    (directory / PC104).rename(board)
    (directory / PC104).symlink_to(board)
    before = inventory.load_fleet(directory).boards["smartcoret3"].description
    board.write_text(board.read_text().replace(before, "another stack"))
    assert inventory.load_fleet(directory).boards["smartcoret3"].description == "another stack"
