"""Draft a board's file from a computer that runs any Debian: which drivers reach its disks, its ports, its firmware.

The computer is asked by the user's own `ssh`, with their configuration: it is no robot yet and has no key of the fleet.
"""

from __future__ import annotations

import re
import shlex
from collections import defaultdict
from collections.abc import Mapping, Sequence

import yaml
from pydantic import ValidationError

from flotilla.common import durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.processes import bounded
from flotilla.common.text import shown
from flotilla.fleet.model import Board

SCRIPT = r"""
set -u
say() { printf '%s\t%s\n' "$1" "$2"; }
drivers() { # modules of a device and of all above it, the device's own first
    at=$(readlink -f "$1")
    while [ "$at" != /sys ] && [ "$at" != / ]; do
        [ ! -e "$at/driver/module" ] || basename "$(readlink -f "$at/driver/module")"
        at=${at%/*}
    done | awk '!seen[$0]++' | tr '\n' ' '
}
say machine "$(uname -m)"
say product "$(cat /sys/class/dmi/id/sys_vendor /sys/class/dmi/id/product_name 2>/dev/null | tr '\n' ' ')"
say firmware "$(if [ -d /sys/firmware/efi ]; then cat /sys/firmware/efi/fw_platform_size; else echo bios; fi)"
say processors "$(getconf _NPROCESSORS_CONF)"
say memory_kib "$(awk '/^MemTotal/ {print $2}' /proc/meminfo)"
say flags "$(awk -F: '/^flags/ {print $2; exit}' /proc/cpuinfo)"
say clock "$(cat /sys/devices/system/clocksource/clocksource0/current_clocksource)"
for disk in /sys/block/*; do
    [ ! -e "$disk/device" ] || say disk "${disk##*/} $(drivers "$disk/device")"
done
for port in /sys/class/net/*; do
    [ ! -e "$port/device" ] || say "$(if [ -e "$port/phy80211" ]; then echo radio; else echo ethernet; fi)" \
        "${port##*/} $(drivers "$port/device")"
done
for dog in /sys/class/watchdog/watchdog*; do
    [ ! -e "$dog" ] || say watchdog "$(cat "$dog/identity" 2>/dev/null) / $(drivers "$dog/device")"
done
say loaded "$(while read -r name rest; do printf '%s ' "$name"; done </proc/modules)"
while read -r number kind rest; do
    case $kind in uart:unknown) ;; uart:*) say uart "${number%:} $kind $rest" ;; esac
done </proc/tty/driver/serial
say end ""
"""
_LEGACY_IO = {"000003F8": "COM1", "000002F8": "COM2", "000003E8": "COM3", "000002E8": "COM4"}
"""Names of the PC's own serial ports, by the base address that the kernel prints."""
_DISKS = ["ahci", "nvme", "sdhci_pci", "sdhci_acpi", "mmc_block", "xhci_pci", "uas", "usb_storage", "sd_mod"]
"""Modules that reach the card of most PCs, which a draft for a PC has besides those that were found: a robot's card is
often another disk than the one that the computer was asked from."""
_OPTICAL = {"sr_mod"}
_QEMU = {
    "uefi": {"machine": "pc-q35-7.2", "network": "e1000e", "disk": "ahci"},
    "bios": {"machine": "pc-i440fx-7.2", "network": "e1000", "disk": "ide"},
}
_QEMU_PORTS = 4
"""Serial ports of a PC, which QEMU has without a further card."""


