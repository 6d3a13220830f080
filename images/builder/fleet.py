"""The fleet's description as typed values: what `ansible/inventory/` says, merged by Ansible's own rules.

Units: bytes, bits per second, seconds. Addresses are IPv4.
"""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Network
from typing import Literal

from pydantic import BaseModel, ConfigDict


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class IsaResources(_Model):
    """Where a serial port sits that no bus announces (PC/104 boards with jumpers)."""

    io: int
    irq: int


class Port(_Model):
    """One serial connector of a board."""

    tty: str
    """Kernel name, such as `ttyS4`."""
    isa: IsaResources | None = None
    """Set for ports that must be declared to the kernel."""


class Console(_Model):
    """The serial port that GRUB, the kernel and the login prompt use."""

    tty: str
    baud: int


class Qemu(_Model):
    """The machine that stands in for the board."""

    system: Literal["i386", "x86_64"]
    machine: str
    cpu: str
    memory_mib: int
    disk: Literal["ide", "ahci", "virtio"]
    network: str
    """QEMU device model of the wired port."""
    devices: list[str]
    """Further `-device` arguments; serial ports of a card take chardevs `port0`, `port1`, … in order of the board's ports."""


class Board(_Model):
    """Everything that differs between kinds of computer: one file in `group_vars/` each."""

    name: str
    """Name of the group without `board_`."""
    description: str
    architecture: Literal["i386", "amd64"]
    kernel: Literal["debian", "lean"]
    kernel_arguments: list[str]
    """Kernel command line beyond what every card has."""
    console: Console
    ports: dict[str, Port]
    """Serial connectors by the name printed on the board."""
    network_interface: str
    """Kernel name of the port that the robot's address belongs to."""
    disk_modules: list[str]
    """Kernel modules needed to reach the card; they make the initramfs."""
    qemu: Qemu


class Ibss(_Model):
    """An 802.11 ad hoc cell. The BSSID is fixed, or cells split."""

    ssid: str
    frequency_mhz: int
    bssid: str


class Network(_Model):
    """The one network of the fleet."""

    subnet: IPv4Network
    link: Literal["ethernet", "ibss"]
    ibss: Ibss | None = None
    dds_domain: int
    udp_ports: list[str]
    """UDP ports or ranges (`5000-5099`) that robots accept from fleet addresses, DDS excepted."""


class Device(_Model):
    """Something plugged into a serial port. Its name becomes `/dev/robot/NAME`."""

    port: str
    baud: int


class Host(_Model):
    """A member of the fleet: a robot or the station."""

    name: str
    address: IPv4Address


class Robot(Host):
    number: int
    board: str
    devices: dict[str, Device] = {}


class Fleet(_Model):
    """The whole description, valid in itself."""

    name: str
    network: Network
    boards: dict[str, Board]
    robots: dict[int, Robot]
    """By number."""
    stations: list[Host]
