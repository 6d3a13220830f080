"""One file to all robots at once, by multicast with forward error correction; `flotilla-receive` is the other end.

A file is cut into blocks of 1 MiB, a block into symbols of 512 bytes, so that a frame leaves control its air time. Each
block's symbols go out once, and with them as many repair symbols as robots lost of the blocks before. Then the sender
asks what is still missing. A repair symbol is the sum modulo 2 of about half of a block's symbols, chosen at random by
its number: it replaces whichever symbol a robot lost, so all robots are served by the same few.

Neither end needs what an earlier call knew: robots say what they lack, so a sender that starts again continues.

A transfer has a key of its own, which comes to robots by SSH. A datagram begins with a tag, the first 8 bytes of
HMAC-SHA-256 by that key over the transfer's number (32 bit) and all that follows the tag; that of an answer is of the
robot's address, too. Then come, all numbers big-endian:

| 4 bytes: block, symbol (16 bit each) | then |
|---|---|
| a block's number, a symbol's number | 512 bytes; from 2048 on it is a repair symbol |
| 0xffff, number of the question | addresses of the robots that shall answer, in this order, 20 ms apart |
| 0xfffe, number of the question | an answer: symbols received (32 bit), blocks that follow, and for each its number and how many symbols it needs |
| 0xfffd, 0 | the end |
"""  # noqa: E501 - a table's row

from __future__ import annotations

import argparse
import hmac
import json
import math
import random
import selectors
import socket
import statistics
import struct
import sys
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from ipaddress import IPv4Address
from pathlib import Path

from flotilla.common.errors import UserError

GROUP = IPv4Address("239.255.42.42")
PORT = 4242
"""UDP port of the robots; their firewall admits stations to it."""
SYMBOL = 512
"""Bytes."""
BLOCK = 2048
"""Symbols."""
RATE = 300_000
"""Bits a second, headers included: 30 % of the lowest rate of 802.11b, at which multicast goes."""
HEADERS = 14 + 20 + 8
"""Bytes of Ethernet, IPv4 and UDP."""

TAG = 8
"""Bytes."""
KEY_BYTES = 32

_HEADER = struct.Struct("!HH")
OVERHEAD = TAG + _HEADER.size
"""Bytes of a datagram before a symbol."""
_ANSWER = struct.Struct("!LH")
_NEED = struct.Struct("!HH")
_QUESTION, _ANSWERED, _END = 0xFFFF, 0xFFFE, 0xFFFD
_MOST_NEEDS = 120
"""In one answer."""
_SLOT_S = 0.02
"""Between the answers of two robots."""
_PATIENCE_S = 0.3
"""After the last robot's slot."""
_SILENT = 20
"""Questions in a row without an answer: nobody waits for that robot any more."""
_MOST_LOSS = 0.5
"""More loss than that is not made up for in advance."""
_FACTOR = 4.0
"""Symbols sent, as a multiple of the file's: after that the file is not sent any further."""
_TOLD_S = 1.0
"""Between two reports to whoever watches."""
_BLOCKS_HELD = 4
"""Blocks whose symbols stay in memory."""
_WORDS = BLOCK // 64
_MASK = (1 << 64) - 1


def describe(content: bytes) -> str:
    """What `flotilla-receive` must know of a file before it comes: the transfer's number, size and checksums."""
    sums = [zlib.crc32(content[at : at + BLOCK * SYMBOL]) for at in range(0, len(content), BLOCK * SYMBOL)]
    return "\n".join(
        [
            f"transfer {transfer_number(content):08x}",
            f"size {len(content)}",
            *(f"block {each:08x}" for each in sums),
            "",
        ]
    )


def order(key: bytes, description: str) -> str:
    """Input of `receive begin` on a robot."""
    return f"key {key.hex()}\n{description}"


def transfer_number(content: bytes) -> int:
    """It is part of the authenticated bytes."""
    return zlib.crc32(content)


def _random_word(counter: int) -> int:
    """SplitMix64, as in `runtime/programs/repair.c`."""
    word = (counter + 1) * 0x9E3779B97F4A7C15 & _MASK
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & _MASK
    word = (word ^ word >> 27) * 0x94D049BB133111EB & _MASK
    return word ^ word >> 31


@lru_cache(maxsize=1024)
def _row(number: int) -> tuple[int, ...]:
    """The symbols of a block that repair symbol `number` is the sum of."""
    words = (_random_word(number * _WORDS + word) for word in range(_WORDS))
    return tuple(64 * at + bit for at, word in enumerate(words) for bit in range(64) if word >> bit & 1)


