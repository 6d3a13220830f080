"""What a message between two robots costs their processors, by transport and proof, in virtual time.

Two computers of the laboratory's fleet are namespaces of one guest, joined by simulated radios. One sends what
`control` sends to `thruster-mapping` each period, by the very blocks and settings that their cards have. A run repeats
to the byte.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from flotilla.fleet import dds_security, message_keys
from flotilla.fleet.model import Board, Fleet
from flotilla.lab.latency import machine, results, subject
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.virtual import DIRECTORY

PERIOD_NS = 10_000_000
_PROGRAMS = ("fly.py", "exchange.py", "flooded.py")
_LIMIT_S = 1800
"""Of the host's clock."""
_MESSAGE = {
    "clock": {"type": "clock"},
    "message": {
        "type": "pack",
        "in": {
            "step": 1, "sensed_ns": 2, "navigation_ns": 3, "control_ns": "clock.wall_ns", "wrench": [0.1, 0.2, 0.3],
            "good": 1,
        },
        "parameters": {
            "names": ["step", "sensed_ns", "navigation_ns", "control_ns", "wrench", "good"],
            "types": ["uint64", "int64", "int64", "int64", "double", "boolean"], "widths": [1, 1, 1, 1, 3, 1],
        },
    },
}  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """One way for messages to go."""

    title: str
    transport: str = ""
    """Empty: none goes, which is what the others are compared with."""
    proof: bool = False


VARIANTS = {
    "none": Variant("the two tasks without a message"),
    "udp": Variant("UDP", "udp"),
    "udp-keys": Variant("UDP, each message with a proof", "udp", proof=True),
    "dds": Variant("DDS", "dds"),
    "dds-security": Variant("DDS with DDS Security", "dds", proof=True),
}


@dataclass(frozen=True)
class Cost:
    """Processor time that a message takes, less what the tasks take without one."""

    sender_ns: int
    receiver_ns: int
    whole_ns: int
    """Of all processes and kernel threads of both computers."""
    taken: int
    """Messages that the receiver took."""


def measure(board: Board, out: Path) -> dict[str, Cost]:
    """Exchange messages for some seconds by each of `VARIANTS`."""
    out.mkdir(parents=True, exist_ok=True)
    described = virtual.fleet("dds", dds_security=True, board=board)
    sender, receiver = described.robot_with("control"), described.robot_with("thruster-mapping")
    there = virtual.session(described, [sender, receiver], [], out / "keys", {}, [])
    exchanges = []
    for name, variant in VARIANTS.items():
        found, files = exchange(name, variant, board, out / "keys")
        exchanges.append(found)
        there |= files
    there[f"{DIRECTORY}/exchanges.json"] = json.dumps(exchanges).encode()
    said: dict[str, dict[str, int]] = run(board, there, out, "exchange")
    return {name: _cost(said[name], said["none"]) for name in VARIANTS if name != "none"}


def run(board: Board, there: Mapping[str, bytes], out: Path, program: str, extra: tuple[str, ...] = ()) -> Any:
    """What a program of this folder says in a guest. `there`: files that it finds; `extra`: QEMU's arguments."""
    programs = {f"{DIRECTORY}/flotilla/lab/scenarios/{name}": (virtual.HERE / name).read_bytes() for name in _PROGRAMS}
    measured = subject.build(board)
    commands = {"session": ["env", "-C", str(DIRECTORY), "python3", "-m", f"flotilla.lab.scenarios.{program}"]}
    initrd = out / "initrd.img"
    subject.write_initrd(measured, initrd, {"scenarios": [], "commands": commands}, {**there, **programs})
    guest = machine.Machine(machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=extra)
    document = results.received(guest.run(out, _LIMIT_S))
    initrd.unlink()
    return json.loads(document["commands"]["session"])


def exchange(name: str, variant: Variant, board: Board, keys: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """As exchange.py reads it, and its files by path."""
    described = virtual.fleet(variant.transport or "udp", dds_security=variant.transport == "dds", board=board)
    rendered = virtual.rendered(described, keys)
    sends: dict[str, Any] = dict(_MESSAGE)
    takes: dict[str, Any] = {"in": {"type": "clock"}}
    if variant.transport:
        sends["out"] = _block(described, rendered, "control", "to_mapping", variant) | {"in": {"data": "message.out"}}
        takes["in"] = _block(described, rendered, "thruster-mapping", "wrench", variant)
    files, tasks = {}, []
    for task, blocks in (("control", sends), ("thruster-mapping", takes)):
        robot = described.robot_with(task)
        directory = f"{DIRECTORY}/{name}/{task}"
        content: dict[str, Any] = {"period": "10 ms", "priority": 80, "overruns": 0, "blocks": blocks}
        if task == "thruster-mapping" and variant.transport:
            content["trigger"] = "in"
        files[f"{directory}/{task}.yml"] = yaml.safe_dump(content).encode()
        own = ["cyclonedds.xml", message_keys.CREDENTIAL]
        own += [dds_security.CREDENTIAL] * (variant.transport == "dds" and variant.proof)
        for file in own:
            files[f"{directory}/{file}"] = rendered[robot.name][f"/etc/flotilla/{file}"]
        configuration = [f"file://{directory}/{file}" for file in own if file.endswith(".xml")]
        tasks.append(
            {"computer": robot.name, "name": task, "directory": directory, "cyclonedds": ",".join(configuration)}
        )
    return {"name": name, "tasks": tasks, "messages": bool(variant.transport)}, files


def received(described: Fleet, keys: Path) -> dict[str, Any]:
    """Parameters of the block that takes the message."""
    block = _block(described, virtual.rendered(described, keys), "thruster-mapping", "wrench", VARIANTS["udp-keys"])
    found: dict[str, Any] = block["parameters"]
    return found


def _block(
    described: Fleet, rendered: dict[str, dict[str, bytes]], task: str, block: str, variant: Variant
) -> dict[str, Any]:
    """As the robot's card has it; without keys where messages have no proof."""
    content = rendered[described.robot_with(task).name][f"/etc/flotilla/tasks/{task}.yml"]
    found: dict[str, Any] = yaml.load(content, yaml.BaseLoader)["blocks"][block]
    if not variant.proof:
        found["parameters"].pop("keys", None)
    return found


def _cost(found: dict[str, int], without: dict[str, int]) -> Cost:
    def each(what: str) -> int:
        return (found[what] - without[what]) // found["periods"]

    return Cost(each("sender_ns"), each("receiver_ns"), each("whole_ns"), found["taken"])
