"""DDS topics between two tasks of the real executive, by the plug-in, on loopback without multicast."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.running import DDS_ON_LOOPBACK, PATIENCE, Task, running

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

ROS_SENDER = """
period: 10 ms
priority: 0
blocks:
  out:
    type: ros-publish
    in: {{linear: [0.25, 0, 0], angular: [0, 0, -0.5]}}
    parameters: {{type: geometry_msgs/msg/Twist, topic: cmd_vel, domain: {domain}}}
"""

ROS_RECEIVER = """
period: 10 ms
priority: 0
blocks:
  in: {{type: ros-subscribe, parameters: {{type: geometry_msgs/msg/Twist, topic: cmd_vel, domain: {domain}}}}}
"""

PARAMETERS = "{{type: wrench, topic: wrench, robot: 2, domain: {domain}, reliability: reliable{more}}}"

DOMAIN = 1 + os.getpid() % 200
"""So that tests at the same time do not hear each other."""

Start = Callable[..., Any]


@pytest.fixture
def start(flotilla_run: Path, tmp_path: Path) -> Start:
    plugin = flotilla_run.parent / "dds.so"
    assert plugin.exists(), "the runtime was built without Cyclone DDS, which runtime/host-packages.txt names"

    blocks = str(flotilla_run.parent)
    environment = {"CYCLONEDDS_URI": DDS_ON_LOOPBACK}
    return lambda name, text, watched: running(
        [flotilla_run, "--blocks", blocks, "--watch", watched], tmp_path / f"{name}.yml", text, environment
    )


def test_a_topic_between_two_tasks(start: Start) -> None:
    sender = SENDER.format(parameters=PARAMETERS.format(domain=DOMAIN, more=""))
    receiver = RECEIVER.format(parameters=PARAMETERS.format(domain=DOMAIN, more=", timeout: 0.5"))
    with start("receiver", receiver, "in.wrench,in.flag,in.sequence,in.peers") as hearing:
        assert hearing.until(lambda row: row["step"] >= 10)["flag"] == 0
        for _ in range(2):  # the second time the sender comes back
            with start("sender", sender, "out.written") as telling:
                row = hearing.until(lambda row: row["flag"] == 1)
                assert row["wrench"] == [0.25, -0.5, 0.125]
                heard = row["sequence"]
                hearing.until(lambda row, heard=heard: row["sequence"] > heard + 20)
                telling.signal(signal.SIGKILL)
                hearing.until(lambda row: row["flag"] == 0)


def test_a_message_of_ros_between_two_tasks(start: Start) -> None:
    """test_ros.py has others at the other end."""
    outputs = "in.linear,in.angular,in.flag"
    with (
        start("receiver", ROS_RECEIVER.format(domain=DOMAIN), outputs) as hearing,
        start("sender", ROS_SENDER.format(domain=DOMAIN), "out.written"),
    ):
        row = hearing.until(lambda row: row["flag"] == 1)
    assert (row["linear"], row["angular"]) == ([0.25, 0, 0], [0, 0, -0.5])


def test_stacks_of_dds_are_small(start: Start) -> None:
    """Memory is locked, and stacks count in full; our threads have 32 kB more, for handlers of signals. Seen to fail
    without the default that privilege_lock_memory sets."""
    sender = SENDER.format(parameters=PARAMETERS.format(domain=DOMAIN, more=""))
    with start("sender", sender, "out.written") as telling:
        telling.until(lambda row: row["step"] >= 10)
        own = Path(f"/proc/{telling.process.pid}")
        threads = [path.read_text().strip() for path in own.glob("task/*/comm")]
        spans = [line.split()[0].split("-") for line in (own / "maps").read_text().splitlines() if " rw-p " in line]
    stacks = sum(int(end, 16) - int(begin, 16) in (256 << 10, 288 << 10) for begin, end in spans)
    assert "recv" in threads
    assert stacks >= len(threads) - 1, f"{stacks} stacks of that size for {threads}"


ADAPTER = "robot0"
_MAKE = f"ip link add {ADAPTER} type veth peer name other0; ip address add 10.77.0.1/24 dev {ADAPTER}"
_UP = f"ip link set {ADAPTER} up; ip link set other0 up"

BOTH_WAYS = """
period: 10 ms
priority: 0
blocks:
  out:
    type: dds-publish
    in: {{wrench: [1, 2, 3]}}
    parameters: {{type: wrench, topic: w, robot: 1, domain: {domain}}}
  in: {{type: dds-subscribe, parameters: {{type: wrench, topic: w, robot: 1, domain: {domain}}}}}