class Block:
    """The symbols of a block, and the repair symbols that are made of them."""

    def __init__(self, content: bytes) -> None:
        self._symbols = [
            int.from_bytes(content[at : at + SYMBOL].ljust(SYMBOL, b"\0"), "little")
            for at in range(0, len(content), SYMBOL)
        ]

    def symbol(self, number: int) -> bytes:
        """The bytes of a symbol: one of the block's own, or from `BLOCK` on a repair symbol."""
        if number < BLOCK:
            return self._symbols[number].to_bytes(SYMBOL, "little")
        total = 0
        for each in _row(number):
            if each >= len(self._symbols):
                break
            total ^= self._symbols[each]
        return total.to_bytes(SYMBOL, "little")


@dataclass(frozen=True)
class Transfer:
    """A file's number, and the key by which its datagrams are authenticated."""

    number: int
    key: bytes

    def symbol(self, number: int, which: int, block: Block) -> bytes:
        """The datagram with symbol `which` of block `number`."""
        return self._tagged(_HEADER.pack(number, which) + block.symbol(which))

    def question(self, number: int, robots: Sequence[str]) -> bytes:
        """The datagram that asks robots, by their addresses, what they lack."""
        return self._tagged(
            _HEADER.pack(_QUESTION, number) + b"".join(IPv4Address(address).packed for address in robots)
        )

    def end(self) -> bytes:
        """The datagram after which nothing comes any more."""
        return self._tagged(_HEADER.pack(_END, 0))

    def answer(self, datagram: bytes, address: str) -> bytes | None:
        """The bytes after the tag, if the tag is of the robot with this address."""
        tag, content = datagram[:TAG], datagram[TAG:]
        return content if hmac.compare_digest(tag, self._tag(content + IPv4Address(address).packed)) else None

    def _tagged(self, content: bytes) -> bytes:
        return self._tag(content) + content

    def _tag(self, content: bytes) -> bytes:
        return hmac.digest(self.key, self.number.to_bytes(4, "big") + content, "sha256")[:TAG]


@dataclass
class _Robot:
    """What is known of a robot."""

    needs: dict[int, int]
    """Symbols, by block; a block that it has is not here."""
    answered: bool = False
    """The question that is open."""
    silent: int = 0
    """Questions in a row without an answer."""
    heard: tuple[int, int] | None = None
    """Symbols sent, and symbols that arrived, at an answer before."""
    loss: float = 0.0
    """Part of the symbols that do not arrive, smoothed."""

    def measure(self, sent: int, arrived: int) -> None:
        """Take the loss from two answers that are far enough apart."""
        if self.heard is None or arrived < self.heard[1]:  # the receiver started again
            self.heard = sent, arrived
        elif (span := sent - self.heard[0]) >= BLOCK // 4:
            lost = min(max(1 - (arrived - self.heard[1]) / span, 0.0), _MOST_LOSS)
            self.loss = lost if self.loss == 0 else (self.loss + lost) / 2
            self.heard = sent, arrived


@dataclass(frozen=True)
class Report:
    """What became of a transfer, or how far it is."""

    whole: list[str]
    """Addresses of the robots that have the file."""
    lacking: dict[str, int | None]
    """Bytes that the others lack; None of a robot that never answered."""
    sent: int
    """Bytes, headers included."""
    seconds: float

    def __str__(self) -> str:
        return json.dumps(self.__dict__)


@dataclass
class _Job:
    """Symbols of a block to be sent."""

    block: int
    numbers: deque[int] = field(default_factory=deque)