def draft(way: str, name: str) -> str:
    """Ask the computer `way`, as `ssh:user@host`; write the draft of `board_NAME.yml`; a line that names the file.

    UserError if the computer does not answer, or is none that images can be built for.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]*", name):
        raise UserError(f"NAME={name}: is no name of a board; take small letters, digits and underscores, such as nuc7")
    if not way.startswith("ssh:") or not way[4:] or way[4] == "-":
        raise UserError(f"TARGET={way}: give ssh:USER@HOST, such as ssh:root@192.168.1.20")
    with progress.step(f"hardware of {way[4:]}"):
        # The serial driver's list is for root alone.
        ask = f'[ "$(id -u)" = 0 ] || as="sudo -n"; exec ${{as-}} sh -c {shlex.quote(SCRIPT)}'
        done = bounded(["ssh", "-o", "BatchMode=yes", "--", way[4:], ask])
    found = read(done.stdout)
    if done.returncode or "end" not in found:
        why = shown(done.stderr.strip()) or f"status {done.returncode}"
        raise UserError(
            f"{way[4:]}: {why}; it needs a login without a question (`ssh {way[4:]} true`), as root or with sudo "
            "without a password"
        )
    try:
        text = render(found, name)
    except (LookupError, ValueError) as error:  # whoever has that computer may answer anything
        raise UserError(f"{way[4:]}: its answer is invalid: {shown(repr(error)[:200])}; nothing was written") from error
    file = paths.BUILD / "reports" / f"board_{name}.yml"
    file.parent.mkdir(parents=True, exist_ok=True)
    durable.write(file, text)
    return f"{paths.shown(file)}: compare it with the manual, then copy it to group_vars/ of the inventory"


def read(output: str) -> dict[str, list[str]]:
    """The values of each key, in their order."""
    found = defaultdict(list)
    for line in output.splitlines():
        key, tab, value = line.partition("\t")
        if tab:
            found[key].append(shown(value.strip()))
    return dict(found)


def render(found: Mapping[str, Sequence[str]], name: str) -> str:
    """The board's file, with a comment for each value that only a person can know. UserError as of `draft`."""
    architecture = _architecture(found)
    firmware = "bios" if found["firmware"] == ["bios"] else "uefi"
    if found["firmware"] == ["32"]:
        raise UserError("the firmware is UEFI of 32 bits, which images do not start from; switch it to BIOS (CSM) mode")
    ports, port_notes = _ports(found)
    disks = _disk_modules(found)
    tty = next((tty for tty in ports.values() if re.fullmatch(r"ttyS[0-3]", tty)), None)
    board = {
        "description": found["product"][0] or "a PC",
        "architecture": architecture,
        "suite": "trixie" if architecture == "amd64" else "bookworm",  # Debian 13 has no kernel for i386
        "firmware": firmware,
        "processors": int(found["processors"][0]),
        "kernel": "debian",
        "kernel_arguments": _kernel_arguments(ports),
        **({"console": {"tty": tty, "baud": 115200}} if tty else {}),
        "ports": {port: {"tty": tty} for port, tty in ports.items()},
        "network_interface": "eth0",
        "disk_modules": disks,
        "modules": _isa_watchdogs(found),
        "qemu": _qemu(architecture, firmware, ports, bool(tty), int(found["memory_kib"][0])),
        "acceptance": {
            "memory_mib": int(found["memory_kib"][0]) * 97 // 100 // 1024,
            "clock_source": found["clock"][0],
        },
    }
    try:
        Board.model_validate({"name": name, **board})
    except ValidationError as error:
        first = error.errors()[0]
        raise UserError(
            f"{'.'.join(map(str, first['loc']))}: {first['msg']}: the computer's answer gives no board that is valid; "
            "write its file manually, from board_pc_uefi.yml"
        ) from error
    notes = [
        f"Drafted from a computer that runs Debian: {board['description']}.",
        "Compare each value with the manual; docs/how-to/porting.md has the steps.",
        *port_notes,
        *(f"Disk {each}" for each in found.get("disk", [])),
        *(f"Ethernet {each}" for each in found.get("ethernet", [])),
        *(f"Radio {each}" for each in found.get("radio", [])),
        *(
            f"Watchdog {each}"
            for each in found.get("watchdog", _isa_watchdogs(found) or ["none: a hang is not noticed"])
        ),
    ]
    head = "".join(f"# {note}\n" for note in notes)
    return f"---\n{head}\nboard:\n" + "".join(
        f"  {line}\n" if line else "\n" for line in yaml.safe_dump(board, sort_keys=False, width=110).splitlines()
    )


