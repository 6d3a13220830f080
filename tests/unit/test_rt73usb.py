"""The emulated 802.11 adapter, and the cell that its frames cross, without a guest; Linux's driver is their judge in
tests/boot/test_radio_cell.py."""

from __future__ import annotations

import struct

import pytest

from flotilla.fleet.model import Ibss
from flotilla.lab.emulators.rt73usb import Frame, Request, Rt73Usb
from flotilla.lab.emulators.usb_redirection import WAITING, Plug, Setup
from flotilla.lab.qemu.air import Air
from flotilla.lab.qemu.qemu import Wire
from flotilla.lab.qemu.segment import free_udp_ports

MAC, OTHER = bytes.fromhex("525400f20001"), bytes.fromhex("525400f20002")
BSSID = bytes.fromhex("02caffee1042")
ALL = b"\xff" * 6
OUT, IN = 0x40, 0xC0
CELL = Ibss(ssid="flotilla", frequency_mhz=2412, bssid="02:ca:ff:ee:10:42")
HELLO = struct.pack("<III", 0, 68, 0) + b"QEMU".ljust(64, b"\0") + struct.pack("<I", 0)
BULK = struct.Struct("<IIIBBHI")


class Bench:
    """An adapter, set up as its driver does it, with what it transmits and says."""

    def __init__(self) -> None:
        self.transmitted: list[Frame] = []
        self.said: list[bytes] = []
        self.adapter = Rt73Usb(MAC, self.transmitted.append)
        self.adapter.say = self.said.append
        self.write(0x0800, b"\x02" * 64)
        self.adapter.control(Setup(OUT, Request.MODE, 8, 0, 0), b"")
        self.write(0x3030, struct.pack("<I", 1 << 2))
        self.write(0x3008, MAC + b"\xff\0")
        self.write(0x3010, BSSID + b"\3\0")
        self.write(0x3040, struct.pack("<I", 1 << 20))
        self.write(0x3050, struct.pack("<I", 7 << 28))
        self.tune(0x786, 0xFEA0B)

    def write(self, at: int, data: bytes) -> None:
        assert self.adapter.control(Setup(OUT, Request.WRITE, 0, at, len(data)), data) == b""

    def read(self, at: int, length: int = 4) -> bytes:
        return self.adapter.control(Setup(IN, Request.READ, 0, at, length), b"") or b""

    def tune(self, divider: int, fraction: int) -> None:
        for word in (0x2C0C, divider, 0x68255, fraction):
            self.write(0x3090, struct.pack("<I", 1 << 31 | 20 << 24 | word))


def data(receiver: bytes, body: bytes = b"hello") -> bytes:
    return b"\x08\x00\x00\x00" + receiver + OTHER + BSSID + b"\0\0" + body


def heard(bench: Bench, content: bytes, rate: int = 110, frequency_mhz: int = 2412) -> list[bytes]:
    bench.said.clear()
    bench.adapter.hear(Frame(content, rate, frequency_mhz), -50)
    return bench.said


@pytest.mark.parametrize(
    ("divider", "fraction", "frequency_mhz"),
    [
        (0x786, 0xFEA0B, 2412), (0x786, 0xFEA1F, 2417), (0x792, 0xFEA0B, 2442), (0x79E, 0xFEA0B, 2472),
        (0x7A2, 0xFEA13, 2484),
    ],
)  # fmt: skip
def test_channels_are_those_of_the_radio_chips_table(divider: int, fraction: int, frequency_mhz: int) -> None:
    bench = Bench()
    bench.tune(divider, fraction)
    assert bench.adapter.frequency_mhz == frequency_mhz
    assert not struct.unpack("<I", bench.read(0x3090))[0] >> 31, "it is busy for ever"


def test_it_hands_on_what_is_for_it() -> None:
    bench = Bench()
    assert heard(bench, data(bytes.fromhex("525400f200ff"))) == []
    assert heard(bench, data(MAC), frequency_mhz=2437) == []
    (said,) = heard(bench, data(MAC), rate=540)
    word0, word1 = struct.unpack_from("<II", said)
    assert (word0 >> 16 & 0xFFF, word0 >> 7 & 1, word1 & 0xFF) == (len(data(MAC)), 1, 0xC)
    assert (word1 >> 8 & 0x1F) * 2 - 90 == -50
    assert said[24:] == data(MAC)
    assert len(heard(bench, data(ALL))) == 1


def test_without_firmware_it_does_nothing() -> None:
    """The driver loads it before it starts the radio."""
    bench = Bench()
    bench.adapter.power_on()
    bench.write(0x3030, struct.pack("<I", 1 << 2))
    bench.adapter.written(struct.pack("<6I", len(data(ALL)) << 16, 0, 3, 0, 0, 0) + data(ALL))
    assert (bench.transmitted, heard(bench, data(ALL))) == ([], [])


