"""Runs in a guest, in the station's namespace: sends what virtual.py made, at a rate, and prints the answers as JSON.

`sender.py TAPE ADDRESS BIT_S`. A tape has for each datagram its length (unsigned, 16 bit, big-endian) and its bytes. A
length with the highest bit set is of one that is lost on its way: its time passes. After a question the answer is
awaited.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time
from pathlib import Path

GROUP, PORT = "239.255.42.42", 4242
HEADERS = 42
TAG = 8
LOST = 0x8000
QUESTION = 0xFFFF
ANSWER_S = 10.0


def main(tape: bytes, address: str, bit_s: int) -> list[str]:
    """What was answered, in hexadecimal digits; nothing where no answer came."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.bind((address, 0))
    out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
    out.settimeout(ANSWER_S)
    answers = []
    at, free_at = 0, time.monotonic()
    while at < len(tape):
        (head,) = struct.unpack_from("!H", tape, at)
        length = head & ~LOST
        datagram = tape[at + 2 : at + 2 + length]
        at += 2 + length
        time.sleep(max(0.0, free_at - time.monotonic()))
        if not head & LOST:
            out.sendto(datagram, (GROUP, PORT))
        free_at = time.monotonic() + 8 * (HEADERS + length) / bit_s
        if struct.unpack_from("!H", datagram, TAG)[0] == QUESTION:
            try:
                answers.append(out.recv(2048).hex())
            except TimeoutError:
                answers.append("")
    return answers


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]).read_bytes(), sys.argv[2], int(sys.argv[3]))))
