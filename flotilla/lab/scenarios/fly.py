"""Runs in a guest: the computers of a fleet in a network namespace each, joined by simulated 802.11 radios in a cell.

Standard library and what the image has; `python3 fly.py SESSION` reads what virtual.py wrote, and prints as JSON the
files that tasks left, in base64: recordings, statistics, and what they said.
"""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

_END_S = 5.0
"""For tasks to end."""
_TOLD_S = 5.0
"""Between two lines on the console that tell the host how far a flight is."""
CONSOLE = Path("/dev/console")


def run(*argv: str) -> None:
    """A command that has to succeed; what it says is part of the error."""
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(argv)}: status {done.returncode}: {done.stdout}{done.stderr}")


class Air:
    """The process that carries frames between the radios, each for its air time: `flotilla.lab.air` in its own Python.

    Above all else: it is no computer's.
    """

    _PROGRAM = """
import ctypes, sys
air = ctypes.CDLL(sys.argv[1])
air.carry.argtypes = [ctypes.c_int, ctypes.c_double, ctypes.c_int]
status = air.carry(int(sys.argv[2]), float(sys.argv[3]), 1)
told = ctypes.create_string_buffer(1000)
air.tell(told, len(told))
print(told.value.decode())
sys.exit(status)
"""

    def __init__(self, settings: dict[str, Any], computers: list[dict[str, Any]]) -> None:
        self._computers = computers
        argv = ["chrt", "-f", "98", "python3", "-c", self._PROGRAM, settings["library"]]
        argv += [str(len(computers)), str(settings["loss"])]
        self._process = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout
        if not self._process.stdout.readline():
            raise RuntimeError(f"the air does not carry: status {self._process.wait()}")
        self._set_rates("legacy-2.4", f"{settings['mbit_s']:g}")

    def end(self) -> str:
        """What it carried, as JSON. From then on frames arrive at once again."""
        self._process.send_signal(signal.SIGTERM)
        told, _ = self._process.communicate(timeout=_END_S)
        if self._process.returncode:
            raise RuntimeError(f"the air ended with status {self._process.returncode}")
        self._set_rates()
        return told

    def _set_rates(self, *rates: str) -> None:
        """Of frames to one computer; who adapts it would begin too low for the load, and never get out of that
        queue. Without rates: as it was."""
        for computer in self._computers:
            run("ip", "netns", "exec", computer["name"], "iw", "dev", "wlan0", "set", "bitrates", *rates)


def join_cell(computers: list[dict[str, Any]]) -> None:
    """A namespace and a radio for each computer; all are in the cell of /etc/flotilla/ibss.conf when it returns."""
    run("modprobe", "mac80211_hwsim", f"radios={len(computers)}")
    for index, computer in enumerate(computers):
        name, radio = computer["name"], f"wlan{index}"
        run("ip", "netns", "add", name)
        run("iw", "phy", f"phy{index}", "set", "netns", "name", name)
        within = ("ip", "netns", "exec", name)
        run(*within, "ip", "link", "set", "lo", "up")
        run(*within, "ip", "link", "set", radio, "name", "wlan0")
        join(name)
        run(*within, "ip", "address", "add", computer["address"], "dev", "wlan0")
    first, *others = computers
    for other in others:
        peer = first["address"].partition("/")[0]
        run("ip", "netns", "exec", other["name"], "ping", "-c", "1", "-w", "20", peer)


def start(task: dict[str, str], out: Path) -> subprocess.Popen[bytes]:
    """One control task, in its computer's namespace, as its unit would start it."""
    out.mkdir(parents=True)
    argv = ["ip", "netns", "exec", task["computer"], "flotilla-run", "--statistics", str(out / "statistics.json")]
    argv += ["--control", str(out / "control")]
    if "blocks" in task:
        argv += ["--blocks", task["blocks"]]
    environment = dict(os.environ)
    if "cyclonedds" in task:
        environment["CYCLONEDDS_URI"] = f"file://{task['cyclonedds']}"
    if "credentials" in task:
        environment["CREDENTIALS_DIRECTORY"] = task["credentials"]
    with (out / "log").open("wb") as log:
        return subprocess.Popen([*argv, task["file"]], stdout=log, stderr=log, env=environment, cwd=out)


