"""Runs on a robot, as root: what its firewall lets in."""

from __future__ import annotations

import ctypes
import select
import socket
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path


def main(inside: str, dds_port: int, rule: str) -> dict[str, list[str]]:
    """What gets in from an address of the fleet and from one outside, with `rule` added meanwhile."""

    def run(command: str) -> None:
        subprocess.run(command.split(), check=True, stdout=subprocess.DEVNULL)

    libc = ctypes.CDLL(None, use_errno=True)
    target, outside = "192.0.2.1", "192.0.2.2"
    passed: dict[str, list[str]] = {"inside": [], "outside": []}
    with ExitStack() as cleanup:
        run("ip netns add neighbour")
        cleanup.callback(run, "ip netns delete neighbour")
        run("ip link add probe0 type veth peer name probe1 netns neighbour")
        cleanup.callback(run, "ip link delete probe0")
        run(f"ip address add {target}/30 dev probe0")
        run("ip link set probe0 up")
        run(f"ip route add {inside}/32 dev probe0")
        for address in (f"{outside}/30", f"{inside}/32"):
            run(f"ip -netns neighbour address add {address} dev probe1")
        run("ip -netns neighbour link set probe1 up")
        if rule:
            cleanup.callback(run, "nft -f /etc/nftables.conf")
            run(f"nft {rule}")
        receivers = {}
        for port in (5000, dds_port, 2323):
            receiver = cleanup.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            receiver.bind((target, port))
            receivers[receiver] = port
        listener = cleanup.enter_context(socket.create_server((target, 2323)))
        listener.listen()
        home = cleanup.enter_context(Path("/proc/self/ns/net").open())
        away = cleanup.enter_context(Path("/run/netns/neighbour").open())
        calls = {}
        assert libc.setns(away.fileno(), 0) == 0
        for name, address in (("inside", inside), ("outside", outside)):
            for port in (22, 2323):
                caller = cleanup.enter_context(socket.socket())
                caller.setblocking(False)
                caller.bind((address, 0))
                caller.connect_ex((target, port))
                calls[caller] = (name, port)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.bind((address, 0))
                for port in receivers.values():
                    sender.sendto(name.encode(), (target, port))
        assert libc.setns(home.fileno(), 0) == 0
        for name, address in (("inside", inside), ("outside", outside)):
            ping = f"ip netns exec neighbour ping -q -c 1 -W 1 -I {address} {target}".split()
            if subprocess.run(ping, stdout=subprocess.DEVNULL).returncode == 0:
                passed[name].append("ping")
        end = time.monotonic() + 2  # what is dropped never answers
        while (left := end - time.monotonic()) > 0:
            readable, writable, _ = select.select(list(receivers), list(calls), [], left)
            for receiver in readable:
                passed[receiver.recv(100).decode()].append(f"udp {receivers[receiver]}")
            for caller in writable:
                name, port = calls.pop(caller)
                if caller.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0:
                    passed[name].append(f"tcp {port}")
    return passed
