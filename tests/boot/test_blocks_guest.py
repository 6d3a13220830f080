"""Every block of the runtime on a robot as shipped: i386, of the Pentium III class, by its own kernel and libraries.

One guest of robot 1 with all the devices that the test lab has, for all tests. Where a test of the runtime on this
computer says what is wanted, it is that very test which runs here, by fixtures that start tasks on the robot instead.
Software emulates the robot's processor, so events and values are judged, never times.
"""

from __future__ import annotations

import fnmatch
import json
import re
import subprocess
import tarfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import yaml

from flotilla.common import paths
from flotilla.debian import pool, runtime
from flotilla.debian.lock import read_lock
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.lab.emulators import igps
from flotilla.lab.emulators.ir104 import Ir104
from flotilla.lab.emulators.serial_line import Device, SerialLine, UnixSocket
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.relay_ports import INPUTS, RelayPorts, drive_inputs
from flotilla.lab.qemu.segment import Segment, station_address
from flotilla.station import recording
from tests.conftest import GuestFactory, RobotGuest
from tests.running import PATIENCE, Row, Task, running_there, watching
from tests.runtime import test_can as can
from tests.runtime import test_dds as dds
from tests.runtime import test_io as io
from tests.runtime import test_serial as serial
from tests.runtime import test_signal as signals

IGPS_PORT = 5010
LOOPBACK = "127.0.0.1"
READ_BACK = 0b101
"""What relays 1 to 8 read, whatever they are."""
CAN_BOARDS = ("-object", "can-bus,id=bus", *("-device", "kvaser_pci,canbus=bus") * 2)
"""The robot's own, and one for what else is on the bus."""
CAN_UP = "for interface in can0 can1; do ip link set $interface up type can bitrate 1000000; done"


@dataclass(frozen=True)
class Sensor:
    """A block, the serial port that its device is plugged into, and what it makes of that."""

    type: str
    port: str
    device: Callable[[], Device]
    outputs: tuple[str, ...]
    parameters: Mapping[str, Any]
    check: Callable[[Row], None]
    good: Callable[[Row], bool] = serial.good


SENSORS = {
    "gyro": Sensor(
        "dsp3000", "COM5", lambda: serial.gyro("text"), ("rate",),
        {**serial.GYRO, "device": "/dev/robot/gyro", "timeout": 1}, serial.check_gyro,
    ),
    "fast_gyro": Sensor(
        "dsp3000", "COM9", lambda: serial.gyro("words"), ("rate",),
        {**serial.GYRO, **serial.WORDS, "device": "/dev/ttyS8", "timeout": 1}, serial.check_gyro,
    ),
    "magnetometer": Sensor(
        "micromag3", "COM6", serial.magnetometer, ("heading", "field"),
        {**serial.MAGNETOMETER, "device": "/dev/robot/magnetometer", "timeout": 1}, serial.check_magnetometer,
    ),
    "battery": Sensor(
        "oceanserver", "COM7", serial.batteries, serial.BATTERY_OUTPUTS,
        {"device": "/dev/robot/battery", "timeout": 2}, serial.check_batteries, serial.good_batteries,
    ),
    "laser": Sensor(
        "urg", "COM8", serial.scanner, ("ranges", "timestamp"),
        {**serial.SCAN, "device": "/dev/robot/laser", "timeout": 1}, serial.check_scan,
    ),
}  # fmt: skip
"""Devices by the inventory's names, and a second gyro."""


@dataclass(frozen=True)
class Camera:
    """A block, and the centre of the brightest spot before its camera, between -1 and 1."""

    type: str
    parameters: Mapping[str, Any]
    spot: tuple[float, float]


VIVID = (
    "cec/core/*",
    "common/v4l2-tpg/*",
    "common/videobuf2/*",
    "mc/*",
    "rc/rc-core",
    "test-drivers/*/*",
    "v4l2-core/*",
)
"""Modules of Linux's virtual camera and what they need."""
LOAD_WEBCAM = """
mkdir /run/vivid
tar -xf /tmp/modules.tar -C /run/vivid
depmod -b /run/vivid
modprobe -d /run/vivid vivid n_devs=1 node_types=1 num_inputs=1 input_types=0
"""
PLUG_WEBCAM = 'echo vivid.0 >/sys/bus/platform/drivers/vivid/"$1"'
FIREWIRE = Path("/tmp/firewire")
"""On the robot: the library that stands for its FireWire, and its camera's plug, a file."""
CAMERAS = {
    # Vertical bars, the whiter the further to the left, and lines of text over their upper part.
    "webcam": Camera("frame-grabber-v4l2", {"width": 320, "height": 180, "rate": 2, "timeout": 2}, (-0.68, 0.16)),
    # The library's camera has a square in the middle of the upper right quarter.
    "firewire": Camera("frame-grabber-iidc", {"width": 640, "height": 480, "timeout": 2}, (0.5, -0.5)),
}
ALWAYS = ("flag", "age", "sequence")


