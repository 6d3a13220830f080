"""Wheeled robots that can be driven without hardware: their card images as guests in real time, in a room.

Each guest is the image as it would be flashed, on a segment with its station, and starts its own tasks. From outside
come two CAN boards on one bus, and over SSH the plant, which is the drives at the second board and the scanner.

This computer reaches the robots at loopback addresses of their own: what it sends to 127.43.1.1 arrives at the first
robot from its station's address, and what that robot sends its station arrives here from 127.43.1.1. So whatever
commands or watches robots does it with the inventory `station`, which has these addresses, and with no privilege.
What a robot reports arrives here with a proof made here, by the robot's key: nothing that is sent back reaches it.
"""

from __future__ import annotations

import copy
import functools
import math
import shutil
import socket
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path
from typing import Any
from unittest import mock

import yaml

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.fleet import identity, inventory, message_keys, privileges
from flotilla.fleet.model import Fleet, Robot
from flotilla.images import build
from flotilla.lab.plants import wheeled
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.segment import Segment
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import Deadline, Expired
from flotilla.lab.scenarios.virtual import PLANT
from flotilla.lab.wheeled import plant
from flotilla.lab.wheeled.by_wires import INVENTORY
from flotilla.lab.wheeled.plant import BITRATE, Plant, Room
from flotilla.lab.wheeled.virtual import CAN_BOARDS, COMMAND_PORT, DRIVES, LASER
from flotilla.station import telemetry
from flotilla.station.authentication import TRAILER, Signer, receive_challenges

DIRECTORY = paths.BUILD / "wheeled"
MOST = 3
"""Robots: more have no place in the rooms."""
STARTS = ((0, 0, 0), (3.5, 0, math.pi), (3.5, -1.2, math.pi))
"""Where the robots begin: m, m, rad."""
BOOT_SECONDS = 900
"""Until a guest lets us in. Only finite, and generous to a busy host."""
BEGIN_SECONDS = 600
_LOOPBACK = [IPv4Network(f"127.43.{number}.0/24") for number in range(1, 255)]
"""Where this computer may have robots: several labs at once take one each."""
_LONGEST = 65536
_SENDERS = 16
"""Programs that command one robot, of which answers find back."""
_THERE = "/home/robot/plant"
"""What is brought into a guest."""
_BEGIN = """
set -e
mkdir -p {devices}
chown {user} {devices}
until ip link show {drives} >/dev/null 2>&1; do sleep 0.2; done
ip link set {drives} up type can bitrate {bitrate} restart-ms 100
systemd-run --quiet --unit=plant -p User={user} -p SupplementaryGroups='dialout realtime robot' -p LimitRTPRIO=99 \\
    -p LimitMEMLOCK=infinity -p WorkingDirectory={there} flotilla-run --blocks {there} {there}/plant.yml
systemd-run --quiet --unit=busy -p CPUSchedulingPolicy=idle sh -c 'while :; do :; done'
"""
"""The plant makes the laser's terminal, so it runs as the user of the control task that opens it; its files are in the
folder of user `robot`.

Both boards are the kernel's to find; only the first is in the inventory, so nobody else sets the second up.

While the guest's processor is idle its time is the host's, which a host that stops it makes jump: drives and tasks then
miss each other's heartbeats. So the processor is kept busy, by what gives way to all else."""


def write_inventory(directory: Path, count: int, subnet: IPv4Network) -> Fleet:
    """The fleet of `inventory/` with so many of its robot, in another network; as an inventory, too."""
    shutil.rmtree(directory, ignore_errors=True)
    shutil.copytree(INVENTORY, directory)
    described = yaml.safe_load((INVENTORY / "robots.yml").read_text())
    (hosts,) = (group["hosts"] for group in described["robots"]["children"].values())
    ((name, first),) = hosts.items()
    for number in range(1, count + 1):
        hosts[name if number == 1 else f"{name}{number}"] = copy.deepcopy(first) | {
            "number": number,
            "address": str(subnet[number]),
        }
    for station in described["stations"]["hosts"].values():
        station["address"] = str(_moved(IPv4Address(station["address"]), subnet))
    (directory / "robots.yml").write_text(yaml.safe_dump(described, sort_keys=False))
    shared = yaml.safe_load((INVENTORY / "group_vars" / "all.yml").read_text())
    shared["network"]["subnet"] = str(subnet)
    (directory / "group_vars" / "all.yml").write_text(yaml.safe_dump(shared, sort_keys=False))
    return inventory.load_fleet(directory)


