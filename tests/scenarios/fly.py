"""Runs in a guest: the computers of a fleet in a network namespace each, joined by simulated 802.11 radios in a cell.

Standard library and what the image has; `python3 fly.py PLAN` reads `Plan` of virtual.py as JSON, and prints JSON: of each
task its status, and the files that it left, in base64: recordings, statistics, and what it said.
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
from pathlib import Path
from typing import Any

_END_S = 5.0
"""For tasks to end."""


def run(*argv: str) -> None:
    """A command that has to succeed; what it says is part of the error."""
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(argv)}: status {done.returncode}: {done.stdout}{done.stderr}")


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
        run(*within, "/usr/lib/flotilla/ibss", "wlan0")
        run(*within, "ip", "address", "add", computer["address"], "dev", "wlan0")
    first, *others = computers
    for other in others:
        peer = first["address"].partition("/")[0]
        run("ip", "netns", "exec", other["name"], "ping", "-c", "1", "-w", "20", peer)


def start(task: dict[str, str], out: Path) -> subprocess.Popen[bytes]:
    """One control task, in its computer's namespace, as its unit would start it."""
    out.mkdir(parents=True)
    argv = ["ip", "netns", "exec", task["computer"], "flotilla-run", "--statistics", str(out / "statistics.json")]
    if "blocks" in task:
        argv += ["--blocks", task["blocks"]]
    environment = os.environ | {"CYCLONEDDS_URI": f"file://{task['cyclonedds']}"} if "cyclonedds" in task else None
    with (out / "log").open("wb") as log:
        return subprocess.Popen([*argv, task["file"]], stdout=log, stderr=log, env=environment, cwd=out)


def fly(plan: dict[str, Any], out: Path) -> dict[str, Any]:
    for link, device in plan["links"].items():
        Path(link).parent.mkdir(parents=True, exist_ok=True)
        Path(link).unlink(missing_ok=True)
        Path(link).symlink_to(device)
    join_cell(plan["computers"])
    tasks = {task["name"]: start(task, out / task["name"]) for task in plan["tasks"]}
    begin = time.monotonic()
    for event in sorted(plan["events"], key=lambda event: float(event["at_s"])):
        time.sleep(max(0.0, begin + event["at_s"] - time.monotonic()))
        run(*event["command"])
    time.sleep(max(0.0, begin + plan["seconds"] - time.monotonic()))
    for task in tasks.values():
        task.send_signal(signal.SIGTERM)
    statuses = {name: task.wait(_END_S) for name, task in tasks.items()}
    files = {
        str(path.relative_to(out)): base64.b64encode(path.read_bytes()).decode()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }
    return {"statuses": statuses, "files": files}


def main(plan: Path) -> None:
    try:
        said = fly(json.loads(plan.read_text()), Path("/run/flight"))
    except Exception:
        said = {"error": traceback.format_exc()}
    print(json.dumps(said))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
