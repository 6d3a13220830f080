"""Flights in real time: the fleet's four computers as guests of their card images, on one Ethernet segment or the air.

This computer is the rest of the test lab: the robot that floats, its gyro on the guest's serial port, its valves at
the relay board's I/O ports, positions to the robot and reports from it by UDP. How fast that goes depends on the host;
the plant's time is therefore the robot's own: each step of its valves with another sample of its gyro takes it a period
further. Computers whose clocks nobody has set are not compared: of latency there is the robot's own, over all hops.
"""

from __future__ import annotations

import functools
import math
import select
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

from flotilla.common import paths, progress
from flotilla.fleet import identity, message_keys
from flotilla.fleet.model import Board, Fleet
from flotilla.images import build
from flotilla.lab.emulators.dsp3000 import Dsp3000
from flotilla.lab.emulators.igps import Faults, Igps
from flotilla.lab.emulators.ir104 import Ir104
from flotilla.lab.emulators.serial_line import SerialLine, UnixSocket
from flotilla.lab.plants.plant import THRUSTERS, Plant
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.radio_segment import segment_of
from flotilla.lab.qemu.relay_ports import RelayPorts
from flotilla.lab.qemu.segment import Segment
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import Deadline, Expired
from flotilla.lab.scenarios import virtual
from flotilla.lab.scenarios.flight import Flight, Record
from flotilla.lab.scenarios.virtual import Plan
from flotilla.station import receiver, station_keys, telemetry
from flotilla.station.authentication import Signer
from flotilla.station.recording import Value

HOW = {
    link: f"Each is a guest of its card image, {where}, in real time on this computer, whose speed the latencies show. "
    "The robot's own clock measures them."
    for link, where in {
        "ethernet": "all on one Ethernet segment",
        "ibss": "with an emulated 802.11 adapter, all in one ad hoc cell",
    }.items()
}
FLIGHTS = ("udp", "dds")
"""Undisturbed, by each transport: the names of the plans that guests fly."""
PERIOD_NS = 10_000_000
IGPS_PORT = 5010
LOOPBACK = "127.0.0.1"
BOOT_SECONDS = 600
LIMIT_PER_SECOND = 10
"""Of this computer's clock, for each second of the plant's."""
Motion = tuple[float, float, float]
"""m/s, m/s, rad/s."""
AT_REST = (0.0, 0.0, 0.0)
_RECORD_STEPS = 5
"""Between two records of the plant."""


class FloatingRobot:
    """The plant with its valves and sensors. Held until `release`, and its time stands still until then."""

    def __init__(self) -> None:
        self.board = Ir104(after_write=self._step)
        self.flown: list[Record] = []
        self._plant = Plant()
        self._steps = 0
        self._sampled = False
        self._floats = False

    @property
    def time_ns(self) -> int:
        """Its time."""
        return self._steps * PERIOD_NS

    @property
    def velocity(self) -> Motion:
        with self.board.lock:
            return self._plant.velocity

    def release(self, velocity: Motion = AT_REST) -> None:
        """Let go of it where it is; what was flown before is forgotten."""
        with self.board.lock:
            self._plant = Plant(initial_pose=self._plant.pose, initial_velocity=velocity)
            self.flown = []
            self._floats = True

    def gyro_deg_s(self, _: float) -> float:
        with self.board.lock:
            self._sampled = True
            return self._plant.gyro_deg_s() if self._floats else 0.0

    def position(self, _: float) -> tuple[float, float]:
        with self.board.lock:
            return self._plant.igps()

    def _step(self, offset: int) -> None:
        """Each step of the task writes each register once, and all valves are on the first."""
        if offset or not (self._floats and self._sampled):
            return
        self._sampled = False
        plant = self._plant
        plant.step(PERIOD_NS / 1e9, self.board.relays[:THRUSTERS])
        self._steps += 1
        if self._steps % _RECORD_STEPS == 0:
            self.flown.append(
                {
                    "time_ns": self.time_ns, "pose": plant.pose, "velocity": plant.velocity,
                    "on_time": plant.on_time, "switches": plant.switches,
                }
            )  # fmt: skip


