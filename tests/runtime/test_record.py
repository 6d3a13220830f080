"""Recording what robots tell the station: by the real program, read back as a viewer would."""

from __future__ import annotations

import json
import re
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet import inventory
from flotilla.station import telemetry
from tests.running import PATIENCE
from tests.station import ADDRESS, FLEET, STRANGER, Robots, contiguous, decoded, on_loopback, pymcap, station, steps


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return on_loopback(tmp_path / "inventory")


def grown(file: Path, size: int) -> Callable[[], bool]:
    return lambda: file.exists() and file.stat().st_size > size


def test_streams_are_what_tasks_send_to_the_station() -> None:
    streams = {stream.topic: stream for stream in telemetry.streams(inventory.load_fleet(FLEET))}
    assert {topic: (stream.address, stream.port, stream.length) for topic, stream in streams.items()} == {
        "/robot1/valves/report": ("170.160.1.1", 5020, 89),
        "/robot3/control/report": ("170.160.1.3", 5021, 98),
    }


def test_all_that_was_sent_is_recorded_and_nothing_else(fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with Robots(fleet) as robots, station(fleet, "record", out) as process:
        robots.until(grown(out, 2000))
        robots.repeat("valves")
        robots.send("valves", b"short")
        robots.send_raw("valves", bytes(129), STRANGER)
        robots.send_raw("valves", bytes(129))
        robots.until(grown(out, out.stat().st_size))
        process.send_signal(signal.SIGINT)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, complaints
    assert "/robot1/valves/report: " in said
    assert "1 datagrams of strangers left out" in said
    messages = decoded(out)
    begun = {task: steps(messages, stream.topic)[0] for task, stream in robots.streams.items()}
    found = re.search(r", 1 of a wrong length, 1 forged and (\d+) replayed left out", said)
    assert found, said
    assert int(found[1]) >= 2, "the repeated one, and what came before the robot had answered the station's challenge"
    for task, stream in robots.streams.items():
        recorded = steps(messages, stream.topic)
        assert recorded == list(range(begun[task], robots.sent[task]))
        assert f"{stream.topic}: {len(recorded)} received" in said
    channels = json.loads(pymcap("info-json", out).stdout)["channels"]
    counts = {channel["topic"]: channel["message_count"] for channel in channels}
    expected = {stream.topic: robots.sent[task] - begun[task] for task, stream in robots.streams.items()}
    assert counts == expected | {"/robot3/control/report/pose": expected["/robot3/control/report"]}
    # Seen to complain of an index of attachments where there are none.
    doctor = pymcap("doctor", out)
    assert doctor.returncode == 0, doctor.stdout


def test_a_killed_recorder_leaves_what_it_had(fleet: Path, tmp_path: Path) -> None:
    """Seen to fail without the flush each second: the file is empty."""
    out = tmp_path / "a.mcap"
    with Robots(fleet) as robots, station(fleet, "record", out) as process:
        robots.until(grown(out, 4000))
        process.kill()
        process.wait(PATIENCE)
    for stream in robots.streams.values():
        recorded = steps(decoded(out, whole=False), stream.topic)
        assert len(recorded) > 20
        assert contiguous(recorded)
    assert "BAD_TRAILING_MAGIC" in pymcap("doctor", "--format", "jsonl", out).stdout, "a doctor that finds nothing"


def test_a_full_disk_leaves_what_was_recorded(fleet: Path, tmp_path: Path) -> None:
    """A limit on the file's size stands in for the disk's. Seen to fail without cutting off the half chunk."""
    out = tmp_path / "a.mcap"
    with Robots(fleet) as robots, station(fleet, "record", out, under=("prlimit", "--fsize=20000")) as process:
        robots.until(lambda: process.poll() is not None)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1, said
    assert "a.mcap: File too large; what was recorded before is in it" in complaints
    for stream in robots.streams.values():
        recorded = steps(decoded(out, whole=False), stream.topic)
        assert recorded
        assert contiguous(recorded)


def test_what_cannot_be_recorded_is_said(fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    out.write_text("precious")
    with station(fleet, "record", out) as process:
        assert "a.mcap is there already" in process.communicate(timeout=PATIENCE)[1]
    assert out.read_text() == "precious"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((ADDRESS, 5020))
        with station(fleet, "record", tmp_path / "b.mcap") as process:
            assert f"UDP port 5020 of {ADDRESS}: Address already in use" in process.communicate(timeout=PATIENCE)[1]
    nowhere = {"KEYS": str(tmp_path / "nowhere")}
    with station(fleet, "record", tmp_path / "b.mcap", environment=nowhere) as process:
        complaints = process.communicate(timeout=PATIENCE)[1]
    assert (
        "nowhere/fleet_secret: is missing, so reports of robots cannot be authenticated; bring it from where"
        in complaints
    )
    assert not (tmp_path / "nowhere").exists(), "a new secret would be no robot's"
    with station(paths.INVENTORY, "record", tmp_path / "b.mcap") as process:
        assert "no control task sends to a station" in process.communicate(timeout=PATIENCE)[1]
    assert not (tmp_path / "b.mcap").exists()