def sensors_task(station: object) -> tuple[str, str]:
    """All that measures, in one task, and what of it is to be seen."""
    blocks: dict[str, Any] = {
        name: {"type": one.type, "parameters": dict(one.parameters)} for name, one in SENSORS.items()
    }
    watched = {name: one.outputs for name, one in SENSORS.items()}
    positioning = {"port": IGPS_PORT, "from": str(station), "range": 10_000, "timeout": 1}
    blocks["igps"] = {"type": "igps", "parameters": positioning}
    watched["igps"] = ("position",)
    for name, camera in CAMERAS.items():
        blocks[name] = {"type": camera.type, "parameters": dict(camera.parameters)}
        wires = {port: f"{name}.{port}" for port in ("image", "flag", "sequence")}
        size = {side: camera.parameters[side] for side in ("width", "height")}
        blocks[f"{name}_spots"] = {"type": "image-processor", "in": wires, "parameters": size}
        watched |= {name: (), f"{name}_spots": ("x", "y")}
    text = yaml.safe_dump({"period": "50 ms", "priority": 0, "overruns": 0, "blocks": blocks})
    return text, ",".join(f"{name}.{output}" for name, outputs in watched.items() for output in (*outputs, *ALWAYS))


RELAYS = """
period: 20 ms
priority: 0
blocks:
  command: {type: trajectory, parameters: {waypoints: [0, 1], times: [0, 2]}}
  fresh: {type: logic, in: {in0: command.done}, parameters: {operation: not, inputs: 1}}
  relays: {type: ir104-pbf, in: {command: [1, 0, 1], flag: fresh.out}, parameters: {channels: [1, 2, 3], timeout: 0.5}}
"""