class GuestFleet:
    """Guests that run, the robot, and the station, which receives only in `until`."""

    def __init__(
        self, described: Fleet, robot: FloatingRobot, igps: Igps, machines: Mapping[str, Guest],
        shells: Mapping[str, Ssh], segment: Segment,
    ) -> None:  # fmt: skip
        self.fleet, self.robot, self.machines, self.shells = described, robot, machines, shells
        self.segment = segment
        self._igps = igps
        self._records: dict[str, list[Record]] = {}
        streams = [replace(stream, address=LOOPBACK) for stream in telemetry.streams(described)]
        key_of, station = station_keys.of_telemetry(described), str(described.stations[0].address)
        self._receiver = receiver.Receiver(streams, lambda stream, _: key_of(stream, station))
        self._receiver.sinks.append(self)
        self._sockets = receiver.listen((stream.port for stream in streams), LOOPBACK)

    def take(self, stream: telemetry.Stream, values: Mapping[str, Value], received_ns: int) -> None:
        """As the recorders of station.yml.j2 would have it, by the plant's time."""
        records = self._records.setdefault(stream.task, [])
        values = {"number" if name == "step" else name: value for name, value in values.items()}
        records.append({**values, "time_ns": self.robot.time_ns, "sequence": len(records) + 1})

    def refresh(self) -> None:
        """Nothing is shown."""

    def end(self) -> str:
        return ""

    def close(self) -> None:
        for one in self._sockets:
            one.close()

    def until(self, what: Callable[[], bool], seconds: float) -> None:
        """Hear the robots until it is so; Expired after so many seconds of this computer's."""
        deadline = Deadline(seconds)
        while not what():
            if deadline.expired:
                commands = self._records.get("valves", [])
                good = sum(record["good"] for record in commands)
                state = "; ".join([f"{good} of {len(commands)} commands good", *self._receiver.summary])
                raise Expired(f"not within {seconds:g} s: {state}. A busy computer is too slow for guests in real time")
            select.select(self._sockets, [], [], min(deadline.left, 0.1))
            self._hear()

    def wait_connected(self) -> None:
        """Until commands of a second's steps have come all the way round: DDS has to find its peers first."""
        self.forget()
        steps = round(1e9 / PERIOD_NS)
        self.until(
            lambda: len({record["number"] for record in self._records.get("valves", ())[-2 * steps :]}) >= steps,
            BOOT_SECONDS,
        )

    def forget(self) -> None:
        """What was said so far."""
        while select.select(self._sockets, [], [], 0)[0]:
            self._hear()
        self._records = {}

    def _hear(self) -> None:
        for one in self._sockets:
            receiver.drain(one, self._receiver)

    def pass_time(self, seconds: float, limit_s: float) -> None:
        """Of the plant's."""
        end_ns = self.robot.time_ns + round(seconds * 1e9)
        self.until(lambda: self.robot.time_ns >= end_ns, limit_s)

    def begin(self, velocity: Motion = AT_REST) -> None:
        """A flight, from where the robot is. Before the first one it gets no positions, so control waits."""
        self.forget()
        self.robot.release(velocity)
        self._igps.faults = Faults()

    def hold(self) -> None:
        """As before the first flight: no positions, and the path from its beginning, which the sensors' task knows."""
        self._igps.faults = Faults(loss=1)
        sensors = self.fleet.robot_with("sensors").name
        self.shells[sensors].run(["sudo", "systemctl", "restart", "flotilla-task@sensors"], timeout=BOOT_SECONDS)

    @property
    def done(self) -> bool:
        """The path was commanded to its end."""
        return any(record["done"] for record in self._records.get("control", ())[-1:])

    @property
    def round_share(self) -> float:
        """How many of the last second's steps came all the way round, 0 to 1, by the steps that valve commands are of.
        NaN until a second was heard; ask for it in `until`, which hears them."""
        steps = round(1e9 / PERIOD_NS)
        last = self._records.get("valves", ())[-steps:]
        return len({record["number"] for record in last}) / steps if len(last) == steps else math.nan

    def flight(self) -> Flight:
        """What came of the flight so far."""
        with self.robot.board.lock:
            flown = list(self.robot.flown)
        return Flight(
            flown, list(self._records.get("valves", ())), list(self._records.get("control", ())), one_clock=False
        )  # fmt: skip

    def restart_with(self, plan: Plan) -> None:
        """Give the control tasks the plan's parameters, where they differ from what the card has."""
        for robot in self.fleet.robots.values():
            for name, task in identity.control_tasks(self.fleet, robot).items():
                changed = virtual.changed(name, task, plan.changes)
                if changed != task:
                    shell = self.shells[robot.name]
                    shell.run(["sudo", "tee", str(identity.TASKS / f"{name}.yml")], stdin=changed.decode())
                    shell.run(["sudo", "systemctl", "restart", f"flotilla-task@{name}"], timeout=BOOT_SECONDS)