def _architecture(found: Mapping[str, Sequence[str]]) -> str:
    machine = found["machine"][0]
    if machine == "x86_64":
        return "amd64"
    if not re.fullmatch(r"i[3-6]86", machine):
        raise UserError(f"{machine}: there are images for PCs alone, with processors of i386 or amd64")
    missing = {"pae", "cmov"} - set(found["flags"][0].split())
    if "cmov" in missing:
        raise UserError("the processor has no `cmov`, which Debian's programs for i386 need")
    if missing:
        raise UserError("the processor has no `pae`, which Debian's real-time kernel needs; write `kernel: lean`")
    return "i386"


def _ports(found: Mapping[str, Sequence[str]]) -> tuple[dict[str, str], list[str]]:
    """Kernel names by the names of connectors, as far as these can be known; and a note about each port."""
    ports, notes = {}, []
    for line in found.get("uart", []):
        number, kind, address, *_ = line.split()
        io = address.removeprefix("port:")
        port = _LEGACY_IO.get(io, f"COM{int(number) + 1}")
        ports[port if port not in ports else f"PORT{number}"] = f"ttyS{number}"
        notes.append(f"Port ttyS{number}: {kind.removeprefix('uart:')} at {io.lstrip('0')}")
    return ports, notes or ["No serial port was found: the monitor shows the boot, and login is by SSH only."]


def _disk_modules(found: Mapping[str, Sequence[str]]) -> list[str]:
    """Of all disks that there are, and of the usual ones."""
    own = [module for line in found.get("disk", []) for module in line.split()[1:]]
    disks = dict.fromkeys(
        [*own, *_DISKS] if found["machine"] == ["x86_64"] else own or ["ata_piix", "ata_generic", "sd_mod"]
    )
    return [module for module in disks if module not in _OPTICAL]


def _kernel_arguments(ports: Mapping[str, str]) -> list[str]:
    """Debian's kernel makes four serial ports by default."""
    highest = max((int(tty.removeprefix("ttyS")) for tty in ports.values()), default=0)
    return [f"8250.nr_uarts={highest + 1}"] if highest > 3 else []


def _isa_watchdogs(found: Mapping[str, Sequence[str]]) -> list[str]:
    """Loaded drivers of watchdogs that no bus announces, so that they need a line. They are in no class of sysfs."""
    return sorted(_ISA_WATCHDOGS & {*found["loaded"][0].split()})


_ISA_WATCHDOGS = {
    "advantechwdt", "eurotechwdt", "f71808e_wdt", "ib700wdt", "ibmasr", "it8712f_wdt", "it87_wdt", "pc87413_wdt",
    "sbc_epx_c3", "sbc_fitpc2_wdt", "sc1200wdt", "smsc37b787_wdt", "w83627hf_wdt", "w83877f_wdt", "w83977f_wdt",
    "wafer5823wdt",
}  # fmt: skip
"""Drivers of Linux's drivers/watchdog that no bus announces."""


def _qemu(
    architecture: str, firmware: str, ports: Mapping[str, str], console: bool, memory_kib: int
) -> dict[str, object]:
    """A computer of the same kind, with as many serial ports as a PC has. `console`: the first port is the console."""
    count = min(len(ports), _QEMU_PORTS)
    return {
        "system": {"amd64": "x86_64", "i386": "i386"}[architecture],
        "machine": _QEMU[firmware]["machine"],
        "cpu": {"amd64": "Nehalem", "i386": "pentium3"}[architecture],
        "memory_mib": max(64, min(512, memory_kib // 1024)),
        "disk": _QEMU[firmware]["disk"],
        "network": _QEMU[firmware]["network"],
        "devices": [f"isa-serial,index={number},chardev=port{number}" for number in range(1 if console else 0, count)],
    }
