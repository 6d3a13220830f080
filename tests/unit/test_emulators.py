"""The emulated serial devices say what the real ones do: against the vectors of their manuals, by their commands."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from hokuyolx import HokuyoLX

from flotilla.lab.emulators import dsp3000, micromag3, oceanserver, urg
from flotilla.lab.emulators.dsp3000 import Dsp3000, Mode
from flotilla.lab.emulators.micromag3 import MicroMag3
from flotilla.lab.emulators.oceanserver import Battery, OceanServer
from flotilla.lab.emulators.serial_line import Device, Faults, Pty, SerialLine, UnixSocket, at_wrong_baud
from flotilla.lab.emulators.urg import Urg

TIMEOUT = 20.0
"""Far more than anything here takes, because the machine may be busy."""


class Counter(Device):
    """Numbers its messages, a hundred a second, and answers in capitals."""

    baud = 9600
    jitter = 0.0
    period = 0.01

    def power_on(self) -> None:
        self.count = 0
        self.measured: list[float] = []

    def received(self, data: bytes) -> list[bytes]:
        return [data.upper()]

    def measure(self, seconds: float) -> list[bytes]:
        self.count += 1
        self.measured.append(seconds)
        return [b"%06d\n" % self.count]


class Robot:
    """Reads and writes a port as the robot does."""

    def __init__(self, path: str, speed: int = termios.B9600) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        settings = termios.tcgetattr(self.fd)
        settings[4] = settings[5] = speed
        termios.tcsetattr(self.fd, termios.TCSANOW, settings)
        self.heard = b""  # at first perhaps what was garbled before

    def read(self) -> bool:
        """False after a hang-up."""
        if not select.select([self.fd], [], [], TIMEOUT)[0]:
            raise TimeoutError(f"heard {self.heard!r}")
        try:
            data = os.read(self.fd, 4096)
        except OSError:
            return False
        self.heard += data
        return bool(data)

    def read_until(self, condition: Callable[[bytes], object]) -> bytes:
        end = time.monotonic() + TIMEOUT
        while not condition(self.heard):
            assert self.read()
            assert time.monotonic() < end, self.heard
        return self.heard

    def close(self) -> None:
        os.close(self.fd)


def period_of(device: Device) -> float | None:
    """Asked for anew: a type checker takes the last answer for still true."""
    return device.period


# --- the line ---


def test_line_carries_both_ways() -> None:
    with SerialLine(Counter()) as line:
        robot = Robot(line.path)
        os.write(robot.fd, b"go")
        robot.read_until(lambda heard: b"GO" in heard)
        robot.read_until(lambda heard: b"000018\n000019\n" in heard.replace(b"GO", b""))
        robot.close()


def test_line_is_unplugged_and_plugged_in_again() -> None:
    device = Counter()
    with SerialLine(device) as line:
        robot = Robot(line.path)
        device.count = 500_000
        robot.read_until(lambda heard: b"\n500" in heard)
        line.unplug()
        assert not Path(line.path).exists()
        while robot.read():
            pass
        robot.close()
        line.replug()
        robot = Robot(line.path)
        robot.read_until(lambda heard: b"\n000" in heard)  # switched on anew
        robot.close()


def test_line_keeps_the_devices_rate() -> None:
    device = Counter()
    with SerialLine(device):
        while len(device.measured) < 20:
            time.sleep(0.01)
    steps = [after - before for before, after in pairwise(device.measured)]
    assert min(steps) == pytest.approx(0.01)  # late or not, a message is as of when it was due


@pytest.mark.parametrize(
    ("faults", "seen"),
    [
        (Faults(garbage=0.5), lambda lines: any(not line.isdigit() for line in lines)),
        (Faults(half=0.5), lambda lines: any(len(line) != 6 for line in lines)),
        (Faults(corrupt=0.5), lambda lines: any(len(line) == 6 and not line.isdigit() for line in lines)),
    ],
)
def test_line_spoils_messages_the_same_way_each_time(faults: Faults, seen: Callable[[list[bytes]], bool]) -> None:
    def first_messages() -> bytes:
        line = SerialLine(Counter(), faults=faults, seed=5)
        return b"".join(line._spoil(b"%06d\n" % number) for number in range(100))

    once, again = first_messages(), first_messages()
    assert once == again
    assert seen(once.splitlines())
    good = sum(line.isdigit() and len(line) == 6 for line in once.splitlines())
    assert 20 < good < 80


def test_line_falls_silent_and_bursts() -> None:
    with SerialLine(Counter(), faults=Faults(silence=True)) as line:
        robot = Robot(line.path)
        while line.sent < 10:
            time.sleep(0.01)
        assert not select.select([robot.fd], [], [], 0)[0]
        line.faults = Faults(burst=10)
        assert robot.read()
        assert len(robot.heard) > 7  # several at once
        assert len(robot.read_until(lambda heard: len(heard) >= 70)) % 70 == 0
        robot.close()


def test_wrong_baud_is_heard_as_a_uart_would() -> None:
    assert at_wrong_baud(b"hello", 9600, 9600) == b"hello"
    assert at_wrong_baud(b"hello", 9600, 9700) == b"hello"
    # One character of zeros at half the rate lasts as long as two: start bit and eight zeros, then again.
    assert at_wrong_baud(b"\x00", 4800, 9600) == b"\x00"
    # 0x55 alternates bit by bit: at twice the rate each of them is seen twice.
    assert at_wrong_baud(b"\x55", 4800, 9600)[0] == 0b01100110
    assert at_wrong_baud(b"hello world", 9600, 38400) != b"hello world"


def test_line_is_garbled_when_the_rates_differ() -> None:
    with SerialLine(Counter()) as line:
        robot = Robot(line.path, termios.B19200)
        assert b"\n0000" not in robot.read_until(lambda heard: len(heard) > 100)
        robot.close()
        robot = Robot(line.path, termios.B9600)
        robot.read_until(lambda heard: b"\n0000" in heard)
        line.faults = Faults(baud=19200)
        robot.heard = b""
        robot.read_until(lambda heard: len(heard) > 100 and not heard[-50:].replace(b"\n", b"").isdigit())
        robot.close()


def listener(path: Path) -> socket.socket:
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(path))
    server.listen()
    return server


def test_line_over_a_socket(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with listener(path) as server, SerialLine(Counter(), UnixSocket(str(path))) as line:
        client, _ = server.accept()
        with client:
            client.settimeout(TIMEOUT)
            assert client.recv(7) == b"000001\n"
            client.send(b"abc")
            heard = b""
            while b"ABC" not in heard:
                heard += client.recv(100)
            line.unplug()
            while client.recv(100):
                pass
        line.replug()
        client, _ = server.accept()
        with client:
            client.settimeout(TIMEOUT)
            assert client.recv(7) == b"000001\n"


def test_a_socket_keeps_little_for_who_does_not_read(tmp_path: Path) -> None:
    """Seen to fail with the buffer that is usual: 70 messages."""
    path = tmp_path / "socket"
    with listener(path):
        endpoint = UnixSocket(str(path))
        descriptor = endpoint.plug()
        kept = 0
        while select.select([], [descriptor], [], 0)[1] and kept < 1000:
            kept += bool(os.write(descriptor, dsp3000.text(0)))
        endpoint.unplug()
    assert 1 <= kept < 10


# --- the gyro ---


def test_dsp3000_text() -> None:
    assert dsp3000.text(-12.345678) == b"     -12.345678   1\r\n"
    assert len(dsp3000.text(123.0, valid=False)) == 21
    assert dsp3000.text(123.0, valid=False).endswith(b"123.000000   0\r\n")


def test_dsp3000_words() -> None:
    # By hand: the valid bit alone is odd; 26 ones of -1 and the valid bit are 27, odd.
    assert dsp3000.word(0.0, Mode.RATE) == b"\x80\x00\x00\x00"
    assert dsp3000.word(-60e-6, Mode.RATE) == b"\x83\xff\xff\xff"
    assert dsp3000.word(60e-6, Mode.RATE) == b"\x84\x00\x00\x01"
    assert dsp3000.word(6e-6, Mode.INCREMENTAL)[0] & 0x18 == 0x08
    assert dsp3000.word(6e-6, Mode.INTEGRATED)[0] & 0x18 == 0x10
    assert dsp3000.word(1.0, Mode.RATE, valid=False)[0] & 0x80 == 0
    for value in range(-100, 100):
        assert int.from_bytes(dsp3000.word(value, Mode.RATE), "big").bit_count() % 2 == 1


def value_of(frame: bytes) -> float:
    return float(frame.split()[0])


def test_dsp3000_obeys() -> None:
    gyro = Dsp3000(lambda seconds: 10.0, deaf=0, noise=0)
    assert value_of(gyro.measure(1.0)[0]) == 10
    gyro.received(b"A")
    assert value_of(gyro.measure(1.5)[0]) == 5
    gyro.received(b"P")
    assert value_of(gyro.measure(2.0)[0]) == 20
    gyro.received(b"Z?")
    assert value_of(gyro.measure(2.5)[0]) == 5
    gyro.power_on()
    assert gyro.mode is Mode.RATE
    gyro.rate = lambda seconds: 376.0
    assert gyro.measure(0.1)[0].endswith(b"0\r\n")


def test_dsp3000_misses_commands() -> None:
    gyro = Dsp3000(deaf=0.5, seed=1)
    missed = 0
    for _ in range(100):
        gyro.power_on()
        gyro.received(b"A")
        missed += gyro.mode is Mode.RATE
    assert 30 < missed < 70


# --- the magnetometer ---


def test_micromag3_record() -> None:
    # The board manual's NMEA example verifies, its own format's does not: there it is 1E.
    assert micromag3.record("HCHDM,71.33,M") == b"$HCHDM,71.33,M*2F\r\n"
    text = "C194.74X-106.00Y-403.00Z98.00:E200"
    assert micromag3.record(text) == f"${text}*6B\r\n".encode()
    compass = MicroMag3(noise=0, sums="unknown")
    compass.error = 0x200
    compass.settings["ez"] = "e"
    assert compass.received(b"s?\r") == [f"${text}*1E\r\n".encode()]


def test_micromag3_obeys() -> None:
    compass = MicroMag3(noise=0)
    assert period_of(compass) is None
    assert compass.received(b"poll") == []
    assert compass.received(b"freq=16\rgo\n") == [micromag3.record("pollfreq=16")]
    assert period_of(compass) == 1 / 16
    assert compass.measure(0.0) == [micromag3.record("C194.74X-106.00Y-403.00")]
    assert compass.received(b"sr?\r\n") == [micromag3.record("raw,X-106Y-403")]
    assert compass.received(b"ez=e\rs?\rsr?\r") == [
        micromag3.record("ez=e"),
        micromag3.record("C194.74X-106.00Y-403.00Z98.00"),
        micromag3.record("raw,X-106Y-403Z98"),
    ]
    assert compass.received(b"uc=m\rex=d\rs?\r")[2] == micromag3.record("C3462Y-403.00Z98.00")
    assert compass.received(b"sdo=n\rs?\r")[1] == micromag3.record("HCHDM,194.74,M")
    assert compass.received(b"sdo=x\rsdo=\r") == [micromag3.record("sdo:E040")] * 2
    assert compass.received(b"h\r") == [micromag3.record("h")]
    assert period_of(compass) is None
    assert compass.received(b"pollfreq=17\r") == [micromag3.record("pollfreq:E040")]
    assert compass.received(b"fly\r") == [micromag3.record("fly:E010")]
    compass.received(b"pollfreq=0\rgo\r")
    assert period_of(compass) == 2
    compass.power_on()
    assert period_of(compass) is None


# --- the batteries ---


def test_oceanserver_records() -> None:
    assert oceanserver.record("S", (1, "270F"), (2, 0), (4, 0x60)) == b"$S,01,270F,02,00,04,60%21\r\n"
    masks = enumerate((0xFF, 0, 0xFF, 0, 0, 0, 0), 1)
    assert oceanserver.record("C1", *masks) == b"$C1,01,FF,02,00,03,FF,04,00,05,00,06,00,07,00%72\r\n"
    registers = (2, "000A"), (1, "0294"), (3, "0080"), (8, "0B94"), (9, "4115"), (10, "FFEC"), (11, "FEC3")
    assert (
        oceanserver.record("B11", *registers) == b"$B11,02,000A,01,0294,03,0080,08,0B94,09,4115,0A,FFEC,0B,FEC3%3D\r\n"
    )


def test_oceanserver_obeys() -> None:
    controller = OceanServer({2: Battery(voltage=15.0, current=-0.02, temperature=296.4, charge=0.5)}, charging=2)
    assert controller.received(b"x") == []  # asleep
    assert controller.received(b" ") == [oceanserver.MENU]
    assert period_of(controller) is None
    assert controller.received(b"x") == []
    assert period_of(controller) == 1
    system, masks, battery, charge = controller.measure(1.0)
    assert system == oceanserver.record("S", (1, "270F"), (2, 0), (4, 50))
    assert masks == oceanserver.record("C1", (1, 2), (2, 2), (3, 0), (4, 0), (5, 0), (6, 0), (7, 0))
    assert battery == oceanserver.record("B12", (8, "0B94"), (9, "3A98"), (10, "FFEC"))
    assert charge == oceanserver.record("B12", (0x0D, "0032"))
    controller.message = "Low, charge now"
    assert controller.measure(2.0)[0] == oceanserver.record("S", (1, "270F"), (2, 0), (3, controller.message), (4, 50))
    assert controller.received(b" ") == [charge, oceanserver.MENU]  # what is on the wire comes before the menu
    assert period_of(controller) is None


# --- the laser scanner ---


def test_urg_encodes_as_published() -> None:
    assert urg.encode(1234, 2) == "CB"
    assert urg.encode(5432, 3) == "1Dh"
    assert urg.encode(16000000, 4) == "m2@0"
    for line in ("00P", "99b", "DMIN:204", "DMAX:5600_", "AMIN:447", "AMAX:725o", "AFRT:3846", "SCAN:600e"):
        assert urg.checksum(line[:-1]) == line[-1]


def test_urg_obeys() -> None:
    scanner = Urg(lambda step, seconds: step, noise=0)
    assert scanner.received(b"GD0044004501\n") == [b"GD0044004501\n10Q\n\n"]  # the laser is off
    assert scanner.received(b"BM\n") == [b"BM\n00P\n\n"]
    assert scanner.received(b"BM\n") == [b"BM\n02R\n\n"]
    data = urg.encode(44, 3) + urg.encode(45, 3)
    assert scanner.received(b"GD0044004501\n") == [f"GD0044004501\n00P\n00000\n{data}{urg.checksum(data)}\n\n".encode()]
    assert scanner.received(b"MD0044004501102\n") == [b"MD0044004501102\n00P\n\n"]
    assert scanner.measure(0.1) == []  # skipped
    assert scanner.measure(0.2)[0].startswith(b"MD0044004501101\n99b\n0038;\n")
    assert scanner.measure(0.3) == []
    assert scanner.measure(0.4)[0].startswith(b"MD0044004501100\n99b\n")
    assert scanner.measure(0.5) == []
    assert scanner.measure(0.6) == []
    scanner.received(b"MS0044072501000\n")
    lines = scanner.measure(0.7)[0].decode().split("\n")
    assert [len(line) for line in lines[3:-2]] == [65] * 21 + [21]  # 682 points of two characters
    assert scanner.received(b"QT\n") == [b"QT\n00P\n\n"]
    assert scanner.measure(0.8) == []


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("MD00x4072501000", "01"),
        ("MD0044072x01000", "02"),
        ("MD00440725x1000", "03"),
        ("MD0044080001000", "04"),
        ("MD0045004401000", "05"),
        ("MD0044072501x00", "06"),
        ("MD00440725010x0", "07"),
        ("XX", "0E"),
        ("SCIP2.0", "0E"),
        ("MD004407250100", "0C"),
        ("QT0", "0D"),
        ("QT;0123456789abcdefg", "0G"),
        ("QT;a,b", "0H"),
        ("TM3", "01"),
        ("TM1", "04"),
        ("TM2", "03"),
        ("SS0192x0", "01"),
        ("SS012345", "02"),
        ("SS019200", "03"),
        ("SS038400", "04"),
        ("CR1x", "01"),
        ("CR11", "02"),
        ("CR00", "03"),
        ("HS2", "01"),
        ("HS0", "02"),
    ],
)
def test_urg_refuses(command: str, status: str) -> None:
    assert Urg().received(f"{command}\n".encode()) == [urg.reply(command, status)]


def test_old_urg_answers_as_it_used_to_until_it_is_switched() -> None:
    """As urg_library and Player expect it: a status of one character, and E for what it does not know."""
    scanner = Urg(old=True, noise=0)
    assert scanner.received(b"QT\nBM\n") == [b"QT\nE\n\n", b"BM\nE\n\n"]
    version = scanner.received(b"V\n")[0].decode().split("\n")
    assert version[:3] == ["V", "0", "VEND:Hokuyo Automatic Co.,Ltd."]
    assert version[4].startswith("FIRM:3.1.04")
    lines = scanner.received(b"G00076801\n")[0].decode().split("\n")
    assert lines[:2] == ["G00076801", "0"]
    assert [len(line) for line in lines[2:-2]] == [64] * 24 + [2]  # 769 points of two characters
    assert scanner.received(b"L0\n") == [b"L0\n0\n\n"]
    assert scanner.received(b"G00076801\n") == [b"G00076801\nE\n\n"]
    assert scanner.received(b"L1\nS1152000000000\n") == [b"L1\n0\n\n", b"S1152000000000\n0\n\n"]
    assert scanner.baud == 115200
    assert scanner.received(b"SCIP2.0\n") == [b"SCIP2.0\n0\n\n"]
    assert not scanner.laser
    assert scanner.received(b"BM\n") == [b"BM\n00P\n\n"]


RECORDED = [
    # What a URG-04LX answered: hokuyo_aist, examples/example_urg_04lx.logr.
    "VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX;[\nFIRM:3.1.04(02/Aug./2007);a\n"
    "PROT:SCIP 2.0;N\nSERI:H0706400;F\n\n",
    "PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
    "AMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n",
    "II\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nLASR:ON;9\n"
    "SCSP:Initial(600[rpm])<-Default setting by user;A\nMESM:CLASSIC;^\nSBPS:19200[bps]<-Default setting by user;A\n"
    "TIME:6A5404;]\nSTAT:Sensor works well.;8\n\n",
    "BM\n02R\n\n",
    "CR00\n03S\n\n",
]


def test_urg_answers_as_recorded() -> None:
    scanner = Urg(noise=0)
    scanner.received(b"BM\n")
    scanner.measure(0x6A5404 / 1000)
    for answer in RECORDED:
        command = answer.split("\n")[0]
        assert scanner.received(f"{command}\n".encode()) == [answer.encode()]


def test_urg_adjusts_the_time_and_obeys_nothing_else_meanwhile() -> None:
    scanner = Urg()
    scanner.received(b"BM\n")
    assert scanner.received(b"TM0\n") == [b"TM0\n00P\n\n"]
    assert not scanner.laser
    assert scanner.received(b"QT\nTM0\n") == [b"QT\n0Ee\n\n", b"TM0\n02R\n\n"]
    scanner.measure(0x323DBB / 1000)
    # As recorded of a UXM-30LX-E, whose II told 323D56 before: hokuyo_aist, examples/example_uxm_30lx_e.logr.
    assert scanner.received(b"TM1\n") == [b"TM1\n00P\n<SfkP\n\n"]
    assert scanner.received(b"TM2\nQT\n") == [b"TM2\n00P\n\n", b"QT\n00P\n\n"]
    scanner.received(b"MD0044072501000\n")
    assert scanner.received(b"TM0\n") == [b"TM0\n10Q\n\n"]


def test_urg_forgets_its_settings_at_a_reset() -> None:
    scanner = Urg()
    assert scanner.received(b"SS115200;a\nCR10\nHS1\nBM\n") == [
        urg.reply(command, "00") for command in ("SS115200;a", "CR10", "HS1", "BM")
    ]
    assert (scanner.baud, scanner.laser) == (115200, True)
    assert period_of(scanner) == pytest.approx(1 / 9)
    assert scanner.received(b"RS\n") == [b"RS\n00P\n\n"]
    assert (scanner.baud, scanner.laser) == (19200, False)
    assert period_of(scanner) == pytest.approx(1 / 10)


def test_urg_tells_of_trouble() -> None:
    scanner = Urg()
    scanner.received(b"MD0044072501000\n")
    scanner.trouble = "51"
    assert scanner.measure(0.1) == [urg.reply("MD0044072501000", "51")]
    assert scanner.measure(0.2) == []
    assert scanner.received(b"BM\nGD0044072501\n") == [urg.reply("BM", "01"), urg.reply("GD0044072501", "51")]


def test_urg_answers_a_new_rate_at_the_old_one() -> None:
    with SerialLine(Urg()) as line:
        robot = Robot(line.path, termios.B19200)
        os.write(robot.fd, b"SS115200\n")
        robot.read_until(lambda heard: heard == b"SS115200\n00P\n\n")
        robot.close()
        robot = Robot(line.path, termios.B115200)
        os.write(robot.fd, b"\nQT\n")
        robot.read_until(lambda heard: heard == b"QT\n00P\n\n")
        robot.close()


def test_urg_clusters_and_marks_what_it_does_not_measure() -> None:
    scanner = Urg(lambda step, seconds: 5000 - step, noise=0)
    scanner.received(b"BM\n")
    data = scanner.received(b"GD0040004903\n")[0].decode().split("\n")[3][:-1]
    points = [data[at : at + 3] for at in range(0, len(data), 3)]
    # Of steps 43 to 45 the first has an error code, which is no distance.
    assert points == [urg.encode(number, 3) for number in (19, 4955, 4952, 4951)]


class Tcp:
    """A listening socket's next connection, as Hokuyo's scanners with Ethernet have it."""

    path = "TCP"

    def __init__(self, server: socket.socket) -> None:
        self._server = server

    def plug(self) -> int:
        self._socket, _ = self._server.accept()
        self._socket.setblocking(False)
        return self._socket.fileno()

    def unplug(self) -> None:
        self._socket.close()

    def robot_baud(self) -> int | None:
        return None


def test_urg_satisfies_a_driver_by_others() -> None:
    """hokuyolx reads and judges all that it is told: names, checksums, statuses, echoes, lengths."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        driver = HokuyoLX(
            activate=False, info=False, tsync=False, convert_time=False, addr=server.getsockname(), timeout=TIMEOUT
        )
        scanner = Urg(noise=0)
        with SerialLine(scanner, Tcp(server)):
            assert driver.version()["PROT"] == "SCIP 2.0"
            assert driver.sensor_state()["STAT"] == "Sensor works well."
            driver.update_info()
            assert (driver.amin, driver.amax, driver.aforw, driver.ares, driver.scan_freq) == (44, 725, 384, 1024, 10)
            assert driver.tsync_enter()[0] == "00"
            assert driver.tsync_get() >= 0
            assert driver.tsync_exit()[0] == "00"
            assert driver.tsync_exit()[0] == "03"
            assert [driver.activate()[0] for _ in range(2)] == [0, 2]
            _, distances = driver.get_dist()
            assert distances.tolist() == [1000 + step for step in range(44, 726)]
            scans = list(driver.iter_dist(scans=3, start=50, end=59, grouping=2, skips=1))
            assert [(scan.tolist(), pending) for scan, _, pending in scans] == [
                ([1050, 1052, 1054, 1056, 1058], pending) for pending in (2, 1, 0)
            ]
            assert scans[0][1] < scans[1][1] < scans[2][1]
            driver.activate()
            driver.standby()
            assert not scanner.laser
            driver.reset()
        driver.close()


# --- the program ---


def test_program_prints_the_path_and_plugs_out(tmp_path: Path) -> None:
    link = tmp_path / "gyro"
    arguments = [sys.executable, "-m", "flotilla", "emulate", "dsp3000", "--link", str(link)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout
        assert program.stdout.readline().strip() == str(link)
        robot = Robot(str(link), termios.B38400)
        assert robot.read_until(lambda heard: heard.count(b"\r\n") > 2).split(b"\r\n")[1].split()[1] == b"1"
        robot.close()
        program.send_signal(signal.SIGINT)
        try:
            assert program.wait(TIMEOUT) == 0
        finally:
            program.kill()
    assert not link.exists()


def test_pty_tells_any_rate() -> None:
    endpoint = Pty()
    endpoint.plug()
    robot = Robot(endpoint.path, termios.B57600)
    assert endpoint.robot_baud() == 57600
    robot.close()
    endpoint.unplug()
