"""Runs in a guest: a control task at 100 Hz while a release comes by multicast, is checked, applied and written.

Standard library and what the image has; `python3 guest.py SESSION` reads what virtual.py wrote, and prints as JSON what
came of each course. Receiver, its service, updater and control task are the image's. What stands in for hardware: the
card is a loop device over memory, and so is the data partition; the station is a network namespace.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

STATION = "station"
UPDATER = Path("/run/update")
FLOTILLA = "/usr/lib/flotilla"
DATA = Path("/data/update")
_END_S = 10.0
"""For the task to end."""
WRAPPER = """#!/usr/bin/python3 -IS
import importlib.machinery, os, sys
sys.dont_write_bytecode = True
update = importlib.machinery.SourceFileLoader("update", "/usr/lib/flotilla/update.py").load_module()
update.disk = lambda: "{card}"
update.partition = lambda slot: "{running}"
if {above}:
    update.yield_to_tasks = lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({above}))
sys.exit(update.main())
"""
SLOT = """#!/bin/sh
exec /usr/bin/flotilla-slot --disk {card} --running A "$@"
"""


def run(*argv: str, given: bytes | None = None) -> str:
    """A command that has to succeed; what it says. Its errors are part of the error."""
    done = subprocess.run(argv, input=given, capture_output=True, check=False, env=ENVIRONMENT)
    if done.returncode:
        raise RuntimeError(f"{' '.join(argv)}: status {done.returncode}: {done.stdout!r} {done.stderr!r}")
    return done.stdout.decode()


ENVIRONMENT = os.environ | {"PATH": f"{UPDATER}:{os.environ.get('PATH', '/usr/sbin:/usr/bin:/sbin:/bin')}"}


def cell(robot: str, station: str, length: int) -> None:
    """The station is a namespace, its only way to the robot a cable. The robot's firewall admits it as a station."""
    run("ip", "netns", "add", STATION)
    run("ip", "link", "add", "cell0", "type", "veth", "peer", "name", "cell1", "netns", STATION)
    run("ip", "address", "add", f"{robot}/{length}", "dev", "cell0")
    run("ip", "link", "set", "cell0", "up")
    within = ("ip", "netns", "exec", STATION)
    run(*within, "ip", "address", "add", f"{station}/{length}", "dev", "cell1")
    run(*within, "ip", "link", "set", "cell1", "up")
    run("nft", "insert", "rule", "inet", "flotilla", "input", "iifname", "cell0", "udp", "dport", "4242", "accept")


def data(megabytes: int) -> None:
    """A data partition with the room that a card's has: ext4 on a block device."""
    file = Path("/run/data.ext4")
    with file.open("wb") as out:
        out.truncate(megabytes << 20)
    device = run("losetup", "--find", "--show", str(file)).strip()
    run("mkfs.ext4", "-q", "-E", "nodiscard,lazy_itable_init=1,lazy_journal_init=1", device)
    DATA.mkdir(parents=True, exist_ok=True)
    run("mount", device, str(DATA))


def card(name: str, session: dict[str, Any], above: int) -> str:
    """A card whose slot A runs, as a block device; from now on the updater's, which has the real-time priority `above`
    if that is not 0."""
    file = Path(f"/run/{name}.card")
    with file.open("wb") as out:
        out.truncate(session["card_bytes"])
        for at, piece in session["card"]:
            out.seek(at)
            out.write(Path(piece).read_bytes())
    device = run("losetup", "--find", "--show", str(file)).strip()
    start, size = session["running"]
    running = run("losetup", "--find", "--show", "--offset", str(start), "--sizelimit", str(size), str(file)).strip()
    UPDATER.mkdir(exist_ok=True)
    for program, text in (("update.py", WRAPPER), ("flotilla-slot", SLOT)):
        path = UPDATER / program
        path.write_text(text.format(card=device, running=running, above=above))
        path.chmod(0o755)
    return device