"""


class Networked:
    """A task in a network namespace of its own, whose adapter comes and goes."""

    def __init__(self, task: Task, log: Path) -> None:
        self.task = task
        self._log = log

    def network(self, commands: str) -> None:
        """Change its network."""
        there = ["nsenter", "--target", str(self.task.process.pid), "--user", "--preserve-credentials", "--net"]
        subprocess.run([*there, "sh", "-e", "-c", commands], check=True)

    def lines(self) -> list[str]:
        """What it has logged, but for remarks about the computer."""
        return [line for line in self._log.read_text().splitlines() if "DDS" in line or "ddsi" in line]


@pytest.fixture
def networked(flotilla_run: Path, tmp_path: Path) -> Callable[[str], Any]:
    """`networked(commands)`: with a network that these make."""

    @contextmanager
    def start(commands: str) -> Iterator[Networked]:
        log = tmp_path / "log"
        # The worst configuration: threads of single sockets.
        chosen = DDS_ON_LOOPBACK.replace('"lo" multicast="false"', f'"{ADAPTER}"').replace("127.0.0.1", "10.77.0.1")
        internal = "<Internal><MultipleReceiveThreads>true</MultipleReceiveThreads></Internal>"
        environment = {"CYCLONEDDS_URI": chosen.replace("</Domain>", f"{internal}</Domain>")}
        here = ["unshare", "--user", "--map-root-user", "--net"]
        command: list[str | Path] = [*here, "sh", "-e", "-c", f'{commands}; exec "$@" 2>{log}', "sh", flotilla_run]
        options: list[str | Path] = ["--blocks", flotilla_run.parent, "--watch", "out.written,in.flag"]
        text = BOTH_WAYS.format(domain=DOMAIN)
        with running([*command, *options], tmp_path / "networked.yml", text, environment) as task:
            yield Networked(task, log)

    return start


def test_a_task_ends_after_its_network_adapter_has_gone(networked: Callable[[str], Any]) -> None:
    """Seen to fail: the task did not end, because Cyclone waited for its thread recvUC, and 100 lines a second were
    logged, one for each sample."""
    with networked(f"{_MAKE}; {_UP}") as robot:
        written = robot.task.until(lambda row: row["out.written"] > 20)["out.written"]
        robot.network(f"ip link delete {ADAPTER}")
        robot.task.until(lambda row: row["out.written"] > written + 200)
        robot.task.signal(signal.SIGTERM)
        robot.task.process.communicate(timeout=PATIENCE)
        assert robot.task.process.returncode == 0
        assert len(robot.lines()) <= 3, robot.lines()  # each says another thing


def test_one_line_while_dds_is_not_available(networked: Callable[[str], Any]) -> None:
    """Seen to fail: two lines a second for each block."""
    with networked("ip link set lo up") as robot:
        robot.task.until(lambda row: row["step"] >= 350)  # three attempts at the least
        (line,) = robot.lines()
        assert line.endswith(f": DDS domain {DOMAIN}: {ADAPTER}: does not match an available interface; retrying"), line
        robot.network(f"{_MAKE}; {_UP}")
        robot.task.until(lambda row: row["in.flag"] == 1)
        (again,) = robot.lines()[1:]
        assert again.endswith(f": DDS domain {DOMAIN} is available"), again
