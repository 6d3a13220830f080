"""Robots in containers: what a card holds, booted in namespaces of this computer instead of on a machine of its own.

A robot in a container is the root slot of a card image, shared by all and read-only, with its own files in the layers
above it, as on its card. Systemd, sshd, firewall and addresses are its own; kernel and hardware are this computer's.
What it must see of its board, or sets in its kernel, are files of its own at the same place (`own_files`); services
that need a card, or would reach this computer, are left out as in any container (`DROP_INS`).

`boot` works in a process that was started by the command of `inside`, and all ends with that process, whatever ends it:
the kernel ends the robots and takes away their mounts and networks. Their empty control groups are left for `clean`.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import time
import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from ipaddress import IPv4Address
from pathlib import Path

from flotilla.common import namespace
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.images import card, data_partition
from flotilla.lab.qemu.segment import station_address
from flotilla.lab.qemu.timing import Deadline, Expired, LabError

BOOT_SECONDS = 300
"""For all robots together, on a computer that has other things to do."""
DATA_BYTES = 256 << 20
"""What a robot may write: memory, taken where something is written."""
PERSONALITY = {"i386": "linux32", "amd64": "linux64"}
"""By the board's architecture, the argument of setarch(8) that makes `uname -m` say what it says on the board."""
LACKING = ["sys_time", "sys_module", "sys_boot", "sys_rawio", "mknod", "wake_alarm", "mac_admin", "mac_override"]
"""Capabilities by which a robot would reach this computer's clock, kernel or devices."""
_NOT_HERE = "[Unit]\nConditionVirtualization=!container\n"
DROP_INS = {
    "flotilla-mark-good": _NOT_HERE,  # there is no boot loader to tell
    "flotilla-grow": _NOT_HERE,  # there is no card to grow to
    "flotilla-zram": _NOT_HERE,  # swap would be this computer's
    # Follows the fleet's time, without the right to set this computer's clock.
    "chrony": "[Unit]\nConditionCapability=\n[Service]\nExecStart=\nExecStart=!/usr/sbin/chronyd -x $DAEMON_OPTS\n",
}
"""By service, how a robot in a container's differs. They lie below /run: /etc is what provisioning looks after."""
NEEDED = {
    "namespaces": "true",
    "control groups of version 2": "mount -t cgroup2 none /mnt && echo 1 >/mnt/cgroup.procs",
    "overlay mounts": "mount -t tmpfs none /mnt; cd /mnt; mkdir l u w o; "
    "mount -t overlay -o lowerdir=l,upperdir=u,workdir=w o o",
    "bridges and virtual cables": "ip link add fleet type bridge; ip link add one type veth peer name other",
    "net.core.rmem_max in each network namespace, as newer kernels show it": "test -e /proc/sys/net/core/rmem_max",
}
"""What a kernel, or a container that we are in, may refuse, and a script that finds out."""
_HERE = Path("/mnt")
"""Where the robots' files are in the namespace: a short path, for there are sockets among them."""
_CGROUPS = "flotilla-light"
_STATION = "station"
_FIRST_PROGRAM = Path(__file__).with_name("first_program.sh")


def inside(argv: Sequence[str]) -> list[str]:
    """The command that runs `argv` where `boot` works."""
    return [*namespace.prefix("--mount-proc", "--net"), *argv]


def check() -> None:
    """Refuse early, with the reason, where this computer cannot have robots in containers."""
    if os.geteuid() != 0:
        raise UserError(
            "robots in containers need root: they mount a card's root and the layers above it as a robot does, which "
            "ordinary users may not; run the same with `sudo`"
        )
    for what, script in NEEDED.items():
        probe = subprocess.run(inside(["sh", "-ec", script]), capture_output=True, text=True, check=False)
        if probe.returncode:
            raise UserError(
                f"robots in containers need {what}, which this computer does not permit: {probe.stderr.strip()}; "
                "if it is a container, start it with --privileged, else take a computer whose kernel has them"
            )