class Sender:
    """Sends one file. One thread; `run` returns when all robots have the file, or cannot be brought to."""

    def __init__(
        self, content: bytes, source: IPv4Address, robots: Sequence[IPv4Address], key: bytes, *, rate: int = RATE,
        group: IPv4Address = GROUP, port: int = PORT,
    ) -> None:  # fmt: skip
        """`content` is not empty; `rate` is in bits a second, headers included; `source` is this station's address."""
        self._content = content
        self._rate = rate
        self._to = str(group), port
        self._transfer = Transfer(transfer_number(content), key)
        self._count = math.ceil(len(content) / (BLOCK * SYMBOL))
        unknown = {block: self._symbols(block) for block in range(self._count)}
        self._robots = {str(address): _Robot(dict(unknown)) for address in robots}
        self._never = set(self._robots)
        self._jobs: deque[_Job] = deque()
        self._fresh: deque[int] = deque()
        self._sent_since: set[int] = set()
        """Blocks of which symbols went out since the last question."""
        self._question = 0
        self._asked_at: float | None = None
        """Of the question that is open."""
        self._wait_s = 0.0
        # Where an earlier call of the sender began is unknown: other repair symbols than its are likely needed.
        self._next_repair = [random.randrange(BLOCK, 0x10000)] * self._count
        self._blocks: dict[int, Block] = {}
        self._symbols_sent = 0
        self._bytes_sent = 0
        self._free_at = 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((str(source), 0))
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, source.packed)
        self._socket.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._socket, selectors.EVENT_READ)

    def _symbols(self, block: int) -> int:
        return math.ceil(min(len(self._content) - block * BLOCK * SYMBOL, BLOCK * SYMBOL) / SYMBOL)

    def _block(self, block: int) -> Block:
        if block not in self._blocks:
            if len(self._blocks) == _BLOCKS_HELD:
                del self._blocks[next(iter(self._blocks))]
            self._blocks[block] = Block(self._content[block * BLOCK * SYMBOL : (block + 1) * BLOCK * SYMBOL])
        return self._blocks[block]

    def run(self, watch: Callable[[Report], object] = lambda report: None) -> Report:
        """Send; errors of the network are waited out.

        `watch` is told how far it is, about once a second; what it raises ends the transfer.
        """
        began = told = time.monotonic()
        with self._selector, self._socket:
            self._ask()
            while True:
                self._listen()
                if self._asked_at is not None and self._is_answered():
                    self._plan()
                if self._asked_at is None and (self._sent_since or not (self._jobs or self._fresh)):
                    if self._is_over():
                        break
                    self._ask()
                elif not self._send_next():
                    self._listen(self._left_s())
                if time.monotonic() - told >= _TOLD_S:
                    told = time.monotonic()
                    watch(self._report(told - began))
            for _ in range(3):  # a robot that hears none of them ends by itself
                self._send(self._transfer.end())
        return self._report(time.monotonic() - began)

    def _report(self, seconds: float) -> Report:
        lacking = {
            address: None if address in self._never else SYMBOL * sum(robot.needs.values())
            for address, robot in self._robots.items()
            if robot.needs
        }
        whole = [address for address, robot in self._robots.items() if not robot.needs]
        return Report(whole, lacking, self._bytes_sent, round(seconds, 3))

    def _is_over(self) -> bool:
        """Everybody has the file or was silent for long, or more was sent than any hope is worth."""
        waited_for = [robot for robot in self._robots.values() if robot.needs and robot.silent < _SILENT]
        total = math.ceil(len(self._content) / SYMBOL)
        return not waited_for or self._symbols_sent > _FACTOR * total + BLOCK

    # --- sending ---

    def _send(self, datagram: bytes) -> None:
        """Send one datagram, not before the one before it has had its time.

        The time begins after the call that sends: whatever this thread waits for, two datagrams are never closer.
        """
        while (wait := self._free_at - time.monotonic()) > 0:
            time.sleep(wait)
        try:
            self._socket.sendto(datagram, self._to)
        except OSError as error:  # such as a radio that has left the cell for a moment
            print(f"{self._to[0]}: {error.strerror}", file=sys.stderr)
        size = HEADERS + len(datagram)
        self._bytes_sent += size
        self._free_at = time.monotonic() + 8 * size / self._rate

    def _send_next(self) -> bool:
        """Send a symbol, if there is one to send."""
        if not self._jobs and self._fresh:
            self._begin(self._fresh.popleft())
        if not self._jobs:
            return False
        job = self._jobs[0]
        number = job.numbers.popleft()
        self._send(self._transfer.symbol(job.block, number, self._block(job.block)))
        self._symbols_sent += 1
        if not job.numbers:
            self._jobs.popleft()
            self._sent_since.add(job.block)
        return True

    def _begin(self, block: int) -> None:
        """All symbols of a block, and repair symbols for the loss of the typical robot."""
        losses = [robot.loss for robot in self._robots.values() if block in robot.needs and not robot.silent]
        loss = statistics.median(losses) if losses else 0.0
        own = self._symbols(block)
        self._jobs.append(_Job(block, deque([*range(own), *self._repairs(block, int(own * loss / (1 - loss)))])))

    def _repairs(self, block: int, count: int) -> Iterator[int]:
        for _ in range(count):
            yield self._next_repair[block]
            self._next_repair[block] += 1
            if self._next_repair[block] > 0xFFFF:
                self._next_repair[block] = BLOCK

    # --- asking ---

    def _ask(self) -> None:
        """Ask all who lack something. What was sent before is in their answers."""
        asked = [address for address, robot in self._robots.items() if robot.needs]
        for address in asked:
            self._robots[address].answered = False
        self._question = self._question % 0xFFFF + 1
        self._sent_since.clear()
        self._send(self._transfer.question(self._question, asked[: SYMBOL // 4]))
        self._asked_at, self._wait_s = time.monotonic(), len(asked) * _SLOT_S + _PATIENCE_S

    def _left_s(self) -> float:
        return 0.0 if self._asked_at is None else max(self._asked_at + self._wait_s - time.monotonic(), 0.0)

    def _is_answered(self) -> bool:
        return self._left_s() == 0 or all(robot.answered or not robot.needs for robot in self._robots.values())

    def _listen(self, timeout_s: float = 0.0) -> None:
        """Take the answers that are there, or the first one within a time."""
        if not self._selector.select(timeout_s):
            return
        while True:
            try:
                datagram, (address, _) = self._socket.recvfrom(2048)
            except BlockingIOError:
                return
            except OSError:  # such as a robot's that nobody listens there, yet
                continue
            self._take(address, datagram)

    def _take(self, address: str, datagram: bytes) -> None:
        robot = self._robots.get(address)
        start = _HEADER.size + _ANSWER.size
        content = self._transfer.answer(datagram, address) if robot else None
        if robot is None or content is None or len(content) < start:
            return
        arrived, count = _ANSWER.unpack_from(content, _HEADER.size)
        if _HEADER.unpack_from(content) != (_ANSWERED, self._question):
            return
        if len(content) != start + count * _NEED.size:
            return
        needs = dict(_NEED.iter_unpack(content[start:]))
        if count == _MOST_NEEDS:  # of blocks after those nothing is said
            last = max(needs)
            needs |= {block: need for block, need in robot.needs.items() if block > last}
        robot.needs = {block: need for block, need in needs.items() if block < self._count}
        robot.answered, robot.silent = True, 0
        robot.measure(self._symbols_sent, arrived)
        self._never.discard(address)

    def _plan(self) -> None:
        """Close the question, and decide what is sent next."""
        self._asked_at = None
        for robot in self._robots.values():
            robot.silent += bool(robot.needs) and not robot.answered
        busy = {job.block for job in self._jobs} | self._sent_since
        fresh = []
        for block in range(self._count):
            needs = [
                (robot.needs[block], robot.loss)
                for robot in self._robots.values()
                if block in robot.needs and robot.answered
            ]
            if not needs or block in busy:
                continue
            if max(need for need, _ in needs) > self._symbols(block) / 2:
                fresh.append(block)
            else:
                count = max(math.ceil(need / (1 - loss)) for need, loss in needs)
                self._jobs.appendleft(_Job(block, deque(self._repairs(block, count))))
        self._fresh = deque(fresh)


def main() -> None:
    """Send a file as the command line says, and print the report."""
    parser = argparse.ArgumentParser(description="Send a file to robots that run flotilla-receive.")
    parser.add_argument("--describe", action="store_true", help="print what flotilla-receive must know, and end")
    parser.add_argument("--at", type=IPv4Address, help="this station's address")
    parser.add_argument("--key", type=Path, metavar="FILE", help="the transfer's key, 64 hexadecimal digits")
    parser.add_argument("--rate", type=int, default=RATE, metavar="BIT/S", help=f"headers included ({RATE})")
    parser.add_argument("--group", type=IPv4Address, default=GROUP, help=f"multicast group ({GROUP})")
    parser.add_argument("--port", type=int, default=PORT, help=f"UDP port ({PORT})")
    parser.add_argument("file", type=Path)
    parser.add_argument("robots", type=IPv4Address, nargs="*", metavar="ADDRESS", help="of robots")
    arguments = parser.parse_args()
    if not arguments.describe and not (arguments.at and arguments.key and arguments.robots):
        parser.error("the following arguments are required: --at, --key, and addresses of robots")
    if arguments.rate < 1:
        parser.error(f"--rate: {arguments.rate}: give bits a second, 1 or more")
    content = arguments.file.read_bytes()
    if not content:
        raise UserError(f"{arguments.file}: is empty: there is nothing to send")
    if arguments.describe:
        print(describe(content), end="")
        return
    try:
        key = bytes.fromhex(arguments.key.read_text())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise UserError(f"{arguments.key}: is no key: give {2 * KEY_BYTES} hexadecimal digits")
    sender = Sender(
        content, arguments.at, arguments.robots, key, rate=arguments.rate, group=arguments.group, port=arguments.port
    )
    report = sender.run()
    print(report)
    sys.exit(1 if report.lacking else 0)


if __name__ == "__main__":
    try:
        main()
    except (UserError, OSError) as error:
        sys.exit(str(error))
