"""Messages of ROS 2 between the blocks and an implementation that shares no code with them, in both directions.

Dust DDS finds and carries them (`ros_computer.py`); rosbags has their definitions, and makes and reads their bytes. The
robot and the other computer are network namespaces of their own, so frames have the size that a radio's have.
"""

from __future__ import annotations

import json
import math
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import numpy
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from flotilla.common import paths
from flotilla.lab.qemu.radio import Radio
from tests.running import Task, judged_by_outcomes

ROBOT, COMPUTER = "10.42.0.1", "10.42.0.254"
"""As in the manual."""
ROS: Any = get_typestore(Stores.ROS2_HUMBLE)
LITTLE_ENDIAN = bytes([0, 1, 0, 0])
"""The header of plain CDR (DDSI-RTPS 2.5, 10.2)."""
STAMP = (1_700_000_000, 123_456_789)
DDS = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="radio0"/></Interfaces>
    <AllowMulticast>spdp</AllowMulticast>
    <MaxMessageSize>1400B</MaxMessageSize><FragmentSize>1300B</FragmentSize>
  </General>
</Domain></CycloneDDS>
"""
"""A robot's, but for multicast, by which Dust DDS finds others."""


@dataclass(frozen=True)
class Case:
    """A message: each value differs from the others, and is exact as a single float."""

    ports: Mapping[str, tuple[str, Any]]
    """By port: the member in ROS's definition, and its value."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    strings: Mapping[str, str] = field(default_factory=dict)
    """By parameter, and member: what ros-publish writes."""

    @property
    def values(self) -> dict[str, Any]:
        return {port: value for port, (_, value) in self.ports.items()}

    @property
    def members(self) -> dict[str, Any]:
        return dict(self.ports.values()) | {name.replace(":", "."): text for name, text in self.strings.items()}


def several(count: int, first: float) -> list[float]:
    return [first + 0.125 * number for number in range(count)]


FRAME = {"header.frame_id": "laser"}
CASES = {
    "geometry_msgs/msg/Twist": Case({"linear": ("linear", [0.5, -0.25, 1.0]), "angular": ("angular", [2, 3, 4])}),
    "nav_msgs/msg/Odometry": Case(
        {
            "position": ("pose.pose.position", [1.5, -2, 3]),
            "orientation": ("pose.pose.orientation", [0.5, 0.25, -0.125, 1]),
            "pose_covariance": ("pose.covariance", several(36, 100)),
            "linear": ("twist.twist.linear", [4, 5, 6]),
            "angular": ("twist.twist.angular", [7, 8, 9]),
            "twist_covariance": ("twist.covariance", several(36, 200)),
        },
        strings={"header.frame_id": "odom", "child_frame_id": "base"},
    ),
    "sensor_msgs/msg/LaserScan": Case(
        {
            "angle_min": ("angle_min", -2.5),
            "angle_max": ("angle_max", 2.5),
            "angle_increment": ("angle_increment", 0.25),
            "time_increment": ("time_increment", 0.125),
            "scan_time": ("scan_time", 0.0625),
            "range_min": ("range_min", 0.03125),
            "range_max": ("range_max", 30),
            "ranges": ("ranges", several(1081, 1)),
            "intensities": ("intensities", several(1081, 1000)),
        },
        {"lengths": [1081, 1081]},
        FRAME,
    ),
    "sensor_msgs/msg/Imu": Case(
        {
            "orientation": ("orientation", [0.5, 0.25, -0.125, 1]),
            "orientation_covariance": ("orientation_covariance", several(9, 10)),
            "angular_velocity": ("angular_velocity", [1.5, -2, 3]),
            "angular_velocity_covariance": ("angular_velocity_covariance", several(9, 20)),
            "linear_acceleration": ("linear_acceleration", [4, 5, 6]),
            "linear_acceleration_covariance": ("linear_acceleration_covariance", several(9, 30)),
        },
        strings=FRAME,
    ),
    "sensor_msgs/msg/BatteryState": Case(
        {
            "voltage": ("voltage", 12.5),
            "temperature": ("temperature", 25),
            "current": ("current", -1.5),
            "charge": ("charge", 4),
            "capacity": ("capacity", 5),
            "design_capacity": ("design_capacity", 6),
            "percentage": ("percentage", 0.75),
            "power_supply_status": ("power_supply_status", 2),
            "power_supply_health": ("power_supply_health", 1),
            "power_supply_technology": ("power_supply_technology", 3),
            "present": ("present", True),
            "cell_voltage": ("cell_voltage", several(3, 4)),
            "cell_temperature": ("cell_temperature", several(2, 20)),
        },
        {"lengths": [3, 2]},
        FRAME | {"location": "left", "serial_number": "A1"},
    ),
    "sensor_msgs/msg/Joy": Case(
        {"axes": ("axes", [0.5, -1, 0.25]), "buttons": ("buttons", [1, 0, 7, -8])}, {"lengths": [3, 4]}, FRAME
    ),
}


ABSENT: dict[str, Any] = {
    "sensor_msgs/msg/BatteryState": (
        {"voltage": 12.5, "present": True},
        ["temperature", "current", "charge", "capacity", "design_capacity", "percentage"],
        math.nan,
    ),
    "sensor_msgs/msg/Imu": (
        {"angular_velocity": [0, 0, 0.5], "orientation_covariance": several(9, 1)},
        ["orientation_covariance", "linear_acceleration_covariance"],
        -1,
    ),
}
"""By type: what a robot knows, members that say that it knows no more, and how they do (the comments in ROS's
definitions)."""
SCAN = """
period: 20 ms
priority: 0
blocks:
  ros:
    type: {block}
    in: {inputs}
    parameters: {{ type: sensor_msgs/msg/LaserScan, topic: robot1/scan, {shown} }}