def _moved(address: IPv4Address, subnet: IPv4Network) -> IPv4Address:
    """The same host in another network."""
    return subnet[int(address) & int(subnet.hostmask)]


@dataclass(frozen=True)
class LiveRobot:
    """A robot whose guest runs."""

    robot: Robot
    """As its image has it."""
    address: str
    """Where this computer reaches it; its reports come from there."""
    machine: Guest
    shell: Ssh
    ssh_port: int
    """Of the loopback, which leads to its SSH."""

    @property
    def command_address(self) -> tuple[str, int]:
        """Where commands go, by UDP."""
        return self.address, COMMAND_PORT


class Commands:
    """Carries commands that come to the address a robot has here, whoever they are from on this computer: QEMU takes
    nobody but 127.0.0.1 for the station. It brings no answers of the robot, so these come by `answer`."""

    def __init__(self, address: str, port: int) -> None:
        """`port`: of 127.0.0.1, which leads to the robot."""
        self._there = ("127.0.0.1", port)
        self._here = _datagrams(address, COMMAND_PORT)
        self._senders: dict[tuple[str, int], socket.socket] = {}
        """A socket towards the robot for each, by where they send from: the robot sees that socket's port."""
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        with suppress(OSError):  # it says so, though it wakes who receives: it is not connected
            self._here.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        for each in (self._here, *self._senders.values()):
            each.close()

    def answer(self, port: int, datagram: bytes) -> bool:
        """What the robot sent to this port of the station: False if no command came from there."""
        with self._lock:
            for sender, towards in self._senders.items():
                if towards.getsockname()[1] == port:
                    self._here.sendto(datagram, sender)
                    return True
        return False

    def _carry(self) -> None:
        while True:
            datagram, sender = self._here.recvfrom(_LONGEST)
            if self._ended.is_set():
                return
            with suppress(ConnectionRefusedError):  # of one before, while the segment ends
                self._towards(sender).sendto(datagram, self._there)

    def _towards(self, sender: tuple[str, int]) -> socket.socket:
        """Of many senders the one that came first is forgotten."""
        with self._lock:
            if sender not in self._senders:
                if len(self._senders) == _SENDERS:
                    self._senders.pop(next(iter(self._senders))).close()
                self._senders[sender] = _datagrams("127.0.0.1", 0)
            return self._senders[sender]