# Each takes what moves and makes something that moves, or switches. Steps are counted, not measured, so that two runs
# are alike.
SIGNALS = """
period: 10 ms
blocks:
  clock: {type: clock}
  bytes: {type: pack, in: {in0: clock.step}, parameters: {types: [uint64]}}
  step: {type: unpack, in: {in: bytes.out}, parameters: {types: [uint32, uint32]}}
  path:
    type: trajectory
    parameters: {waypoints: [0, 0, 1, -0.5, -1, 0.7, 0.3, 0], dimensions: 2, times: [0, 0.5, 1.2, 1.6],
                 interpolation: quintic}
  bias: {type: constant, parameters: {value: 0.125}}
  biased: {type: sum, in: {in0: "path.position[0]", in1: bias.out}, parameters: {signs: "+-"}}
  scaled: {type: gain, in: {in: biased.out}, parameters: {factor: -1.7}}
  both: {type: join, in: {in0: scaled.out, in1: "path.velocity[1]"}}
  filtered: {type: low-pass, in: {in: "both.out[1]"}, parameters: {time_constant: 0.05}}
  limited: {type: limit, in: {in: scaled.out}, parameters: {min: -0.8, max: 0.9, rate: 3}}
  turned: {type: rotate, in: {x: "path.position[0]", y: "path.position[1]", angle: limited.out}}
  before: {type: delay, in: {in: turned.x}, parameters: {initial: 0.2}}
  way: {type: integrator, in: {in: before.out}}
  observed:
    type: alpha-beta-filter
    in: {measurement: way.out, sequence: step.out0}
    parameters: {time_constant: 0.1}
  control:
    type: pid
    in: {set_point: "path.position[1]", measurement: observed.value}
    parameters: {kp: 2, ki: 1, kd: 0.1, filter: 0.03, min: -0.7, max: 0.7}
  switch: {type: schmitt-trigger, in: {in: control.out}, parameters: {on: 0.4, off: 0.2, symmetric: true}}
  any: {type: logic, in: {in0: switch.on, in1: limited.limited}, parameters: {operation: xor}}
  chosen: {type: select, in: {condition: any.out, then: control.out, otherwise: turned.y}}
  wheels: {type: differential-drive, in: {v: chosen.out, omega: filtered.out}, parameters: {radius: 0.1, track: 0.4}}
  pose:
    type: differential-odometry
    in: {left: wheels.left, right: wheels.right}
    parameters: {radius: 0.1, track: 0.4}
  driven:
    type: encoder-odometry
    in: {left: way.out, right: observed.value, flag: 1}
    parameters: {radius: 0.1, track: 0.4, fastest: 100}
  range: {type: sum, in: {in0: control.out, in1: 1.2}}
  scan: {type: join, in: {in0: range.out, in1: range.out, in2: 2.5}, parameters: {inputs: 3}}
  clearance:
    type: curve-clearance
    in: {ranges: scan.out, flag: 1}
    parameters: {points: 3, first: -0.4, increment: 0.4, radius: 0.3, least_seen: 0, curvatures: [-1, 0, 1]}
  slowed:
    type: obstacle-stop
    in:
      v: chosen.out
      omega: filtered.out
      speed: driven.v
      rate: driven.omega
      flag: clearance.flag
      age: 0.01
      sequence: step.out0
      clearance: clearance.clearance
    parameters: {curvatures: [-1, 0, 1], deceleration: 0.5, delay: 0.1, margin: 0.05}
  attitude: {type: angles-to-quaternion, in: {roll: limited.out, pitch: turned.y, yaw: before.out}}
  angles: {type: quaternion-to-angles, in: {quaternion: attitude.quaternion}}
  command: {type: pack, in: {in0: 7, in1: step.out0}, parameters: {types: [uint32, uint32]}}
  guard:
    type: command-guard
    in: {data: command.out, flag: switch.on, age: 0.01, sequence: step.out0}
    parameters: {length: 8}
  valves:
    type: thruster-mapping
    in: {force_x: chosen.out, force_y: turned.y, torque: 0.05}
    parameters: {positions: [0.1, 0.1, -0.1, 0.1, -0.1, -0.1, 0.1, -0.1], directions: [1, 0, 0, -1, -1, 0, 0, 1],
                 force: 1, steps: 5, minimum: 0.003}
  spots:
    type: image-processor
    in: {image: [0, 0, 0, 0, 0, 201, 255, 0, 0, 190, 199, 0, 0, 0, 0, 0], flag: 1, sequence: 7}
    parameters: {width: 4, height: 4}
"""
OBSERVED = (
    "clock.time,clock.step,bytes.out,step.out0,step.out1,path.position,path.velocity,path.acceleration,path.done,"
    "bias.out,biased.out,scaled.out,both.out,filtered.out,limited.out,limited.limited,turned.x,turned.y,before.out,"
    "way.out,observed.value,observed.rate,control.out,control.saturated,switch.on,switch.sign,any.out,chosen.out,"
    "wheels.left,wheels.right,wheels.limited,pose.v,pose.omega,pose.x,pose.y,pose.heading,attitude.quaternion,"
    "driven.v,driven.omega,driven.x,driven.y,driven.heading,driven.lost,range.out,scan.out,clearance.clearance,"
    "clearance.flag,slowed.v,slowed.omega,slowed.limited,slowed.free,"
    "command.out,guard.data,guard.flag,guard.age,guard.operator,guard.other,guard.conflict,guard.refused,"
    "angles.roll,angles.pitch,angles.yaw,valves.valves,valves.on_time,"
    "valves.achieved,valves.saturated,spots.count,spots.x,spots.y,spots.brightness,spots.flag,spots.sequence"
)


class DeviceBench:
    """The robot and what is plugged into it."""

    def __init__(
        self, robot: RobotGuest, lines: Mapping[str, SerialLine], positions: igps.Igps, relays: Ir104, station: object
    ) -> None:
        self.robot, self.lines, self.positions, self.relays, self.station = robot, lines, positions, relays, station

    def plug(self, *, plugged: bool) -> None:
        """All sensors' plugs."""
        for line in self.lines.values():
            if plugged:
                line.replug()
            else:
                line.unplug()
        self.positions.faults = replace(self.positions.faults, loss=0 if plugged else 1)
        self.robot.shell.run(["sudo", "sh", "-c", PLUG_WEBCAM, "sh", "bind" if plugged else "unbind"])
        self.robot.shell.run(["touch" if plugged else "rm", str(FIREWIRE / "plug")])