"""
SCAN_INPUTS = {
    "angle_min": 0, "angle_max": 1, "angle_increment": 0.5, "range_min": 0, "range_max": 9, "ranges": [1, 2, 3]
}  # fmt: skip

# --- messages, by ROS's definitions ---


def default(kind: Any) -> Any:
    node, what = kind
    if node is Nodetype.NAME:
        return made(what, {})
    if node is Nodetype.BASE:
        return {"string": "", "bool": False}.get(what[0], 0)
    return numpy.zeros(what[1] if node is Nodetype.ARRAY else 0, what[0][1][0])


def made(name: str, members: Mapping[str, Any]) -> Any:
    """A message with these members, `pose.position` say, and zeros otherwise; a list fills members in their order."""
    values = {}
    for member, kind in ROS.fielddefs[name][1]:
        inner = {path.partition(".")[2]: each for path, each in members.items() if path.partition(".")[0] == member}
        value = inner.get("")
        if kind[0] is Nodetype.NAME and isinstance(value, list):
            names = [each for each, _ in ROS.fielddefs[kind[1]][1]]
            value = made(kind[1], dict(zip(names, value, strict=True)))
        elif kind[0] is Nodetype.NAME:
            value = made(kind[1], inner)
        elif kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) and value is not None:
            value = numpy.array(value, kind[1][0][1][0])
        values[member] = default(kind) if value is None else value
    return ROS.types[name](**values)


def member(message: Any, path: str) -> Any:
    """The value of a member: a list of what is in it where it is a structure or an array."""
    for name in path.split("."):
        message = getattr(message, name)
    if isinstance(message, numpy.ndarray):
        return message.tolist()
    if hasattr(message, "__msgtype__"):
        return [getattr(message, name) for name, _ in ROS.fielddefs[message.__msgtype__][1]]
    return message


def encoded(name: str, members: Mapping[str, Any]) -> bytes:
    data = bytes(ROS.serialize_cdr(made(name, members), name))
    assert data[:4] == LITTLE_ENDIAN
    return data[4:]


# --- the robot, and the other computer ---


@pytest.fixture
def cell(flotilla_run: Path) -> Iterator[Radio]:
    assert (flotilla_run.parent / "dds.so").exists(), "the runtime was built without Cyclone DDS"
    with Radio([ROBOT, COMPUTER], loss=0, seed=1) as radio:
        yield radio


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def robot(cell: Radio, flotilla_run: Path, tmp_path: Path) -> Callable[..., Any]:
    """Run a task with one block, and watch its outputs."""

    def start(block: str, outputs: str, parameters: Mapping[str, Any], inputs: Mapping[str, Any]) -> Any:
        described: dict[str, Any] = {"type": block, "parameters": parameters} | ({"in": inputs} if inputs else {})
        text = f"period: 20 ms\npriority: 0\nblocks:\n  ros: {json.dumps(described)}\n"
        file = tmp_path / "task.yml"
        file.write_text(judged_by_outcomes(text))
        watched = ",".join(f"ros.{each}" for each in outputs.split(","))
        argv: list[str | Path] = ["--blocks", flotilla_run.parent, "--watch", watched, file]
        return ended(cell.nodes[ROBOT].run("env", f"CYCLONEDDS_URI={DDS}", flotilla_run, *argv, cwd=tmp_path))

    return start


def blocks_of(language: str) -> list[str]:
    """What the manual shows in a language."""
    manual = (paths.PROJECT / "docs" / "how-to" / "ros.md").read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", manual, re.MULTILINE | re.DOTALL)


@pytest.fixture
def computer(cell: Radio) -> Callable[..., Any]:
    def start(*words: str) -> Any:
        argv = [sys.executable, "-m", "tests.runtime.ros_computer", *words]
        return ended(cell.nodes[COMPUTER].run(*argv, cwd=paths.PROJECT))

    return start


@pytest.fixture(scope="module")
def ros() -> Path:
    """The Python of an environment with ROS 2 itself."""
    if sys.version_info[:2] != (3, 11) or platform.machine() != "x86_64":
        pytest.skip("ROS 2 is on PyPI for Python 3.11 on x86_64 alone")
    place, lock = paths.BUILD / "ros", paths.PROJECT / "requirements" / "ros.lock"
    settings: list[str | Path] = [
        sys.executable,
        paths.PROJECT / "images" / "pip_settings.py",
        Path(sys.executable).with_name("uv"),
    ]
    subprocess.run([*settings, "venv", "--quiet", "--allow-existing", "--python", sys.executable, place], check=True)
    python = place / "bin" / "python"
    # Not sync, which removes the packages within ROS's wheels as none of the lock's.
    install = [*settings, "pip", "install", "--quiet", "--python", python, "--require-hashes", "-r", lock]
    subprocess.run(install, cwd=paths.PROJECT, check=True)
    return python


@pytest.fixture
def ros_computer(cell: Radio, ros: Path, tmp_path: Path) -> Callable[..., Any]:
    """Its discovery by the robot's address, as a station has it, or by multicast."""

    def start(*words: str) -> Any:
        variables = [f"ROS_LOG_DIR={tmp_path}", f"ROS_STATIC_PEERS={ROBOT}", "PYTHONPATH="]
        argv: list[str | Path] = ["env", *variables, ros, paths.PROJECT / "tests" / "runtime" / "ros_itself.py"]
        return ended(cell.nodes[COMPUTER].run(*argv, *words, cwd=tmp_path))

    return start


