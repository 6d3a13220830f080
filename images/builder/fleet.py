"""The fleet's description as typed values: what `ansible/inventory/` says, merged by Ansible's own rules.

Units: bytes, bits per second, seconds. Addresses are IPv4. What a single value may be is checked here; what values
must have to do with each other (no two robots with one number, …) is checked in `inventory.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from ipaddress import IPv4Address, IPv4Network
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Strict
from pydantic_core import PydanticCustomError

from images.builder.errors import UserError

BAUDS = (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
"""Rates of termios(3) that serial devices use. A plain 16550A ends at 115200."""

CAN_BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bits per second of CANopen (CiA 301, 5.2), which other devices on CAN use, too."""

CHANNELS_MHZ = (
    *range(2412, 2473, 5),  # 802.11b/g channels 1–13
    2484,  # 802.11b channel 14, Japan
    *range(5180, 5321, 20),  # 802.11a channels 36–64
    *range(5500, 5721, 20),  # 100–144
    *range(5745, 5826, 20),  # 149–165
)
"""Channel centres of IEEE 802.11. Which of them may be used without radar detection is the country's to say."""


def _checked(right: Callable[[Any], object], message: str, remedy: str) -> AfterValidator:
    """A check whose failure says what is wrong and what would be right."""

    def check(value: Any) -> Any:
        if not right(value):
            raise PydanticCustomError("flotilla", "{message}", {"message": message, "remedy": remedy})
        return value

    return AfterValidator(check)


def _matching(pattern: str, message: str, remedy: str) -> AfterValidator:
    return _checked(re.compile(pattern).fullmatch, message, remedy)


def _between(low: int, high: int, why: str = "") -> AfterValidator:
    return _checked(lambda value: low <= value <= high, "is out of range", f"{low} to {high}{why and f': {why}'}")


def _is_udp_range(text: str) -> bool:
    ports = [int(port) for port in text.split("-")] if re.fullmatch(r"\d{1,5}(-\d{1,5})?", text) else []
    return bool(ports) and 1 <= ports[0] <= ports[-1] <= 65535


_Int = Annotated[int, Strict()]
"""A YAML integer; neither `true` nor `"5"` passes for one."""
Baud = Annotated[_Int, _checked(BAUDS.__contains__, "is not a standard rate", f"one of {', '.join(map(str, BAUDS))}")]
Tty = Annotated[
    str, _matching(r"tty[A-Z]+[0-9]+", "is not a serial port's kernel name", "such as ttyS4, as in /dev without /dev/")
]
Interface = Annotated[
    str,
    _matching(
        r"[a-z][a-z0-9]{0,14}", "is not a network interface's name", "such as eth0 or wlan0, at most 15 characters"
    ),
]
CanInterface = Annotated[
    str,
    _matching(r"can[0-9]", "is not a CAN interface's name", "can0 to can9, as the kernel names the board's channels"),
]
Label = Annotated[
    str,
    _matching(
        r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?",
        "is not a valid host name (RFC 1123)",
        "small letters, digits and inner hyphens, at most 63 characters, such as robot5",
    ),
]
DeviceName = Annotated[
    str,
    _matching(
        r"[a-z][a-z0-9_]{0,31}",
        "is not a valid device name",
        "a small letter, then small letters, digits or underscores, such as gyro_2: it becomes /dev/robot/NAME",
    ),
]
TaskName = Annotated[
    str,
    _matching(
        r"[a-z][a-z0-9-]{0,31}",
        "is not a task's name",
        "a small letter, then small letters, digits or hyphens, such as heading: ansible/control_tasks/heading.yml",
    ),
]
SensorName = Annotated[
    str,
    _matching(
        r"[a-z][a-z0-9-]{0,31}\.[A-Za-z0-9_-]+",
        "is not TASK.BLOCK",
        "a control task and one of its blocks that have a flag, such as heading.gyro",
    ),
]
Word = Annotated[str, _matching(r"\S+", "contains blanks or nothing", "one word; write further ones as further items")]
Module = Annotated[str, _matching(r"[A-Za-z0-9_]+", "is not a kernel module's name", "such as ata_piix, without .ko")]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class IsaResources(_Model):
    """Where a serial port sits that no bus announces (PC/104 boards with jumpers)."""

    io: Annotated[
        _Int,
        _checked(
            lambda io: 0x100 <= io <= 0xFFF8 and io % 8 == 0,
            "is not a serial port's base address",
            "0x100 to 0xFFF8 in steps of 8, such as 0x3E8",
        ),
    ]
    """Base of the UART's eight I/O ports."""
    irq: Annotated[_Int, _between(3, 15, "the ISA bus has no others")]


