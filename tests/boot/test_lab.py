"""The test lab itself, proven on a computer of one sector: no card image, a second or two per boot."""

from __future__ import annotations

import hashlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path

import pytest
from qemu.qmp import ExecuteError

from flotilla.common import paths
from flotilla.fleet.model import Network
from flotilla.lab.qemu import protocols, qemu, tiny
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.process import Exited
from flotilla.lab.qemu.segment import Segment
from flotilla.lab.qemu.timing import Expired, LabError

SECONDS = 300
"""Limit for what takes one or two on an idle host."""
NETWORK = Network(subnet=IPv4Network("10.42.0.0/24"), link="ethernet", dds_domain=0, udp_ports=[])
ROBOT, OTHER, STATION = IPv4Address("10.42.0.3"), IPv4Address("10.42.0.4"), IPv4Address("10.42.0.250")


@pytest.fixture
def image(tmp_path: Path) -> Path:
    file = tmp_path / "tiny.img"
    file.write_bytes(tiny.disk())
    return file


@pytest.fixture
def guest(image: Path, artefacts: Path) -> Iterator[Guest]:
    """The tiny computer, switched off."""
    with Guest(tiny.BOARD, image, artefacts / "tiny", qemu.Options(name="tiny")) as guest:
        yield guest


def test_it_serves_the_protocols(guest: Guest) -> None:
    power: protocols.Power = guest
    console: protocols.Console = guest.console
    power.on()
    console.expect(tiny.GREETING, SECONDS)
    console.send("echo this\r")
    assert console.expect(r"(\w+) this", SECONDS)[1] == "echo"
    assert console.text.count(tiny.GREETING) == 1
    power.cut()


def test_time_to_a_line_is_known_afterwards(guest: Guest) -> None:
    started = time.monotonic()
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    whole = time.monotonic() - started
    first, last = guest.seconds_to(tiny.GREETING[:1]), guest.seconds_to(tiny.GREETING)
    assert 0 < first <= last <= whole
    with pytest.raises(LabError, match="has not come"):
        guest.seconds_to("never said")


def test_expired_deadline_shows_the_console(guest: Guest) -> None:
    guest.on()
    guest.console.expect("ready", SECONDS)
    started = time.monotonic()
    with pytest.raises(Expired, match=r"(?s)'never said' did not come within 0.3 s.*" + tiny.GREETING):
        guest.console.expect("never said", 0.3)
    assert 0.3 <= time.monotonic() - started < SECONDS


def test_what_was_matched_is_not_matched_again(guest: Guest) -> None:
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    with pytest.raises(Expired):
        guest.console.expect(tiny.GREETING, 0.3)


def test_bad_argument_is_reported_at_once(image: Path, artefacts: Path) -> None:
    options = qemu.Options(extra=("-device", "no-such-device"))
    with Guest(tiny.BOARD, image, artefacts / "tiny", options) as guest:
        with pytest.raises(Exited, match=r"status 1: .*'no-such-device' is not a valid device model name"):
            guest.on()
        with pytest.raises(LabError, match="off"):
            guest.execute("query-status")


def test_death_of_qemu_ends_every_wait(guest: Guest) -> None:
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    assert guest._emulator
    os.kill(guest._emulator.pid, signal.SIGKILL)
    with pytest.raises(LabError, match=r"(?s)QEMU ended with status -9.*" + tiny.GREETING):
        guest.console.expect("never said", SECONDS)
    with pytest.raises(Exited, match="status -9"):
        guest.execute("query-status")
    with pytest.raises(Exited, match="status -9"):
        guest.wait_event("WATCHDOG", SECONDS)
    with pytest.raises(LabError, match="status -9"):
        guest.console.send("anybody there?")


def test_control_channel(guest: Guest) -> None:
    guest.prepare()
    assert guest.execute("query-status")["status"] == "prelaunch"
    guest.on()
    assert guest.execute("query-status")["status"] == "running"
    guest.wait_event("RESUME", SECONDS)
    with pytest.raises(Expired):
        guest.wait_event("WATCHDOG", 0.2)
    with pytest.raises(ExecuteError):
        guest.execute("set_link", name="no-such-card", up=True)
    with pytest.raises(LabError, match="on already"):
        guest.on()
    assert '"query-status"' in (guest.directory / "qmp.log").read_text()


def test_reset_button(guest: Guest) -> None:
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    guest.reset()
    guest.console.expect(tiny.GREETING, SECONDS)