def heard(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout
    line = process.stdout.readline()
    assert line, process.communicate()[1]
    row: dict[str, Any] = json.loads(line)
    return row


def parameters(name: str, case: Case, topic: str) -> dict[str, Any]:
    return {"type": name, "topic": topic, **case.parameters}


@pytest.mark.parametrize("name", CASES)
def test_ros_reads_what_a_robot_publishes(name: str, cell: Radio, robot: Any, computer: Any) -> None:
    case = CASES[name]
    expected = encoded(name, case.members)
    strings = {path.rpartition(".")[2]: text for path, text in case.strings.items()}
    begun = time.time()
    with (
        computer("hear", name, "/robot3/it", str(len(expected))) as listener,
        robot("ros-publish", "written", parameters(name, case, "robot3/it") | strings, case.values),
    ):
        row = heard(listener)
    message = ROS.deserialize_cdr(LITTLE_ENDIAN + bytes.fromhex(row["message"]), name)
    assert {path: member(message, path) for path in case.members} == case.members
    if case.strings:
        assert begun <= message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec <= time.time()
    assert row["user_data"] == f"typehash={ROS.hash_rihs01(name)};"
    assert max(cell.sent[ROBOT]) < 1514, "IP had to fragment it"


@pytest.mark.nightly
@pytest.mark.parametrize("name", CASES)
def test_ros_itself_reads_what_a_robot_publishes(name: str, robot: Any, ros_computer: Any) -> None:
    """Through Fast DDS and rclpy's messages. Seen to fail with two members of ros.idl exchanged."""
    case = CASES[name]
    strings = {path.rpartition(".")[2]: text for path, text in case.strings.items()}
    begun = time.time()
    with (
        ros_computer("hear", name, "/robot3/it") as listener,
        robot("ros-publish", "written", parameters(name, case, "robot3/it") | strings, case.values),
    ):
        assert listener.stdout
        line = listener.stdout.readline()
        assert line, listener.communicate()[1]
    message = ROS.deserialize_cdr(bytes.fromhex(line), name)
    assert {path: member(message, path) for path in case.members} == case.members
    if case.strings:
        assert begun <= message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec <= time.time()


@pytest.mark.nightly
@pytest.mark.parametrize("name", CASES)
def test_a_robot_reads_what_ros_itself_publishes(name: str, robot: Any, ros_computer: Any) -> None:
    case = CASES[name]
    stamp = {"header.stamp": list(STAMP)} if case.strings else {}
    said = (LITTLE_ENDIAN + encoded(name, case.members | stamp)).hex()
    wanted = parameters(name, case, "/it") | {"timeout": 30}
    if case.strings:
        wanted["frame_id"] = case.strings["header.frame_id"]
    with (
        ros_computer("say", name, "/it", said),
        robot("ros-subscribe", ",".join(["flag,stamp,refused", *case.ports]), wanted, {}) as process,
    ):
        row = Task(process).until(lambda row: row["flag"])
    assert {port: row[port] for port in case.ports} == case.values
    assert row["stamp"] == (STAMP[0] * 10**9 + STAMP[1] if stamp else 0)
    assert row["refused"] == 0


@pytest.mark.parametrize("name", ABSENT)
def test_ros_sees_what_is_unknown(name: str, robot: Any, computer: Any) -> None:
    known, unknown, expected = ABSENT[name]
    with (
        computer("hear", name, "/it", str(len(encoded(name, {})))) as listener,
        robot("ros-publish", "written", {"type": name, "topic": "it"}, known),
    ):
        row = heard(listener)
    message = ROS.deserialize_cdr(LITTLE_ENDIAN + bytes.fromhex(row["message"]), name)
    found = [numpy.atleast_1d(member(message, path))[0] for path in unknown]
    assert found == pytest.approx([expected] * len(unknown), nan_ok=True)
    for port, value in known.items():
        if port not in unknown:
            assert member(message, port) == value


@pytest.mark.parametrize("name", CASES)
def test_a_robot_reads_what_ros_publishes(name: str, robot: Any, computer: Any) -> None:
    case = CASES[name]
    stamp = {"header.stamp": list(STAMP)} if case.strings else {}
    said = encoded(name, case.members | stamp).hex()
    wanted = parameters(name, case, "/it") | {"timeout": 30}
    if case.strings:
        wanted["frame_id"] = case.strings["header.frame_id"]
    with (
        computer("say", name, "/it", said),
        robot("ros-subscribe", ",".join(["flag,stamp,refused", *case.ports]), wanted, {}) as process,
    ):
        row = Task(process).until(lambda row: row["flag"])
    assert {port: row[port] for port in case.ports} == case.values
    assert row["stamp"] == (STAMP[0] * 10**9 + STAMP[1] if stamp else 0)
    assert row["refused"] == 0


@pytest.mark.parametrize(
    "excess", [{"header.frame_id": "a" * 256}, {"axes": [9.0] * 10001}], ids=["characters", "elements"]
)
def test_what_exceeds_the_bounds_is_dropped(excess: dict[str, Any], robot: Any, computer: Any) -> None:
    """Beside one who stays within them. Seen to fail with higher bounds in ros.idl."""
    name = "sensor_msgs/msg/Joy"
    sound, beyond = (encoded(name, members).hex() for members in ({"axes": [1.0]}, {"axes": [9.0]} | excess))
    wanted = {"type": name, "topic": "it", "lengths": [1], "timeout": 30}
    with (
        computer("say", name, "/it", sound),
        computer("say", name, "/it", beyond),
        robot("ros-subscribe", "peers,sequence,axes,refused", wanted, {}) as process,
    ):
        begun = Task(process).until(lambda row: row["peers"] == 2 and row["sequence"])["sequence"]
        for row in Task(process).rows():
            assert (row["axes"], row["refused"]) == (1, 0)
            if row["sequence"] > begun + 60:
                break


@pytest.mark.parametrize("text", blocks_of("yaml"), ids=["twist", "scan"])
def test_the_manuals_tasks_are_right(text: str, flotilla_run: Path, tmp_path: Path) -> None:
    """Seen to fail with a port that is not there."""
    file = tmp_path / "task.yml"
    file.write_text(text)
    argv: list[str | Path] = [flotilla_run, "--blocks", flotilla_run.parent, "--check", file]
    assert subprocess.run(argv, capture_output=True, text=True, check=False).stderr == ""


def test_the_manuals_discovery_finds_a_robot(cell: Radio, flotilla_run: Path, tmp_path: Path) -> None:
    """The robot's configuration is the image's; the ROS computer's is the manual's, under Cyclone DDS as ROS has it.

    Seen to fail with another robot's address in the manual's."""
    template = paths.PROJECT / "rootfs_overlay" / "etc" / "flotilla" / "cyclonedds.xml.j2"
    own = jinja2.Template(template.read_text()).render(
        interface="radio0", dds_peers=[ROBOT], network={"dds_security": False}
    )
    (ours,) = blocks_of("xml")
    shown = "domain: 42, lengths: [3]"
    publish = SCAN.format(block="ros-publish", inputs=json.dumps(SCAN_INPUTS), shown=shown)
    subscribe = SCAN.format(block="ros-subscribe", inputs="{}", shown=shown)
    nodes = {ROBOT: (own, publish, "written"), COMPUTER: (ours.replace("eth0", "radio0"), subscribe, "ranges,ros.flag")}
    with ExitStack() as running:
        processes = {}
        for address, (configuration, text, watched) in nodes.items():
            configured, task = tmp_path / f"{address}.xml", tmp_path / f"{address}.yml"
            # The image's asks for memory and priorities that an ordinary user does not have.
            configured.write_text(re.sub(r"(?s)<Scheduling>.*?</Scheduling>", "", configuration))
            task.write_text(judged_by_outcomes(text))
            argv: list[str | Path] = [flotilla_run, "--blocks", flotilla_run.parent, "--watch", f"ros.{watched}", task]
            start = cell.nodes[address].run("env", f"CYCLONEDDS_URI=file://{configured}", *argv, cwd=tmp_path)
            processes[address] = running.enter_context(ended(start))
        assert Task(processes[COMPUTER]).until(lambda row: row["flag"])["ranges"] == SCAN_INPUTS["ranges"]