def load_webcam(robot: RobotGuest) -> None:
    """Linux's virtual camera, which the card lacks, of the very package that the card's kernel is from."""
    lock = read_lock(robot.board.name)
    (package,) = packages = lock.having("kernel")
    pool.fill([replace(lock, packages=packages)])
    modules = BytesIO()
    with (
        subprocess.Popen(["dpkg-deb", "--fsys-tarfile", pool.file(package)], stdout=subprocess.PIPE) as unpacking,
        tarfile.open(fileobj=unpacking.stdout, mode="r|") as unpacked,
        tarfile.open(fileobj=modules, mode="w") as chosen,
    ):
        for file in unpacked:
            if any(fnmatch.fnmatch(file.name, f"*/kernel/drivers/media/{pattern}.ko") for pattern in VIVID):
                chosen.addfile(file, unpacked.extractfile(file))
    robot.shell.write("/tmp/modules.tar", modules.getvalue())
    robot.shell.run(["sudo", "sh", "-ec", LOAD_WEBCAM])


def bring_firewire(robot: RobotGuest) -> None:
    """A library with a camera, because QEMU has no FireWire."""
    options = ["-std=c11", *runtime.WARNINGS, "-pthread"]
    source = runtime.SOURCE / "tests/camera"
    library = runtime.compile_shared(source, ["dc1394_bus.c", "dc1394_camera.c"], robot.board.system, options)
    robot.shell.run(["mkdir", str(FIREWIRE)])
    robot.shell.write(str(FIREWIRE / "libdc1394.so.25"), library)
    robot.shell.run(["touch", str(FIREWIRE / "plug")])


@pytest.fixture(scope="module")
def lab(fleet: Fleet, module_guest: GuestFactory, tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeviceBench]:
    """Its own control task, which has some of the ports, is stopped."""
    out = tmp_path_factory.mktemp("bench")
    address, station = inventory.robot(fleet, 1).address, station_address(fleet)
    relays = Ir104()
    with ExitStack() as stack:
        segment = stack.enter_context(
            Segment(fleet.network, [address], station, out / "segment", [(address, IGPS_PORT)])
        )
        ports = stack.enter_context(RelayPorts(relays, [READ_BACK, 0, 0]))
        sockets = {one.port: out / one.port for one in SENSORS.values()}
        options = {
            "extra": (*ports.arguments, *INPUTS, *CAN_BOARDS),
            "ports": {port: qemu.unix_socket(path) for port, path in sockets.items()},
        }
        robot = module_guest(1, boot=False, segment=segment, qemu_options=options)
        robot.machine.prepare()
        lines = {
            name: stack.enter_context(SerialLine(one.device(), UnixSocket(str(sockets[one.port]))))
            for name, one in SENSORS.items()
        }
        there = (LOOPBACK, segment.udp_port(address, IGPS_PORT))
        positions = stack.enter_context(igps.Igps(there, io.path_of, rate=20))
        robot.machine.on()
        robot.wait_booted()
        robot.shell.run(["sudo", "systemctl", "stop", "flotilla-task@*"])
        load_webcam(robot)
        bring_firewire(robot)
        yield DeviceBench(robot, lines, positions, relays, station)


# --- where the tests of this computer's runtime start tasks here ---

Start = Callable[..., AbstractContextManager[Task]]


@pytest.fixture
def start(lab: DeviceBench) -> Start:
    def start(name: str, text: str, watched: str = "", *options: str) -> AbstractContextManager[Task]:
        return running_there(lab.robot.shell, name, text, *watching(watched), *options)

    return start


@pytest.fixture
def rows(lab: DeviceBench) -> Callable[[str, int, str], list[Row]]:
    def rows(text: str, steps: int, watched: str) -> list[Row]:
        script = 'cat >/tmp/task.yml && exec flotilla-run --no-wait --steps "$1" --watch "$2" /tmp/task.yml'
        done = lab.robot.shell.run(["sudo", "sh", "-c", script, "sh", str(steps), watched], stdin=text)
        return [json.loads(line) for line in done.stdout.splitlines()]

    return rows


