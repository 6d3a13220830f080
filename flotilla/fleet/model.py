"""The fleet's description as typed values: what `ansible/inventory/` says, merged by Ansible's own rules.

Units: bytes, bits per second, seconds. Addresses are IPv4. What a single value may be is checked here; what values
must have to do with each other (no two robots with one number, …) is checked in `inventory.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, Strict, model_validator
from pydantic_core import PydanticCustomError

from flotilla.common import signals
from flotilla.common.errors import UserError

BAUDS = (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
"""Rates of termios(3) that serial devices use. A plain 16550A ends at 115200."""

CAN_BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bits per second of CANopen (CiA 301, 5.2), which other devices on CAN use, too."""

MESSAGE_BYTES = 1472
"""A message at most: what one Ethernet frame of 1500 bytes carries by IPv4 and UDP. Nothing is fragmented."""

CHANNELS_MHZ = (
    *range(2412, 2473, 5),  # 802.11b/g channels 1–13
    2484,  # 802.11b channel 14, Japan
    *range(5180, 5321, 20),  # 802.11a channels 36–64
    *range(5500, 5721, 20),  # 100–144
    *range(5745, 5826, 20),  # 149–165
)
"""Channel centres of IEEE 802.11. Which of them may be used without radar detection is the country's to say."""


@dataclass(frozen=True)
class Check(AfterValidator):
    """A check of one value. The reference of keys shows `right` and `unit`."""

    right: str = ""
    """Values that pass."""
    unit: str = ""


def _checked(test: Callable[[Any], object], message: str, right: str, unit: str = "") -> Check:
    """A check whose failure says what is wrong and what would be right."""
    remedy = f"{right} {unit}".rstrip()

    def check(value: Any) -> Any:
        if not test(value):
            raise PydanticCustomError("flotilla", "{message}", {"message": message, "remedy": remedy})
        return value

    return Check(check, right, unit)


def matching(pattern: str, message: str, remedy: str) -> Check:
    return _checked(re.compile(pattern).fullmatch, message, remedy)


def between(low: int, high: int, why: str = "", unit: str = "") -> Check:
    """A value from `low` to `high`, for the reason `why`."""
    right = f"{low} to {high}{why and f': {why}'}"
    return _checked(lambda value: low <= value <= high, "is out of range", right, unit)


def _is_udp_range(text: str) -> bool:
    ports = [int(port) for port in text.split("-")] if re.fullmatch(r"\d{1,5}(-\d{1,5})?", text) else []
    return bool(ports) and 1 <= ports[0] <= ports[-1] <= 65535


