"""Runs in a guest: two tasks, one of which sends to the other, and a third one, while datagrams come from the cable.

Standard library and what the image has. `python3 -m flotilla.lab.scenarios.flooded` reads what wire_flood.py wrote, in
the current directory, and prints as JSON what came of it.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from flotilla.lab.scenarios import exchange, fly

SECONDS = 5
_SETTLED_S = 3
_PRIORITY = 75
_CABLE = "eth1"
_INTERFACES = Path("/sys/class/net")
_RECEIVED = _INTERFACES / _CABLE / "statistics/rx_packets"


def adapter(address: str) -> str:
    """The interface that has this hardware address."""
    return next(path.parent.name for path in _INTERFACES.glob("*/address") if path.read_text().strip() == address)


def within(computer: str, *argv: str) -> None:
    """Above the interrupts of the cable, because it ends the flood, too, and below control."""
    fly.run("chrt", "--fifo", str(_PRIORITY), "ip", "netns", "exec", computer, *argv)


def firewalled(computer: str) -> int:
    """Packets that its firewall has dropped as too many."""
    argv = ["ip", "netns", "exec", computer, "nft", "--json", "list", "chain", "inet", "flotilla", "flood"]
    listed = json.loads(subprocess.run(argv, check=True, capture_output=True).stdout)["nftables"]
    parts = [part for each in listed for part in each.get("rule", {}).get("expr", ())]
    return sum(int(part["counter"]["packets"]) for part in parts if "counter" in part)


def frames(computer: str) -> int:
    """That the adapter has taken."""
    argv = ["ip", "netns", "exec", computer, "cat", str(_RECEIVED)]
    return int(subprocess.run(argv, check=True, capture_output=True).stdout)


def phase(tasks: list[dict[str, Any]], *, flooded: bool) -> dict[str, Any]:
    """Some seconds of it."""
    sends, takes, _ = tasks
    with ExitStack() as stack:
        for task in tasks:
            stack.enter_context(exchange.running(task, "--statistics", f"{task['directory']}/statistics.json"))
        time.sleep(_SETTLED_S)
        before = counted(sends, takes)
        if flooded:
            within(takes["computer"], "ip", "link", "set", _CABLE, "up")
            fly.run("sh", "-c", "exec /usr/lib/flotilla/irq-priorities >/dev/null 2>&1")  # some of its processes stay
        time.sleep(SECONDS)
        if flooded:
            within(takes["computer"], "ip", "link", "set", _CABLE, "down")
        after = counted(sends, takes)
    told = {task["name"]: json.loads(Path(f"{task['directory']}/statistics.json").read_text()) for task in tasks}
    return {name: after[name] - before[name] for name in after} | {
        "overruns": {name: each["overruns"] for name, each in told.items()},
        "longest_ns": {name: each["step"]["max_ns"] for name, each in told.items()},
    }


def counted(sends: dict[str, Any], takes: dict[str, Any]) -> dict[str, int]:
    received = exchange.outputs(takes, "in.sequence", "in.forged", "in.refused", "in.dropped")
    return {
        "frames": frames(takes["computer"]),
        "firewalled": firewalled(takes["computer"]),
        "messages": received["in.sequence"],
        "forged": received["in.forged"],
        "refused": received["in.refused"],
        "dropped": received["in.dropped"],
        "sent": exchange.outputs(sends, "out.sent")["out.sent"],
    }


def main() -> dict[str, Any]:
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    exchange.join()
    described = json.loads(Path("flood.json").read_text())
    receiver = described["tasks"][1]["computer"]
    fly.run("ip", "link", "set", adapter(described["adapter"]), "netns", receiver, "name", _CABLE)
    within(receiver, "nft", "--file", "nftables.conf")
    return {name: phase(described["tasks"], flooded=name == "flooded") for name in ("quiet", "flooded")}


if __name__ == "__main__":
    print(json.dumps(main()))
