"""The QEMU command line, `make boot` and `make ssh`, without running QEMU or ssh."""

from __future__ import annotations

import json
import os
import subprocess
from ipaddress import IPv4Address, IPv4Network
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Network, Robot
from flotilla.lab.qemu import boot, qemu, saved
from flotilla.robot import ssh

ROBOT = Robot(name="robot3", address=IPv4Address("10.42.0.3"), number=3, board="pc104")
NETWORK = Network(subnet=IPv4Network("10.42.0.0/24"), link="ethernet", dds_domain=0, udp_ports=[])
CARD = Path("/somewhere/card,1.qcow2")
EMULATOR: dict[str, Any] = {
    "system": "i386",
    "machine": "pc-i440fx-7.2",
    "cpu": "pentium3",
    "memory_mib": 256,
    "disk": "ide",
    "network": "i82559er",
    "devices": ["isa-serial,index=1,chardev=port1", "ib700"],
}


def board(console: str = "ttyS0", **emulator: Any) -> Board:
    return Board.model_validate(
        {
            "name": "pc104",
            "description": "a stack",
            "architecture": "i386",
            "kernel": "debian",
            "kernel_arguments": [],
            "console": {"tty": console, "baud": 115200},
            "ports": {"COM1": {"tty": "ttyS0"}, "COM2": {"tty": "ttyS1"}, "COM5": {"tty": "ttyS4"}},
            "network_interface": "eth0",
            "disk_modules": ["ata_piix"],
            "qemu": EMULATOR | emulator,
        }
    )


@pytest.fixture(autouse=True)
def qemu_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Programs that QEMU would bring; the command line needs only their paths."""
    directory = tmp_path / "bin"
    directory.mkdir()
    for name in ("qemu-system-i386", "qemu-system-x86_64"):
        (directory / name).write_text("#!/bin/false\n")
        (directory / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(directory))
    return directory


@pytest.fixture
def build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A build directory and keys of the test's own."""
    monkeypatch.setattr(ssh, "RUN", tmp_path / "run")
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys of ours")
    paths.KEYS.mkdir()
    (paths.KEYS / "operator_ed25519").touch()
    (paths.KEYS / "known_hosts").touch()
    return tmp_path


def values(argv: list[str], option: str) -> list[str]:
    """Every value of an option, in order."""
    return [value for name, value in pairwise(argv) if name == option]


def command_line(of: Board, **options: Any) -> list[str]:
    return qemu.command_line(of, CARD, qemu.Options(**options))


def test_machine_is_the_boards_and_nothing_else() -> None:
    argv = command_line(board())
    assert argv[0].endswith("/qemu-system-i386")
    assert "-nodefaults" in argv
    assert values(argv, "-machine") == ["pc-i440fx-7.2"]
    assert values(argv, "-cpu") == ["pentium3"]
    assert values(argv, "-m") == ["256"]
    assert values(argv, "-accel") == ["tcg"]
    assert command_line(board(system="x86_64"))[0].endswith("/qemu-system-x86_64")


