"""Flights in virtual time by a fleet: each of its computers is a guest that boots the shipped system, all by one clock.

Each guest has a processor of its own, the robot's identity as its card has it, and a simulated radio; the image's
services join the cell and run the control tasks. Guests wait for each other at the end of each quantum, and what their
radios send is carried by one channel (`flotilla.lab.air`). The station and the robot that flies are a namespace of the
flying robot's guest. A run repeats to the byte.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.debian.lock import HOST
from flotilla.fleet import identity
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.images import data_partition
from flotilla.images.filesystem import Node
from flotilla.lab import air
from flotilla.lab.latency import computable_keys, machine, results, subject
from flotilla.lab.qemu import qemu
from flotilla.lab.scenarios import guests as realtime
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.flight import Flight
from flotilla.lab.scenarios.virtual import DIRECTORY, PLANT, RATE_MBIT_S, STATION, Plan

HERE = Path(__file__).parent
DEFAULT = "air"
HOW = (
    "Each is a guest with a processor of its own, in virtual time; all have one clock, and simulated radios on one "
    "channel of 802.11b. The robot's own clock measures latencies."
)
_MEMBER = f"{DIRECTORY}/member.so"
_BEFORE_S = 300.0
"""Of virtual time, at most, before a flight begins: guests boot, and join the cell."""
_RESULTS_LIMIT_S = 900
"""Of the host's clock, for a guest to send its results: finite, and generous to a busy host."""
_TOLD_BYTES = 1000


@dataclass(frozen=True)
class Member:
    """One guest."""

    robot: Robot
    radios: tuple[int, ...]
    """Numbers on the channel."""
    files: Mapping[str, bytes]
    nodes: Sequence[Node]
    """Of its data partition."""


def members(plan: Plan, fleet: Fleet, board: Board, keys: Path) -> list[Member]:
    """The flying robot's guest first, which has the station's radio, too."""
    flying = fleet.robot_with("valves")
    robots = sorted(fleet.robots.values(), key=lambda robot: robot != flying)
    library = air.compiled(air.MEMBER, board.system)
    programs = ("fly.py", "member.py")
    common = {f"{DIRECTORY}/flotilla/lab/scenarios/{name}": (HERE / name).read_bytes() for name in programs}
    common[_MEMBER] = library
    found, radios = [], 0
    with mock.patch.object(paths, "KEYS", keys):
        computable_keys.write(
            [*(f"{robot.name}_ed25519" for robot in robots), "operator_ed25519", "operator_authority"]
        )
        for robot in robots:
            count = 2 if robot is flying else 1
            session = _session(plan, fleet, board, robot, (radios, count))
            files = common | {f"{DIRECTORY}/session.json": json.dumps(session, sort_keys=True).encode()}
            if robot is flying:
                files |= virtual.lab_files(plan, fleet, board, keys, DIRECTORY)
                files[f"{DIRECTORY}/plant/plant.so"] = runtime.compile_plugin(PLANT, board.system)
            nodes = [_changed(node, plan) for node in data_partition.nodes(fleet, robot)]
            found.append(Member(robot, tuple(range(radios, radios + count)), files, nodes))
            radios += count
    return found


def _bell(board: Board) -> str:
    """The connector by which a guest learns that it has mail: the last one but that of the results."""
    return list(qemu.port_ids(board))[-2]


def _session(plan: Plan, fleet: Fleet, board: Board, robot: Robot, radios: tuple[int, int]) -> dict[str, Any]:
    """As member.py reads it."""
    flying = fleet.robot_with("valves")
    (station,) = fleet.stations
    session: dict[str, Any] = {
        "name": robot.name, "library": _MEMBER, "radios": radios, "mbit_s": RATE_MBIT_S, "seconds": plan.seconds,
        "flight": None, "tasks": robot.control_tasks, "bell": f"/dev/{board.ports[_bell(board)].tty}",
    }  # fmt: skip
    if robot is flying:
        others = [other for other in fleet.robots.values() if other is not flying]
        tasks = virtual.lab_tasks(DIRECTORY)
        events = [asdict(event) for event in plan.events]
        length = fleet.network.subnet.prefixlen
        session |= {
            "station": {"name": STATION, "address": f"{station.address}/{length}"},
            "peers": [str(host.address) for host in (*others, station)],
            "flight": {"name": plan.name, "seconds": plan.seconds, "tasks": tasks, "events": events},
        }
    return session


def _changed(node: Node, plan: Plan) -> Node:
    """A file of a data partition; a control task with what the plan changes."""
    if node.content is None or node.path.parent.name != identity.TASKS.name:
        return node
    return replace(node, content=virtual.changed(node.path.stem, node.content, plan.changes))


