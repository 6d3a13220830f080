"""The QEMU command line that stands in for a board. Nothing here runs anything but `qemu-img`.

The machine is the board's, spelled out: no default devices, the machine version of the inventory, and software
emulation even where the host could do better, because only that stops on an instruction that the processor lacks.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path
from typing import Any, Literal

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Network

CARD_BYTES = 1_000_000_000
"""What a card sold as 1 GB holds at least; larger than the images, so that the first boot grows the data partition."""

UEFI_PLACES = (Path("/usr/share/ovmf/OVMF.fd"), Path("/usr/share/qemu/OVMF.fd"))
"""Where distributions have the firmware that needs no file for its settings."""

_DISKS = {
    # `ide.0` is what the machine has built in: IDE on pc, AHCI on q35.
    "ide": ["ide-hd,drive=card,bus=ide.0,unit=0,bootindex=0"],
    "ahci": ["ahci,id=sata", "ide-hd,drive=card,bus=sata.0,bootindex=0"],
    "nvme": ["nvme,drive=card,serial=card,bootindex=0"],
    "usb": ["qemu-xhci", "usb-storage,drive=card,bootindex=0"],
    "virtio": ["virtio-blk-pci,drive=card,bootindex=0"],
}
"""Devices that attach the card, by `qemu.disk`."""
NEVER_SAVED = {"nvme"}
"""Those of them whose state QEMU cannot save."""

_VIRTUAL_START = datetime(2026, 1, 1)

# Chardev backends: the text after `-chardev` without the id.
NULL = "null"
PTY = "pty"
STDIO = "stdio,mux=on,signal=off"
"""This terminal, shared by console and monitor; Ctrl-C goes to the guest."""


def unix_socket(path: Path) -> str:
    """A unix socket on which QEMU listens; what the guest says while nobody is connected is lost."""
    return f"socket,path={_escaped(path)},server=on,wait=off"


def tcp_socket(port: int = 0) -> str:
    """A loopback port on which QEMU listens, as pyserial's `socket://` opens it. 0: a free one, ask QMP which."""
    return f"socket,host=127.0.0.1,port={port},server=on,wait=off,nodelay=on"


def inherited_socket(descriptor: int) -> str:
    """One end of a connected socket that QEMU inherits: no path to clean up, no race for a listener."""
    return f"socket,fd={descriptor}"


@dataclass(frozen=True)
class UserLink:
    """The wired port on a network of its own, where the host answers as `station` and nothing else exists."""

    subnet: IPv4Network
    guest: IPv4Address
    station: IPv4Address
    """Where connections from the host seem to come from; the guest's firewall judges them by it."""
    port: int = 0
    """Loopback port that leads to the guest's SSH; 0: a free one, ask QMP which."""


@dataclass(frozen=True)
class Wire:
    """The wired port on a cable, one end of it: Ethernet frames as datagrams between two loopback ports."""

    here: int
    there: int

    @property
    def other_end(self) -> Wire:
        return Wire(self.there, self.here)


@dataclass(frozen=True)
class Options:
    """What differs between two runs of the same board."""

    name: str = "robot"
    console: str = NULL
    """Chardev backend of the console."""
    ports: Mapping[str, str] = field(default_factory=dict)
    """Chardev backends of the board's further serial ports, by the name printed on the board; the rest is silent."""
    link: UserLink | Wire | None = None
    """None: the wired port is there, nothing is plugged in."""
    mac: str = "52:54:00:f1:00:00"
    qmp: str | None = None
    """Chardev backend of the control channel."""
    monitor: bool = False
    """QEMU's own prompt on the console, behind Ctrl-A C; for a console on the terminal."""
    paused: bool = False
    """Do not run before QMP says `cont`."""
    reboot: bool = True
    """False: QEMU ends where the machine would reboot."""
    watchdog: Literal["reset", "shutdown", "poweroff", "pause", "none"] = "none"
    """What the board's watchdog does when nobody feeds it. The boot loader starts it, and it waits for 30 s of the
    host's time, in which a guest of a busy host is not up: that would be reset for ever."""
    capture: Path | None = None
    """pcap file of everything on the wired port."""
    log_writes: Path | None = None
    """Log of all writes and flushes of the card, in their order; an existing file is continued unless it is empty.
    `flotilla/lab/power_cuts/write_log.py` reads it."""
    virtual_time: bool = False
    """Time advances by instructions executed, not by the host's clock, and idle time is skipped."""
    steady: bool = False
    """Time advances by instructions executed, but no faster than the host's clock: a host that stops the guest for a
    while, or is too slow for it, makes it slow, and nothing in it late."""
    extra: tuple[str, ...] = ()
    """Further arguments."""


