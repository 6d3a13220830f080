"""A flood from the cable against two robots that exchange messages, in virtual time.

As for `message_cost`, two computers are namespaces of one guest. The receiver has an Ethernet adapter, too, from which
datagrams come as from the sender: right in address, port and length, wrong in their proof; or from many addresses of
the fleet's network, one after the other. They come from outside the guest (flotilla/lab/air/wire.c), so that the rate
does not depend on what the guest does.
"""

from __future__ import annotations

import json
import random
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flotilla.debian.lock import HOST
from flotilla.fleet.model import Board
from flotilla.lab import air
from flotilla.lab.scenarios import message_cost, virtual
from flotilla.lab.scenarios.virtual import DIRECTORY

_ADAPTER = "52:54:00:f1:00:02"
_FRAMES = 64
_MANY = 200
_PROOF_BYTES = 40
_ALONE = """
period: 10 ms
priority: 80
overruns: 0
blocks:
  clock: {type: clock}
  filtered: {type: low-pass, in: {in: clock.time}, parameters: {time_constant: 1}}
"""
"""A task that no message comes to."""


@dataclass(frozen=True)
class Flooded:
    """What came of so many seconds of it."""

    frames: int
    """That the adapter took."""
    messages: int
    """Of the sender, that the receiver took."""
    sent: int
    """Messages of the sender."""
    forged: int
    """Datagrams that the receiver refused for their proof."""
    refused: int
    """Datagrams that it refused for their address."""
    dropped: int
    """Datagrams that its queue had no room for."""
    firewalled: int
    """Datagrams that its firewall dropped as too many."""
    overruns: dict[str, int]
    """By task."""
    longest_ns: dict[str, int]
    """Step, by task."""


def frames(sources: Sequence[str], target: str, port: int, bytes_: int) -> bytes:
    """Forged datagrams as flotilla/lab/air/wire.c reads them, from each source in turn."""
    made = b""
    for number, source in enumerate(sources):
        payload = random.Random(number).randbytes(bytes_)
        datagram = struct.pack("!HHHH", port, port, 8 + len(payload), 0) + payload
        header = struct.pack(
            "!BBHHHBBH4s4s", 0x45, 0, 20 + len(datagram), number, 0, 64, socket.IPPROTO_UDP, 0,
            socket.inet_aton(source), socket.inet_aton(target),
        )  # fmt: skip
        words = sum(struct.unpack("!10H", header))
        checksum = ~((words & 0xFFFF) + (words >> 16)) & 0xFFFF
        packet = header[:10] + struct.pack("!H", checksum) + header[12:] + datagram
        frame = bytes.fromhex(_ADAPTER.replace(":", "")) + bytes.fromhex("020000000003") + b"\x08\x00" + packet
        made += struct.pack("<H", len(frame)) + frame
    return made


def measure(board: Board, out: Path, rate_hz: int, *, many: bool = False) -> dict[str, Flooded]:
    """Before the flood and during it: `quiet` and `flooded`. `many`: it forges many addresses, none of a sender."""
    out.mkdir(parents=True, exist_ok=True)
    described = virtual.fleet("udp", board=board)
    sender, receiver = described.robot_with("control"), described.robot_with("thruster-mapping")
    exchange, there = message_cost.exchange("flood", message_cost.VARIANTS["udp-keys"], board, out / "keys")
    there |= virtual.session(described, [sender, receiver], [], out / "keys", {}, [])
    there[f"{DIRECTORY}/nftables.conf"] = virtual.rendered(described, out / "keys")[receiver.name]["/etc/nftables.conf"]
    alone = exchange["tasks"][1] | {"name": "alone"}
    exchange["tasks"].append(alone | {"directory": f"{alone['directory']}-alone"})
    there[f"{alone['directory']}-alone/alone.yml"] = _ALONE.encode()
    there[f"{DIRECTORY}/flood.json"] = json.dumps(exchange | {"adapter": _ADAPTER}).encode()
    block = message_cost.received(described, out / "keys")
    sources = [*map(str, described.network.subnet.hosts())][-_MANY:] if many else [str(sender.address)] * _FRAMES
    (out / "frames").write_bytes(
        frames(sources, str(receiver.address), int(block["port"]), int(block["length"]) + _PROOF_BYTES)
    )
    (out / "wire.so").write_bytes(air.compiled(air.WIRE, HOST))
    file, plugin = (str(out / name).replace(",", ",,") for name in ("frames", "wire.so"))
    extra = (
        "-netdev", "hubport,id=wire,hubid=0", "-device", f"{board.qemu.network},netdev=wire,mac={_ADAPTER},romfile=",
        "-plugin", f"{plugin},netdev=wire,frames={file},interval_ns={1_000_000_000 // rate_hz}",
    )  # fmt: skip
    said = message_cost.run(board, there, out, "flooded", extra)
    return {name: Flooded(**found) for name, found in said.items()}