Integer = Annotated[int, Strict()]
"""A YAML integer; neither `true` nor `"5"` passes for one."""
Baud = Annotated[
    Integer, _checked(BAUDS.__contains__, "is not a standard rate", f"one of {', '.join(map(str, BAUDS))}", "bit/s")
]
Tty = Annotated[
    str, matching(r"tty[A-Z]+[0-9]+", "is not a serial port's kernel name", "such as ttyS4, as in /dev without /dev/")
]
Interface = Annotated[
    str,
    matching(
        r"[a-z][a-z0-9]{0,14}", "is not a network interface's name", "such as eth0 or wlan0, at most 15 characters"
    ),
]
UsbIdentity = Annotated[
    str,
    matching(
        r"|[0-9a-f]{4}:[0-9a-f]{4}(/[A-Za-z0-9_.-]{1,64})?",
        "is not who a USB device is",
        "vendor and product in quotes, small hexadecimal digits, such as '15d1:0000', and /SERIAL if it has one",
    ),
]
CanInterface = Annotated[
    str,
    matching(r"can[0-9]", "is not a CAN interface's name", "can0 to can9, as the kernel names the board's channels"),
]
Label = Annotated[
    str,
    matching(
        r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?",
        "is not a valid host name (RFC 1123)",
        "small letters, digits and inner hyphens, at most 63 characters, such as robot5",
    ),
]
DeviceName = Annotated[
    str,
    matching(
        r"[a-z][a-z0-9_]{0,31}",
        "is not a valid device name",
        "a small letter, then small letters, digits or underscores, such as gyro_2: it becomes /dev/robot/NAME",
    ),
]
TaskName = Annotated[
    str,
    matching(
        r"[a-z][a-z0-9-]{0,31}",
        "is not a task's name",
        "a small letter, then small letters, digits or hyphens, such as heading: ansible/control_tasks/heading.yml",
    ),
]
AppName = Annotated[
    str,
    matching(
        r"[a-z][a-z0-9-]{0,31}",
        "is not an app's name",
        "a small letter, then small letters, digits or hyphens, at most 32, such as hover: apps/hover",
    ),
]
SensorName = Annotated[
    str,
    matching(
        r"[a-z][a-z0-9-]{0,31}\.[A-Za-z0-9_-]+",
        "is not TASK.BLOCK",
        "a control task and one of its blocks that have a flag, such as heading.gyro",
    ),
]
SignalName = Annotated[
    str,
    matching(
        r"[a-z][a-z0-9]*(_[a-z0-9]+)*",
        "is not a signal's name",
        "small letters, digits and single inner underscores, such as sensed_ns",
    ),
    _checked(
        lambda name: name not in ("in", "out", "flag", "length"),
        "is a port that the blocks pack and unpack have already",
        "not in, out, flag or length",
    ),
]
Word = Annotated[str, matching(r"\S+", "contains blanks or nothing", "one word, without blanks")]
Item = Annotated[str, matching(r"\S+", "contains blanks or nothing", "one word; write further ones as further items")]
"""A word of a list."""
Architecture = Literal["i386", "amd64"]
Release = Literal["bookworm", "trixie"]
"""Debian's names of the processor architectures that boards may have."""
Processor = Annotated[
    str, matching(r"[a-z0-9][a-z0-9._-]*", "is not a value of GCC's -march", "such as pentium3, see `man gcc`")
]
Module = Annotated[str, matching(r"[A-Za-z0-9_]+", "is not a kernel module's name", "such as ata_piix, without .ko")]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class IsaResources(_Model):
    """Where a serial port sits that no bus announces (PC/104 boards with jumpers)."""

    io: Annotated[
        Integer,
        _checked(
            lambda io: 0x100 <= io <= 0xFFF8 and io % 8 == 0,
            "is not a serial port's base address",
            "0x100 to 0xFFF8 in steps of 8, such as 0x3E8",
        ),
    ]
    """Base address of the UART's eight I/O ports, as set by the jumpers."""
    irq: Annotated[Integer, between(3, 15, "the ISA bus has no others")]
    """Interrupt, as set by the jumpers."""


class Port(_Model):
    """One serial connector of a board."""

    tty: Tty
    """Kernel name, such as `ttyS4`."""
    isa: IsaResources | None = None
    """Resources of a port that must be declared to the kernel: one on a board with jumpers."""


class Console(_Model):
    """The serial port that GRUB, the kernel and the login prompt use."""

    tty: Annotated[
        str,
        matching(r"ttyS[0-3]", "cannot be the console", "ttyS0 to ttyS3: GRUB reaches only the ports of the PC itself"),
    ]
    """Kernel name of the console's port."""
    baud: Annotated[
        Integer,
        _checked(
            BAUDS[: BAUDS.index(115200) + 1].__contains__,
            "is not a console's rate",
            "one of 300, 600, … 115200",
            "bit/s",
        ),
    ]
    """Bit rate of the console: 8 data bits, no parity, 1 stop bit."""


class PortWrite(_Model):
    """A byte written to an I/O port of the PC."""

    port: Annotated[Integer, between(0, 0xFFFF)]
    """I/O port."""
    value: Annotated[Integer, between(0, 0xFF)]
    """The byte."""


class Watchdog(_Model):
    """How to reach the hardware watchdog without its driver. Once started it resets the board unless restarted."""

    start: PortWrite
    """The write that starts the watchdog with its longest timeout, and restarts it."""
    stop: PortWrite
    """The write that stops the watchdog."""


class Qemu(_Model):
    """The machine that stands in for the board."""

    system: Literal["i386", "x86_64"]
    """Emulator: `qemu-system-SYSTEM`."""
    machine: Word
    """Argument of `-machine`. It has a version, so that a newer QEMU simulates the same machine."""
    cpu: Word
    """Argument of `-cpu`."""
    memory_mib: Annotated[Integer, between(64, 65536, unit="MiB")]
    """RAM of the machine."""
    disk: Literal["ide", "ahci", "nvme", "usb", "virtio"]
    """Bus that the card is attached to."""
    network: Word
    """QEMU device model of the wired port."""
    devices: list[Item]
    """Arguments of further `-device` options. Serial devices take chardevs: `port0` is the board's first port by tty,
    `port1` the second, and so on. The lab provides a chardev for each port; the console's needs no device."""