def test_a_board_with_uefi_has_its_firmware(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert values(command_line(board()), "-bios") == []
    pc = board().model_copy(update={"firmware": "uefi"})
    monkeypatch.setattr(qemu, "UEFI_PLACES", (tmp_path / "OVMF.fd",))
    with pytest.raises(UserError, match=r"OVMF\.fd.*missing on this computer.*apt-get install.* ovmf"):
        command_line(pc)
    (tmp_path / "OVMF.fd").touch()
    assert values(command_line(pc), "-bios") == [str(tmp_path / "OVMF.fd")]


@pytest.mark.parametrize(
    ("disk", "machine", "devices"),
    [
        ("ide", "pc-i440fx-7.2", ["ide-hd,drive=card,bus=ide.0,unit=0,bootindex=0"]),
        ("ahci", "pc-q35-7.2", ["ide-hd,drive=card,bus=ide.0,unit=0,bootindex=0"]),
        ("ahci", "pc-i440fx-7.2", ["ahci,id=sata", "ide-hd,drive=card,bus=sata.0,bootindex=0"]),
        ("virtio", "pc-i440fx-7.2", ["virtio-blk-pci,drive=card,bootindex=0"]),
        ("nvme", "pc-q35-7.2", ["nvme,drive=card,serial=card,bootindex=0"]),
        ("usb", "pc-q35-7.2", ["qemu-xhci", "usb-storage,drive=card,bootindex=0"]),
    ],
)
def test_card(disk: str, machine: str, devices: list[str]) -> None:
    argv = command_line(board(disk=disk, machine=machine))
    assert values(argv, "-device")[: len(devices)] == devices
    (blockdev,) = map(json.loads, values(argv, "-blockdev"))
    assert blockdev["file"]["filename"] == str(CARD)
    assert blockdev["driver"] == "qcow2"


def test_serial_ports_are_silent_unless_asked() -> None:
    argv = command_line(board(), console="stdio", ports={"COM5": qemu.tcp_socket(4005)})
    assert values(argv, "-serial") == ["chardev:console"]
    assert values(argv, "-chardev") == [
        "stdio,id=console",
        "null,id=port1",
        "socket,id=port2,host=127.0.0.1,port=4005,server=on,wait=off,nodelay=on",
    ]
    devices = values(argv, "-device")
    assert devices.index("isa-serial,index=1,chardev=port1") < devices.index("ib700")
    assert qemu.unix_socket(Path("/a,b")) == "socket,path=/a,,b,server=on,wait=off"


def test_console_on_another_port() -> None:
    argv = command_line(board(console="ttyS1"))
    assert values(argv, "-serial") == ["none", "chardev:console"]
    assert qemu.port_ids(board(console="ttyS1")) == {"COM1": "port0", "COM5": "port2"}


@pytest.mark.parametrize("port", ["COM1", "COM77"])
def test_port_that_is_the_console_or_missing(port: str) -> None:
    with pytest.raises(ValueError, match=f"no port {port} besides the console"):
        command_line(board(), ports={port: qemu.PTY})


def test_user_network_knows_the_fleet_and_lets_nothing_out() -> None:
    link = qemu.UserLink(NETWORK.subnet, ROBOT.address, IPv4Address("10.42.0.254"), 2203)
    argv = command_line(board(), link=link, mac=qemu.robot_mac(3))
    (netdev,) = values(argv, "-netdev")
    assert netdev == (
        "user,id=net,net=10.42.0.0/24,host=10.42.0.254,dns=10.42.0.253,dhcpstart=10.42.0.3,ipv6=off,restrict=on,"
        "hostfwd=tcp:127.0.0.1:2203-10.42.0.3:22"
    )
    assert "i82559er,id=nic,mac=52:54:00:f1:00:03,romfile=,netdev=net" in values(argv, "-device")


def test_time_is_the_hosts_unless_asked() -> None:
    assert not values(command_line(board()), "-icount")
    argv = command_line(board(), steady=True)
    assert values(argv, "-icount") == ["shift=3,sleep=on,align=on"]
    assert values(argv, "-accel") == ["tcg,thread=single"]


def test_datagrams_come_in_and_none_goes_out() -> None:
    guest, station = IPv4Address("10.42.0.3"), IPv4Address("10.42.0.254")
    netdev = qemu.user_netdev("net", NETWORK.subnet, station, {}, {(guest, 5030): 4711}, outward=False)
    assert {"restrict=on", "hostfwd=udp:127.0.0.1:4711-10.42.0.3:5030"} <= set(netdev.split(","))


def test_user_network_with_datagrams_lets_guests_reach_the_station() -> None:
    station, guest = IPv4Address("10.42.0.254"), IPv4Address("10.42.0.3")
    arguments = qemu.user_netdev("net", NETWORK.subnet, station, {}, {(guest, 5010): 4711}).split(",")
    assert {"restrict=off", "hostfwd=udp:127.0.0.1:4711-10.42.0.3:5010"} <= set(arguments)


@pytest.mark.parametrize("last", [252, 253, 254])
def test_user_network_avoids_the_guests_address(last: int) -> None:
    guest = IPv4Address(f"10.42.0.{last}")
    station = qemu.station_address(NETWORK, guest)
    arguments = dict(
        argument.partition("=")[::2]
        for argument in qemu.user_netdev("net", NETWORK.subnet, station, {guest: 0}).split(",")
    )
    assert len({str(guest), arguments["host"], arguments["dns"]}) == 3


def test_wire_stays_on_the_loopback_interface() -> None:
    wire = qemu.Wire(here=4711, there=4712)
    argv = command_line(board(), link=wire, capture=Path("/wire.pcap"))
    assert values(argv, "-netdev") == ["socket,id=net,udp=127.0.0.1:4712,localaddr=127.0.0.1:4711"]
    assert wire.other_end == qemu.Wire(here=4712, there=4711)
    assert values(argv, "-object") == ["filter-dump,id=capture,netdev=net,file=/wire.pcap"]


def test_without_link_the_network_card_is_still_there() -> None:
    argv = command_line(board())
    assert values(argv, "-netdev") == []
    assert any(device.startswith("i82559er,") for device in values(argv, "-device"))


def test_macs_differ() -> None:
    assert len({qemu.robot_mac(number) for number in range(1, 251)}) == 250


def test_switches() -> None:
    plain = command_line(board())
    assert "-S" not in plain
    assert "-no-reboot" not in plain
    assert values(plain, "-mon") == []
    assert values(plain, "-action") == ["watchdog=none"]
    argv = command_line(board(), paused=True, reboot=False, watchdog="pause", qmp="socket,fd=5", extra=("-d", "int"))
    assert "-S" in argv
    assert "-no-reboot" in argv
    assert values(argv, "-action") == ["watchdog=pause"]
    assert "socket,id=qmp,fd=5" in values(argv, "-chardev")
    assert values(argv, "-mon") == ["chardev=qmp,mode=control"]
    assert argv[-2:] == ["-d", "int"]


def test_virtual_time() -> None:
    argv = command_line(board(), virtual_time=True)
    assert values(argv, "-icount") == ["shift=3,sleep=off"]
    assert values(argv, "-accel") == ["tcg,thread=single"]
    assert any("clock=vm" in value for value in values(argv, "-rtc"))


def test_missing_qemu(qemu_installed: Path) -> None:
    (qemu_installed / "qemu-system-i386").unlink()
    with pytest.raises(UserError, match=r"qemu-system-i386 is missing.*apt-get install.*qemu-system-x86 qemu-utils"):
        command_line(board())


def test_boot_without_image(build: Path) -> None:
    with pytest.raises(UserError, match=r"robot3.img is missing; build it: make image ROBOT=3"):
        boot.boot(ROBOT, board(), NETWORK, build / "robot3.img")


def test_boot_without_a_console_names_the_way_to_log_in(
    build: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    image = build / "robot3.img"
    image.touch()
    monkeypatch.setattr(qemu, "make_overlay", lambda *_: None)
    monkeypatch.setattr(subprocess, "run", lambda argv, **_: subprocess.CompletedProcess(argv, 0))
    for console, shown in ((board().console, False), (None, True)):
        boot.boot(ROBOT, board().model_copy(update={"console": console}), NETWORK, image)
        assert ("has no `console:`" in capsys.readouterr().err) == shown


@pytest.mark.parametrize("console", [True, False])
def test_a_guest_without_a_console_has_booted_once_ssh_connects(console: bool) -> None:
    """Seen to fail: `make fleet` waited for a login prompt that this guest does not have."""
    waited = Mock()
    waited.expect.return_value = ["", ROBOT.name]
    booted = board(disk="nvme")  # of which nothing is saved
    guest = Mock(restored=False, board=booted.model_copy(update={} if console else {"console": None}))
    guest.console.expect = waited.expect
    saved.wait(guest, ROBOT, Mock(connect=waited.connect))
    assert [name for name, *_ in waited.mock_calls] == (["expect", "connect"] if console else ["connect"])


def test_port_is_known_only_while_make_boot_runs(build: Path) -> None:
    assert ssh.forwarded_port(ROBOT) is None
    with ssh.announced(ROBOT, 40022):
        assert ssh.forwarded_port(ROBOT) == 40022
        with pytest.raises(UserError, match="runs already"), ssh.announced(ROBOT, 40023):
            pass
        assert ssh.forwarded_port(ROBOT) == 40022
    assert ssh.forwarded_port(ROBOT) is None


def ssh_command(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What `make ssh` would become."""
    became: list[str] = []
    monkeypatch.setattr(os, "execvp", lambda _, argv: became.extend(argv))
    ssh.shell(ROBOT, ["uptime"])
    return became


def test_ssh_pins_the_host_key(build: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And ends where nothing answers: `make param` was seen to wait for 15 minutes."""
    argv = ssh_command(monkeypatch)
    assert argv[-2:] == ["10.42.0.3", "uptime"]
    assert {
        'User="robot"',
        'ConnectTimeout="20"',
        'StrictHostKeyChecking="yes"',
        'HostKeyAlias="robot3"',
        f'UserKnownHostsFile="{build}/keys of ours/known_hosts"',
        f'IdentityFile="{build}/keys of ours/operator_ed25519"',
    } <= set(values(argv, "-o"))


def test_ssh_prefers_the_guest(build: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ssh.announced(ROBOT, 40022):
        assert ssh_command(monkeypatch)[-4:] == ["-p", "40022", "127.0.0.1", "uptime"]


def test_ssh_without_keys(build: Path) -> None:
    (paths.KEYS / "known_hosts").unlink()
    with pytest.raises(UserError, match="known_hosts is missing"):
        ssh.shell(ROBOT)
