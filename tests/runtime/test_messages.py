"""A further message is data: added to messages.yml, it goes from task to task by the real runtime and both
transports, and into a recording that readers decode which share nothing with what wrote it."""

from __future__ import annotations

import json
import os
import select
import shutil
import struct
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.fleet import identity, inventory, message_keys
from flotilla.fleet.model import Fleet
from flotilla.station import station_keys, telemetry
from flotilla.station.receiver import Receiver, drain, listen
from flotilla.station.record import Recorder
from tests.running import DDS_ON_LOOPBACK, PATIENCE, free_port, running
from tests.station import decoded, on_loopback, pymcap

MESSAGES = """
probe:
  sender: source
  receiver: sink
  port: {probe}
  rate_hz: 100
  deadline_ms: 1000
  signals:
    step: {{ type: uint64 }}
    wide: {{ type: double, width: 3, unit: [s, m, "1"] }}
    right: {{ type: boolean }}
    small: {{ type: int16 }}

sink-heard:
  sender: sink
  receiver: stations
  port: {heard}
  rate_hz: 50
  every: 2
  signals:
    small: {{ type: int16 }}
    step: {{ type: uint64 }}
    wide: {{ type: double, width: 3, unit: [s, m, "1"] }}
    fresh: {{ type: boolean }}
    half: {{ type: double, unit: s }}
"""
SOURCE = """
period: 10 ms
priority: 0
blocks:
  clock: { type: clock }
  wide: { type: join, in: { in0: clock.time, in1: -1.5, in2: 2 }, parameters: { inputs: 3 } }
  message:
    type: pack
    in: { step: clock.step, wide: wide.out, right: 1, small: -7 }
    parameters:
{{ message("probe").layout }}
  to_sink:
{{ message("probe").send("message.out") }}
"""
SINK = """
period: 10 ms
priority: 0
trigger: probe
blocks:
  probe:
{{ message("probe").receive }}
  in:
    type: unpack
    in: { in: probe.data }
    parameters:
{{ message("probe").layout }}
  half: { type: gain, in: { in: "in.wide[0]" }, parameters: { factor: 0.5 } }
  heard:
    type: pack
    every: {{ message("sink-heard").every }}
    in: { small: in.small, step: in.step, wide: in.wide, fresh: probe.flag, half: half.out }
    parameters:
{{ message("sink-heard").layout }}
  to_station:
{{ message("sink-heard").send("heard.out") }}
"""
HEARD = struct.Struct("<hQ3d?d")
MANY = 20
"""Reports that are waited for."""


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """One on loopback, whose robot 1 has the tasks `source` and `sink`."""
    tasks = tmp_path / "control_tasks"
    shutil.copytree(paths.TASKS, tasks)
    with (tasks / paths.MESSAGES).open("a") as file:
        file.write(MESSAGES.format(probe=free_port(), heard=free_port()))
    (tasks / "source.yml").write_text(SOURCE)
    (tasks / "sink.yml").write_text(SINK)
    monkeypatch.setattr(paths, "TASKS", tasks)
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    described = inventory.load_fleet(on_loopback(tmp_path / "inventory", "127.0.0."))  # as robot 1's tasks send
    robot = described.robots[1].model_copy(update={"control_tasks": ["source", "sink"]})
    # Tests at the same time do not hear each other.
    network = described.network.model_copy(update={"dds_domain": 1 + os.getpid() % 200, "udp_ports": ["1024-65535"]})
    return described.model_copy(update={"robots": {1: robot}, "network": network})


class Heard:
    """A sink that keeps what it gets, in the order of HEARD."""

    def __init__(self) -> None:
        self.messages: list[tuple[Any, ...]] = []

    def take(self, stream: telemetry.Stream, values: Mapping[str, Any], received_ns: int) -> None:
        names = ("small", "step", "wide", "fresh", "half")
        small, step, wide, fresh, half = (values[name] for name in names)
        self.messages.append((small, step, *wide, fresh, half))

    def refresh(self) -> None:
        """Nothing is shown."""

    def end(self) -> str:
        return ""


def by(transport: str, fleet: Fleet) -> Fleet:
    return fleet.model_copy(update={"network": fleet.network.model_copy(update={"transport": transport})})


@pytest.mark.parametrize("transport", ["udp", "dds"])
def test_a_message_is_added_by_data_alone(transport: str, fleet: Fleet, flotilla_run: Path, tmp_path: Path) -> None:
    """Seen to fail with big-endian numbers, with gaps in the layout, and with names in another order than types."""
    fleet = by(transport, fleet)
    texts = {name: task.decode() for name, task in identity.control_tasks(fleet, fleet.robots[1]).items()}
    robot = fleet.robots[1]
    keys = message_keys.read().lines(robot, identity.hosts(fleet))
    (tmp_path / message_keys.CREDENTIAL).write_text(keys)
    (stream,) = telemetry.streams(fleet)
    assert (stream.topic, stream.length, stream.every) == ("/robot1/sink/heard", HEARD.size, 2)
    file = tmp_path / "a.mcap"
    receiver, recorder = Receiver([stream], station_keys.of_telemetry(fleet)), Recorder([stream], file)
    heard = Heard()
    receiver.sinks += [recorder, heard]
    command: list[str | Path] = [flotilla_run, "--blocks", str(flotilla_run.parent)]
    with ExitStack() as stack:
        (station,) = listen([stream.port], "127.0.0.254")
        stack.enter_context(station)
        for name in ("sink", "source"):
            environment = {"CYCLONEDDS_URI": DDS_ON_LOOPBACK, "CREDENTIALS_DIRECTORY": str(tmp_path)}
            stack.enter_context(running(command, tmp_path / f"{name}.yml", texts[name], environment))
        while sum(fresh for *_, fresh, _ in heard.messages) < MANY:
            assert select.select([station], [], [], PATIENCE)[0], receiver.summary
            drain(station, receiver)
            assert len(heard.messages) < 100 * MANY, receiver.summary
    recorder.end()
    count = receiver.counts[stream.topic]
    assert (receiver.strangers, count.refused, count.forged) == (0, 0, 0)
    assert 0 < count.replayed < 10, "those before the robot has answered the challenge"
    # What blocks packed, unpacked and packed again.
    for small, step, time_s, minus, two, fresh, half in heard.messages:
        if fresh:
            assert (small, minus, two, half) == (-7, -1.5, 2, pytest.approx(time_s / 2))
            periods = time_s / 0.01  # some may have been skipped
            assert step <= round(periods) == pytest.approx(periods, abs=1e-6)
    # What is recorded of it, by the file's own schema.
    recorded = [
        (message.small, message.step, *message.wide, message.fresh, message.half) for _, message in decoded(file)
    ]
    assert recorded == heard.messages
    (schema,) = json.loads(pymcap("info-json", file).stdout)["schemas"]
    assert schema["name"] == "flotilla.SinkHeard"
    doctor = pymcap("doctor", file)
    assert doctor.returncode == 0, doctor.stdout