def _datagrams(address: str, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind((address, port))
    return made


class Cable:
    """Listens to what a guest sends by UDP to the station, from when it is connected: QEMU copies each frame."""

    def __init__(self, path: Path, station: IPv4Address, take: Callable[[int, bytes], None]) -> None:
        """`take` gets port and payload of each datagram, in a thread of its own."""
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))
        self._station = station.packed
        self._take = take
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @staticmethod
    def arguments(path: Path) -> tuple[str, ...]:
        """Of QEMU."""
        mirror = "filter-mirror,id=mirror,netdev=net,queue=rx,outdev=mirror"
        return ("-chardev", qemu.chardev("mirror", qemu.unix_socket(path)), "-object", mirror)

    def close(self) -> None:
        """The guest may have closed it before."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        with self._socket.makefile("rb") as stream:
            while length := stream.read(4):
                if datagram := udp_to(self._station, stream.read(int.from_bytes(length))):
                    self._take(*datagram)


def udp_to(address: bytes, frame: bytes) -> tuple[int, bytes] | None:
    """Port and payload of the UDP datagram to an IPv4 address that an Ethernet frame holds; None: it holds none.

    Nothing that robots report is so long that it comes in fragments.
    """
    packet = frame[14:]
    if len(packet) < 20 or frame[12:14] != b"\x08\x00" or packet[0] >> 4 != 4 or packet[9] != socket.IPPROTO_UDP:
        return None
    if packet[16:20] != address or int.from_bytes(packet[6:8]) & 0x3FFF:  # a fragment
        return None
    begin = 4 * (packet[0] & 0xF)
    if len(packet) < begin + 8:
        return None
    port, length = struct.unpack_from(">2xHH", packet, begin)
    return port, packet[begin + 8 : begin + length]


class Live:
    """Robots that run. Whoever waits for something is woken by each datagram that they send."""

    def __init__(self, fleet: Fleet, station: Path) -> None:
        """`station`: the inventory by which this computer reaches them, `fleet` what it says."""
        self.fleet, self.inventory = fleet, station
        self.robots: list[LiveRobot] = []
        self._streams = {(stream.robot, stream.port): stream for stream in telemetry.streams(fleet)}
        self._newest: dict[tuple[str, int], bytes] = {}
        self._signers: dict[tuple[str, int], Signer] = {}
        self._changed = threading.Condition()

    @property
    def station_address(self) -> str:
        """Where reports arrive on this computer."""
        return str(self.fleet.stations[0].address)

    @property
    def report_port(self) -> int:
        """UDP port of what their tasks `drive` report."""
        (port,) = {stream.port for stream in self._streams.values() if stream.task == "drive"}
        return port

    def report(self, index: int = 0) -> dict[str, Any]:
        """The newest that a robot told its station; empty before it has told any."""
        name = self.robots[index].robot.name
        datagram = self._newest.get((name, self.report_port))
        return self._streams[name, self.report_port].unpack(datagram) if datagram else {}

    def truth(self, index: int = 0) -> dict[str, Any]:
        """The newest of the plant: where the robot really is; `plant.TRUTH` has the names. Empty before the first."""
        datagram = self._newest.get((self.robots[index].robot.name, plant.TRUTH_PORT))
        return plant.truth(datagram) if datagram else {}

    def until(self, what: Callable[[], Any], seconds: float, why: str) -> None:
        """Wait until it is so, which only something that a robot tells can change."""
        deadline = Deadline(seconds)
        with self._changed:
            while not what():
                if deadline.expired:
                    state = [(self.report(index), self.truth(index)) for index in range(len(self.robots))]
                    raise Expired(f"{why}: not within {seconds:g} s: {state}")
                self._changed.wait(min(deadline.left, 1))

    def heard(self, name: str, commands: Commands, forward: socket.socket, port: int, payload: bytes) -> None:
        """A robot told its station something: it reaches who commands it, or what listens on this computer, if anything
        does."""
        if commands.answer(port, payload):
            return
        if (name, port) in self._streams:
            self._report(name, forward, port, payload)
        with self._changed:
            self._newest[name, port] = payload
            self._changed.notify_all()

    def _report(self, name: str, forward: socket.socket, port: int, message: bytes) -> None:
        """To the station's programs on this computer, which may have asked for a proof that it is new."""
        if not (signer := self._signers.get((name, port))):
            (robot,) = (one.robot for one in self.robots if one.robot.name == name)
            key = message_keys.read().between(robot, self.fleet.stations[0])
            signer = self._signers[name, port] = Signer(key, port)
        # All streams of a robot are sent from one socket.
        receive_challenges(forward, [other for (sender, _), other in self._signers.items() if sender == name])
        with suppress(ConnectionRefusedError):
            forward.sendto(signer.sign(message[:-TRAILER]), (self.station_address, port))


