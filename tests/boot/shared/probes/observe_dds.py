"""Runs on a robot, as root: DDS programs, seen on the wire and in the kernel."""

from __future__ import annotations

import os
import re
import select
import socket
import struct
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

FOUND_S = 600
"""For the two to find each other and send on a busy host."""


def fragment_sizes(payload: bytes) -> set[int]:
    """Of the RTPS submessages DATA_FRAG of a datagram."""
    found = set()
    position = 20  # behind the header of RTPS
    while position + 4 <= len(payload):
        kind, _, length = struct.unpack_from("<BBH", payload, position)
        if kind == 0x16:
            found.add(struct.unpack_from("<H", payload, position + 30)[0])
        position += 4 + length if length else len(payload)
    return found


def main(configuration: str, domain: int, processes: int, seconds: float) -> dict[str, Any]:
    """What a subscriber, and a publisher of 8000 bytes, do with a configuration: on the wire and in the kernel.

    For so many seconds: of both from the first fragment of a sample on. Ports are counted from the domain's own. What
    goes to other computers is seen before it needs them to answer.
    """
    first = 7400 + 250 * domain
    table = f"""table inet observed {{
        set sent {{ type ipv4_addr . inet_service; flags dynamic; size 1024; }}
        chain output {{
            type filter hook output priority -10;
            udp dport {first}-{first + 249} add @sent {{ ip daddr . udp dport }}
        }}
    }}"""
    found: dict[str, Any] = {}
    payloads = []
    fragments: set[int] = set()

    def shown(*argv: str) -> str:
        return subprocess.run(argv, capture_output=True, text=True, check=True).stdout

    with ExitStack() as cleanup:
        wire = cleanup.enter_context(socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0800)))
        wire.setsockopt(socket.SOL_SOCKET, 33, 4 << 20)  # SO_RCVBUFFORCE
        wire.bind(("lo", 0x0800))
        file = Path("/tmp/observed.xml")
        file.write_text(configuration)
        cleanup.callback(file.unlink)
        subprocess.run(["nft", "-f", "-"], input=table, text=True, check=True)
        cleanup.callback(shown, "nft", "delete", "table", "inet", "observed")
        running = []
        for role in [["sub"], ["pub", "20Hz", "size", "8000"]][:processes]:
            log = Path(f"/tmp/observed.{role[0]}")
            cleanup.callback(log.unlink)
            output = cleanup.enter_context(log.open("w"))
            environment = {**os.environ, "CYCLONEDDS_URI": f"file://{file}"}
            argv = ["ddsperf", "-i", str(domain), *role]
            process = subprocess.Popen(argv, env=environment, stdout=output, stderr=output)
            cleanup.callback(process.wait)
            cleanup.callback(process.kill)
            running.append((process, log))
        end = time.monotonic() + (FOUND_S if processes > 1 else seconds)
        while (left := end - time.monotonic()) > 0 and all(process.poll() is None for process, _ in running):
            if select.select([wire], [], [], min(left, 0.2))[0]:
                packet = wire.recv(65536)
                header = (packet[0] & 15) * 4
                if packet[9] == 17 and first <= struct.unpack_from("!H", packet, header + 2)[0] < first + 250:
                    payloads.append(payload := packet[header + 8 :])
                    if (sizes := fragment_sizes(payload)) and not fragments:
                        end = time.monotonic() + seconds
                    fragments |= sizes
        found["ended"] = [process.poll() for process, _ in running]
        tasks = [path for process, _ in running for path in Path(f"/proc/{process.pid}/task").glob("*/comm")]
        found["threads"] = sorted({path.read_text().strip() for path in tasks})
        after = {path: path.with_name("stat").read_text().rpartition(")")[2].split() for path in tasks}  # proc(5)
        found["real_time"] = {
            path.read_text().strip(): int(stat[37]) for path, stat in after.items() if stat[37] != "0"
        }
        there = [Path(f"/proc/{process.pid}/maps") for process, _ in running if process.poll() is None]
        maps = [line for path in there for line in path.read_text().splitlines()]
        spans = [line.split()[0].split("-") for line in maps if " rw-p 00000000 00:00 0" in line]
        found["stacks"] = sum(int(end, 16) - int(begin, 16) == 256 << 10 for begin, end in spans)
        groups = re.findall(r"^\t+([0-9A-F]{8}) ", Path("/proc/net/igmp").read_text(), re.M)
        found["groups"] = sorted({socket.inet_ntoa(struct.pack("=I", int(group, 16))) for group in groups})
        bound = re.findall(r":(\d+) +\S+ +users:\(\(\"ddsperf", shown("ss", "-Huanp"))
        found["bound"] = sorted(int(port) - first - 10 for port in bound)
        sent = re.findall(r"([\d.]+) \. (\d+)", shown("nft", "list set inet observed sent"))
        found["sent"] = sorted((peer, int(port) - first) for peer, port in sent)
        found["said"] = [log.read_text()[-1000:] for _, log in running]
    advertised = set()
    for payload in payloads:
        # A locator: kind 1 (UDP over IPv4), port, sixteen bytes of address.
        for locator in re.finditer(rb"\x01\0\0\0..\0\0\0{12}(.{4})", payload, re.S):
            advertised.add(socket.inet_ntoa(locator[1]))
    found["advertised"], found["fragments"] = sorted(advertised), sorted(fragments)
    found["largest"] = max(map(len, payloads), default=0)
    return found