class Acceptance(_Model):
    """Limits of `make accept` for a computer of this kind. Card images do not depend on them."""

    memory_mib: Annotated[Integer, between(16, 65536, unit="MiB")] = 64
    """Minimum of memory, as the kernel counts it: a few per cent less than the size of the modules."""
    clock_source: Word = "tsc"
    """Clock source that the kernel must use; to read others takes microseconds."""
    wake_up_us: Annotated[Integer, between(1, 1_000_000, unit="µs")] = 100
    """Maximum wake-up latency of a real-time thread: under every load of `make latency`, as one of two threads that
    interrupt each other, and by a semaphore."""
    byte_us: Annotated[Integer, between(1, 1_000_000, unit="µs")] = 1000
    """Maximum latency of a byte from a serial port's interrupt to the thread that waits for it, under every load."""
    hardware_latency_us: Annotated[Integer, between(1, 1_000_000, unit="µs")] = 20
    """Maximum duration of an interruption of the kernel by the hardware (SMI)."""
    card_read_mb_s: Annotated[float, Strict(), between(0, 10_000, unit="MB/s")] = 2
    """Minimum read rate of the card."""
    card_write_mb_s: Annotated[float, Strict(), between(0, 10_000, unit="MB/s")] = 0.5
    """Minimum write rate of the card, including the final sync."""
    temperature_c: Annotated[Integer, between(20, 125, unit="°C")] = 85
    """Maximum temperature of the hottest sensor."""


def _by_tty(ports: dict[str, Port]) -> dict[str, Port]:
    # Ansible keeps no order.
    return dict(sorted(ports.items(), key=lambda item: (len(item[1].tty), item[1].tty)))


class System(NamedTuple):
    """What programs are compiled for: an architecture, and a release whose libraries they load."""

    architecture: Architecture
    suite: Release

    def __str__(self) -> str:
        return f"{self.architecture} of {self.suite}"


