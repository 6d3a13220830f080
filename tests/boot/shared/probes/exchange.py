"""Runs on a robot, as root: its serial ports, all at once."""

from __future__ import annotations

import os
import select
import time
import tty

PATIENCE_S = 600
"""For what takes well under one on an idle host."""


def main(lines: dict[str, str]) -> dict[str, str]:
    """Write a line to each port, then read one from each, all open at once."""
    ports = {name: os.open(f"/dev/{name}", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK) for name in lines}
    received = dict.fromkeys(lines, b"")
    for name, port in ports.items():
        tty.setraw(port)
        os.write(port, lines[name].encode())
    end = time.monotonic() + PATIENCE_S
    while (left := end - time.monotonic()) > 0 and not all(line.endswith(b"\n") for line in received.values()):
        readable, _, _ = select.select(list(ports.values()), [], [], left)
        for name, port in ports.items():
            if port in readable:
                received[name] += os.read(port, 100)
    for port in ports.values():
        os.close(port)
    return {name: line.decode() for name, line in received.items()}
