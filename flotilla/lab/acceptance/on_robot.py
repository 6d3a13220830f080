"""Runs on a robot, as root: what its computer is, does and measures. A line of JSON for each part; it judges nothing.

Standard library only, and the robot's own `update.py` for its slots. Nothing of the robot is changed: ports that a task
or a person has open are left alone, and the file that is written to the card is removed.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import mmap
import os
import re
import select
import struct
import subprocess
import sys
import termios
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

MIB = 1 << 20
READ_MIB, WRITTEN_MIB = 32, 8
"""From the card, and to it."""
TIOCM_LOOP = 0x8000
"""The UART's own loopback, for which no plug is needed; the connector keeps still."""
PIECE = 8
"""Bytes that are under way at a time: half of what a 16550A holds."""
PATTERN = bytes(range(256))
ANSWER_S = 2.0
USERS = re.compile(r"flotilla-(?:task|app)@[^/]+|serial-getty@[^/]+|session-[^/]+")
"""Units whose programs use a port. `flotilla-irq-priorities` keeps ports open without using them."""


def output(*argv: str) -> str:
    """What a program prints; its errors as OSError."""
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"{argv[0]}: {done.stderr.strip() or f'status {done.returncode}'}")
    return done.stdout


def read(path: str) -> str:
    """A file in one line, empty where there is none."""
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def computer(_: dict[str, Any]) -> dict[str, Any]:
    kib = re.search(r"MemTotal: *(\d+)", read("/proc/meminfo"))
    clocks = "/sys/devices/system/clocksource/clocksource0"
    battery_clock = read("/sys/class/rtc/rtc0/since_epoch")
    system_s = time.time()
    return {
        "vendor": read("/sys/class/dmi/id/sys_vendor"),
        "product": read("/sys/class/dmi/id/product_name"),
        "processor": (re.findall(r"model name\s*: (.*)", read("/proc/cpuinfo")) or [""])[0],
        "release": os.uname().release,
        "version": os.uname().version,
        "memory_mib": int(kib[1]) / 1024 if kib else 0,
        "clock_source": read(f"{clocks}/current_clocksource"),
        "clock_sources": read(f"{clocks}/available_clocksource").split(),
        "battery_clock_off_s": int(battery_clock) - system_s if battery_clock else None,
        "messages": output("dmesg", "--level=emerg,alert,crit,err,warn").splitlines(),
    }


def temperatures(_: dict[str, Any]) -> dict[str, float]:
    """In °C, by sensor."""
    found = {}
    places = Path("/sys/class")
    for path in [*places.glob("thermal/thermal_zone*/temp"), *places.glob("hwmon/*/temp*_input")]:
        name = read(f"{path.parent}/type") or read(f"{path.parent}/name")
        if value := read(str(path)):
            found[f"{name} {path.name}"] = int(value) / 1000
    return found


def watchdog(_: dict[str, Any]) -> dict[str, Any]:
    """How systemd feeds it."""
    names = ("RuntimeWatchdogUSec", "WatchdogDevice", "WatchdogLastPingTimestampMonotonic")
    shown = dict(line.split("=", 1) for line in output("systemctl", "show", "-p", ",".join(names)).splitlines())
    fed_us = int(shown.get(names[2], "") or 0)
    return {
        "device": shown.get("WatchdogDevice", ""),
        "is_there": Path("/dev/watchdog").exists(),
        "timeout": shown.get("RuntimeWatchdogUSec", ""),
        "fed_s_ago": time.monotonic() - fed_us / 1e6 if fed_us else None,
    }


def interrupts() -> dict[str, int]:
    """How many there were, by number."""
    rows = (line.split() for line in read("/proc/interrupts").splitlines()[1:])
    return {row[0].rstrip(":"): sum(int(each) for each in row[1:] if each.isdigit()) for row in rows}