def fly(plan: Plan, board: Board, out: Path) -> Flight:
    """Fly it, in the directory `out`."""
    described = realtime.fleet(plan.transport, board, "ibss", dds_security=plan.dds_security)
    board = described.boards[board.name]
    (out / "keys").mkdir(parents=True, exist_ok=True)
    system = subject.build(board)
    emulator = machine.emulator()
    for name, sources in {"barrier.so": air.BARRIER, "conductor.so": air.CONDUCTOR}.items():
        (out / name).write_bytes(air.compiled(sources, HOST))
    fleet = members(plan, described, board, out / "keys")
    console = out / fleet[0].robot.name / machine.CONSOLE
    title = f"{plan.name}: {len(fleet)} guests in lock-step"
    with ExitStack() as stack:
        # Left after the guests have ended, which ends all that waits for them: Ctrl-C does, too.
        pool = stack.enter_context(ThreadPoolExecutor(len(fleet)))
        guests = [stack.enter_context(_running(member, board, system, emulator, out)) for member in fleet]
        seconds = {plan.name: plan.seconds}
        stack.enter_context(progress.step(title, lambda: virtual.far(progress.text(console), seconds)))
        told = pool.submit(_conduct, plan, fleet, guests, out).result()
        directories = [out / member.robot.name for member in fleet]
        contents = list(pool.map(partial(machine.ended, timeout_s=_RESULTS_LIMIT_S), guests, directories))
    flight = out / "flight"
    flight.mkdir(exist_ok=True)
    (flight / "air.json").write_text(told)
    said = {
        member.robot.name: virtual.unpack(results.received(content), flight)
        for member, content in zip(fleet, contents, strict=True)
    }
    if errors := [f"{name}: {error}" for name, error in said.items() if error]:
        raise UserError("the scenario failed in a guest:\n" + "\n".join(errors))
    return replace(Flight.read(flight), one_clock=False)


@contextmanager
def _running(
    member: Member, board: Board, system: subject.Subject, emulator: machine.Emulator, out: Path
) -> Iterator[subprocess.Popen[str]]:
    """A guest that runs, at most as long as the body does."""
    directory = out / member.robot.name
    directory.mkdir(exist_ok=True)
    box, initrd = directory / "mailbox", directory / "initrd.img"
    box.write_bytes(bytes(air.MAILBOX_BYTES))
    commands = {
        "session": ["env", "-C", str(DIRECTORY), "python3", "-m", "flotilla.lab.scenarios.member", "session.json"]
    }
    subject.write_initrd(system, initrd, {"scenarios": [], "commands": commands}, member.files, member.nodes)
    extra = _shared_memory(box, out / "barrier.so", qemu.port_ids(board)[_bell(board)])
    if len(member.radios) > 1:
        extra += machine.RELAYS
    guest = machine.Machine(emulator, board, system.kernel, initrd, system.arguments(), extra=extra)
    argv = guest.command_line(directory / machine.CONSOLE, directory / "results")
    try:
        with machine.started(emulator, argv, directory) as process:
            yield process
    finally:
        initrd.unlink()


def _shared_memory(box: Path, barrier: Path, bell: str) -> tuple[str, ...]:
    """QEMU's arguments for a guest that shares its mailbox, and waits for others."""
    file, plugin = (str(path).replace(",", ",,") for path in (box, barrier))
    memory = f"memory-backend-file,id=mailbox,share=on,mem-path={file},size={air.MAILBOX_BYTES}"
    waits = f"{plugin},mailbox={file},bell={bell}"
    return ("-object", memory, "-device", "ivshmem-plain,memdev=mailbox", "-plugin", waits)


def _conduct(plan: Plan, fleet: Sequence[Member], guests: Sequence[subprocess.Popen[str]], out: Path) -> str:
    """Until one of the guests wishes to end; what the channel did, as JSON."""
    conductor = ctypes.CDLL(str(out / "conductor.so"))
    alive = ctypes.CFUNCTYPE(ctypes.c_bool)(lambda: all(guest.poll() is None for guest in guests))
    boxes = [bytes(out / member.robot.name / "mailbox") for member in fleet]
    guest_of = [number for number, member in enumerate(fleet) for _ in member.radios]
    told = ctypes.create_string_buffer(_TOLD_BYTES)
    status = conductor.conduct(
        len(boxes), (ctypes.c_char_p * len(boxes))(*boxes), len(guest_of), (ctypes.c_int * len(guest_of))(*guest_of),
        ctypes.c_double(plan.air_loss or 0), ctypes.c_int64(round((_BEFORE_S + plan.seconds) * 1e9)), alive, told,
        _TOLD_BYTES,
    )  # fmt: skip
    if status == errno.ETIMEDOUT:
        gone = [(member, guest) for member, guest in zip(fleet, guests, strict=True) if guest.poll() is not None]
        raise UserError("\n".join(_why(guest, out / member.robot.name) for member, guest in gone))
    if status == errno.ETIME:
        raise UserError(
            f"{plan.name}: no guest had flown it {_BEFORE_S + plan.seconds:g} virtual seconds after power on"
        )
    if status:
        raise UserError(f"guests in lock-step: {os.strerror(status)}")
    return told.value.decode()


def _why(guest: subprocess.Popen[str], directory: Path) -> str:
    """What a guest that ended too early has to say; UserError where QEMU does."""
    document = results.received(machine.ended(guest, directory, timeout_s=1))
    return f"{directory.name}: {virtual.unpack(document, directory / 'flight') or 'ended before the others'}"