def boot(
    fleet: Fleet, robots: Sequence[Robot], image: Path, log: Path, booted: Callable[[Robot], object] = lambda _: None
) -> None:
    """Boot the robots. Each then answers SSH at its own address, and this computer has the station's.

    `image`: a card image of their board. `log`: a directory for what their first programs say.
    `booted` is called for each.
    """
    if os.getpid() != 1:
        raise ValueError("robots in containers need a process that the command of `inside` started")
    root, station = _HERE / "root", _HERE / "station"
    log.mkdir(parents=True, exist_ok=True)
    _mount("-t", "tmpfs", "-o", "mode=755", "light", _HERE)
    slot = card.SLOTS[0]
    _mount("-t", "squashfs", "-o", f"ro,loop,offset={slot.start},sizelimit={slot.size}", image, root)
    _mount("-t", "cgroup2", "cgroup2", _HERE / "cgroups")
    ours = _cgroup()
    _join(ours / _STATION)
    _lay_network(fleet, station)
    booting = []
    for robot in robots:
        here = _HERE / robot.name
        _mount("-t", "tmpfs", "-o", f"mode=755,size={DATA_BYTES}", robot.name, here)
        _fill(here, root, fleet, robot)
        notified = _listen(here / "run/notify")
        (ours / robot.name).mkdir()
        argv: list[str | Path] = ["sh", "-c", 'echo 0 >"$0/cgroup.procs" && exec "$@"', ours / robot.name]
        argv += ["setpriv", "--bounding-set", ",".join(f"-{name}" for name in LACKING)]
        argv += ["setarch", PERSONALITY[fleet.boards[robot.board].architecture]]
        argv += ["unshare", "--mount", "--pid", "--net", "--uts", "--ipc", "--cgroup", "--fork", "--kill-child", "--"]
        argv += [_FIRST_PROGRAM, here, root, station, robot.name]
        with (log / f"{robot.name}.log").open("wb") as output:
            first = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        booting.append((robot, notified, first))
    deadline = Deadline(BOOT_SECONDS)
    for robot, notified, first in booting:
        if not _booted(notified, first, deadline):
            text = (log / f"{robot.name}.log").read_text(errors="replace").strip()
            raise LabError(f"{robot.name} did not boot within {deadline.seconds:g} s, or ended; its log: {text}")
        booted(robot)
        notified.close()  # a socket that nobody reads would hold up its systemd at some later reload
        _run("ip", "link", "set", robot.name, "master", "fleet", "up")
    for robot in robots:
        _wait_for_ssh(robot.address, deadline)


def cpu_s() -> tuple[float, float]:
    """Processor time so far: the station's, which is this process and what it started, and all robots' together."""
    used = {
        group.parent.name: int(group.read_text().split()[1]) / 1e6  # usage_usec, the first line's
        for group in _cgroup().glob("*/cpu.stat")
    }
    station = used.pop(_STATION)
    return station, sum(used.values())


def written_bytes(robot: Robot) -> int:
    """Memory that a robot's files take, those of its root aside."""
    place = os.statvfs(_HERE / robot.name)
    return (place.f_blocks - place.f_bfree) * place.f_frsize


def clean() -> None:
    """Remove the control groups of runs that are over. All else went with their namespaces."""
    script = """
mount -t cgroup2 none /mnt
for run in /mnt/"$0"-*; do
    [ -d "$run" ] || continue
    for _ in $(seq 50); do # of a run that was killed, the kernel still ends the processes
        grep -q 'populated 1' "$run/cgroup.events" || break
        sleep 0.1
    done
    # Another that begins now may remove the same one.
    grep -q 'populated 1' "$run/cgroup.events" || find "$run" -depth -type d -exec rmdir {} + || [ ! -d "$run" ]
done"""
    _run(*namespace.prefix(), "sh", "-c", script, _CGROUPS)


def _cgroup() -> Path:
    """The control group of this run. No other run has its name while there is a process in it."""
    return _HERE / "cgroups" / f"{_CGROUPS}-{Path('/proc/self/ns/pid').stat().st_ino}"


