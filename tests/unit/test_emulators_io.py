"""The emulators of the indoor positioning system and of the relay board."""

from __future__ import annotations

import math
import socket
import struct
from itertools import islice

import pytest

from flotilla.lab.emulators.igps import Faults, Igps, pack
from flotilla.lab.emulators.ir104 import Ir104, Switching

NOWHERE = ("127.0.0.1", 9)


def still(_: float) -> tuple[float, float]:
    return (-2.25, 1.5)


# --- indoor positioning ---


def test_datagram_is_y_then_x() -> None:
    assert pack((-2.25, 1.5)) == bytes.fromhex("000000000000f83f 00000000000002c0")
    assert pack((-2.25, 1.5), "big") == bytes.fromhex("3ff8000000000000 c002000000000000")


def test_rate_and_jitter() -> None:
    igps = Igps(NOWHERE, still, rate=50, jitter=0.004)
    times = [due for due, _ in islice(igps.datagrams(), 500)]
    late = [due - count / 50 for count, due in enumerate(times)]
    assert min(late) >= 0
    assert max(late) <= 0.004
    assert max(late) - min(late) > 0.003


def test_position_is_of_its_time() -> None:
    igps = Igps(NOWHERE, lambda seconds: (seconds, -seconds), rate=8, jitter=0)
    sent = [struct.unpack("<2d", datagrams[0]) for _, datagrams in islice(igps.datagrams(), 4)]
    assert sent == [(-count / 8, count / 8) for count in range(4)]


def test_seed_repeats() -> None:
    def some(seed: int) -> list[tuple[float, list[bytes]]]:
        faults = Faults(loss=0.2, garbage=0.2, blind=0.2, wild=0.2)
        return list(islice(Igps(NOWHERE, lambda s: (s, s), faults=faults, seed=seed).datagrams(), 100))

    assert repr(some(1)) == repr(some(1))
    assert repr(some(1)) != repr(some(2))


@pytest.mark.parametrize(
    ("faults", "least", "most"), [(Faults(), 0, 0), (Faults(loss=0.25), 200, 300), (Faults(loss=1), 1000, 1000)]
)
def test_loss(faults: Faults, least: int, most: int) -> None:
    datagrams = [sent for _, sent in islice(Igps(NOWHERE, still, faults=faults).datagrams(), 1000)]
    assert least <= datagrams.count([]) <= most


def test_garbage_never_has_the_length() -> None:
    datagrams = [sent[0] for _, sent in islice(Igps(NOWHERE, still, faults=Faults(garbage=1)).datagrams(), 1000)]
    lengths = {len(datagram) for datagram in datagrams}
    assert 16 not in lengths
    assert {0, 15, 17} <= lengths


def test_blind_and_wild() -> None:
    blind = next(Igps(NOWHERE, still, faults=Faults(blind=1)).datagrams())[1][0]
    assert math.isnan(struct.unpack("<2d", blind)[0])
    wild = next(Igps(NOWHERE, still, faults=Faults(wild=1)).datagrams())[1][0]
    assert struct.unpack("<2d", wild)[1] > 1e5


def test_burst() -> None:
    counts = [len(sent) for _, sent in islice(Igps(NOWHERE, still, faults=Faults(burst=5)).datagrams(), 10)]
    assert counts == [0, 0, 0, 0, 5] * 2


def test_sends() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        robot.settimeout(10)
        with Igps(robot.getsockname(), still, rate=200, faults=Faults(garbage=0.5)) as igps:
            received = [robot.recv(100) for _ in range(40)]
        good = received.count(pack((-2.25, 1.5)))
        assert 0 < good <= igps.sent
        assert good < 40


# --- relay board ---


class Clock:
    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def relays_on(board: Ir104) -> list[int]:
    return [number for number, on in enumerate(board.relays, 1) if on]


def test_relays_read_back() -> None:
    board = Ir104()
    assert relays_on(board) == []
    board.write(0x300, 0b10000001)
    board.write(0x301, 0b00000001)
    board.write(0x302, 0b11111000)
    assert relays_on(board) == [1, 8, 9, 20]
    assert [board.read(port) for port in (0x300, 0x301, 0x302)] == [0b10000001, 1, 0b1000]


def test_inputs_are_low_when_driven() -> None:
    board = Ir104(base=0x240)
    assert [board.read(port) for port in (0x244, 0x245, 0x246)] == [0xFF, 0xFF, 0xFF]
    board.drive(1)
    board.drive(9)
    board.drive(20)
    assert [board.read(port) for port in (0x244, 0x245, 0x246)] == [0xFE, 0xFE, 0xF7]
    board.drive(9, False)
    assert board.read(0x245) == 0xFF
    board.write(0x244, 0)  # inputs are read only
    assert board.read(0x244) == 0xFE


def test_log_has_each_change_once() -> None:
    clock = Clock()
    board = Ir104(clock)
    board.feed(0, bytes([1, 1, 1]))
    clock.seconds = 2.0
    board.feed(0, bytes([3, 2]))
    clock.seconds = 5.0
    board.cut_power()
    assert board.log == [
        Switching(0.0, 1, True),
        Switching(2.0, 2, True),
        Switching(2.0, 1, False),
        Switching(5.0, 2, False),
    ]
    assert board.on_seconds(1, 9.0) == 2.0
    assert board.on_seconds(2, 4.0) == 2.0
    assert board.on_seconds(2, 9.0) == 3.0
    assert board.on_seconds(3, 9.0) == 0.0


def test_stuck_relay_reads_otherwise() -> None:
    board = Ir104(stuck={2: False, 3: True})
    board.write(0x300, 0b0011)
    assert board.read(0x300) == 0b0101


def test_board_that_is_gone() -> None:
    board = Ir104()
    board.write(0x300, 1)
    board.present = False
    board.write(0x300, 0)
    assert board.read(0x300) == 0xFF
    board.present = True
    assert board.read(0x300) == 1


@pytest.mark.parametrize("port", [0x2FF, 0x308])
def test_foreign_port(port: int) -> None:
    with pytest.raises(ValueError, match=f"port 0x{port:x} is not the board's"):
        Ir104().write(port, 0)
    with pytest.raises(ValueError, match="is not the board's"):
        Ir104().read(port)


@pytest.mark.parametrize("number", [0, 21])
def test_missing_input(number: int) -> None:
    with pytest.raises(ValueError, match=f"there is no input {number}"):
        Ir104().drive(number)
