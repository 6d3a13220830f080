"""Runs on a robot, as root: a neighbour with the address of another computer of the fleet tells it the time."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import socket
import struct
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

KEYS = "/tmp/neighbour.keys"
CONFIGURATION = "/tmp/neighbour.conf"
PATIENCE_S = 600
"""For what takes a few seconds; finite, and generous to a busy host."""
ENOUGH = 3
"""Answers of a kind."""
CAME, TAKEN = 0, 1
"""Which of `heard`."""


def run(command: str) -> str:
    return subprocess.run(command.split(), check=True, stdout=subprocess.PIPE, text=True).stdout


def enter(network: int) -> None:
    """Make sockets there from now on."""
    assert ctypes.CDLL(None, use_errno=True).setns(network, 0) == 0


def heard(address: str) -> tuple[int, int]:
    """Answers that chronyd got from an address since it started, and how many of them it took."""
    text = run(f"chronyc -n ntpdata {address}")
    counts = dict(re.findall(r"^(Total RX|Total valid RX) +: (\d+)", text, re.MULTILINE))
    return int(counts["Total RX"]), int(counts["Total valid RX"])


def ask(address: str, what: int) -> tuple[int, int]:
    """Have chronyd ask until so many more answers came, or were taken; how many came, and were taken."""
    before = heard(address)
    end = time.monotonic() + PATIENCE_S
    while (now := heard(address))[what] < before[what] + ENOUGH:
        assert time.monotonic() < end, f"no answer of {address}"
        subprocess.run(["chronyc", "-n", "burst", "1/1", address], stdout=subprocess.DEVNULL)
        time.sleep(0.2)  # chronyd has no event for an answer
    return now[0] - before[0], now[1] - before[1]


def answer(server: socket.socket, proof: bytes) -> None:
    """An hour ahead, at the best stratum, to whoever asks, until it is killed."""
    while True:
        question, client = server.recvfrom(1000)
        now = time.time() + 2208988800 + 3600
        stamp = struct.pack(">II", int(now), int(now % 1 * 2**32))
        head = struct.pack(">BBbbII4s", 0b00100100, 1, question[2], -20, 0, 0, b"GPS\0")
        key = question[48:52]
        server.sendto(head + stamp + question[40:48] + stamp + stamp + (key + proof if proof else b""), client)


def liar(cleanup: ExitStack, address: str, proof: bytes) -> None:
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind((address, 123))
    child = os.fork()
    if not child:
        answer(server, proof)
    server.close()
    cleanup.callback(os.waitpid, child, 0)
    cleanup.callback(os.kill, child, signal.SIGKILL)


def main(address: str, robot: str, keys: str) -> dict[str, tuple[int, int]]:
    """Answers of `address`, and those that chronyd took: without a proof, with a wrong one, with the right key."""
    found = {}
    with ExitStack() as cleanup:
        run("ip netns add neighbour")
        cleanup.callback(run, "ip netns delete neighbour")
        run("ip link add clock0 type veth peer name clock1 netns neighbour")
        cleanup.callback(run, "ip link delete clock0")
        run("ip link set clock0 up")
        run(f"ip route add {address}/32 dev clock0 src {robot}")
        run(f"ip -netns neighbour address add {address}/32 dev clock1")
        run("ip -netns neighbour link set clock1 up")
        run(f"ip -netns neighbour route add {robot}/32 dev clock1")
        for name, proof in (("none", b""), ("wrong", bytes(16))):
            with ExitStack() as serving:
                home = serving.enter_context(Path("/proc/self/ns/net").open())
                away = serving.enter_context(Path("/run/netns/neighbour").open())
                enter(away.fileno())
                liar(serving, address, proof)
                enter(home.fileno())
                found[name] = ask(address, CAME)
        Path(KEYS).write_text(keys)
        Path(CONFIGURATION).write_text(
            f"keyfile {KEYS}\nlocal stratum 1\nallow\nbindcmdaddress /\ncmdport 0\npidfile /tmp/neighbour.pid\n"
        )
        server = subprocess.Popen(
            f"ip netns exec neighbour chronyd -x -n -u root -f {CONFIGURATION}".split(), stdout=subprocess.DEVNULL
        )
        cleanup.callback(server.wait)
        cleanup.callback(server.terminate)
        found["right"] = ask(address, TAKEN)
    return found
