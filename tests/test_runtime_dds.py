"""DDS topics between two tasks of the real executive, by the plug-in, on loopback without multicast."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PATIENCE = 30  # s, for what takes about one

CONFIGURATION = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>4</MaxAutoParticipantIndex>
    <Peers><Peer Address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""

SENDER = """
period: 10 ms
priority: 0
blocks:
  wrench: {{type: constant, parameters: {{value: [0.25, -0.5, 0.125]}}}}
  out: {{type: dds-publish, in: {{wrench: wrench.out}}, parameters: {parameters}}}
"""

RECEIVER = """
period: 10 ms
priority: 0
blocks:
  in: {{type: dds-subscribe, parameters: {parameters}}}
"""

PARAMETERS = "{{type: wrench, topic: wrench, robot: 2, domain: {domain}, reliability: reliable{more}}}"

Row = dict[str, Any]
Start = Callable[..., Any]


def until(process: subprocess.Popen[str], wanted: Callable[[Row], bool]) -> Row:
    """The first row that is as wanted."""
    assert process.stdout
    deadline = time.monotonic() + PATIENCE
    row: Row = {}
    for line in process.stdout:
        row = json.loads(line)
        if wanted(row):
            return row
        assert time.monotonic() < deadline, f"not within {PATIENCE} s; the last row was {row}"
    raise AssertionError(f"the task ended, status {process.wait()}; the last row was {row}")


@pytest.fixture
def start(flotilla_run: Path, tmp_path: Path) -> Start:
    plugin = flotilla_run.parent / "dds.so"
    assert plugin.exists(), "the runtime was built without Cyclone DDS, which tests/host-packages.txt names"

    @contextmanager
    def run(name: str, text: str, watched: str) -> Iterator[subprocess.Popen[str]]:
        path = tmp_path / f"{name}.yml"
        path.write_text(text)
        command = [str(flotilla_run), "--blocks", str(flotilla_run.parent), "--watch", watched, str(path)]
        environment = {**os.environ, "CYCLONEDDS_URI": CONFIGURATION}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            try:
                yield process
            finally:
                process.kill()

    return run


def test_a_topic_between_two_tasks(start: Start) -> None:
    domain = 1 + os.getpid() % 200
    sender = SENDER.format(parameters=PARAMETERS.format(domain=domain, more=""))
    receiver = RECEIVER.format(parameters=PARAMETERS.format(domain=domain, more=", timeout: 0.5"))
    with start("receiver", receiver, "in.wrench,in.flag,in.sequence,in.peers") as hearing:
        assert until(hearing, lambda row: row["step"] >= 10)["in.flag"] == 0
        for _ in range(2):  # the second time the sender comes back
            with start("sender", sender, "out.written") as telling:
                row = until(hearing, lambda row: row["in.flag"] == 1)
                assert row["in.wrench"] == [0.25, -0.5, 0.125]
                heard = row["in.sequence"]
                until(hearing, lambda row, heard=heard: row["in.sequence"] > heard + 20)  # type: ignore[misc]
                telling.kill()
                until(hearing, lambda row: row["in.flag"] == 0)