def fleet(transport: str, board: Board | None = None, link: str = "ethernet", *, dds_security: bool = False) -> Fleet:
    """The scenarios' fleet by wired ports or adapters, and our kernel, which boots fastest."""
    described = virtual.fleet(transport, dds_security=dds_security, board=board)
    network = described.network.model_copy(update={"link": link})
    boards = {name: board.model_copy(update={"kernel": "lean"}) for name, board in described.boards.items()}
    return described.model_copy(update={"network": network, "boards": boards})


@contextmanager
def guest_fleet(
    plan: Plan, out: Path, board: Board | None = None, link: str = "ethernet", described: Fleet | None = None
) -> Iterator[GuestFleet]:
    """All booted, with the plan's parameters; the robot is held until `begin`. `described`: not the scenarios'."""
    described = described or fleet(plan.transport, board, link)
    robots = list(described.robots.values())
    flying = described.robot_with("valves")
    robot = FloatingRobot()
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(paths, "KEYS", out / "keys"))
        build.build(described, robots, out / "images")
        receiver = (flying.address, IGPS_PORT)
        segment = stack.enter_context(segment_of(described, robots, out / "segment", [receiver]))
        relays = stack.enter_context(RelayPorts(robot.board))
        gyro = out / "gyro.socket"
        machines, shells = {}, {}
        for one in robots:
            options = segment.options(one)
            if one is flying:
                ports = {one.devices["gyro"].port: qemu.unix_socket(gyro)}
                options = replace(options, extra=(*options.extra, *relays.arguments), ports=ports)
            image = build.image_of(one, out / "images")
            machines[one.name] = stack.enter_context(Guest(described.boards[one.board], image, out / one.name, options))
            port = functools.partial(segment.ssh_port, one.address)
            shells[one.name] = stack.enter_context(Ssh(one, LOOPBACK, port))
        machines[flying.name].prepare()
        stack.enter_context(SerialLine(Dsp3000(robot.gyro_deg_s, noise=0), UnixSocket(str(gyro))))
        there = (LOOPBACK, segment.udp_port(*receiver))
        signer = Signer(message_keys.read().between(described.stations[0], flying), IGPS_PORT)
        igps = stack.enter_context(Igps(there, robot.position, rate=100, faults=Faults(loss=1), signer=signer))
        lab = GuestFleet(described, robot, igps, machines, shells, segment)
        stack.callback(lab.close)
        with progress.step(f"boot {len(robots)} guests") as step:
            for machine in machines.values():
                machine.on()
            for number, (name, machine) in enumerate(machines.items()):
                step.at(number, len(machines), "guests", name)
                machine.console.expect(rf"{name} login: ", BOOT_SECONDS)
            step.at(len(machines), len(machines), "guests", "control loop")
            for shell in shells.values():
                shell.connect(BOOT_SECONDS)
            lab.restart_with(plan)
            lab.wait_connected()
        yield lab


def fly(plan: Plan, out: Path, board: Board | None = None, link: str = "ethernet") -> Flight:
    """The plan's square, undisturbed."""
    with guest_fleet(plan, out, board, link) as lab:
        lab.begin()
        with progress.step(f"{plan.seconds:g} s of flight") as step:

            def done() -> bool:
                step.at(lab.robot.time_ns // 10**9, round(plan.seconds), "seconds")
                return lab.done

            lab.until(done, LIMIT_PER_SECOND * plan.seconds)
        return lab.flight()