class Task:
    """The control task, and what it says of itself."""

    def __init__(self, session: dict[str, Any], out: Path, file: str, library: str = "") -> None:
        """`library`: what it loads before all others."""
        self.out = out
        out.mkdir()
        argv = ["flotilla-run", "--blocks", session["blocks"], "--statistics", str(out / "statistics.json")]
        argv += ["--control", str(out / "control"), file]
        with (out / "log").open("wb") as log:
            environment = os.environ | ({"LD_PRELOAD": library} if library else {})
            self._process = subprocess.Popen(argv, stdout=log, stderr=log, cwd=out, env=environment)

    def now(self) -> dict[str, Any]:
        """How it does, as `flotilla-param` says; nothing when it has ended, since too many steps were lost."""
        argv = ["flotilla-param", "--control", str(self.out / "control"), "--status=json", "task"]
        done = subprocess.run(argv, capture_output=True, check=False)
        if done.returncode:
            return {}
        said: dict[str, Any] = json.loads(done.stdout)
        return said

    def end(self) -> dict[str, Any]:
        """End it: its status, what it wrote, and its statistics."""
        self._process.send_signal(signal.SIGTERM)
        said = {"status": self._process.wait(_END_S), "log": (self.out / "log").read_text()}
        file = self.out / "statistics.json"
        return said | {"statistics": json.loads(file.read_text()) if file.exists() else None}


def scheduling(name: str, priority: int) -> str:
    """How a service runs, in the kernel's words; `priority`: a real-time one that it gets first, 0: as it was started.

    It was started without: what the service manager does for that takes longer than a task may wait.
    """
    process = run("systemctl", "show", "--property=MainPID", "--value", name).strip()
    if priority:
        run("chrt", "--fifo", "--pid", str(priority), process)
    return run("chrt", "-p", process)


def course(name: str, session: dict[str, Any], above: dict[str, int], out: Path) -> dict[str, Any]:
    """A release comes while the task runs. `above`: real-time priorities of `receiver` and `updater`; 0: as shipped."""
    device = card(name, session, above["updater"])
    update = str(UPDATER / "update.py")
    task = Task(session, out / name, session["task"])
    time.sleep(session["alone_s"])
    told: dict[str, Any] = {"alone": task.now()}
    told["begin"] = json.loads(run(update, "begin", given=Path(session["offer"]).read_bytes()))
    told["begun"] = task.now()
    description = Path(session["description"]).read_bytes()
    run(f"{FLOTILLA}/receive", "begin", session["station"], session["robot"], given=description)
    told["scheduling"] = scheduling("flotilla-receive", above["receiver"])
    sender = ["ip", "netns", "exec", STATION, "python3", session["sender"], session["tape"], session["station"]]
    told["answers"] = json.loads(run(*sender, str(session["bit_s"])))
    told["received"] = task.now()
    file = Path(run(f"{FLOTILLA}/receive", "end").strip())
    told["file"] = hashlib.sha256(file.read_bytes()).hexdigest()
    told["delta"] = json.loads(run("sh", "-c", f"{update} delta <{file}"))
    told["finish"] = json.loads(run(update, "finish"))
    told["written"] = task.now()
    told["task"] = task.end()
    told["slots"] = json.loads(run(f"{UPDATER}/flotilla-slot", "show"))["slots"]
    start, size = session["written"]
    with Path(device).open("rb") as written:
        written.seek(start)
        told["content"] = hashlib.sha256(written.read(size)).hexdigest()
    return told


def alone(session: dict[str, Any], out: Path, file: str, library: str = "") -> dict[str, Any]:
    """A task, and no update."""
    task = Task(session, out, file, library)
    time.sleep(session["alone_s"])
    before = task.now()
    time.sleep(session["without_s"])
    return {"before": before, "now": task.now()} | task.end()


def main(session: dict[str, Any], out: Path) -> dict[str, Any]:
    said: dict[str, Any] = {}
    out.mkdir()
    try:
        cell(session["robot"], session["station"], session["prefix"])
        data(session["data_mib"])
        said["alone"] = alone(session, out / "alone", session["task"])
        said["bad"] = alone(session, out / "bad", session["heartbeat"], session["overrun"])
        for name, above in session["courses"].items():
            said[name] = course(name, session, above, out)
    except Exception:
        said["error"] = traceback.format_exc()
    return said


if __name__ == "__main__":
    os.chdir("/run")
    print(json.dumps(main(json.loads(Path(sys.argv[1]).read_text()), Path("/run/courses"))))