@pytest.fixture
def queue() -> str:
    return "/flotilla-test"


# --- sensors ---


Wanted = Mapping[str, Callable[[Row], bool]]


def seen(task: Task, wanted: Wanted, seconds: float = PATIENCE / 2) -> dict[str, Row]:
    """For each block its part of the first row in which that is as wanted; without those that have none in time."""
    found: dict[str, Row] = {}
    end = time.monotonic() + seconds
    for row in task.rows():
        for name in wanted.keys() - found.keys():
            part = {signal.removeprefix(f"{name}."): value for signal, value in row.items()}
            if wanted[name](part):
                found[name] = part
        if found.keys() == wanted.keys() or time.monotonic() > end:
            break
    return found


@dataclass(frozen=True)
class Story:
    """What the sensors' blocks said at first, unplugged, and plugged in again."""

    first: Mapping[str, Row]
    unplugged: Mapping[str, Row]
    replugged: Mapping[str, Row]


@pytest.fixture(scope="module")
def story(lab: DeviceBench) -> Story:
    good: Wanted = dict.fromkeys(CHECKS, serial.good) | {name: one.good for name, one in SENSORS.items()}
    bad: Wanted = dict.fromkeys(good, serial.bad)
    text, watched = sensors_task(lab.station)
    environment = {"LD_LIBRARY_PATH": str(FIREWIRE), "DC1394_PLUG": str(FIREWIRE / "plug")}
    with running_there(lab.robot.shell, "sensors", text, *watching(watched), environment=environment) as task:
        first = seen(task, good)
        lab.plug(plugged=False)
        unplugged = seen(task, bad)
        lab.plug(plugged=True)
        replugged = seen(task, good)
    return Story(first, unplugged, replugged)


def check_position(row: Row) -> None:
    x, y = row["position"]
    assert x > 0
    assert x * 20 % 1 == pytest.approx(0, abs=1e-9)
    assert y == 0.5


def check_image(name: str, row: Row) -> None:
    brightest = row[f"{name}_spots.x"][0], row[f"{name}_spots.y"][0]
    assert brightest == pytest.approx(CAMERAS[name].spot, abs=0.05)


CHECKS: Mapping[str, Callable[[Row], None]] = {
    **{name: one.check for name, one in SENSORS.items()},
    "igps": check_position,
    **{name: partial(check_image, name) for name in CAMERAS},
}


@pytest.mark.parametrize("name", CHECKS)
def test_sensor(story: Story, name: str) -> None:
    """Seen to fail with the other sense of rotation, another format, other batteries, another sender.

    Also with a time-out of 100 s, and with a plug that was not put back; cameras with a size that the driver lacks,
    without the library that has one, and with a plug that was not pulled.
    """
    check = CHECKS[name]
    for rows, what in ((story.first, "it never was good"), (story.replugged, "it did not come back")):
        assert name in rows, what
        assert rows[name]["age"] < 4
        check(rows[name])
    assert name in story.unplugged, "nobody missed it"
    check(story.unplugged[name])  # the last value stays
    sequences = [rows[name]["sequence"] for rows in (story.first, story.unplugged, story.replugged)]
    assert 0 < sequences[0] <= sequences[1] < sequences[2]


# --- actuators ---


def test_relays(lab: DeviceBench, start: Start) -> None:
    """Seen to fail with another input driven."""
    driven = {2, 9, 20}
    for number in driven:
        lab.relays.drive(number)
    drive_inputs(lab.robot.machine, lab.relays)
    with start("relays", RELAYS, "relays.relays,relays.inputs,relays.mismatch,relays.timed_out") as task:
        row = task.until(lambda row: row["relays"] == [1, 0, 1])
        assert lab.relays.wait(lambda: lab.relays.relays[:3] == (True, False, True), PATIENCE)
        assert row["inputs"] == [int(number in driven) for number in range(1, 21)]
        assert (row["mismatch"], row["timed_out"]) == (0, 0)
        lab.relays.drive(9, False)
        drive_inputs(lab.robot.machine, lab.relays)
        task.until(lambda row: row["inputs"] == [int(number in driven - {9}) for number in range(1, 21)])
        assert task.until(lambda row: row["timed_out"])["mismatch"] == 1, "relays that read back on are off"
        assert lab.relays.wait_relays(on=False)