def command_line(board: Board, card: Path, options: Options) -> list[str]:
    """The whole command, ready to run. `card`: overlay of the card image, see `make_overlay`."""
    argv = [program(board), "-name", options.name, "-nodefaults", "-no-user-config", "-display", "none"]
    argv += ["-machine", board.qemu.machine, "-cpu", board.qemu.cpu, "-m", str(board.qemu.memory_mib)]
    argv += ["-smp", str(board.processors)]
    if board.firmware == "uefi":
        argv += ["-bios", uefi_firmware()]
    if options.virtual_time:
        # One thread, fixed seed and clock: tried to repeat to the byte, see the facts on testing networks.
        argv += ["-accel", "tcg,thread=single", "-icount", "shift=3,sleep=off", "-machine", "hpet=off,usb=off"]
        argv += ["-rtc", f"base={_VIRTUAL_START.isoformat()},clock=vm", "-seed", "1"]
    elif options.steady:
        argv += ["-accel", "tcg,thread=single", "-icount", "shift=3,sleep=on,align=on", "-rtc", "base=utc,clock=vm"]
    else:
        argv += ["-accel", "tcg", "-rtc", "base=utc"]
    argv += ["-action", f"watchdog={options.watchdog}"]
    if not options.reboot:
        argv += ["-no-reboot"]
    if options.paused:
        argv += ["-S"]
    argv += _card(board, card, options)
    # The network card precedes the board's devices: slots are dealt in this order, so its address never moves.
    argv += _network(board, options)
    argv += console(board, options.console)
    if unknown := options.ports.keys() - set(port_ids(board)):
        raise ValueError(f"board {board.name} has no port {', '.join(sorted(unknown))} besides the console")
    for port, identifier in port_ids(board).items():
        argv += ["-chardev", chardev(identifier, options.ports.get(port, NULL))]
    for device in board.qemu.devices:
        argv += ["-device", device]
    if options.qmp:
        argv += ["-chardev", chardev("qmp", options.qmp), "-mon", "chardev=qmp,mode=control"]
    if options.monitor:
        argv += ["-mon", "chardev=console,mode=readline"]
    return [*argv, *options.extra]


def virtual_s(execute: Callable[..., Any]) -> float:
    """Seconds of virtual time since power on, by the machine's battery clock. `execute`: its QMP commands."""
    now = execute("qom-get", path="/machine", property="rtc-time")
    day = datetime(now["tm_year"] + 1900, now["tm_mon"] + 1, now["tm_mday"])
    since = day + timedelta(hours=now["tm_hour"], minutes=now["tm_min"], seconds=now["tm_sec"])
    return (since - _VIRTUAL_START).total_seconds()


def program(board: Board) -> str:
    """The emulator for the board."""
    return find_tool(f"qemu-system-{board.qemu.system}")


def uefi_firmware() -> str:
    """QEMU's firmware for boards with UEFI. What it keeps of its settings ends with QEMU."""
    if found := next((place for place in UEFI_PLACES if place.is_file()), None):
        return str(found)
    raise UserError(
        "OVMF.fd, by which QEMU has UEFI, is missing on this computer; install it: "
        "sudo apt-get install --no-install-recommends ovmf"
    )


def find_tool(name: str) -> str:
    """Path of one of QEMU's programs, or how to install them."""
    found = shutil.which(name)
    if found is None:
        raise UserError(
            f"{name} is missing on this computer; install it: "
            "sudo apt-get install --no-install-recommends qemu-system-x86 qemu-utils"
        )
    return found