def users_of(device: str) -> list[str]:
    """Units that use a port."""
    found = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            opened = {str(each.readlink()) for each in (process / "fd").iterdir()}
        except OSError:  # it ended
            continue
        if device in opened:
            found |= set(USERS.findall(read(f"{process}/cgroup")))
    return sorted(found)


def exchanged(port: int) -> bytes:
    """What comes back of PATTERN, a piece at a time, until a piece does not."""
    came = b""
    for start in range(0, len(PATTERN), PIECE):
        os.write(port, PATTERN[start : start + PIECE])
        until = time.monotonic() + ANSWER_S
        while len(came) < start + PIECE:
            ready, _, _ = select.select([port], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                return came
            came += os.read(port, PIECE)
    return came


def looped(device: str) -> bytes:
    """What comes back through the UART's own loopback at 115200 Bd. The port is left as it was."""
    port = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        before = termios.tcgetattr(port)
        tty.setraw(port)
        mode = termios.tcgetattr(port)
        mode[2] = mode[2] & ~termios.CRTSCTS | termios.CLOCAL
        mode[4] = mode[5] = termios.B115200
        termios.tcsetattr(port, termios.TCSANOW, mode)
        loop = struct.pack("I", TIOCM_LOOP)
        fcntl.ioctl(port, termios.TIOCMBIS, loop)
        try:
            termios.tcflush(port, termios.TCIOFLUSH)
            return exchanged(port)
        finally:
            termios.tcflush(port, termios.TCIOFLUSH)  # what an interrupt that is lost never sends would be waited for
            fcntl.ioctl(port, termios.TIOCMBIC, loop)
            termios.tcsetattr(port, termios.TCSANOW, before)
    finally:
        os.close(port)


def serial(asked: dict[str, Any]) -> dict[str, Any]:
    """By connector: its UART, who uses it, or what came back through it and by how many interrupts."""
    uarts = {
        f"ttyS{number}": {"uart": kind, "irq": irq}
        for number, kind, irq in re.findall(
            r"^(\d+): uart:(\S+) .*?irq:(\d+)", read("/proc/tty/driver/serial"), re.MULTILINE
        )
    }
    found = {}
    for name, line in asked["ports"].items():
        device = f"/dev/{line}"
        fact: dict[str, Any] = {"uart": "unknown", "irq": "0", **uarts.get(line, {})}
        found[name] = fact
        if not Path(device).exists():
            fact["uart"] = "missing"
        if fact["uart"] in ("missing", "unknown") and line.startswith("ttyS"):
            continue
        fact["users"] = users_of(device)
        if fact["users"] or line == asked["console"]:
            continue
        before = interrupts().get(fact["irq"], 0)
        try:
            fact["came"] = looped(device) == PATTERN
        except OSError as error:
            fact["error"] = str(error)
        fact["interrupts"] = interrupts().get(fact["irq"], 0) - before
    return found


def network(asked: dict[str, Any]) -> dict[str, Any]:
    """Interfaces as `ip` shows them: the robot's link, and its CAN buses."""
    found: dict[str, Any] = {}
    for name in (asked["interface"], *asked["can"]):
        try:
            (found[name],) = json.loads(output("ip", "-s", "-j", "-d", "link", "show", "dev", name))
        except OSError as error:
            found[name] = {"missing": str(error)}
    return found


def read_mb_s(device: str) -> float:
    """From a disk, past all caches."""
    disk = os.open(device, os.O_RDONLY | os.O_DIRECT)
    try:
        with mmap.mmap(-1, MIB) as room:  # aligned, as O_DIRECT wants it
            begun = time.monotonic()
            count = sum(os.preadv(disk, [room], number * MIB) for number in range(READ_MIB))
            return count / 1e6 / (time.monotonic() - begun)
    finally:
        os.close(disk)


def written_mb_s(directory: str) -> float:
    """To a file, until it is on the card. The file is gone afterwards."""
    path = Path(directory, f".acceptance-{os.getpid()}")
    try:
        begun = time.monotonic()
        with path.open("xb") as file:
            for _ in range(WRITTEN_MIB):
                file.write(os.urandom(MIB))
            file.flush()
            os.fsync(file.fileno())
        return WRITTEN_MIB * MIB / 1e6 / (time.monotonic() - begun)
    finally:
        path.unlink(missing_ok=True)


def card(_: dict[str, Any]) -> dict[str, Any]:
    """Speed, what the slots hold, and the data partition."""
    sys.path.insert(0, "/usr/lib/flotilla")
    import update  # type: ignore[import-not-found]  # the robot's own

    disk = update.disk()
    slots = {}
    for name, slot in json.loads(output("flotilla-slot", "show"))["slots"].items():
        if slot["blob"]:
            left, digest = int(update.Slot(name).header()["BYTES"]), hashlib.sha256()
            try:
                with Path(update.partition(name)).open("rb") as file:
                    while left and (content := file.read(min(MIB, left))):
                        digest.update(content)
                        left -= len(content)
                slots[name] = {"header": slot["blob"], "content": digest.hexdigest()}
            except OSError as error:
                slots[name] = {"error": str(error)}
    place = os.statvfs("/data")
    data = Path(output("findmnt", "-n", "-o", "SOURCE", "/data").strip()).resolve().name
    block = Path(disk).name
    of_data = f"/sys/block/{block}/{data}"
    return {
        "read_mb_s": read_mb_s(disk),
        "written_mb_s": written_mb_s("/data"),
        "slots": slots,
        "disk_bytes": 512 * int(read(f"/sys/block/{block}/size")),
        "data_end_bytes": 512 * (int(read(f"{of_data}/start")) + int(read(f"{of_data}/size"))),
        "data_bytes": place.f_blocks * place.f_frsize,
        "data_free_bytes": place.f_bavail * place.f_frsize,
        "file_system_errors": int(read(f"/sys/fs/ext4/{data}/errors_count") or 0),
    }


def hardware_latency(asked: dict[str, Any]) -> dict[str, Any]:
    """The longest moment, in µs, in which the hardware itself took the processor away (SMI)."""
    argv = ["hwlatdetect", f"--duration={asked['seconds']}", "--threshold=1"]  # below its own threshold it says nothing
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    found = re.search(r"Max Latency: (\d+|Below threshold)", done.stdout)
    if not found:
        raise OSError(done.stderr.strip() or f"hwlatdetect: status {done.returncode}")
    return {"longest_us": int(found[1]) if found[1].isdigit() else 0}


def real_time(asked: dict[str, Any]) -> dict[str, float]:
    """RTAI's `preempt` and `switches` by today's meters, in µs.

    Two periodic threads of which the faster one interrupts the slower; a thread that wakes another by a semaphore.
    """
    samples = 1000 * asked["seconds"]
    base = ["-q", "-p", "90", "-i", "1000", "-l", str(samples), "--json=/dev/fd/2"]

    def threads(*argv: str) -> dict[str, Any]:
        done = subprocess.run(["chrt", "--fifo", "1", *argv], capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{argv[0]}: {done.stderr.strip()}")
        said: dict[str, Any] = json.loads(done.stderr[done.stderr.index("{") : done.stderr.rindex("}") + 1])
        return said["thread"]  # type: ignore[no-any-return]

    preempted = threads("cyclictest", "-m", "-t", "2", "-d", "500", *base)
    switched = threads("ptsematest", *base)["0"]["receiver"]
    return {
        "faster_us": preempted["0"]["max"],
        "slower_us": preempted["1"]["max"],
        "switch_us": switched["max"],
        "switch_mean_us": switched["avg"],
    }


PARTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    part.__name__: part
    for part in (computer, temperatures, watchdog, serial, network, card, real_time, hardware_latency)
}


def main(asked: dict[str, Any]) -> None:
    for name in asked["parts"]:
        try:
            said = {"facts": PARTS[name](asked)}
        except (OSError, ValueError, KeyError, ImportError) as error:
            said = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps({"part": name, **said}), flush=True)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