def test_end_where_the_machine_would_reboot(image: Path, artefacts: Path) -> None:
    with Guest(tiny.BOARD, image, artefacts / "tiny", qemu.Options(reboot=False)) as guest:
        guest.on()
        guest.console.expect(tiny.GREETING, SECONDS)
        with pytest.raises(Expired, match="still runs"):
            guest.wait_off(0.2)
        guest.reset()
        guest.wait_off(SECONDS)
        with pytest.raises(LabError, match="switched off"):
            guest.console.expect("never said", SECONDS)


def test_power_cycle(guest: Guest) -> None:
    """Also: what the previous life said does not count as said by the next."""
    guest.on()
    guest.console.expect("tiny", SECONDS)
    guest.cut()
    assert not guest.running
    with pytest.raises(LabError, match="power was cut"):
        guest.console.expect("never said", SECONDS)
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    assert 0 < guest.seconds_to(tiny.GREETING) < SECONDS


def test_serial_port_from_the_first_byte(guest: Guest) -> None:
    guest.prepare()
    with closing(guest.port("COM2", timeout=SECONDS)) as device:
        guest.on()
        assert device.read_until().decode() == tiny.GREETING + "\r\n"
        device.write(b"$S")
        assert device.read(2) == b"$S"
    with pytest.raises(KeyError):
        guest.port("COM1")


def test_image_never_changes(guest: Guest, image: Path) -> None:
    before = hashlib.sha256(image.read_bytes()).hexdigest()
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    write_card(guest, 0xEE)
    guest.cut()
    assert first_sector(guest) == b"\xee" * 512, "the negative control: nothing was written"
    assert hashlib.sha256(image.read_bytes()).hexdigest() == before


def test_a_saved_guest_goes_on_and_so_does_each_that_is_restored(
    guest: Guest, image: Path, artefacts: Path, tmp_path: Path
) -> None:
    """With its memory and its card, and without another boot. Seen to fail with the card's first layer instead."""
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    write_card(guest, 0xEE)
    guest.save(tmp_path)
    write_card(guest, 0x55)
    guest.console.send("saved?")
    guest.console.expect(r"saved\?", SECONDS)
    guest.cut()
    for name in ("first", "second"):
        with Guest(tiny.BOARD, image, artefacts / name, qemu.Options(name=name)) as other:
            other.restore(tmp_path)
            other.console.send("restored?")
            other.console.expect(r"restored\?", SECONDS)
            assert tiny.GREETING not in other.console.text
            other.cut()
            assert first_sector(other) == b"\xee" * 512


