"""Runs in a guest: a computer that is in the cell but not of the fleet, and sends to the ports of its control tasks.

`python3 stranger.py SECONDS ADDRESS:PORT:LENGTH…`: to each, once in a control period, something of the right length or
not. It ends when the time is over.
"""

from __future__ import annotations

import itertools
import random
import socket
import sys
import time

PERIOD_S = 0.01


def payloads(length: int) -> list[bytes]:
    """What a receiver of `length` bytes may not take: noise of that length, shorter, longer, and nothing."""
    noise = random.Random(length).randbytes(2 * length)
    return [noise[:length], noise[: length - 1], noise[: length + 1], b"", noise]


def main(seconds: float, targets: list[str]) -> None:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receivers = []
    for target in targets:
        address, port, length = target.split(":")
        receivers.append(((address, int(port)), itertools.cycle(payloads(int(length)))))
    due = time.monotonic()
    for _ in range(round(seconds / PERIOD_S)):
        due += PERIOD_S
        for receiver, content in receivers:
            sender.sendto(next(content), receiver)
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2:])
