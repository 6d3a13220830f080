"""One radio cell without a radio: its members' frames reach all others or are lost.

A member is a node, a network namespace whose interface is a TAP device that this process serves, or a guest in QEMU on
a cable (`qemu.Wire`). A frame goes to each member that it is for, and each of them loses it or not by a sequence of its
own, from a seed. TCP loses nothing: 802.11 repeats a frame to one station until that acknowledges it, and no frame to
all. Other frames to one station are lost here all the same, which is harder on who sends them.

A frame never waits: what a node's queue cannot hold, the test sees in `overrun`.
"""

from __future__ import annotations

import os
import random
import selectors
import socket
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from flotilla.common import paths
from flotilla.lab.qemu.qemu import Wire

_TCP, _UDP = 6, 17
_GROUPS = b"\x01\x00\x5e"
"""What hardware addresses of IPv4's groups begin with."""

_NODE = """
import array, fcntl, os, socket, struct, subprocess, sys
address, sink = sys.argv[1], socket.socket(fileno=int(sys.argv[2]))
tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
fcntl.ioctl(tap, 0x400454CA, struct.pack("16sH22x", b"radio0", 0x1002))  # TUNSETIFF: IFF_TAP | IFF_NO_PI
for words in (f"address add {address}/24 dev radio0", "link set lo up", "link set radio0 txqueuelen 20000 up",
              "route add 224.0.0.0/4 dev radio0"):
    subprocess.run(["ip", *words.split()], check=True)
socket.send_fds(sink, [b"x"], [tap])
sink.recv(1)
"""


def _udp_ports(frame: bytes) -> tuple[int, int]:
    """From and to; 0 and 0 in other frames. IPv4 without options, and never in fragments."""
    if frame[12:14] != b"\x08\x00" or frame[23] != _UDP:
        return 0, 0
    return int.from_bytes(frame[34:36]), int.from_bytes(frame[36:38])


class Node:
    """A computer in the cell."""

    def __init__(self, address: str) -> None:
        self.address = address
        ours, theirs = socket.socketpair()
        self._control = ours
        argv = ["unshare", "--user", "--map-root-user", "--net", "--", sys.executable, "-c", _NODE]
        self._holder = subprocess.Popen(
            [*argv, address, str(theirs.fileno())], pass_fds=[theirs.fileno()], stderr=subprocess.PIPE, text=True
        )
        theirs.close()
        said, descriptors, _, _ = socket.recv_fds(ours, 1, 1)
        if not said:
            raise RuntimeError(f"{address}: no network namespace: {self._holder.communicate()[1]}")
        self.tap = descriptors[0]

    @property
    def prefix(self) -> list[str]:
        """Of a command that is to run on that computer; its process is the command's own."""
        return ["nsenter", f"--target={self._holder.pid}", "--user", "--net", "--preserve-credentials", "--"]

    def run(self, *argv: str | Path, cwd: Path, more: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
        """Start a program on that computer; `more`: further variables of its environment."""
        return subprocess.Popen(
            [*self.prefix, *map(str, argv)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd,
            env={**os.environ, "PYTHONPATH": str(paths.IMPORTS), **(more or {})}, stdin=subprocess.DEVNULL,
        )  # fmt: skip

    def close(self) -> None:
        self._control.close()
        self._holder.communicate()
        os.close(self.tap)


class _Cable:
    """Our end of a guest's cable: frames as datagrams."""

    def __init__(self, guest: Wire) -> None:
        end = guest.other_end
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.socket.bind(("127.0.0.1", end.here))
        self.socket.connect(("127.0.0.1", end.there))
        self.socket.setblocking(False)  # what was there to read may have been an error that a write has taken


class Radio:
    """The cell: its members, and the thread that carries frames between them."""

    def __init__(
        self, addresses: Sequence[str], *, loss: float, seed: int, guests: Mapping[str, Wire] | None = None
    ) -> None:
        """`addresses`: of nodes. `guests`: by address, the robot's end of its cable; guests may come and go."""
        self.nodes = {address: Node(address) for address in addresses}
        self._cables = {address: _Cable(wire) for address, wire in (guests or {}).items()}
        self._ends_of = {address: node.tap for address, node in self.nodes.items()}
        self._ends_of |= {address: cable.socket.fileno() for address, cable in self._cables.items()}
        addresses = list(self._ends_of)
        self._places: dict[bytes, str] = {}
        """Members by their hardware address, as far as they have sent something."""
        self._loss = loss
        self._chance = {
            (sender, receiver): random.Random(f"{seed} {sender} {receiver}")
            for sender in addresses
            for receiver in addresses
        }
        self.sent: dict[str, list[int]] = {address: [] for address in addresses}
        """Sizes of the frames that each node sent, in bytes from the Ethernet header on."""
        self.deaf: set[str] = set()
        """Members that no multicast over IPv4 reaches; all else does."""
        self.lost = self.carried = self.overrun = 0
        self._lossy_bytes: Counter[tuple[int, int]] = Counter()
        """Of frames that may be lost, from the Ethernet header on, by UDP ports; 0 and 0 is all else."""
        self.on_frame = threading.Condition()
        """Notified after each frame."""
        self._ends, self._end = os.pipe()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def __enter__(self) -> Radio:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._end)
        self._thread.join()
        os.close(self._ends)
        for cable in self._cables.values():
            cable.socket.close()
        for node in self.nodes.values():
            node.close()

    def lossy_bytes(self, port: int) -> int:
        """Bytes of all frames from or to a UDP port, from the Ethernet header on."""
        return sum(count for ports, count in self._lossy_bytes.items() if port in ports)

    def wait_for_frames(self, sender: str, count: int) -> None:
        """Wait until a node sent so many frames."""
        with self.on_frame:
            self.on_frame.wait_for(lambda: len(self.sent[sender]) >= count)

    def _carry(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._ends, selectors.EVENT_READ)
            for address, end in self._ends_of.items():
                selector.register(end, selectors.EVENT_READ, address)
            while True:
                for key, _ in selector.select():
                    if key.fd == self._ends:
                        return
                    try:
                        frame = os.read(key.fd, 4096)
                    except (ConnectionRefusedError, BlockingIOError):  # of a guest that is off
                        continue
                    self._pass_on(key.data, frame)

    def _pass_on(self, sender: str, frame: bytes) -> None:
        self._places[frame[6:12]] = sender
        place = self._places.get(frame[:6])
        receivers: Collection[str] = self._ends_of if place is None else (place,)
        to_a_group = frame[:3] == _GROUPS
        repeated = frame[12:14] == b"\x08\x00" and frame[23] == _TCP
        if not repeated:
            self._lossy_bytes[_udp_ports(frame)] += len(frame)
        for receiver in receivers:
            if receiver == sender:
                continue
            self.carried += 1
            lost = not repeated and self._chance[sender, receiver].random() < self._loss
            if lost or (to_a_group and receiver in self.deaf):
                self.lost += 1
                continue
            try:
                os.write(self._ends_of[receiver], frame)
            except ConnectionRefusedError:
                continue
            except OSError:
                self.overrun += 1
        with self.on_frame:
            self.sent[sender].append(len(frame))
            self.on_frame.notify_all()