def test_what_it_sends_has_rate_sequence_and_attempts() -> None:
    bench = Bench()
    for word2, ofdm in ((3, 0), (0xC, 1)):
        word0 = len(data(OTHER)) << 16 | 1 << 3 | ofdm << 5
        bench.adapter.written(struct.pack("<6I", word0, 1 << 28, word2, 0, 0, 0) + data(OTHER) + b"fill")
    first, second = bench.transmitted
    assert (first.rate_100kbit_s, second.rate_100kbit_s) == (110, 540)
    assert (first.attempts, first.frequency_mhz, len(first.content)) == (7, 2412, len(data(OTHER)))
    assert [struct.unpack_from("<H", frame.content, 22)[0] for frame in (first, second)] == [0x10, 0x20]


def test_beacons_are_of_the_cell_once_in_an_interval() -> None:
    bench = Bench()
    beacon = b"\x80\0\0\0" + ALL + MAC + BSSID + bytes(2) + bytes(8) + b"rest"
    bench.write(0x2400, struct.pack("<6I", len(beacon) << 16 | 1 << 4 | 1 << 1, 0, 0, 0, 0, 1 << 24))
    bench.write(0x2418, beacon)
    bench.write(0x3064, struct.pack("<I", 1 << 20 | 1600))
    due = bench.adapter.next_tick_ns()
    assert due
    bench.adapter.tick(due - 1)
    assert bench.transmitted == []
    bench.adapter.hear(Frame(beacon, 10, 2412), -50)
    later = bench.adapter.next_tick_ns()
    assert later, "another member's beacon takes its place"
    bench.adapter.tick(later)
    (sent,) = bench.transmitted
    assert sent.is_beacon
    assert struct.unpack_from("<Q", sent.content, 24)[0] > 0, "it has no time stamp"
    bench.write(
        0x2400, bytes(4)
    )  # as the driver takes a beacon away; seen to send an empty frame then, which nobody can read
    again = bench.adapter.next_tick_ns()
    assert again
    bench.adapter.tick(again)
    assert bench.transmitted == [sent]


def test_a_plug_answers_requests_and_keeps_what_nobody_asked_for() -> None:
    bench = Bench()
    sent: list[bytes] = []
    plug = Plug(bench.adapter, sent.append)
    plug.feed(HELLO[:7])
    plug.feed(HELLO[7:])
    kinds = [struct.unpack_from("<I", each)[0] for each in sent]
    assert kinds == [0, 4, 5, 1], "hello, interfaces, endpoints, and only then the device"
    device = struct.unpack_from("<BBBBHH", sent[-1], 12)
    assert device[4:] == (0x148F, 0x2573)
    for number in range(WAITING + 1):
        plug.say(b"%d" % number)
    assert plug.dropped == 1
    sent.clear()
    plug.feed(BULK.pack(101, 8, 77, 0x81, 0, 512, 0))
    (answer,) = sent
    assert BULK.unpack_from(answer) == (101, 9, 77, 0x81, 0, 1, 0)
    assert answer[20:] == b"0"


@pytest.mark.parametrize(("attempts", "arrives"), [(1, 0.7), (4, 0.99)])
def test_frames_to_one_member_are_repeated(attempts: int, arrives: float) -> None:
    """By a loss of 0.3: 0.7 of single frames arrive, 0.9919 of those with four attempts."""
    air = Air(loss=0.3)
    air.adapter("near", "52:54:00:f2:00:01")
    far = air.adapter("far", "52:54:00:f2:00:02")
    came = []
    far.hear = lambda frame, dbm: came.append(frame)  # type: ignore[method-assign]
    for _ in range(2000):
        air._arrive("near", Frame(data(ALL), 10, 2412, attempts))
    assert len(came) / 2000 == pytest.approx(arrives, abs=0.03)
    air.reach("far", reached=False)
    came.clear()
    air._arrive("near", Frame(data(ALL), 10, 2412, attempts))
    assert came == []
    air.close()


def test_a_cable_speaks_ethernet() -> None:
    air = Air()
    sent: list[Frame] = []
    here, there = free_udp_ports(2)
    cable = air.cable("station", Wire(here, there), CELL)
    cable.transmit = sent.append
    cable.take(MAC + OTHER + b"\x08\x00packet")
    (frame,) = sent
    assert (frame.receiver, frame.content[10:22]) == (MAC, OTHER + BSSID)
    assert frame.content[24:] == bytes.fromhex("aaaa03000000") + b"\x08\x00packet"
    with pytest.MonkeyPatch.context() as patch:
        out: list[bytes] = []
        patch.setattr(
            cable, "socket", type("Socket", (), {"send": staticmethod(out.append), "close": cable.socket.close})
        )
        answer = Frame(data(OTHER, bytes.fromhex("aaaa03000000") + b"\x08\x00answer"), 110, 2412)
        cable.hear(answer, -50)
        cable.hear(Frame(answer.content, 110, 2437), -50)
        cable.hear(Frame(data(MAC, answer.content[24:]), 110, 2412), -50)
    assert out == [OTHER + OTHER + b"\x08\x00answer"], "another channel's, or another computer's"
    air.close()
