"""Runs in a guest: a computer that is in the cell but not of the fleet, and attacks its control tasks.

`python3 stranger.py SECONDS ADDRESS:PORT:LENGTH…` sends to each, once in a control period, from its own address,
something of the right length or not. It also listens to all frames of the cell. What a control task got it sends once
more, as recorded, altered, and as noise, with the address of the robot that sent it, to one task after the other; and
back to that robot, as if from the one that got it. It ends when the time is over.
"""

from __future__ import annotations

import itertools
import random
import socket
import subprocess
import sys
import time

PERIOD_S = 0.01
MONITOR = "mon0"
_ETH_P_ALL = 3
_LISTENS = 25
"""Once in so many periods."""
_AT_ONCE = 30
"""Frames; all would take the whole processor, which is all computers'."""
_IPV4_IN_802_11 = bytes.fromhex("aaaa030000000800")
"""LLC and SNAP headers of an IPv4 packet (RFC 1042)."""
_IP_HEADER, _UDP_HEADER = 20, 8
_CHECKSUM = _IP_HEADER + 6

Receiver = tuple[str, int]


def payloads(length: int) -> list[bytes]:
    """What a receiver of `length` bytes may not take: noise of that length, shorter, longer, and nothing."""
    noise = random.Random(length).randbytes(2 * length)
    return [noise[:length], noise[: length - 1], noise[: length + 1], b"", noise]


def packet_of(frame: bytes) -> bytes | None:
    """The UDP packet of IPv4 in a frame with whatever header; None: it has none."""
    _, found, packet = frame.partition(_IPV4_IN_802_11)
    if not found or len(packet) < _IP_HEADER + _UDP_HEADER or packet[0] != 0x45 or packet[9] != socket.IPPROTO_UDP:
        return None
    return packet[: int.from_bytes(packet[2:4], "big")]


def receiver_of(packet: bytes) -> Receiver:
    return socket.inet_ntoa(packet[16:20]), int.from_bytes(packet[22:24], "big")


def reflected(packet: bytes) -> bytes:
    """To who sent it, from who got it; checksums stay right."""
    source, target = packet[12:16], packet[16:20]
    return packet[:12] + target + source + packet[22:24] + packet[20:22] + packet[24:]


def forgeries(packet: bytes) -> tuple[bytes, ...]:
    """What somebody makes of a recorded message who has no key: the same, altered by a bit, noise, reflected."""
    payload = _IP_HEADER + _UDP_HEADER
    altered = bytearray(packet)
    altered[payload] ^= 1
    altered[_CHECKSUM : _CHECKSUM + 2] = bytes(2)  # there is none, which IPv4 allows
    noise = bytearray(altered)
    noise[payload:] = random.Random(len(packet)).randbytes(len(packet) - payload)
    return packet, bytes(altered), bytes(noise), reflected(packet)


def own_address(towards: Receiver) -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(towards)
        return str(probe.getsockname()[0])


class Listener:
    """Makes forgeries of what each receiver gets, of the frames that anybody sends, anew now and then."""

    def __init__(self, address: str) -> None:
        self._address = socket.inet_aton(address)
        for argv in (
            ["iw", "dev", "wlan0", "interface", "add", MONITOR, "type", "monitor"],
            ["ip", "link", "set", MONITOR, "up"],
        ):
            subprocess.run(argv, check=True)
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL))
        self._socket.bind((MONITOR, 0))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _AT_ONCE * 4096)
        self._socket.setblocking(False)
        self.made: dict[Receiver, tuple[bytes, ...]] = {}
        self._own: set[bytes] = set()

    def listen(self) -> None:
        """What has come since. Its own messages are not worth recording."""
        for _ in range(_AT_ONCE):
            try:
                frame = self._socket.recv(4096)
            except BlockingIOError:
                return
            packet = packet_of(frame)
            if packet and packet[12:16] != self._address and self._message(packet) not in self._own:
                self.made[receiver_of(packet)] = forgeries(packet)
                self._own |= {self._message(each) for each in forgeries(packet)}

    @staticmethod
    def _message(packet: bytes) -> bytes:
        """Without what the network changes."""
        return packet[_IP_HEADER:_CHECKSUM] + packet[_CHECKSUM + 2 :]


def main(seconds: float, targets: list[str]) -> None:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    forger = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
    receivers = []
    for target in targets:
        address, port, length = target.split(":")
        receivers.append(((address, int(port)), itertools.cycle(payloads(int(length)))))
    listener = Listener(own_address(receivers[0][0]))
    due = time.monotonic()
    end = due + seconds
    for period in itertools.count():
        due = max(due + PERIOD_S, time.monotonic())
        if due > end:
            break
        if period % _LISTENS == 0:
            listener.listen()
        for receiver, content in receivers:
            sender.sendto(next(content), receiver)
        receiver, _ = receivers[period % len(receivers)]
        for packet in listener.made.get(receiver, ()):
            forger.sendto(packet, (receiver_of(packet)[0], 0))
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2:])
