"""Asks a robot: what it is beside its description, what its computer is and does, how late it is."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flotilla.apps import assigned
from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.lab.acceptance import answers, on_robot, relays
from flotilla.lab.acceptance.relays import Relay
from flotilla.lab.latency import results, target
from flotilla.lab.latency.results import Results
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import LabError
from flotilla.robot import release, state

_HERE = Path(__file__).parent
_STATE = paths.PROJECT / "ansible" / "library" / "robot_state.py"
_STATE_ARGUMENTS = "<<INCLUDE_ANSIBLE_MODULE_JSON_ARGS>>"
_SENT_BYTES = 4 << 20
"""Over the robot's link, each way: for errors to show."""
_RESTART_S = 600
"""For a computer that was reset to answer again; an emulated one on a busy host needs most of it."""
_HANG = (
    "systemctl stop 'flotilla-task@*' 'flotilla-app@*'; sysctl -q kernel.sched_rt_runtime_us=-1; "
    "for each in $(seq $(nproc)); do chrt -f 99 sh -c 'while :; do :; done' & done; wait"
)
"""Real-time loops that nothing interrupts: to the robot's services, a system that hangs. What drives actuators ends
first, because a computer that hangs leaves them as they are."""


@dataclass(frozen=True)
class Facts:
    """What a robot answered."""

    parts: dict[str, Any]
    """By name of the part of `on_robot.py`."""
    errors: dict[str, str]
    """Of parts that could not be asked."""
    state: dict[str, Any]
    """As `robot_state` found it."""
    release: str | None
    """SHA-256 of what the robot's image here holds; None without one."""
    link: tuple[Any, Any]
    """Interfaces before and after some MiB each way."""
    latency: Results | None = None
    """None: it was not asked for."""
    relays: list[Relay] | None = None
    """None: nobody watched."""
    bite_s: float | None = None
    """From a hang until another boot answered; None: not tried. Infinite: none did."""


def ask(
    fleet: Fleet, robot: Robot, shell: Ssh, out: Path, *,
    plan: results.Plan | None, seconds: int, inventory: Path = paths.INVENTORY, bite: bool = False,
    person: Callable[[str], bool] | None = None,
) -> Facts:  # fmt: skip
    """All there is to know. `plan`: of latency, None for none; `seconds`: of each other meter; `bite`: hang the
    computer, for its watchdog to act; `person`: watches the relays."""
    watched = relays.watch(robot, shell, person) if person else None  # first, while the person is there
    board = fleet.boards[robot.board]
    described = _described(fleet, robot, shell, inventory)
    before = _parts(shell, board, fleet, robot, ["network"], 0)
    with progress.step(f"{robot.name}: {progress.size(_SENT_BYTES)} each way over its link"):
        shell.write("/dev/null", bytes(_SENT_BYTES))
        shell.run(["head", "-c", str(_SENT_BYTES), "/dev/zero"])
    said = _parts(shell, board, fleet, robot, list(on_robot.PARTS), seconds)
    return Facts(
        parts={name: each["facts"] for name, each in said.items() if "facts" in each},
        errors={name: each["error"] for name, each in said.items() if "error" in each},
        state=described,
        release=release.wanted(robot),
        link=(before["network"].get("facts"), said["network"].get("facts")),
        latency=target.measure(robot, board, shell, plan, out) if plan else None,
        relays=watched,
        bite_s=_bitten(robot, shell) if bite else None,
    )


def _described(fleet: Fleet, robot: Robot, shell: Ssh, inventory: Path) -> dict[str, Any]:
    """What provisioning asks a robot, without Ansible."""
    built = assigned.built(fleet, [robot])[robot.name]
    arguments = json.dumps(state.arguments(inventory, fleet, robot, built, fleet.health))
    source = _STATE.read_text().replace(_STATE_ARGUMENTS, arguments)
    with progress.step(f"{robot.name} beside its description"):
        return answers.state(robot.name, shell.run(["sudo", "python3", "-"], stdin=source).stdout)


def _parts(
    shell: Ssh, board: Board, fleet: Fleet, robot: Robot, parts: Sequence[str], seconds: int
) -> dict[str, dict[str, Any]]:
    """What the parts say, each with `facts` or an `error`."""
    asked = {
        "parts": parts,
        "ports": {name: port.tty for name, port in board.ports.items()},
        "console": board.console_tty,
        "interface": fleet.interface(robot),
        "can": sorted(robot.can),
        "seconds": seconds,
    }
    found: dict[str, dict[str, Any]] = {}
    with progress.step(f"{robot.name}: its computer", lambda: progress.Far(len(found), len(parts), "parts")):
        for line in _lines(robot, shell, asked):
            said = answers.part(robot.name, line, board.ports)
            found[said["part"]] = said
    if missing := [name for name in parts if name not in found]:
        raise UserError(f"{robot.name} stopped answering at {missing[0]}; is it on? `make ssh ROBOT={robot.number}`")
    return found


def _lines(robot: Robot, shell: Ssh, asked: dict[str, Any]) -> Iterator[Any]:
    with shell.start(["sudo", "python3", "-", json.dumps(asked)]) as program:
        assert program.stdin
        assert program.stdout
        program.stdin.write((_HERE / "on_robot.py").read_text())
        program.stdin.close()
        yield from answers.lines(robot.name, program.stdout)


def _bitten(robot: Robot, shell: Ssh) -> float:
    """Hang the computer; how long until another boot answers."""
    read = ["cat", "/proc/sys/kernel/random/boot_id"]
    before = shell.run(read).stdout
    with progress.step(f"{robot.name}: a hang, for its watchdog to end"):
        begun = time.monotonic()
        shell.run(["sudo", "systemd-run", "--quiet", "sh", "-c", _HANG], check=False)
        while (lasted := time.monotonic() - begun) < _RESTART_S:
            try:
                if shell.run(read, timeout=30).stdout != before:
                    return lasted
            except LabError:  # it hangs, or boots
                shell.hang_up()
    return math.inf
