"""Guests that begin booted: the state in which a robot's guest had booted, kept in the cache by its content.

A restored guest is the machine that was saved, to the byte of its memory, so two of them even draw the same random
numbers. Only its clock is set: to that of this computer, as the battery clock of a robot has it.
"""

from __future__ import annotations

import hashlib
import itertools
import re
import subprocess
from pathlib import Path

from flotilla.common import cache
from flotilla.fleet.model import Robot
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import LabError

BOOT_SECONDS = 1200
"""Until the login prompt. Some 30 s on an idle host; the limit only has to be finite, and generous to a busy one."""
_KIND = "guest"
_BACKENDS = re.compile(r"-(chardev|mon|blockdev|object|name|action|S)")
"""Options that say what is behind a device. It may be another when the guest is restored."""


def begin(guest: Guest, robot: Robot, shell: Ssh, *, cold: bool = False) -> None:
    """Bring a guest that is off to where all has started that starts at boot. `cold`: boot it in any case."""
    start(guest, cold=cold)
    wait(guest, robot, shell)


def start(guest: Guest, *, cold: bool = False) -> None:
    """Switch a guest on, or restore it where one like it was saved. Further ones can start before any is waited for."""
    key = _key(guest)
    if cold or not cache.has(_KIND, key):
        guest.on()
    else:
        guest.restore(cache.result(_KIND, key, guest.save))  # there is nothing to save: it is in use from now on


def wait(guest: Guest, robot: Robot, shell: Ssh) -> None:
    """Until a guest that was started has booted, and SSH is connected. The first one like it is saved."""
    if guest.restored:
        shell.script("date --set=@$(cat /sys/class/rtc/rtc0/since_epoch)")
        return
    if guest.board.console:
        await_login(guest, robot)
    shell.connect(BOOT_SECONDS)
    shell.script("systemctl is-system-running --wait", check=False)
    if guest.board.qemu.disk not in qemu.NEVER_SAVED and not cache.has(_KIND, key := _key(guest)):
        shell.hang_up()  # its connection would be a restored guest's too
        cache.result(_KIND, key, guest.save)
        shell.connect()


def await_login(guest: Guest, robot: Robot, timeout: float = BOOT_SECONDS) -> None:
    """Until the console asks who logs in; LabError where it has another name than the robot's."""
    name = guest.console.expect(r"(\S+) login: ", timeout)[1]
    if name != robot.name:
        raise LabError(f"{robot.name} has booted, and calls itself {name}")


def _key(guest: Guest) -> str:
    """Of all that makes the state: the card, the machine, what is plugged into it, and the emulator."""
    program, *words = qemu.command_line(guest.board, Path("card"), guest.options)
    emulator = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout
    machine = []
    for name, value in itertools.pairwise([*words, ""]):
        if name == "-netdev":
            machine.append(f"{name} {value.partition(',')[0]}")
        elif name.startswith("-") and not _BACKENDS.fullmatch(name):
            machine.append(f"{name} {value}")
    plugged = sorted(guest.options.ports)
    with guest.image.open("rb") as image:
        card = hashlib.file_digest(image, "sha256").hexdigest()
    return cache.digest(emulator, *machine, *plugged, card, str(guest.image.resolve()), Path(__file__))