def test_a_damaged_state_is_no_guest(guest: Guest, image: Path, artefacts: Path, tmp_path: Path) -> None:
    guest.on()
    guest.console.expect(tiny.GREETING, SECONDS)
    guest.save(tmp_path)
    machine = tmp_path / "machine"
    machine.write_bytes(machine.read_bytes()[: machine.stat().st_size // 2])
    with (
        Guest(tiny.BOARD, image, artefacts / "other", qemu.Options()) as other,
        pytest.raises(LabError, match="QEMU ended with status"),
    ):
        other.restore(tmp_path)


def test_card_is_larger_than_the_image(guest: Guest) -> None:
    guest.prepare()
    sizes = {node["node-name"]: node["image"]["virtual-size"] for node in guest.execute("query-named-block-nodes")}
    assert sizes["card"] == qemu.CARD_BYTES


def test_nothing_is_left_behind(image: Path, artefacts: Path) -> None:
    with Guest(tiny.BOARD, image, artefacts / "tiny") as guest:
        guest.on()
        assert guest._emulator
        pid = guest._emulator.pid
        assert Path(f"/proc/{pid}").exists()
    assert not Path(f"/proc/{pid}").exists()
    left = {file.name for file in guest.directory.iterdir()}
    assert left == {"console.log", "qmp.log", "qemu.command", "qemu.stderr", "steps.log"}


def test_nothing_outlives_a_killed_session(image: Path, artefacts: Path) -> None:
    """A test run that is killed cannot clean up; the kernel does."""
    script = f"""
from pathlib import Path
from flotilla.lab.qemu import tiny
from flotilla.lab.qemu.guest import Guest
guest = Guest(tiny.BOARD, Path({str(image)!r}), Path({str(artefacts / "tiny")!r}))
guest.on()
print(guest._emulator.pid, flush=True)
guest.console.expect("never said", {SECONDS})
"""
    with subprocess.Popen([sys.executable, "-c", script], cwd=paths.PROJECT, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout
        emulator = os.pidfd_open(int(run.stdout.readline()))
        run.kill()
    with closing(os.fdopen(emulator, "rb")):
        # A process descriptor becomes readable when the process ends.
        assert _readable(emulator, SECONDS), "QEMU still runs"


@pytest.mark.parametrize("verdict", ["pass", "fail"])
def test_evidence_is_kept_of_failures_only(verdict: str, tmp_path: Path) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_inner.py").write_text(
        "def test_it(artefacts):\n"
        "    (artefacts / 'console.log').write_text('last words')\n"
        f"    assert {verdict == 'pass'}\n"
    )
    argv = [sys.executable, "-m", "pytest", "-p", "tests.artefacts", "-p", "no:cacheprovider", str(tmp_path)]
    environment = os.environ | {"BUILD": str(tmp_path / "build")}
    done = subprocess.run(argv, cwd=paths.PROJECT, env=environment, capture_output=True, text=True, check=False)
    evidence = tmp_path / "build/test-artefacts/test_inner.test_it"
    if verdict == "pass":
        assert done.returncode == 0, done.stdout + done.stderr
        assert not evidence.exists()
    else:
        assert done.returncode == 1, done.stdout + done.stderr
        assert (evidence / "console.log").read_text() == "last words"
        assert str(evidence) in done.stdout


def test_segment_joins_robots_and_leads_to_their_ssh(artefacts: Path) -> None:
    """A few lines of Python stand for two robots."""
    mac = bytes.fromhex(qemu.robot_mac(3).replace(":", ""))
    with (
        Segment(NETWORK, [ROBOT, OTHER], STATION, artefacts / "segment") as segment,
        _plugged(segment.link(ROBOT)) as robot,
        _plugged(segment.link(OTHER)) as other,
    ):
        question = b"\xff" * 6 + mac + struct.pack("!HHHBBH", 0x806, 1, 0x800, 6, 4, 1)
        question += mac + ROBOT.packed + bytes(6) + STATION.packed
        robot.send(question)
        assert other.recv(2048) == question
        # The station answers, and it is the first thing to come: nobody hears himself.
        answer = robot.recv(2048)
        assert (answer[:6], answer[20:22], answer[28:32]) == (mac, b"\0\x02", STATION.packed)
        with socket.create_connection(("127.0.0.1", segment.ssh_port(ROBOT)), SECONDS):
            call = robot.recv(2048)
            assert (call[:6], call[26:34], call[36:38]) == (mac, STATION.packed + ROBOT.packed, b"\0\x16")


def test_pulled_cable(image: Path, artefacts: Path) -> None:
    link = qemu.UserLink(NETWORK.subnet, ROBOT, STATION)
    with Guest(tiny.BOARD, image, artefacts / "tiny", qemu.Options(link=link), capture=True) as guest:
        guest.on()
        assert 1024 <= guest.ssh_port() < 65536
        guest.cable(plugged=False)
        guest.cable(plugged=True)
        assert (guest.directory / "wire.pcap").read_bytes()[:4] == struct.pack("=I", 0xA1B2C3D4)


def write_card(guest: Guest, byte: int) -> None:
    """Fill the card's first sector by the monitor, through the disk as the guest would. What goes wrong is not said."""
    (disk,) = (each["qdev"] for each in guest.execute("query-block") if each.get("inserted"))
    for command in (f"write -P {byte:#x} 0 512", "flush"):
        guest.execute("human-monitor-command", command_line=f'qemu-io -d {disk} "{command}"')


def first_sector(guest: Guest) -> bytes:
    """Of the card of a guest that is off."""
    overlay, out = guest.directory / "card.qcow2", guest.directory / "sector"
    argv = [qemu.find_tool("qemu-img"), "dd", "-f", "qcow2", "-O", "raw", "bs=512", "count=1", f"if={overlay}"]
    subprocess.run([*argv, f"of={out}"], check=True)
    return out.read_bytes()


def _readable(descriptor: int, seconds: float) -> bool:
    return bool(select.select([descriptor], [], [], seconds)[0])


def _plugged(wire: qemu.Wire) -> socket.socket:
    """A socket that sends and receives Ethernet frames on a cable, as QEMU's do."""
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.settimeout(SECONDS)
    end.bind(("127.0.0.1", wire.here))
    end.connect(("127.0.0.1", wire.there))
    return end
