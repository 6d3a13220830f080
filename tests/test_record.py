"""Recording what robots tell the station: by the real program, read back as a viewer would."""

from __future__ import annotations

import io
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, SeekingReader

from images.builder import inventory, paths
from runtime.station import telemetry
from runtime.station.receiver import Receiver
from runtime.station.record import Recorder
from tests.running import PATIENCE, running
from tests.station import ADDRESS, FLEET, Messages, Robots, contiguous, message_class, on_loopback, station, steps

SENDER = """
period: 2 ms
blocks:
  clock: {type: clock}
  wide: {type: join, in: {in0: clock.time, in1: -1.5, in2: 2}, parameters: {inputs: 3}}
  report:
    type: pack
    in: {step: clock.step, good: 1, wide: wide.out, small: -7}
    parameters:
      names: [step, good, wide, small]
      types: [uint64, boolean, double, int16]
      widths: [1, 1, 3, 1]
      alignment: 8
  out: {type: udp-send, in: {data: report.out}, parameters: {address: 127.0.0.1, port: PORT, length: 42}}
"""


def decoded(file: Path, *, whole: bool = True) -> Messages:
    """All messages, decoded by the file's own schemas alone. A file that is not `whole` has no index and no end."""
    data = io.BytesIO(file.read_bytes())
    reader = SeekingReader(data, validate_crcs=True) if whole else NonSeekingReader(data, validate_crcs=True)
    kinds: dict[int, type[Any]] = {}
    found: Messages = []
    try:
        for schema, channel, message in reader.iter_messages(log_time_order=whole):  # which would wait for the end
            assert schema is not None
            if schema.id not in kinds:
                kinds[schema.id] = message_class(schema.name, schema.data)
            assert message.sequence == sum(topic == channel.topic for topic, _ in found)
            found.append((channel.topic, kinds[schema.id].FromString(message.data)))
    except EndOfFile:
        assert not whole
    return found


def pymcap(command: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """By a reader that shares nothing with the writer."""
    argv = [str(Path(sys.executable).with_name("pymcap-cli")), command, *map(str, arguments)]
    return subprocess.run(argv, capture_output=True, text=True, check=False, timeout=PATIENCE)


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return on_loopback(tmp_path / "inventory")


def grown(file: Path, size: int) -> Callable[[], bool]:
    return lambda: file.exists() and file.stat().st_size > size


def test_streams_are_what_tasks_send_to_the_station() -> None:
    streams = {stream.topic: stream for stream in telemetry.streams(inventory.load_fleet(FLEET))}
    assert {topic: (stream.address, stream.port, stream.length) for topic, stream in streams.items()} == {
        "/robot1/valves/report": ("170.160.1.1", 5020, 81),
        "/robot3/control/report": ("170.160.1.3", 5021, 98),
    }


def test_what_a_task_packs_is_what_is_read(flotilla_run: Path, tmp_path: Path) -> None:
    """The real blocks send. Seen to fail with the alignment left out, and with big-endian numbers."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        text = SENDER.replace("PORT", str(one.getsockname()[1]))
        task = yaml.load(text, yaml.BaseLoader)
        (stream,) = telemetry.of_task("robot1", "127.0.0.1", "sender", task, {"127.0.0.1"})
        assert stream.length == 42
        one.settimeout(PATIENCE)
        out = tmp_path / "a.mcap"
        recorder = Recorder([stream], out)
        receiver = Receiver([stream])
        receiver.sinks.append(recorder)
        with running([flotilla_run], tmp_path / "sender.yml", text):
            for _ in range(50):
                receiver.take(one.recv(100), "127.0.0.1", stream.port, time.time_ns())
        recorder.end()
    messages = [message for _, message in decoded(out)]
    assert contiguous([message.step for message in messages])
    assert len(messages) == 50
    assert {(message.good, *message.wide[1:], message.small) for message in messages} == {(True, -1.5, 2.0, -7)}
    periods = [message.wide[0] / 0.002 for message in messages]
    assert periods == pytest.approx([round(each) for each in periods], abs=1e-6)


def test_all_that_was_sent_is_recorded_and_nothing_else(fleet: Path, tmp_path: Path) -> None:
    robots, out = Robots(fleet), tmp_path / "a.mcap"
    with station(fleet, "--record", out) as process:
        robots.until(grown(out, 2000))
        robots.send("valves", b"short")
        robots.send("valves", address="127.0.0.9")
        robots.sent["valves"] -= 1  # the stranger's does not count
        robots.until(grown(out, out.stat().st_size))
        process.send_signal(signal.SIGINT)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, complaints
    assert "/robot1/valves/report: " in said
    assert ", 1 of a wrong length left out" in said
    assert "1 datagrams of strangers left out" in said
    messages = decoded(out)
    begun = {task: steps(messages, stream.topic)[0] for task, stream in robots.streams.items()}
    for task, stream in robots.streams.items():
        recorded = steps(messages, stream.topic)
        assert recorded == list(range(begun[task], robots.sent[task]))
        assert f"{stream.topic}: {len(recorded)} received" in said
    channels = json.loads(pymcap("info-json", out).stdout)["channels"]
    counts = {channel["topic"]: channel["message_count"] for channel in channels}
    assert counts == {stream.topic: robots.sent[task] - begun[task] for task, stream in robots.streams.items()}
    # Seen to complain of an index of attachments where there are none.
    doctor = pymcap("doctor", out)
    assert doctor.returncode == 0, doctor.stdout


def test_a_killed_recorder_leaves_what_it_had(fleet: Path, tmp_path: Path) -> None:
    """Seen to fail without the flush each second: the file is empty."""
    robots, out = Robots(fleet), tmp_path / "a.mcap"
    with station(fleet, "--record", out) as process:
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
    robots, out = Robots(fleet), tmp_path / "a.mcap"
    with station(fleet, "--record", out, under=("prlimit", "--fsize=20000")) as process:
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
    with station(fleet, "--record", out) as process:
        assert "a.mcap is there already" in process.communicate(timeout=PATIENCE)[1]
    assert out.read_text() == "precious"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((ADDRESS, 5020))
        with station(fleet, "--record", tmp_path / "b.mcap") as process:
            assert "UDP port 5020 of 127.0.0.254: Address already in use" in process.communicate(timeout=PATIENCE)[1]
    with station(paths.INVENTORY, "--record", tmp_path / "b.mcap") as process:
        assert "no control task sends to a station" in process.communicate(timeout=PATIENCE)[1]
    assert not (tmp_path / "b.mcap").exists()
