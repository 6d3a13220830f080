"""A release comes to a robot whose control runs, in virtual time: one guest that boots the shipped system from memory.

All that takes a robot's processor is the image's: kernel, network, `flotilla-receive` and its service, `update.py`,
`ssh-keygen`, `flotilla-patch`, `flotilla-slot`, `flotilla-run`. Slots hold a few MB instead of 70, and the card is in
memory. A run repeats to the byte.
"""

from __future__ import annotations

import hashlib
import json
import random
import struct
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from flotilla.fleet import release_keys
from flotilla.fleet.model import Board, Releases
from flotilla.images import card, environment_block
from flotilla.lab.latency import computable_keys, machine, results, subject
from flotilla.lab.latency.virtual_loop import CHAIN, PLUGIN
from flotilla.robot import release
from flotilla.updates import bundle, delta, multicast

HERE = Path(__file__).parent
OVERRUN = HERE / "overrun.c"
DIRECTORY = subject.DIRECTORY
OVERRUN_THERE = f"{DIRECTORY}/library/overrun.so"
"""Not beside the plug-ins."""
ROBOT, STATION, PREFIX = "10.43.0.1", "10.43.0.100", 24
"""A network of its own: the wire of the guest leads nowhere."""
SEED = 1
BASE_BYTES = 3 << 20
NEW_BYTES = 256 << 10
"""What a delta has to bring; as much of it as of a release of a few MB."""
NEW_AT = 1 << 20
"""All behind it has moved."""
LOSS = 0.1
MORE_REPAIRS = 12
"""Than symbols are lost: that many make all but one in thousands of blocks whole."""
ALONE_S = 1.0
"""Of the task, before the update begins."""
WITHOUT_S = 5.0
"""Of the task without an update."""
DATA_MIB = 96
MEMORY_MIB = 512
"""Of the guest, which has its card in memory."""
ALONE, BAD = "alone", "bad"
"""The task without an update; the heartbeat with the library by which tasks of a bad release overrun."""
KEY = bytes(range(multicast.KEY_BYTES))
"""Of the transfer: what is measured repeats."""
SHIPPED, RECEIVER, UPDATER = "shipped", "receiver", "updater"
ABOVE = 90
"""A real-time priority; the task has 80."""
COURSES: Mapping[str, Mapping[str, int]] = {
    SHIPPED: {"receiver": 0, "updater": 0},
    RECEIVER: {"receiver": ABOVE, "updater": 0},
    UPDATER: {"receiver": 0, "updater": ABOVE},
}
"""Real-time priorities of receiver and updater; 0: as they are shipped."""
_HOST_S = 1200
"""Finite, and generous to a busy host."""


@dataclass(frozen=True)
class Update:
    """What is brought, and how."""

    files: dict[str, bytes]
    """Of the guest, by path."""
    session: dict[str, Any]
    delta: bytes
    content: bytes
    lost: int
    """Symbols of the delta that do not arrive."""


def update(board: Board, directory: Path) -> Update:
    """Two releases, the delta between them, and the datagrams that bring it. `directory`: of what is made meanwhile."""
    releases = Releases(keys=[signer(directory)])
    trusted = release_keys.document(releases)
    old = random.Random(SEED).randbytes(BASE_BYTES)
    new = old[:NEW_AT] + random.Random(SEED + 1).randbytes(NEW_BYTES) + old[NEW_AT:]
    headers = {}
    for number, content in ((1, old + trusted), (2, new + trusted)):
        place = directory / str(number)
        place.mkdir()
        (place / "slot.img").write_bytes(content)
        headers[number] = header(board, number, content, len(trusted))
        (place / "header.json").write_text(json.dumps(headers[number]))
    made = directory / "delta"
    delta.make(directory / "1/slot.img", directory / "2/slot.img", made)
    manifest = bundle.manifest_of(directory / "2", {}).decode()
    sent = made.read_bytes()
    symbols, lost = tape(sent)
    a = card.SLOTS[0]
    pieces = {
        0: partition_table(), card.STATE.start: card.tries_block(),
        **{card.STATE.start + copy: card.state_copy() for copy in card.COPIES},
        a.start: (directory / "1/slot.img").read_bytes(),
        a.end - card.HEADER_ROOM: environment_block.make(headers[1], card.HEADER_BYTES),
    }  # fmt: skip
    files = {f"{DIRECTORY}/card/{at}": piece for at, piece in pieces.items()}
    own = {
        "offer": release.Bundle(made, manifest, (signature(directory, manifest),), 0).offer(),
        "description": multicast.order(KEY, multicast.describe(sent)).encode(),
        "tape": symbols,
        "sender": (HERE / "sender.py").read_bytes(),
    }
    files |= {f"{DIRECTORY}/{name}": content for name, content in own.items()}
    content = (directory / "2/slot.img").read_bytes()
    session = {
        "card": [[at, f"{DIRECTORY}/card/{at}"] for at in pieces], "card_bytes": card.SIZE,
        "running": [a.start, a.size], "written": [card.SLOTS[1].start, len(content)],
        **{name: f"{DIRECTORY}/{name}" for name in own},
    }  # fmt: skip
    return Update(files, session, sent, content, lost)


def signer(directory: Path) -> str:
    """A key that everybody can compute signs; its public half. Its private half is the file `key`."""
    private, public = computable_keys.ssh_key("release")
    (directory / "key").write_text(private)
    (directory / "key").chmod(0o600)
    return public.strip()