class Flight:
    """Tasks that run, and what may happen to them."""

    def __init__(self, tasks: list[dict[str, str]], out: Path) -> None:
        self.tasks, self.out = tasks, out
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.out_of: dict[str, Path] = {}
        self.spawned: list[subprocess.Popen[bytes]] = []
        self.actions: dict[str, Callable[..., None]] = {
            "run": run,
            "power-off": self.power_off,
            "power-on": self.power_on,
            "spawn": self.spawn,
            "lose": self.lose,
        }
        for task in tasks:
            self.start(task)

    def start(self, task: dict[str, str], again: str = "") -> None:
        self.out_of[task["name"]] = self.out / (task["name"] + again)
        self.running[task["name"]] = start(task, self.out_of[task["name"]])

    def power_off(self, computer: str) -> None:
        """Its tasks stop at any instruction, and its radio is silent."""
        for task in self.tasks:
            if task["computer"] == computer:
                self.running[task["name"]].kill()
                self.running.pop(task["name"]).wait(_END_S)
        run("ip", "netns", "exec", computer, "iw", "dev", "wlan0", "ibss", "leave")

    def power_on(self, computer: str) -> None:
        """As after a boot: into the cell, and all tasks from the beginning. At most once in a flight."""
        join(computer)
        for task in self.tasks:
            if task["computer"] == computer:
                self.start(task, "-again")

    def spawn(self, *argv: str) -> None:
        """A command that goes on beside the tasks, and has to have succeeded when they end."""
        self.spawned.append(subprocess.Popen(argv))

    def lose(self, task: str) -> None:
        """A task is gone, and nobody listens where it did."""
        self.running[task].kill()
        self.running.pop(task).wait(_END_S)

    def end(self) -> dict[str, int]:
        """The exit status of each task, which was asked how it does and to end, and of what was spawned."""
        statuses = {str(spawned.args): spawned.wait(_END_S) for spawned in self.spawned}
        for name in self.running:
            out = self.out_of[name]
            argv = ["flotilla-param", "--control", str(out / "control"), "--status=json", name]
            (out / "status.json").write_bytes(subprocess.run(argv, check=True, stdout=subprocess.PIPE).stdout)
        for task in self.running.values():
            task.send_signal(signal.SIGTERM)
        return statuses | {name: task.wait(_END_S) for name, task in self.running.items()}


def tell(name: str, passed_s: float) -> None:
    """Tell the host how far a flight is."""
    with CONSOLE.open("w") as console:
        console.write(f"flight: {name} {passed_s:g} s\n")


def wait_until(at_s: float, name: str, begin: float) -> None:
    """Until so long after the flight's beginning, which it tells every few seconds."""
    while (passed_s := time.monotonic() - begin) < at_s:
        told_s = (passed_s // _TOLD_S + 1) * _TOLD_S
        time.sleep(max(0.0, begin + min(told_s, at_s) - time.monotonic()))
        if told_s < at_s:
            tell(name, told_s)


def fly(flight: dict[str, Any], computers: list[dict[str, Any]], out: Path) -> None:
    """Start the tasks, let things happen to them, end them; each has to end as asked."""
    out.mkdir(parents=True)
    air = Air(flight["air"], computers) if flight.get("air") else None
    begin = time.monotonic()
    happened: list[int] = []
    tasks = Flight(flight["tasks"], out)
    tell(flight["name"], 0)
    for event in sorted(flight["events"], key=lambda event: float(event["at_s"])):
        wait_until(event["at_s"], flight["name"], begin)
        tasks.actions[event["action"]](*event["arguments"])
        happened.append(time.monotonic_ns())
    (out / "events.json").write_text(json.dumps(happened))
    wait_until(flight["seconds"], flight["name"], begin)
    tell(flight["name"], flight["seconds"])
    statuses = tasks.end()
    if any(statuses.values()):
        raise RuntimeError(f"{flight['name']}: ended with {statuses}")
    if air:
        (out / "air.json").write_text(air.end())


def join(computer: str) -> None:
    """Put a computer into the cell, as its unit does; with nothing in the way of its packets."""
    within = ("ip", "netns", "exec", computer)
    run(*within, "/usr/lib/flotilla/ibss", "wlan0")
    subprocess.run([*within, "tc", "qdisc", "del", "dev", "wlan0", "root"], capture_output=True, check=False)


def main(session: dict[str, Any], out: Path) -> dict[str, Any]:
    said: dict[str, Any] = {}
    try:
        for link, device in session["links"].items():
            Path(link).parent.mkdir(parents=True, exist_ok=True)
            Path(link).unlink(missing_ok=True)
            Path(link).symlink_to(device)
        join_cell(session["computers"])
        for task in session["safe"]:  # as a relay board is after power on
            run("flotilla-run", "--safe", task)
        for flight in session["flights"]:
            fly(flight, session["computers"], out / flight["name"])
            for computer in session["computers"]:
                join(computer["name"])
    except Exception:
        said["error"] = traceback.format_exc()
    files = [path for path in sorted(out.rglob("*")) if path.is_file()]
    said["files"] = {str(path.relative_to(out)): base64.b64encode(path.read_bytes()).decode() for path in files}
    return said


if __name__ == "__main__":
    print(json.dumps(main(json.loads(Path(sys.argv[1]).read_text()), Path("/run/flight"))))