class Board(_Model):
    """Everything that differs between kinds of computer: one file in `group_vars/` each."""

    name: str
    """Name of the group without `board_`."""
    description: str
    """The computer in one line, for reports."""
    architecture: Architecture
    """Debian's name of the processor architecture."""
    suite: Release = "bookworm"
    """Debian's name of the release that its packages are of: Debian 12 or 13. Debian 13 has no kernel for i386."""
    firmware: Literal["bios", "uefi"] = "bios"
    """Firmware that starts the card. `bios`: the boot loader is in an MBR. `uefi`: the boot loader is a file in a
    system partition, and the partition table is a GPT."""
    processor: Processor | None = None
    """Processor for which programs that measure the board are compiled: a value of GCC's `-march`. Leave it out for
    the oldest one of the architecture."""
    processors: Annotated[Integer, between(1, 1024)] = 1
    """Number of processors, hyper-threads included. The highest `cpu:` of a control task is one less."""
    isolated_processors: list[Annotated[Integer, between(1, 1023)]] = []
    """Processors that run only control tasks with `cpu:`, without other programs and interrupts. The first processor,
    0, runs all the rest."""
    kernel: Literal["debian", "lean"]
    """`debian`: Debian's real-time kernel. `lean`: the one that `make kernel` builds from `kernel/NAME.yml`."""
    kernel_arguments: list[Item]
    """Kernel command line, in addition to the arguments of every card."""
    console: Console | None = None
    """Serial port of GRUB, kernel messages and login. Leave it out for a board without a serial port: GRUB and the
    kernel then write to the monitor only, and login is by SSH only."""
    ports: Annotated[dict[str, Port], AfterValidator(_by_tty)]
    """Serial connectors, by the name printed on the board."""
    network_interface: Interface
    """Kernel name of the wired port. It has the robot's address when `network.link` is `ethernet`. Images boot with
    `net.ifnames=0`, so the first one is `eth0` on every board."""
    packets_per_s: Annotated[Integer, between(100, 10_000_000)] = 4000
    """Packets of TCP a second that the firewall lets in by one network interface, and three quarters of that from one
    address; of all else half as many by one interface, and a quarter as many from one address; a quarter from outside
    the fleet's subnet. More are dropped where they cost least. With a lower number control keeps its deadlines in a
    worse flood; with a higher one files arrive faster."""
    disk_modules: list[Module]
    """Kernel modules that reach the card. The initramfs consists of them."""
    modules: list[Module] = []
    """Kernel modules of devices that no bus announces, such as an ISA watchdog. Each boot loads them."""
    watchdog: Watchdog | None = None
    """Hardware watchdog. The boot loader starts it, and systemd takes it over through its driver. The driver's source
    names the ports. Leave it out for a board without a watchdog, or with one that needs more than a byte."""
    qemu: Qemu
    """The QEMU machine that simulates the board in `make boot` and in tests."""
    acceptance: Acceptance = Field(default=Acceptance(), exclude=True)
    """Limits of `make accept` for a computer of this kind."""

    @property
    def system(self) -> System:
        """What its programs are compiled for."""
        return System(self.architecture, self.suite)

    @property
    def console_tty(self) -> str:
        """Kernel name of the console's port; empty for a board without a console."""
        return self.console.tty if self.console else ""

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
    """Name of the cell."""
    frequency_mhz: Annotated[
        Integer,
        _checked(
            CHANNELS_MHZ.__contains__,
            "is not the centre of an 802.11 channel",
            "2412, 2417, … 2472 (channels 1 to 13), or a 5 GHz channel such as 5180",
            "MHz",
        ),
    ]
    """Centre of the channel."""
    bssid: Annotated[
        str,
        matching(
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
    """Identifier of the cell, the same on every robot: without a fixed one the cell splits."""
    interface: Interface = "wlan0"
    """Kernel name of the radio. It has the robot's address if `network.link` is `ibss`. The key is not in the board's
    file, because with `net.ifnames=0` the only radio of any board is `wlan0`."""


class Network(_Model):
    """The one network of the fleet."""

    subnet: Annotated[
        IPv4Network,
        _checked(
            lambda net: 8 <= net.prefixlen <= 30, "has no room or no end", "address/length, length 8 to 30, best 24"
        ),
    ]
    """Subnet of all robots and stations: a private network (RFC 1918), not routed."""
    link: Literal["ethernet", "ibss"]
    """`ethernet`: the wired port, a cable or a radio bridge. `ibss`: an 802.11 adapter in ad hoc mode."""
    ibss: Ibss | None = None
    """The ad hoc cell. Required when `link` is `ibss`."""
    dds_domain: Annotated[Integer, between(0, 232, "beyond it the ports 7400 + 250 × domain … do not exist")]
    """Domain of the fleet's DDS participants. Participants of different domains do not discover each other."""
    udp_ports: list[
        Annotated[
            str,
            BeforeValidator(lambda port: str(port) if type(port) is int else port),
            _checked(
                _is_udp_range, "is not a port or a range of ports", "such as 5000 or 5000-5099, within 1 to 65535"
            ),
        ]
    ]
    """UDP ports or ranges that robots accept from fleet addresses. DDS and SSH need no entry."""
    transport: Literal["udp", "dds"] = "udp"
    """Transport of messages between control tasks of several robots: UDP datagrams, or topics of Cyclone DDS."""
    dds_security: Annotated[bool, Strict()] = False
    """`true`: control tasks authenticate each other by certificates in DDS, and accept only authenticated messages.
    Discovery takes some seconds longer. The default is `true` where `transport` is `dds`; give `false` there if a
    processor is too slow for it, as one of 400 MHz is (decision 75)."""
    update_kbit_s: Annotated[Integer, between(10, 1_000_000, unit="kbit/s")] = 300
    """Rate at which a station sends an update to several robots at once, headers included. The default is 30 % of the
    lowest rate of 802.11b, which multicast uses; control can use the rest."""

    @model_validator(mode="before")
    @classmethod
    def _secure_by_default(cls, given: object) -> object:
        """Only a line of the inventory leaves messages by DDS open."""
        if isinstance(given, dict) and given.get("transport") == "dds":
            return {"dds_security": True} | given
        return given


class Health(_Model):
    """What a robot's control tasks may say of themselves without ending a roll-out."""

    overruns_percent: Annotated[float, Strict(), between(0, 100, unit="%")] = 1
    """Limit of overruns: steps that overran, of those that a task makes during the health check. 100 permits all."""
    required_sensors: list[SensorName] = []
    """Sensors, as `TASK.BLOCK`, whose flag must be 1 on each robot that has the task. The check only shows the flags of
    other sensors."""

    def sensors_of(self, task: str) -> list[str]:
        """The blocks of a task that are required."""
        named = (each.split(".", 1) for each in self.required_sensors)
        return [block for of, block in named if of == task]


class Releases(_Model):
    """Signers of the releases that robots accept."""

    keys: Annotated[list[str], Field(min_length=1, max_length=16)] = ["release"]
    """Each the name of a key that is kept beside the robots' keys and made when it is first needed, or a public SSH key
    with a name behind it, `ssh-ed25519 AAAA… alice`, whose private half is elsewhere. Robots go by the keys of the
    release that they run: a new key comes to them by a release that the old ones have signed."""
    signatures: Annotated[Integer, between(1, 16)] = 1
    """Number of these keys that must have signed a release: 2 of 3, for instance."""
    lifetime_days: Annotated[Integer, between(1, 3650, unit="days")] = 180
    """Days after which an update bundle expires. Robots with the time of a station reject it from then on."""

    @model_validator(mode="after")
    def _enough(self) -> Releases:
        if self.signatures > len(self.keys):
            raise ValueError(f"signatures: {self.signatures} of {len(self.keys)} keys: name more keys or ask for fewer")
        return self


class Device(_Model):
    """Something plugged into a serial port, or into USB as one. Its name becomes `/dev/robot/NAME`."""

    port: str = ""
    """The connector's name in the board's `ports`. Give this, or `usb`."""
    usb: UsbIdentity = ""
    """Identifier of the device on USB, in any socket: vendor and product as `lsusb` shows them, `15d1:0000` for a
    Hokuyo URG. If a robot has several of a kind, also the serial number, `0403:6001/A9XYZ`."""
    baud: Baud
    """Bit rate, from the device's manual."""


class Can(_Model):
    """A channel of the robot's CAN board; its name is the kernel's, such as `can0`."""

    bitrate: Annotated[
        Integer,
        _checked(
            CAN_BITRATES.__contains__, "is not a standard rate", f"one of {', '.join(map(str, CAN_BITRATES))}", "bit/s"
        ),
    ]
    """Bit rate of the bus, the same for each node."""
    restart_ms: Annotated[Integer, between(1, 60_000, unit="ms")] = 100
    """Delay after which a controller that went bus-off restarts."""


class Host(_Model):
    """A member of the fleet: a robot or the station."""

    name: Label
    """Host name."""
    address: IPv4Address
    """Address within `network.subnet`, each once."""


class Robot(Host):
    """A robot: a host of a group `board_NAME`."""

    number: Annotated[Integer, between(1, 250)]
    """Number of the robot in commands, each once: `make image ROBOT=5`."""
    board: str
    """Name of the board, a key of `Fleet.boards`."""
    devices: dict[DeviceName, Device] = {}
    """Devices at the serial ports. `gyro` becomes `/dev/robot/gyro`."""
    can: dict[CanInterface, Can] = {}
    """CAN interfaces to bring up, by the kernel's name. A CAN board that is no PCI card also needs its driver in
    `board.modules`."""
    control_tasks: list[TaskName] = []
    """Control tasks that start with the robot: `heading` is `ansible/control_tasks/heading.yml`."""
    standby: list[TaskName] = []
    """Tasks of `control_tasks` that are hot standbys on this robot: receivers use their messages while another robot
    with the task is silent."""
    apps: list[AppName] = []
    """Apps on the robot's card that start with the robot: `hover` is the directory `apps/hover`."""


STATIONS = "stations"
"""The receiver of messages that go to all stations of the fleet."""


class Signal(_Model):
    """A value in a message: one element or a vector of them."""

    type: Annotated[
        str, _checked(signals.CODES.__contains__, "is not a signal's type", f"one of {', '.join(signals.CODES)}")
    ]
    """Type of an element."""
    width: Annotated[Integer, between(1, MESSAGE_BYTES, unit="elements")] = 1
    """Number of elements."""
    unit: Annotated[list[Item], BeforeValidator(lambda unit: [unit] if isinstance(unit, str) else unit)] = []
    """Unit of all elements, or a list with one for each; `"1"` for a plain number. Required for `single` and `double`.
    The name of an integer contains its unit, such as `sensed_ns`."""


class Drawn(_Model):
    """A message of Foxglove's that is made of a message's signals, so that viewers draw it."""

    type: Word
    """Foxglove's schema, such as `PoseInFrame` or `LaserScan`."""
    constants: dict[str, Any] = {}
    """Members that never change, as in JSON: `{ frame_id: fleet }`."""
    signals: dict[str, Word] = {}
    """Signals by member: `pose.position.x: "state[0]"`. A quaternion takes a heading in rad, a timestamp an int64 in
    ns; without a signal it is the time of reception."""


class Message(_Model):
    """What one control task sends to another, or to the stations: one entry of `ansible/control_tasks/messages.yml`.

    Its bytes are its signals in their order, little-endian and without gaps, the same by each transport."""

    sender: TaskName
    """Control task that packs and sends the message. Receivers accept it only from robots that have this task."""
    receiver: TaskName
    """Control task that receives it, on each robot that has the task; or `stations`."""
    port: Annotated[Integer, between(1024, 65535)]
    """UDP port at the receiver. DDS ignores it: its topic is the message's name."""
    rate_hz: Annotated[
        float, Strict(), _checked(lambda rate: 0 < rate <= 10_000, "is out of range", "above 0, up to 10000", "Hz")
    ]
    """Rate of messages from each sender when nothing is late or lost."""
    every: Annotated[Integer, between(1, 10_000, unit="steps")] = 1
    """The sender sends in every Nth step."""
    deadline_ms: Annotated[Integer, between(1, 60_000, unit="ms")] | None = None
    """Time without a message after which the receiver's flag is 0. Required unless the receiver is `stations`."""
    standby: Annotated[bool, Strict()] = False
    """`true`: another robot may be a hot standby for the sender."""
    charge: SignalName | None = None
    """Signal that is a battery's state of charge, 0 to 1. `make top` shows it."""
    attempts: list[SignalName] = []
    """Signals that count datagrams which the sender of the message rejected, such as forged ones. `make top` and the
    station's page show those that are not 0."""
    foxglove: dict[SignalName, Drawn] = {}
    """Messages for viewers, by name: `pose` of `control-report` becomes the topic `/robot3/control/report/pose`."""
    signals: dict[SignalName, Signal]
    """The values, in the order of their bytes."""

    @property
    def bytes(self) -> int:
        """Its length."""
        return sum(signals.size(signal.type, signal.width) for signal in self.signals.values())

    @property
    def step_s(self) -> float:
        """The sender's period."""
        return 1 / (self.rate_hz * self.every)


class Fleet(_Model):
    """The whole description, valid in itself."""

    name: Label
    """Name of the fleet."""
    network: Network
    """The network of all robots and stations."""
    health: Health = Health()
    """Limits of the health check that ends a roll-out."""
    releases: Releases = Releases()
    """Signers of the releases that robots accept."""
    boards: dict[str, Board]
    """By name."""
    robots: dict[int, Robot]
    """By number, ascending."""
    stations: list[Host]
    """Computers that command, record and provision."""
    messages: dict[str, Message] = {}
    """By name, in the order of `messages.yml`."""

    def board(self, name: str | None = None) -> Board:
        """A board by its name; the first robot's where a command is given none."""
        if name is None:
            return self.boards[next(iter(self.robots.values())).board]
        if name not in self.boards:
            raise UserError(
                f"board {name}: there is no such board in the inventory; take one of {', '.join(self.boards)}, or "
                f"describe it in group_vars/board_{name}.yml"
            )
        return self.boards[name]

    def robots_with(self, task: str) -> list[Robot]:
        """The one robot that has a control task, for tasks that talk to it; after it those that stand by for it."""
        there = [robot for robot in self.robots.values() if task in robot.control_tasks]
        first = [robot for robot in there if task not in robot.standby]
        if len(first) != 1:
            names = " and ".join(robot.name for robot in first) or "no robot"
            raise UserError(
                f"control task {task}: {names} has it, and another task talks to the one that has; "
                "a further robot may be its hot standby: standby in robots.yml"
            )
        return first + [robot for robot in there if task in robot.standby]

    def robot_with(self, task: str) -> Robot:
        """The same for a task that no other robot may stand by for."""
        robot, *others = self.robots_with(task)
        if others:
            raise UserError(
                f"control task {task}: no robot can be its hot standby, and {others[0].name} is; "
                "remove it from standby and control_tasks there"
            )
        return robot

    def interface(self, robot: Robot) -> str:
        """Kernel name of the interface that the robot's address belongs to."""
        ibss = self.network.ibss
        if self.network.link == "ibss" and ibss:
            return ibss.interface
        return self.boards[robot.board].network_interface