def _run(*argv: str | Path) -> str:
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LabError(f"{' '.join(map(str, argv))}: {done.stderr.strip()}")
    return done.stdout


def _mount(*arguments: str | Path) -> None:
    """mount(8), whose last argument is made if it is missing."""
    Path(arguments[-1]).mkdir(exist_ok=True)
    _run("mount", *arguments)


def _join(cgroup: Path) -> None:
    """Make a control group and enter it, so that nobody takes ours for a run's that is over."""
    cgroup.mkdir(parents=True)
    (cgroup / "cgroup.procs").write_text("0")


def _lay_network(fleet: Fleet, station: Path) -> None:
    """The segment with the station on it; `station` becomes the name by which robots find this network."""
    station.touch()
    _run("mount", "--bind", "/proc/self/ns/net", station)
    _run("ip", "link", "set", "lo", "up")
    _run("ip", "link", "add", "fleet", "type", "bridge")
    _run("ip", "address", "add", f"{station_address(fleet)}/{fleet.network.subnet.prefixlen}", "dev", "fleet")
    _run("ip", "link", "set", "fleet", "up")


def _fill(here: Path, root: Path, fleet: Fleet, robot: Robot) -> None:
    """What the robot's first program lays over the root: data partition, /run, and files over what is everybody's."""
    for directory in ("root", "files", "data"):
        (here / directory).mkdir()
    for node in data_partition.nodes(fleet, robot):
        place = here / "data" / node.path.relative_to("/")
        if node.target:
            place.symlink_to(node.target)
            continue
        if node.content is None:
            place.mkdir()
        else:
            place.write_bytes(node.content)
        place.chmod(node.mode)
    for service, drop_in in DROP_INS.items():
        place = here / f"run/systemd/system/{service}.service.d/light.conf"
        place.parent.mkdir(parents=True)
        place.write_text(drop_in)
    for path, text in own_files(root, fleet.boards[robot.board]).items():
        place = here / "files" / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)


def own_files(root: Path, board: Board) -> dict[str, str]:
    """By path, what a robot sees of its own: the board's serial ports, its boot, and settings that the kernel has once.

    Those settings begin as this computer's are; the robot's boot sets them.
    """
    ports = sorted(int(port.tty[4:]) for port in board.ports.values() if port.tty.startswith("ttyS"))
    lines = [f"{number}: uart:16550A port:00000000 irq:4\n" for number in ports]
    files = {
        "proc/tty/driver/serial": "serinfo:1.0 driver revision:\n" + "".join(lines),
        "proc/sys/kernel/random/boot_id": f"{uuid.uuid4()}\n",
    }
    for file in [*root.glob("usr/lib/sysctl.d/*.conf"), *root.glob("etc/sysctl.d/*.conf")]:
        for key in re.findall(r"^\s*-?([a-z][^#;\s=]+)\s*=", file.read_text(), re.MULTILINE):
            setting = Path("/proc/sys", key.replace(".", "/"))
            files[str(setting.relative_to("/"))] = setting.read_text()
    return files


def _listen(path: Path) -> socket.socket:
    """The socket on which a robot's systemd reports that it has booted (sd_notify(3))."""
    notified = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    notified.bind(str(path))
    return notified


def _booted(notified: socket.socket, first: subprocess.Popen[bytes], deadline: Deadline) -> bool:
    """Wait until the robot has booted; False where it does not, or has ended."""
    notified.settimeout(0.5)
    message = b""
    while b"READY=1" not in message.split(b"\n"):
        if deadline.expired or first.poll() is not None:
            return False
        with suppress(TimeoutError):
            message = notified.recv(4096)
    return True


def _wait_for_ssh(address: IPv4Address, deadline: Deadline) -> None:
    while not deadline.expired:
        try:
            with socket.create_connection((str(address), 22), deadline.left) as connection:
                if connection.recv(4) == b"SSH-":
                    return
        except OSError:
            time.sleep(0.1)  # nothing tells from outside when an address answers
    raise Expired(f"{address}: no SSH within {deadline.seconds:g} s")