class Port(_Model):
    """One serial connector of a board."""

    tty: Tty
    """Kernel name, such as `ttyS4`."""
    isa: IsaResources | None = None
    """Set for ports that must be declared to the kernel."""


class Console(_Model):
    """The serial port that GRUB, the kernel and the login prompt use."""

    tty: Annotated[
        str,
        _matching(
            r"ttyS[0-3]", "cannot be the console", "ttyS0 to ttyS3: GRUB reaches only the ports of the PC itself"
        ),
    ]
    baud: Annotated[
        _Int,
        _checked(BAUDS[: BAUDS.index(115200) + 1].__contains__, "is not a console's rate", "such as 115200 or 38400"),
    ]


class PortWrite(_Model):
    """A byte written to an I/O port of the PC."""

    port: Annotated[_Int, _between(0, 0xFFFF)]
    value: Annotated[_Int, _between(0, 0xFF)]


class Watchdog(_Model):
    """How to reach the hardware watchdog without its driver. Once started it resets the board unless restarted."""

    start: PortWrite
    """Runs it for as long as it can wait, and starts the wait anew."""
    stop: PortWrite
    """Halts it."""


class Qemu(_Model):
    """The machine that stands in for the board."""

    system: Literal["i386", "x86_64"]
    """Which `qemu-system-…`."""
    machine: Word
    """`-machine`, with version, so that another QEMU shows the guest the same machine."""
    cpu: Word
    """`-cpu`."""
    memory_mib: Annotated[_Int, _between(64, 65536)]
    disk: Literal["ide", "ahci", "virtio"]
    """How the card is attached."""
    network: Word
    """QEMU device model of the wired port."""
    devices: list[Word]
    """Further `-device` arguments. Connectors take chardevs: `port0` is the board's first port, `port1` its second, …;
    whoever starts QEMU provides a chardev for each port and attaches the console's by `-serial`."""


def _by_tty(ports: dict[str, Port]) -> dict[str, Port]:
    return dict(sorted(ports.items(), key=lambda item: (len(item[1].tty), item[1].tty)))


class Board(_Model):
    """Everything that differs between kinds of computer: one file in `group_vars/` each."""

    name: str
    """Name of the group without `board_`."""
    description: str
    architecture: Literal["i386", "amd64"]
    """Debian's name of the processor architecture."""
    kernel: Literal["debian", "lean"]
    """Debian's own real-time kernel, or the one built from `kernel/`."""
    kernel_arguments: list[Word]
    """Kernel command line beyond what every card has."""
    console: Console
    ports: Annotated[dict[str, Port], AfterValidator(_by_tty)]
    """Serial connectors by the name printed on the board, in order of their ttys (Ansible keeps no order)."""
    network_interface: Interface
    """Kernel name of the wired port; the robot's address belongs to it when the network's link is `ethernet`.
    Images boot with `net.ifnames=0`, so the first one is `eth0` on every board."""
    disk_modules: list[Module]
    """Kernel modules needed to reach the card; they make the initramfs."""
    modules: list[Module] = []
    """Kernel modules of devices that no bus announces, such as an ISA watchdog; loaded on every boot."""
    watchdog: Watchdog | None = None
    """The boot loader starts it; the service manager takes it over through its driver, whose source says how."""
    qemu: Qemu

    @property
    def machine(self) -> str:
        """What `uname -m` may say on it: a regular expression that is a pattern of the shell's, too."""
        return {"i386": "i[3-6]86", "amd64": "x86_64"}[self.architecture]


class Ibss(_Model):
    """An 802.11 ad hoc cell. The BSSID is fixed, or cells split."""

    ssid: Annotated[
        str,
        _checked(
            lambda ssid: 1 <= len(ssid.encode()) <= 32, "is not a valid network name", "1 to 32 bytes (IEEE 802.11)"
        ),
    ]
    frequency_mhz: Annotated[
        _Int,
        _checked(
            CHANNELS_MHZ.__contains__,
            "is not the centre of an 802.11 channel",
            "2412, 2417, … 2472 MHz (channels 1 to 13), or a 5 GHz channel such as 5180",
        ),
    ]
    bssid: Annotated[
        str,
        _matching(
            r"[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}",
            "is not a BSSID",
            "six pairs of hexadecimal digits in quotes, such as '02:ca:ff:ee:10:42'",
        ),
        _checked(
            lambda bssid: int(bssid[:2], 16) % 2 == 0 and bssid.strip("0:"),
            "is a multicast or zero address",
            "the second digit even, best 2 (locally administered), such as '02:ca:ff:ee:10:42'",
        ),
    ]
    interface: Interface = "wlan0"
    """Kernel name of the radio. The robot's address belongs to it when the network's link is `ibss`. It is here and
    not with the board, because with `net.ifnames=0` the only radio of any board is `wlan0`."""


