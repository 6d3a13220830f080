"""One radio cell without a radio: nodes in network namespaces of their own, whose frames reach all others or are lost.

Each node's interface is a TAP device that this process serves: every frame goes to every other node, and each of them
loses it or not by a sequence of its own, from a seed. A frame never waits: what a node's queue cannot hold, the test
sees in `overrun`.
"""

from __future__ import annotations

import os
import random
import selectors
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from flotilla.common import paths

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

    def run(self, *argv: str | Path, cwd: Path) -> subprocess.Popen[str]:
        """Start a program on that computer; its process is the program's own."""
        enter = ["nsenter", f"--target={self._holder.pid}", "--user", "--net", "--preserve-credentials", "--"]
        return subprocess.Popen(
            [*enter, *map(str, argv)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd,
            env=os.environ | {"PYTHONPATH": str(paths.PROJECT)},
        )  # fmt: skip

    def close(self) -> None:
        self._control.close()
        self._holder.communicate()
        os.close(self.tap)


class Radio:
    """The cell: the nodes, and the thread that carries frames between them."""

    def __init__(self, addresses: Sequence[str], *, loss: float, seed: int) -> None:
        self.nodes = {address: Node(address) for address in addresses}
        self._loss = loss
        self._chance = {
            (sender, receiver): random.Random(f"{seed} {sender} {receiver}")
            for sender in addresses
            for receiver in addresses
        }
        self.sent: dict[str, list[int]] = {address: [] for address in addresses}
        """Sizes of the frames that each node sent, in bytes from the Ethernet header on."""
        self.lost = self.carried = self.overrun = 0
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
        for node in self.nodes.values():
            node.close()

    def wait_for_frames(self, sender: str, count: int) -> None:
        """Wait until a node sent so many frames."""
        with self.on_frame:
            self.on_frame.wait_for(lambda: len(self.sent[sender]) >= count)

    def _carry(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._ends, selectors.EVENT_READ)
            for address, node in self.nodes.items():
                selector.register(node.tap, selectors.EVENT_READ, address)
            while True:
                for key, _ in selector.select():
                    if key.fd == self._ends:
                        return
                    self._pass_on(key.data, os.read(key.fd, 4096))

    def _pass_on(self, sender: str, frame: bytes) -> None:
        for receiver, node in self.nodes.items():
            if receiver == sender:
                continue
            self.carried += 1
            if self._chance[sender, receiver].random() < self._loss:
                self.lost += 1
                continue
            try:
                os.write(node.tap, frame)
            except OSError:
                self.overrun += 1
        with self.on_frame:
            self.sent[sender].append(len(frame))
            self.on_frame.notify_all()