def signature(directory: Path, text: str) -> str:
    argv = ["ssh-keygen", "-q", "-Y", "sign", "-n", release_keys.NAMESPACE, "-f", str(directory / "key")]
    return subprocess.run(argv, input=text, capture_output=True, text=True, check=True).stdout


def header(board: Board, number: int, content: bytes, keys_bytes: int) -> dict[str, str]:
    """Of a slot that holds this; the keys come last. Nobody starts it."""
    keys = f"{(len(content) - keys_bytes) // card.SECTOR}+{keys_bytes // card.SECTOR}"
    return {
        "RELEASE": str(number), "FLOOR": "1", "BOARD": board.name, "LAYOUT": str(card.LAYOUT.layout),
        "VERSION": "none", "BYTES": str(len(content)), "BLOB": hashlib.sha256(content).hexdigest(), "KERNEL": "0+8",
        "INITRD": "", "KEYS": keys, "ARGUMENTS": "quiet",
    }  # fmt: skip


def partition_table() -> bytes:
    """The card's MBR, without boot code: by it the updater finds the slots."""
    entries = b"".join(
        bytes(8) + struct.pack("<II", each.start // card.SECTOR, each.size // card.SECTOR)
        for each in (card.STATE, *card.SLOTS, card.DATA)
    )
    return bytes(446) + entries + b"\x55\xaa"


def tape(content: bytes) -> tuple[bytes, int]:
    """The datagrams of a transfer as sender.py reads them, and how many symbols of the content are lost.

    As the sender of `multicast.py` does: a question, all symbols, a question, repair symbols, a question, the end. A
    tenth of the symbols is lost, of the repair symbols too.
    """
    if len(content) > multicast.BLOCK * multicast.SYMBOL:
        raise UserError(f"a delta of {len(content)} bytes: more than a block, which is what a tape has")
    transfer = multicast.Transfer(multicast.transfer_number(content), KEY)
    block = multicast.Block(content)
    chance = random.Random(SEED)
    out, lost = [], 0

    def send(datagram: bytes, *, arrives: bool = True) -> None:
        out.append(struct.pack("!H", len(datagram) | (0 if arrives else 0x8000)) + datagram)

    send(transfer.question(1, [ROBOT]))
    for number in range(-(-len(content) // multicast.SYMBOL)):
        arrives = chance.random() >= LOSS
        lost += not arrives
        send(transfer.symbol(0, number, block), arrives=arrives)
    send(transfer.question(2, [ROBOT]))
    left, number = lost + MORE_REPAIRS, multicast.BLOCK
    while left:
        arrives = chance.random() >= LOSS
        left -= arrives
        send(transfer.symbol(0, number, block), arrives=arrives)
        number += 1
    send(transfer.question(3, [ROBOT]))
    send(transfer.end())
    return b"".join(out), lost


@dataclass(frozen=True)
class Staged:
    """What came of all courses."""

    update: Update
    said: dict[str, dict[str, Any]]
    """By course."""


def stage(board: Board, kbit_s: int, out: Path) -> Staged:
    """Have the release come, once for each course."""
    if not (port := subject.tested_ports(board).get("uart_own")):
        raise UserError(
            f"group_vars/board_{board.name}.yml: board.ports: the loop needs ttyS1 beside a console; add it"
        )
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out) as directory:
        brought = update(board, Path(directory))
    session = brought.session | {
        "robot": ROBOT, "station": STATION, "prefix": PREFIX, "bit_s": 1000 * kbit_s, "data_mib": DATA_MIB,
        "blocks": str(DIRECTORY), "task": f"{DIRECTORY}/task.yml", "alone_s": ALONE_S, "without_s": WITHOUT_S,
        "courses": COURSES, "heartbeat": f"{DIRECTORY}/heartbeat.yml", "overrun": OVERRUN_THERE,
    }  # fmt: skip
    files = brought.files | {
        f"{DIRECTORY}/task.yml": CHAIN.format(device=f"/dev/{board.ports[port].tty}").encode(),
        f"{DIRECTORY}/loopback.so": runtime.compile_plugin(PLUGIN, board.system),
        f"{DIRECTORY}/heartbeat.yml": (paths.TASKS / "heartbeat.yml").read_bytes(),
        OVERRUN_THERE: runtime.compile_plugin(OVERRUN, board.system),
        f"{DIRECTORY}/guest.py": (HERE / "guest.py").read_bytes(),
        f"{DIRECTORY}/session.json": json.dumps(session).encode(),
    }
    measured = subject.build(board)
    initrd = out / "initrd.img"
    commands = {"session": ["python3", f"{DIRECTORY}/guest.py", f"{DIRECTORY}/session.json"]}
    subject.write_initrd(measured, initrd, {"scenarios": [], "commands": commands}, files)
    board = board.model_copy(update={"qemu": board.qemu.model_copy(update={"memory_mib": MEMORY_MIB})})
    extra = machine.RELAYS
    guest = machine.Machine(machine.emulator(), board, measured.kernel, initrd, measured.arguments(), extra=extra)
    with progress.step("an update while control runs"):
        document = results.received(guest.run(out, _HOST_S))
    initrd.unlink()
    said = json.loads(document["commands"]["session"])
    if "error" in said:
        raise UserError(f"the update failed in the guest:\n{said['error'].strip()}")
    (out / "said.json").write_text(json.dumps(said, indent=1, sort_keys=True) + "\n")
    return Staged(brought, said)