class Network(_Model):
    """The one network of the fleet."""

    subnet: Annotated[
        IPv4Network,
        _checked(
            lambda net: 8 <= net.prefixlen <= 30, "has no room or no end", "address/length, length 8 to 30, best 24"
        ),
    ]
    link: Literal["ethernet", "ibss"]
    """`ethernet`: the wired port, maybe with a pocket radio behind it. `ibss`: an 802.11 adapter in ad hoc mode."""
    ibss: Ibss | None = None
    """Required when the link is `ibss`."""
    dds_domain: Annotated[_Int, _between(0, 232, "beyond it the ports 7400 + 250 × domain … do not exist")]
    udp_ports: list[
        Annotated[
            str,
            BeforeValidator(lambda port: str(port) if type(port) is int else port),
            _checked(
                _is_udp_range, "is not a port or a range of ports", "such as 5000 or 5000-5099, within 1 to 65535"
            ),
        ]
    ]
    """UDP ports or ranges (`5000-5099`) that robots accept from fleet addresses, DDS excepted."""
    transport: Literal["udp", "dds"] = "udp"
    """What carries messages between control tasks of several robots: datagrams, or Cyclone DDS topics."""


class Health(_Model):
    """What a robot's control tasks may say of themselves without ending a roll-out."""

    overruns_percent: Annotated[float, Strict(), _between(0, 100, "100 permits all")] = 1
    """Steps that overran, of those that a task makes while the robot is looked at."""
    required_sensors: list[SensorName] = []
    """Their flags have to be 1, on each robot that has the task. All others' are only shown: a robot flies without
    some, and one without a cable is no worse than it was."""

    def sensors_of(self, task: str) -> list[str]:
        """The blocks of a task that are required."""
        named = (each.split(".", 1) for each in self.required_sensors)
        return [block for of, block in named if of == task]


class Device(_Model):
    """Something plugged into a serial port. Its name becomes `/dev/robot/NAME`."""

    port: str
    """The connector's name in the board's `ports`."""
    baud: Baud


class Can(_Model):
    """A channel of the robot's CAN board; its name is the kernel's, such as `can0`."""

    bitrate: Annotated[
        _Int,
        _checked(CAN_BITRATES.__contains__, "is not a standard rate", f"one of {', '.join(map(str, CAN_BITRATES))}"),
    ]
    """Bits per second, the same for all on the bus."""
    restart_ms: Annotated[_Int, _between(1, 60_000, "milliseconds")] = 100
    """How long after bus-off the controller starts again by itself."""


class Host(_Model):
    """A member of the fleet: a robot or the station."""

    name: Label
    address: IPv4Address


class Robot(Host):
    number: Annotated[_Int, _between(1, 250)]
    board: str
    """Name of the board, a key of `Fleet.boards`."""
    devices: dict[DeviceName, Device] = {}
    can: dict[CanInterface, Can] = {}
    """CAN interfaces that are brought up, by the kernel's name. An app may use one that no control task does."""
    control_tasks: list[TaskName] = []
    """Control tasks that start with the robot: `ansible/control_tasks/NAME.yml` each."""
    standby: list[TaskName] = []
    """Those of them that are another robot's first: this one's are listened to while that one is silent."""


class Fleet(_Model):
    """The whole description, valid in itself."""

    name: Label
    network: Network
    health: Health = Health()
    boards: dict[str, Board]
    robots: dict[int, Robot]
    """By number, ascending."""
    stations: list[Host]

    def robots_with(self, task: str) -> list[Robot]:
        """The one robot that has a control task, for tasks that talk to it; after it those that stand by for it."""
        there = [robot for robot in self.robots.values() if task in robot.control_tasks]
        first = [robot for robot in there if task not in robot.standby]
        if len(first) != 1:
            names = " and ".join(robot.name for robot in first) or "no robot"
            raise UserError(
                f"control task {task}: {names} has it, and another task talks to the one that has; "
                "a further robot may stand by for it: standby in robots.yml"
            )
        return first + [robot for robot in there if task in robot.standby]

    def robot_with(self, task: str) -> Robot:
        """The same for a task that no other robot may stand by for."""
        robot, *others = self.robots_with(task)
        if others:
            raise UserError(
                f"control task {task}: no robot can stand by for it, and {others[0].name} does; "
                "remove it from standby and control_tasks there"
            )
        return robot

    def interface(self, robot: Robot) -> str:
        """Kernel name of the interface that the robot's address belongs to."""
        ibss = self.network.ibss
        if self.network.link == "ibss" and ibss:
            return ibss.interface
        return self.boards[robot.board].network_interface
