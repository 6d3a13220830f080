"""Runs in a guest: the robot's tasks as its image brings them, the plant at the other end of bus and serial line, and a
station that commands.

Standard library and what the image has; `python3 guest.py SESSION` reads what virtual.py wrote, and prints as JSON the
files that tasks left, in base64: recordings, statistics, and what they said.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

COMMAND = struct.Struct("<IIdddB")
"""operator, sequence, v, omega, boom, enable; drive.yml has it, too."""
OPERATOR, SECOND = 1, 2
"""The numbers of this station, and of another one that has its address."""
FLOOD = 50
"""Commands in an interval, instead of one."""
_INTERVAL_S = 0.1
"""Between two commands."""
_END_S = 5.0
"""For tasks to end."""
_TOLD_S = 5.0
CONSOLE = Path("/dev/console")
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 1


def run(*argv: str) -> None:
    """A command that has to succeed; what it says is part of the error."""
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(argv)}: status {done.returncode}: {done.stdout}{done.stderr}")


def report(interface: str, what: int) -> None:
    """A report of the controller, as its driver would make it: the kernel hands the frame to who asked for reports."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
        can.bind((interface,))
        can.send(struct.pack("=IB3x8x", socket.CAN_ERR_FLAG | what, 8))


def link(interface: str, state: str) -> None:
    """Set it up or down, in no time: a program takes half a second here, in which the station would be silent."""
    name = interface.encode()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_:
        (flags,) = struct.unpack("16xh22x", fcntl.ioctl(any_, _SIOCGIFFLAGS, struct.pack("16s24x", name)))
        flags = flags | _IFF_UP if state == "up" else flags & ~_IFF_UP
        fcntl.ioctl(any_, _SIOCSIFFLAGS, struct.pack("16sh22x", name, flags))


_HAPPENS: dict[str, Callable[..., None]] = {"link": link, "report": report}


def start(task: dict[str, str], out: Path) -> subprocess.Popen[bytes]:
    """One control task, as its unit would start it."""
    out.mkdir(parents=True)
    argv = ["flotilla-run", "--statistics", str(out / "statistics.json")]
    if "blocks" in task:
        argv += ["--blocks", task["blocks"]]
    with (out / "log").open("wb") as log:
        return subprocess.Popen([*argv, task["file"]], stdout=log, stderr=log, cwd=out)


class Station:
    """Commands the robot, and keeps what it reports."""

    def __init__(self, session: dict[str, Any]) -> None:
        self.robot = (session["robot"], session["command_port"])
        self.sequence = 0
        self.reports: list[tuple[int, str]] = []
        self._wild = random.Random(1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((session["station"], session["report_port"]))
        self._socket.setblocking(False)

    def command(self, v: float, omega: float, boom: float, enable: bool, operator: int = OPERATOR) -> None:
        self.sequence += 1
        self._socket.sendto(COMMAND.pack(operator, self.sequence, v, omega, boom, enable), self.robot)

    def disturb(self, what: str) -> None:
        """For an interval: `second` operator who turns it, `rubbish` of the right and of other lengths, or a `flood` of
        commands."""
        if what == "second":
            self.command(0.2, 1.5, 0.4, True, SECOND)
        elif what == "rubbish":
            for length in (COMMAND.size, 1, COMMAND.size - 1, COMMAND.size, 1400, COMMAND.size + 1, 0):
                self._socket.sendto(self._wild.randbytes(length), self.robot)
        else:
            for _ in range(FLOOD):
                self.command(0.5, 0.6, 0, True)

    def hear(self) -> None:
        while True:
            try:
                self.reports.append((time.monotonic_ns(), self._socket.recv(2048).hex()))
            except BlockingIOError:
                return

    def close(self) -> None:
        self._socket.close()


def command(station: Station, commands: list[list[Any]], at_s: float) -> None:
    """What is to be said at this time: the newest row of `at_s, what`, where None is silence."""
    said = [what for begin_s, what in commands if begin_s <= at_s + 1e-6]
    if said and said[-1] is not None:
        station.command(*said[-1])


def drive(course: dict[str, Any], session: dict[str, Any], out: Path) -> None:
    """Start the tasks, command them, let things happen to them, end them; each has to end as asked."""
    out.mkdir(parents=True)
    station = Station(session)
    begin_ns = time.monotonic_ns()
    running = {task["name"]: start(task, out / task["name"]) for task in course["tasks"]}
    events = sorted(course["events"], key=lambda event: float(event[0]))
    happened: list[int] = []
    told_s = 0.0
    for index in range(round(course["seconds"] / _INTERVAL_S)):
        at_s = index * _INTERVAL_S
        time.sleep(max(0.0, begin_ns / 1e9 + at_s - time.monotonic()))
        while events and events[0][0] <= at_s + 1e-6:
            what, *arguments = events.pop(0)[1]
            _HAPPENS[what](*arguments)
            happened.append(time.monotonic_ns())
        command(station, course["commands"], at_s)
        for begin_s, end_s, what in course["disturbances"]:
            if begin_s <= at_s + 1e-6 < end_s:
                station.disturb(what)
        station.hear()
        if at_s >= told_s:
            CONSOLE.write_text(f"flight: {course['name']} {at_s:g} s\n")
            told_s += _TOLD_S
    for task in running.values():
        task.send_signal(signal.SIGTERM)
    statuses = {name: task.wait(_END_S) for name, task in running.items()}
    station.close()
    said = {"begin_ns": begin_ns, "events_ns": happened, "reports": station.reports, "statuses": statuses}
    (out / "station.json").write_text(json.dumps(said))


def main(session: dict[str, Any], out: Path) -> dict[str, Any]:
    said: dict[str, Any] = {}
    try:
        for address in (session["robot"], session["station"]):
            run("ip", "address", "add", f"{address}/32", "dev", "lo")
        Path(session["laser"]).parent.mkdir(parents=True, exist_ok=True)
        for interface in session["interfaces"]:
            bitrate = str(session["bitrate"])
            run("ip", "link", "set", interface, "up", "type", "can", "bitrate", bitrate, "restart-ms", "100")
        for course in session["courses"]:
            drive(course, session, out / course["name"])
    except Exception:
        said["error"] = traceback.format_exc()
    files = [path for path in sorted(out.rglob("*")) if path.is_file()]
    said["files"] = {str(path.relative_to(out)): base64.b64encode(path.read_bytes()).decode() for path in files}
    return said


if __name__ == "__main__":
    os.chdir("/run")
    print(json.dumps(main(json.loads(Path(sys.argv[1]).read_text()), Path("/run/courses"))))