def make_overlay(image: Path, overlay: Path, size: int = 0, below: Literal["raw", "qcow2"] = "raw") -> None:
    """Make the throw-away layer that takes the guest's writes, so that the image never changes.

    `size`: bytes of the card, when it is larger than the image, as real cards are. `below`: the image's format; an
    overlay's card is as large as it was.
    """
    argv = [find_tool("qemu-img"), "create", "-q", "-f", "qcow2", "-F", below, "-b", str(image.resolve()), str(overlay)]
    if below == "raw":
        argv += [str(-(-max(size, image.stat().st_size) // 512) * 512)]
    progress.command(argv)
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"{paths.shown(overlay)}: qemu-img cannot make the overlay: {done.stderr.strip()}")
    overlay.chmod(0o600)  # what the guest writes may be a private key


def console(board: Board, backend: str) -> list[str]:
    """Arguments of the console's backend, and of the serial port that uses it if the board has a console.

    `-serial` counts from COM1; the ports around the console's are the board's devices.
    """
    argv = ["-chardev", chardev("console", backend)]
    if not board.console:
        return argv
    return [*argv, *["-serial", "none"] * int(board.console.tty[4:]), "-serial", "chardev:console"]


def chardev(identifier: str, backend: str) -> str:
    """Argument of `-chardev`."""
    kind, comma, rest = backend.partition(",")
    return f"{kind},id={identifier}{comma}{rest}"


def port_ids(board: Board) -> dict[str, str]:
    """Chardev ids of the board's serial ports: `port0` its first, and so on; the console's is called otherwise."""
    return {
        name: f"port{index}" for index, (name, port) in enumerate(board.ports.items()) if port.tty != board.console_tty
    }


def robot_mac(number: int, *, radio: bool = False) -> str:
    """A locally administered address of its own for each robot's port or radio, so that guests can share a segment."""
    return f"52:54:00:{'f2' if radio else 'f1'}:{number >> 8 & 0xFF:02x}:{number & 0xFF:02x}"


def station_address(network: Network, *taken: IPv4Address) -> IPv4Address:
    """The highest address of the network that nobody in `taken` has: the host's, when no station is named."""
    return next(address for address in _from_above(network.subnet) if address not in taken)


def user_netdev(
    identifier: str, subnet: IPv4Network, station: IPv4Address, forwards: Mapping[IPv4Address, int],
    datagrams: Mapping[tuple[IPv4Address, int], int] | None = None,
    outward: bool = True,
) -> str:  # fmt: skip
    """A user-mode network: `station` stands for the host, each loopback port of `forwards` leads to a guest's SSH.

    `datagrams`: by a guest's address and UDP port, the loopback port that leads there. With it guests also reach the
    host's loopback ports at the station's address; without, they reach nothing but each other.

    `outward`: False: datagrams only come in.
    """
    # QEMU insists on a name server and a DHCP range inside the network; nobody asks them, they only must not collide.
    dns = next(address for address in _from_above(subnet) if address != station and address not in forwards)
    dhcp = next(iter(forwards), subnet[1])
    arguments = [f"user,id={identifier},net={subnet},host={station},dns={dns},dhcpstart={dhcp},ipv6=off"]
    arguments += [f"restrict={'off' if datagrams and outward else 'on'}"]
    arguments += [f"hostfwd=tcp:127.0.0.1:{port}-{address}:22" for address, port in forwards.items()]
    arguments += [f"hostfwd=udp:127.0.0.1:{here}-{guest}:{port}" for (guest, port), here in (datagrams or {}).items()]
    return ",".join(arguments)


def wire_netdev(identifier: str, wire: Wire) -> str:
    """A cable that never leaves the loopback interface, whether or not something is at its other end."""
    return f"socket,id={identifier},udp=127.0.0.1:{wire.there},localaddr=127.0.0.1:{wire.here}"


def _from_above(subnet: IPv4Network) -> list[IPv4Address]:
    return [subnet[-index] for index in range(2, min(subnet.num_addresses, 256))]


def logged(node: dict[str, object], log: Path) -> dict[str, object]:
    """A block device of which every write and flush goes to `log`, too: an existing file, which is continued."""
    return {
        "driver": "blklogwrites",
        "file": node,
        "log": {"driver": "file", "filename": str(log), "cache": {"no-flush": True}},
        **({"log-append": True} if log.stat().st_size else {"log-sector-size": 512}),
        "log-super-update-interval": 1,  # the number of entries is right whenever QEMU ends
    }


def _card(board: Board, overlay: Path, options: Options) -> list[str]:
    blockdev: dict[str, object] = {
        "driver": "qcow2",
        # Guest flushes reach the host's page cache, which survives a killed QEMU; the host's disk need not follow.
        "cache": {"no-flush": True},
        "file": {"driver": "file", "filename": str(overlay)},
    }
    if options.log_writes:
        options.log_writes.touch()
        blockdev = logged(blockdev, options.log_writes)
    blockdev["node-name"] = "card"
    disk = board.qemu.disk
    if disk == "ahci" and "q35" in board.qemu.machine:
        disk = "ide"
    argv = ["-blockdev", json.dumps(blockdev)]
    for device in _DISKS[disk]:
        argv += ["-device", device]
    return argv


def _network(board: Board, options: Options) -> list[str]:
    link = options.link
    # No boot ROM: the card is what boots, and the ROMs are in a package of their own that may be missing.
    device = f"{board.qemu.network},id=nic,mac={options.mac},romfile="
    if link is None:
        return ["-device", device]
    if isinstance(link, UserLink):
        netdev = user_netdev("net", link.subnet, link.station, {link.guest: link.port})
    else:
        netdev = wire_netdev("net", link)
    argv = ["-netdev", netdev, "-device", f"{device},netdev=net"]
    if options.capture:
        argv += ["-object", f"filter-dump,id=capture,netdev=net,file={_escaped(options.capture)}"]
    return argv


def _escaped(path: Path) -> str:
    """In QEMU's option lists a comma ends the value unless doubled."""
    return str(path).replace(",", ",,")