def test_frames_pass_between_two_boards(lab: DeviceBench, start: Start) -> None:
    """Seen to fail with the second one's link down."""
    lab.robot.shell.run(["sudo", "sh", "-ec", CAN_UP])
    frames = yaml.safe_load(can.FRAMES)
    frames["blocks"]["back"]["parameters"]["interface"] = "can1"
    with start("can", yaml.safe_dump(frames), can.FRAMES_WATCHED) as task:
        can.check_frames(task)


# --- messages ---

test_udp_from_task_to_task = io.test_udp_from_task_to_task
test_queue_between_two_rates = io.test_queue_between_two_rates
test_a_topic_between_two_tasks = dds.test_a_topic_between_two_tasks
test_a_message_of_ros_between_two_tasks = dds.test_a_message_of_ros_between_two_tasks

# --- signals ---

test_delay_is_of_one_step_wherever_it_stands = signals.test_delay_is_of_one_step_wherever_it_stands
test_integrators_close_a_loop = signals.test_integrators_close_a_loop
test_controller_brings_a_plant_to_its_set_point = signals.test_controller_brings_a_plant_to_its_set_point
test_packed_signals_come_back = signals.test_packed_signals_come_back


def numbers(value: Any) -> list[float]:
    return value if isinstance(value, list) else [value]


def test_signals_are_those_of_this_computer(
    rows: Callable[[str, int, str], list[Row]], flotilla_run: Path, tmp_path: Path
) -> None:
    """But for the last digits: its floating-point unit is the 387. The C tests judge each block on this computer.

    Seen to fail with a gain that differs in the fourth digit.
    """
    steps = 200
    task = tmp_path / "task.yml"
    task.write_text(SIGNALS)
    command: list[str | Path] = [flotilla_run, "--no-wait", "--steps", str(steps), "--watch", OBSERVED, task]
    here = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
    expected = [json.loads(line) for line in here.stdout.splitlines()]
    found = rows(SIGNALS, steps, OBSERVED)
    assert len(found) == len(expected) == steps
    for name in OBSERVED.split(","):
        wanted = [numbers(row[name]) for row in expected]
        for step, row in enumerate(found):
            assert numbers(row[name]) == pytest.approx(wanted[step], rel=1e-9, abs=1e-12), (name, step)
    moved = {name.partition(".")[0] for name in OBSERVED.split(",") if len({str(row[name]) for row in found}) > 1}
    assert yaml.safe_load(SIGNALS)["blocks"].keys() - moved == {"bias"}, "these show nothing"


def test_recording_is_read_back(lab: DeviceBench) -> None:
    script = "mkdir -p /tmp/recorded && cat >/tmp/task.yml && exec flotilla-run --no-wait --steps 100 /tmp/task.yml"
    lab.robot.shell.run(["sudo", "sh", "-c", script], stdin=signals.RECORDED.format(directory="/tmp/recorded"))
    found = recording.parse(lab.robot.shell.read("/tmp/recorded/log-000001.rec"))
    signals.check_square(found)
    assert len(found.records) == 100


# --- none is left out ---


def test_every_block_is_tested(lab: DeviceBench) -> None:
    """Seen to fail without the relays' task."""
    tasks = {
        test_sensor: sensors_task(lab.station)[0],
        test_relays: RELAYS,
        test_frames_pass_between_two_boards: can.FRAMES,
        test_udp_from_task_to_task: io.SENDER + io.RECEIVER,
        test_queue_between_two_rates: io.QUEUE_SENDER + io.QUEUE_RECEIVER,
        test_a_topic_between_two_tasks: dds.SENDER + dds.RECEIVER,
        test_a_message_of_ros_between_two_tasks: dds.ROS_SENDER + dds.ROS_RECEIVER,
        test_signals_are_those_of_this_computer: SIGNALS,
        test_recording_is_read_back: signals.RECORDED,
    }
    wheeled = (paths.TASKS / "drive.yml").read_text()  # in virtual time, for a busy host loses heartbeats of drives
    tested = {type for text in (*tasks.values(), wheeled) for type in re.findall(r"\btype: ([a-z0-9-]+)", text)}
    there = {line.split()[0] for line in lab.robot.shell.run(["flotilla-blocks"]).stdout.splitlines()}
    assert there - tested == set(), "blocks without a test here"
