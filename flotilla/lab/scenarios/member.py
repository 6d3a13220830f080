"""Runs in a guest that is one computer of a fleet in lock-step: its radios, and its part of a flight.

Standard library and what the image has. The computer is the image's: its services run the control tasks, join the cell
and admit packets. `python3 -m flotilla.lab.scenarios.member SESSION` reads what lockstep.py wrote, and prints as JSON
the files that tasks left, in base64.
"""

from __future__ import annotations

import base64
import functools
import json
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flotilla.lab.scenarios import fly

_PCI = Path("/sys/bus/pci/devices")
_SHARED_MEMORY = ("0x1af4", "0x1110")
"""Vendor and device of QEMU's ivshmem."""
_CELL_S = 90.0
"""Until an adapter that has just appeared is in the cell, and hears the others."""
_INTERFACE = "wlan0"
_PROGRAM = """
import ctypes, sys
member = ctypes.CDLL(sys.argv[1])
sys.exit(member.take_part(sys.argv[2].encode(), sys.argv[3].encode(), int(sys.argv[4]), int(sys.argv[5]), 1))
"""


def mailbox() -> Path:
    """The memory that this guest shares with its conductor."""
    for device in sorted(_PCI.iterdir()):
        if tuple((device / name).read_text().strip() for name in ("vendor", "device")) == _SHARED_MEMORY:
            (device / "enable").write_text("1")
            return device / "resource2"
    raise RuntimeError("the guest has no memory that it shares")


class Lockstep:
    """The process that keeps this guest in lock-step."""

    def __init__(self, library: str, bell: str, radios: list[int]) -> None:
        fly.run("stty", "-F", bell, "115200", "raw", "-echo", "clocal")
        argv = ["python3", "-c", _PROGRAM, library, str(mailbox()), bell, *map(str, radios)]
        self._process = subprocess.Popen(argv, stdout=subprocess.PIPE)
        assert self._process.stdout
        if not self._process.stdout.readline():
            raise RuntimeError(f"the guest is not in lock-step: status {self._process.wait()}")

    def __enter__(self) -> Lockstep:
        return self

    def __exit__(self, *_: object) -> None:
        """Whatever happens here, no guest waits for this one."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()

    def end(self) -> None:
        """For all guests."""
        self._process.send_signal(signal.SIGTERM)
        self.wait()

    def wait(self) -> None:
        """Until all end."""
        if status := self._process.wait():
            raise RuntimeError(f"lock-step ended with status {status}")


def until(what: Callable[[], bool], wanted: str) -> None:
    """RuntimeError where it is not so in time."""
    end = time.monotonic() + _CELL_S
    while not what():
        if time.monotonic() > end:
            raise RuntimeError(f"not within {_CELL_S:g} s: {wanted}")
        time.sleep(0.1)


def in_cell() -> bool:
    """The image's units have joined, and the interface has its address."""
    said = subprocess.run(["ip", "-4", "-o", "address", "show", "dev", _INTERFACE], capture_output=True, check=False)
    joined = subprocess.run(["iw", "dev", _INTERFACE, "link"], capture_output=True, check=False)
    return b"inet " in said.stdout and b"Joined" in joined.stdout


def hears(address: str) -> bool:
    return not subprocess.run(["ping", "-c", "1", "-w", "2", address], capture_output=True, check=False).returncode


def set_rate(computer: str, mbit_s: float) -> None:
    """Of frames to one computer, as in flights of one guest."""
    fly.run("ip", "netns", "exec", computer, "iw", "dev", _INTERFACE, "set", "bitrates", "legacy-2.4", f"{mbit_s:g}")


def station(described: dict[str, str]) -> None:
    """A computer beside this one, with a radio of its own: the second."""
    name = described["name"]
    fly.run("ip", "netns", "add", name)
    fly.run("iw", "phy", "phy1", "set", "netns", "name", name)
    within = ("ip", "netns", "exec", name)
    fly.run(*within, "ip", "link", "set", "lo", "up")
    fly.run(*within, "ip", "link", "set", "wlan1", "name", _INTERFACE)
    fly.join(name)
    fly.run(*within, "ip", "address", "add", described["address"], "dev", _INTERFACE)


def status(task: str) -> dict[str, Any]:
    """What a control task of the image says of itself."""
    told = subprocess.run(["flotilla-param", "--status=json", task], capture_output=True, text=True, check=False)
    if told.returncode:
        raise RuntimeError(f"{task}: {told.stderr}")
    said: dict[str, Any] = json.loads(told.stdout)
    return said


def since(before: dict[str, Any], after: dict[str, Any], seconds: float) -> dict[str, int]:
    """What a task has counted in between. Where it had no overrun in the last `seconds`, the flight's, those before it
    are left out: computers were still starting."""
    counted: dict[str, int] = {name: after[name] - before[name] for name in ("steps", "timeouts")}
    last = after["last_overrun"]
    flown = last is not None and last["ago_s"] <= seconds
    return counted | {name: (after[name] - before[name]) * flown for name in ("overruns", "skipped")}


def take_part(session: dict[str, Any], out: Path, lockstep: Lockstep) -> None:
    name = session["name"]
    fly.run("ip", "netns", "attach", name, "1")  # so that events find this computer as they find those of one guest
    until(in_cell, "in the cell")
    set_rate(name, session["mbit_s"])
    before = {task: status(task) for task in session["tasks"]}
    if session["flight"]:
        station(session["station"])
        set_rate(session["station"]["name"], session["mbit_s"])
        for peer in session["peers"]:
            until(functools.partial(hears, peer), f"an answer of {peer}")
        fly.fly(session["flight"], [], out)
        lockstep.end()
    else:
        lockstep.wait()
    for task in session["tasks"]:
        (out / task).mkdir(parents=True, exist_ok=True)
        (out / task / "statistics.json").write_text(json.dumps(since(before[task], status(task), session["seconds"])))


def main(session: dict[str, Any], out: Path) -> dict[str, Any]:
    said: dict[str, Any] = {}
    try:
        fly.run("modprobe", "mac80211_hwsim", "radios=0")
        with Lockstep(session["library"], session["bell"], session["radios"]) as lockstep:
            take_part(session, out, lockstep)
    except Exception:
        said["error"] = traceback.format_exc()
    files = [path for path in sorted(out.rglob("*")) if path.is_file()]
    said["files"] = {str(path.relative_to(out)): base64.b64encode(path.read_bytes()).decode() for path in files}
    return said


if __name__ == "__main__":
    print(json.dumps(main(json.loads(Path(sys.argv[1]).read_text()), Path("/run/flight"))))
