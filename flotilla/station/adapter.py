"""Puts an 802.11 adapter of a computer into the fleet's ad hoc cell, and everything back. Runs as root.

`python3 adapter.py join JSON` and `python3 adapter.py leave INTERFACE`; `flotilla station-join` calls it through sudo.
Standard library alone, so that root runs no code of the project's environment.

What was changed is written to STATE before the first change, so that `leave` puts it back whatever happened since. A
restart of the computer forgets both, as NetworkManager and the kernel forget these settings.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Any

STATE = Path("/run/flotilla")
"""One file for each adapter that is in a cell: INTERFACE.json."""
SYS = Path("/sys")
JOIN_S = 10
"""For the driver to be in the cell; the first beacon goes out at once."""
_FREQUENCY = re.compile(r"\* (?P<mhz>\d+)(?:\.\d+)? MHz \[\d+\](?P<limits>.*)")
_KNOWN_TO_WORK = "adapters with the drivers ath5k, ath9k or rt73usb join"
_SERVICES = ("wpa_supplicant@{}.service", "dhcpcd@{}.service", "iwd.service")
"""Units that configure an adapter by themselves, besides NetworkManager."""


class RefusalError(Exception):
    """Why the adapter cannot join, and what to do."""


@dataclass(frozen=True)
class Cell:
    """What to join; as `network.ibss` of the inventory has it."""

    ssid: str
    frequency_mhz: int
    bssid: str
    address: str
    """Of this computer, with the length of the subnet: 10.42.0.254/24."""


@dataclass
class Before:
    """What an adapter was like before it joined."""

    type: str = "managed"
    up: bool = False
    power_save: bool = False
    addresses: list[str] = field(default_factory=list)
    managed: bool = False
    """By NetworkManager."""
    blocked: bool = False
    """By rfkill, in software."""
    services: list[str] = field(default_factory=list)
    """Units that were stopped."""


def run(*argv: str) -> str:
    """What a command prints. RefusalError when it fails."""
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise RefusalError(f"{' '.join(argv)}: {said[-1] if said else f'status {done.returncode}'}")
    return done.stdout


def quiet(*argv: str) -> bool:
    """Whether a command succeeds."""
    try:
        run(*argv)
    except RefusalError:
        return False
    return True


def adapters() -> list[str]:
    return sorted(each.parent.name for each in (SYS / "class" / "net").glob("*/phy80211"))


def chosen(interface: str | None) -> str:
    """The adapter that was named, or the only one."""
    there = adapters()
    if interface is None and len(there) == 1:
        return there[0]
    if interface is None or interface not in there:
        what = f"{interface}: is no 802.11 adapter of this computer" if interface else "say which adapter: ADAPTER="
        raise RefusalError(f"{what}; there {'is' if len(there) == 1 else 'are'} {', '.join(there) or 'none'}")
    return interface


def phy(interface: str) -> Path:
    return (SYS / "class" / "net" / interface / "phy80211").resolve()


def driver(interface: str) -> str:
    link = SYS / "class" / "net" / interface / "device" / "driver"
    return link.resolve().name if link.exists() else "its driver"


def check(interface: str, cell: Cell) -> None:
    """Refuse what cannot work, before anything is changed."""
    described = run("iw", "phy", phy(interface).name, "info")
    _, _, modes = described.partition("Supported interface modes:")
    if not re.match(r"(\s*\* \S+)*?\s*\* IBSS\s", modes):
        raise RefusalError(f"{interface}: {driver(interface)} has no ad hoc mode (IBSS); {_KNOWN_TO_WORK}")
    channels = {int(found["mhz"]): found["limits"] for found in _FREQUENCY.finditer(described)}
    limits = channels.get(cell.frequency_mhz)
    if limits is None:
        raise RefusalError(
            f"{interface}: has no channel of {cell.frequency_mhz} MHz; take another adapter, or another "
            "channel for the fleet: network.ibss.frequency_mhz"
        )
    for word in ("disabled", "no IR", "radar detection"):
        if word in limits:
            raise RefusalError(
                f"{interface}: {cell.frequency_mhz} MHz is marked '{word}' where this computer is: nobody may begin "
                "a cell there; set the country with `iw reg set`, or another network.ibss.frequency_mhz for the fleet"
            )
    for each in phy(interface).glob("rfkill*"):
        if (each / "hard").read_text().strip() == "1":
            raise RefusalError(f"{interface}: a switch of the computer turns radio off; switch it on")
    subnet = IPv4Interface(cell.address).network
    for other in json.loads(run("ip", "-json", "-4", "address", "show")):
        for address in other.get("addr_info", []):
            if other["ifname"] != interface and IPv4Interface(f"{address['local']}/32").ip in subnet:
                raise RefusalError(
                    f"{other['ifname']}: has {address['local']}, which is in the fleet's subnet {subnet}, too; "
                    "packets to robots would go there; remove it: "
                    f"ip address del {address['local']}/{address['prefixlen']} dev {other['ifname']}"
                )


def managed(interface: str) -> bool:
    """By NetworkManager, which runs."""
    if not shutil.which("nmcli") or not quiet("nmcli", "--terse", "general", "status"):
        return False
    states = run("nmcli", "--terse", "--fields", "DEVICE,STATE", "device").splitlines()
    return any(line.startswith(f"{interface}:") and not line.endswith(":unmanaged") for line in states)


def before(interface: str) -> Before:
    """How the adapter is now."""
    (link,) = json.loads(run("ip", "-json", "-4", "address", "show", "dev", interface))
    found = re.search(r"^\s*type (.+)$", run("iw", "dev", interface, "info"), re.MULTILINE)
    services = [service.format(interface) for service in _SERVICES]
    return Before(
        type=found[1] if found else "managed",
        up="UP" in link["flags"],
        power_save=quiet("iw", "dev", interface, "get", "power_save")
        and "on" in run("iw", "dev", interface, "get", "power_save").split(),
        addresses=[f"{each['local']}/{each['prefixlen']}" for each in link.get("addr_info", [])],
        managed=managed(interface),
        blocked=any((each / "soft").read_text().strip() == "1" for each in phy(interface).glob("rfkill*")),
        services=[each for each in services if quiet("systemctl", "is-active", "--quiet", each)],
    )


def block(interface: str, on: bool) -> None:
    for each in phy(interface).glob("rfkill*"):
        (each / "soft").write_text("1" if on else "0")


def enter(interface: str, cell: Cell, was: Before) -> None:
    """Take the adapter from whoever configures it, and join."""
    if was.managed:
        run("nmcli", "device", "set", interface, "managed", "no")
    for service in was.services:
        run("systemctl", "stop", service)
    if was.blocked:
        block(interface, False)
    run("ip", "link", "set", interface, "down")
    run("ip", "-4", "address", "flush", "dev", interface)
    run("iw", "dev", interface, "set", "type", "ibss")
    quiet("iw", "dev", interface, "set", "power_save", "off")  # not every driver has it
    run("ip", "link", "set", interface, "up")
    run("iw", "dev", interface, "ibss", "join", cell.ssid, str(cell.frequency_mhz), "fixed-freq", cell.bssid)
    joined = wait_joined(interface)
    if joined != cell.bssid.lower():
        raise RefusalError(
            f"{interface}: {driver(interface)} is in the cell {joined or 'none'} and not in {cell.bssid}: "
            f"it does not take a fixed BSSID; {_KNOWN_TO_WORK}"
        )
    run("ip", "address", "add", cell.address, "dev", interface)


def wait_joined(interface: str) -> str | None:
    """The BSSID of the cell that it has joined; None after JOIN_S."""
    end = time.monotonic() + JOIN_S
    while not (found := re.search(r"Joined IBSS (\S+)", run("iw", "dev", interface, "link"))):
        if time.monotonic() > end:
            return None
        time.sleep(0.1)  # the kernel's event may have passed before `iw event` listens
    return found[1].lower()


def put_back(interface: str, was: Before) -> None:
    """As it was; goes on after a step that fails, and says afterwards which did."""
    steps: list[Callable[[], object]] = []

    def add(*argv: str) -> None:
        steps.append(lambda: run(*argv))

    if (SYS / "class" / "net" / interface).exists():  # else it was unplugged
        quiet("iw", "dev", interface, "ibss", "leave")  # where it never joined
        add("ip", "-4", "address", "flush", "dev", interface)
        add("ip", "link", "set", interface, "down")
        add("iw", "dev", interface, "set", "type", was.type)
        if was.power_save:
            add("iw", "dev", interface, "set", "power_save", "on")
        if was.up:
            add("ip", "link", "set", interface, "up")
        for address in was.addresses:
            add("ip", "address", "add", address, "dev", interface)
        if was.blocked:
            steps.append(lambda: block(interface, True))
        if was.managed:
            add("nmcli", "device", "set", interface, "managed", "yes")
    for service in was.services:
        add("systemctl", "start", service)
    failed = []
    for step in steps:
        try:
            step()
        except (RefusalError, OSError) as error:
            failed.append(str(error))
    if failed:
        raise RefusalError(f"{interface}: not all is as before: {'; '.join(failed)}")


def file_of(interface: str) -> Path:
    return STATE / f"{interface}.json"


def join(interface: str | None, cell: Cell) -> str:
    """Join, or join again; where that fails, all is as before. The adapter's name."""
    name = chosen(interface)
    check(name, cell)
    file = file_of(name)
    known = Before(**json.loads(file.read_text())) if file.exists() else before(name)
    STATE.mkdir(mode=0o755, exist_ok=True)
    beside = file.with_suffix(".part")
    beside.write_text(json.dumps(asdict(known)))
    beside.replace(file)
    try:
        enter(name, cell, known)
    except BaseException:
        leave(name)
        raise
    return name


def leave(interface: str | None) -> str:
    """Leave the cell; the adapter's name."""
    there = sorted(each.stem for each in STATE.glob("*.json"))
    if interface is None and len(there) == 1:
        interface = there[0]
    if interface is None or interface not in there:
        raise RefusalError(
            f"{interface or 'no adapter'}: is in no cell by station-join; {', '.join(there) or 'none'} is"
        )
    was = Before(**json.loads(file_of(interface).read_text()))
    try:
        put_back(interface, was)
    finally:
        file_of(interface).unlink()
    return interface


def main(words: Sequence[str]) -> int:
    os.environ["PATH"] = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    try:
        if words[0] == "join":
            wanted: dict[str, Any] = json.loads(words[1])
            print(join(wanted.pop("interface"), Cell(**wanted)))
        else:
            print(leave(words[1] if len(words) > 1 else None))
    except (RefusalError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