@contextmanager
def robots(
    n: int = 1, room: str = "corner", directory: Path = DIRECTORY, starts: tuple[tuple[float, ...], ...] = STARTS
) -> Iterator[Live]:
    """Build, boot and bring them into the room; each reports when this begins, and its motors are off.

    In `directory` are keys, images, the two inventories and each guest's evidence. Nothing of the project's own fleet
    is touched.
    """
    if not 1 <= n <= min(MOST, len(starts)):
        raise UserError(f"N={n}: a world has places for 1 to {min(MOST, len(starts))} robots")
    walls = wheeled.ROOMS / f"{room}.yml"
    if not walls.exists():
        rooms = ", ".join(sorted(file.stem for file in wheeled.ROOMS.glob("*.yml")))
        raise UserError(f"ROOM={room}: {paths.shown(walls)} is missing; worlds are {rooms}")
    with ExitStack() as stack:
        subnet = stack.enter_context(_loopback())
        fleet = write_inventory(directory / "inventory", n, inventory.load_fleet(INVENTORY).network.subnet)
        live = Live(write_inventory(directory / "station", n, subnet), directory / "station")
        stack.enter_context(mock.patch.object(paths, "KEYS", directory / "keys"))
        described = list(fleet.robots.values())
        build.build(fleet, described, directory / "images")
        station = fleet.stations[0].address
        segment = Segment(
            fleet.network, [robot.address for robot in described], station, directory / "segment",
            [(robot.address, COMMAND_PORT) for robot in described], outward=False,
        )  # fmt: skip
        stack.enter_context(segment)
        sockets = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lab-")))  # their paths must be short
        for robot in described:
            there = directory / robot.name
            there.mkdir(parents=True, exist_ok=True)
            wire = sockets / robot.name
            options = qemu.Options(
                name=robot.name, mac=qemu.robot_mac(robot.number), link=segment.link(robot.address),
                steady=True, extra=(*CAN_BOARDS, *Cable.arguments(wire)),
            )  # fmt: skip
            image = build.image_of(robot, directory / "images")
            machine = stack.enter_context(Guest(fleet.boards[robot.board], image, there, options))
            machine.prepare()
            address = str(_moved(robot.address, subnet))
            commands = Commands(address, segment.udp_port(robot.address, COMMAND_PORT))
            stack.callback(commands.close)
            forward = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            forward.bind((address, 0))
            cable = Cable(wire, station, functools.partial(live.heard, robot.name, commands, forward))
            stack.callback(cable.close)
            port = segment.ssh_port(robot.address)
            shell = stack.enter_context(Ssh(robot, "127.0.0.1", functools.partial(int, port)))
            live.robots.append(LiveRobot(robot, address, machine, shell, port))
        _boot(live)
        for index in range(n):
            _bring(live, fleet, index, Plant(room, figures={"initial_pose": starts[index]}))
        yield live


def _boot(live: Live) -> None:
    count = len(live.robots)
    with progress.step(f"boot {count} guest{'s' * (count > 1)}") as step:
        for one in live.robots:
            one.machine.on()
        for number, one in enumerate(live.robots):
            step.at(number, count, "guests", one.robot.name)
            one.machine.console.expect(rf"{one.robot.name} login: ", BOOT_SECONDS)
            one.shell.connect(BOOT_SECONDS)


def _bring(live: Live, fleet: Fleet, index: int, there: Plant) -> None:
    """The plant into a guest."""
    one = live.robots[index]
    board = fleet.boards[one.robot.board]
    others = {each.number: str(each.address) for each in fleet.robots.values() if each.number != one.robot.number}
    station = str(fleet.stations[0].address)
    task = plant.task(there, DRIVES, LASER, station=station, room=Room(one.robot.number, others))
    with progress.step(f"plant of {one.robot.name}"):
        one.shell.run(["mkdir", "-p", _THERE])
        one.shell.write(f"{_THERE}/plant.so", runtime.compile_plugin(PLANT, board.system))
        one.shell.write(f"{_THERE}/plant.yml", yaml.safe_dump(task).encode())
        tasks = {name: yaml.safe_load(text) for name, text in identity.control_tasks(fleet, one.robot).items()}
        user = privileges.device_users(tasks)[Path(LASER).name]
        begin = _BEGIN.format(user=user, devices=Path(LASER).parent, there=_THERE, drives=DRIVES, bitrate=BITRATE)
        one.shell.run(["sudo", "sh", "-c", begin], timeout=BEGIN_SECONDS)
        live.until(lambda: live.truth(index) and live.report(index).get("seeing"), BEGIN_SECONDS, "the plant begins")


@contextmanager
def _loopback() -> Iterator[IPv4Network]:
    """A network of the loopback interface that no other lab has."""
    for subnet in _LOOPBACK:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as claim:
            try:
                claim.bind((str(subnet[-1]), COMMAND_PORT))
            except OSError:
                continue
            yield subnet
            return
    raise UserError(f"all of {_LOOPBACK[0]} to {_LOOPBACK[-1]} are taken; end a lab: make wheeled-down")
