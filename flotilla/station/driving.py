"""The one sender of a station's commands to robots that are driven: those whose control task is `drive`.

Whoever drives, a keyboard, a gamepad or a browser, is an `Operator` who holds the robot. At most one does; a handover
takes both. `Driving` may be called by any thread. Its own thread sends the holder's newest input ten times a second:

    with Driving(fleet) as driving:
        driving.take("rover", anna)
        driving.drive("rover", anna.id, v=0.3, omega=0.0, boom=0.1, enable=True)  # again and again while it is to move

What the robot makes of commands is in docs/how-to/wheeled-robot.md.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any

import yaml

from flotilla.common import paths, signals
from flotilla.common.errors import UserError
from flotilla.common.yaml_file import did_you_mean
from flotilla.fleet import identity
from flotilla.fleet.model import Fleet, Host, Robot
from flotilla.station import sending
from flotilla.station.authentication import Signer

TASK = "drive"
"""The control task that takes commands."""
LAYOUT = {
    "operator": "uint32", "sequence": "uint32", "v": "double", "omega": "double", "boom": "double", "enable": "boolean",
}  # fmt: skip
"""Signals of a command, in this order and without gaps; the block `in` of drive.yml has the same."""
COMMAND = struct.Struct("<" + "".join(signals.CODES[kind] for kind in LAYOUT.values()))
RATE_HZ = 10.0
"""Datagrams a second to each robot that is held and has an input."""
DEAD_MAN_S = 0.3
"""An older input moves nothing: whoever drives repeats it while the key is held."""
SILENT_S = 5.0
"""A holder without any input for so long holds nothing any more."""
STOP_S = 10.0
"""For so long rest is sent after a stop: other ways of stopping, by ssh, take some seconds."""
APART_S = 1.2
"""From the last datagram of one hold to the first of the next: the robot takes two that speak within 1 s for a
conflict (`guard.apart` of drive.yml)."""
_LONGEST = 2048
_AT_ONCE = 100
"""Datagrams of robots that are taken in one tick."""
LOCKS = paths.BUILD / "run"
"""A file for each robot that is held, locked by the program that sends to it."""


@dataclass(frozen=True)
class Operator:
    """Who drives."""

    id: str
    """Each once: of a browser's session, or of a program."""
    name: str
    """Shown to people."""


@dataclass(frozen=True)
class Motion:
    """What a robot is to do."""

    v: float
    """m/s ahead."""
    omega: float
    """rad/s, anticlockwise."""
    boom: float
    """Its extension in m."""
    enable: bool
    """Motors on."""

    @property
    def resting(self) -> Motion:
        """The wheels at rest; boom and motors as they are."""
        return Motion(0.0, 0.0, self.boom, self.enable)


@dataclass(frozen=True)
class Vehicle:
    """A robot that can be driven, with the figures of its control task."""

    robot: str
    address: str
    port: int
    signed: bool
    """It takes only commands that prove their sender."""
    limits: Mapping[str, tuple[float, float]]
    """Least and greatest `v` in m/s, `omega` in rad/s, `boom` in m."""

    def clipped(self, motion: Motion) -> Motion:
        values = {name: min(max(getattr(motion, name), low), high) for name, (low, high) in self.limits.items()}
        return Motion(enable=motion.enable, **values)


@dataclass(frozen=True)
class State:
    """Who drives a robot, and what is sent to it."""

    robot: str
    holder: Operator | None
    offered: Operator | None
    """To whom the holder offers it."""
    number: int
    """The hold's in each datagram, 1 to 2³² − 1; the robot reports it back as `operator`. 0: nobody holds it."""
    sequence: int
    """Of the last datagram of this hold; 0: none yet."""
    input: Motion | None
    """The holder's newest, within the robot's limits."""
    input_age_s: float | None
    """Since then; None: the holder gave none yet."""
    sending: Motion | None
    """What goes out ten times a second; None: nothing does."""
    note: str
    """In words: why it does not move as the input says, or how the last hold ended; else empty."""
    error: str
    """Why the last datagram could not be sent; empty: it could."""


class Refused(UserError):
    """An input or a wish of an operator that is not taken."""


class HeldError(Refused):
    """Somebody else holds the robot."""

    def __init__(self, robot: str, holder: str, remedy: str = "ask for a handover, or wait") -> None:
        super().__init__(f"{robot}: {holder} commands it; {remedy}")
        self.robot, self.holder = robot, holder
        """The robot's name; the holder's, as shown to people."""


@dataclass
class _Hold:
    operator: Operator
    lock: IO[str] | None
    """None: of a stop, which asks nobody."""
    heard_s: float
    """When the holder last said anything."""
    number: int = field(default_factory=lambda: secrets.randbelow(2**32 - 1) + 1)
    sequence: int = 0
    offered: Operator | None = None
    input: Motion | None = None
    input_s: float = 0.0


@dataclass
class _Channel:
    """To one robot."""

    vehicle: Vehicle
    hold: _Hold | None = None
    signer: Signer | None = None
    """From the first hold on: nobody else needs keys."""
    sent_s: float = -math.inf
    """When the last datagram left."""
    not_before_s: float = -math.inf
    """The hold's first datagram has to wait until then."""
    stop: _Hold | None = None
    """Rest is sent in its name, whoever commands elsewhere: a robot that two command stops."""
    stop_until_s: float = -math.inf
    note: str = ""
    error: str = ""


class Driving:
    """The sender. `address`: this computer's to send from. Robots accept only stations', which prove who they are by
    the keys in `paths.KEYS`. `clock` in s, and `send` in place of a socket's: for tests. As a context manager it sends
    by a thread of its own; else call `tick`."""

    def __init__(
        self,
        fleet: Fleet,
        address: str = sending.EVERYWHERE,
        *,
        clock: Callable[[], float] = time.monotonic,
        send: Callable[[bytes, tuple[str, int]], object] | None = None,
        locks: Path = LOCKS,
    ) -> None:
        self._clock = clock
        self._locks = locks
        self._signer = partial(_signer, fleet, address)
        self._channels = {each.robot: _Channel(each) for each in vehicles(fleet)}
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._socket: socket.socket | None = None
        if send is None:
            self._socket = sending.bound(address)
            send = self._socket.sendto
        self._send = send

    def __enter__(self) -> Driving:
        self._thread = threading.Thread(target=self._run, name="driving", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def vehicles(self) -> list[Vehicle]:
        """The robots that can be driven."""
        return [channel.vehicle for channel in self._channels.values()]

    def take(self, robot: str, operator: Operator) -> None:
        """Hold a robot that nobody holds; who holds it already goes on. HeldError names the holder, UserError the keys
        that this computer lacks."""
        with self._lock:
            channel = self._channel(robot)
            channel.signer = channel.signer or self._signer(channel.vehicle)
            if channel.hold and channel.hold.operator.id != operator.id:
                raise HeldError(robot, channel.hold.operator.name)
            channel.stop = None
            if not channel.hold:
                self._begin(channel, operator, _locked(self._locks, robot, operator))

    def offer(self, robot: str, holder: str, to: Operator | None) -> None:
        """The holder (`id`) offers the robot to another operator, or to nobody any more. Until that one accepts, the
        holder commands."""
        with self._lock:
            hold = self._hold(robot, holder)
            if to and to.id == holder:
                raise Refused(f"{robot}: {to.name} commands it already")
            hold.offered = to

    def accept(self, robot: str, operator: str) -> None:
        """Take over what the holder offers to the operator of this id. The robot stops, and rests until the new holder
        gives an input."""
        with self._lock:
            channel = self._channel(robot)
            hold = channel.hold
            if not hold or not hold.offered or hold.offered.id != operator:
                holder = (
                    f"{hold.operator.name} commands it; ask for an offer" if hold else "nobody commands it; take it"
                )
                raise Refused(f"{robot}: it is not offered to {operator}: {holder}")
            self._halt(channel)
            assert hold.lock
            self._begin(channel, hold.offered, _signed(hold.lock, hold.offered))

    def release(self, robot: str, operator: str) -> None:
        """The holder (`id`) leaves the robot, which stops."""
        with self._lock:
            self._hold(robot, operator)
            self._end(self._channel(robot), "")

    def stop(self, robot: str) -> None:
        """End what anybody holds, and send rest with motors off at once and for STOP_S, or until somebody takes the
        robot here. UserError names the keys that this computer lacks."""
        with self._lock:
            channel = self._channel(robot)
            channel.signer = channel.signer or self._signer(channel.vehicle)
            stop = _Hold(Operator("stop", "stop all"), None, self._clock(), input=Motion(0.0, 0.0, 0.0, False))
            if before := channel.hold or channel.stop:  # the robot goes on to obey whom it obeys
                stop.number, stop.sequence = before.number, before.sequence
                boom = before.input.boom if before.input else 0.0
                stop.input = Motion(0.0, 0.0, boom, False)
            if channel.hold and channel.hold.lock:
                channel.hold.lock.close()
            channel.hold, channel.note, channel.stop = None, "stopped", stop
            channel.stop_until_s = self._clock() + STOP_S
            self._send_stop(channel)

    def drive(self, robot: str, operator: str, v: float, omega: float, boom: float, enable: bool) -> None:
        """The holder's newest input: `v` in m/s, `omega` in rad/s, `boom` in m, clipped to the robot's limits. Give it
        again within DEAD_MAN_S while it is to last, also at rest. Values may come as they were read from JSON."""
        for name, value in (("v", v), ("omega", omega), ("boom", boom)):
            if type(value) not in (int, float) or not -math.inf < value < math.inf:
                raise Refused(f"{robot}: {name}: {value!r}: is no finite number; give one")
        if not isinstance(enable, bool):
            raise Refused(f"{robot}: enable: {enable!r}: is neither true nor false; give one of them")
        motion = Motion(v, omega, boom, enable)
        with self._lock:
            hold = self._hold(robot, operator)
            channel = self._channel(robot)
            hold.input, hold.input_s = channel.vehicle.clipped(motion), self._clock()
            hold.heard_s = hold.input_s
            channel.note = ""

    def state(self, robot: str) -> State:
        with self._lock:
            channel = self._channel(robot)
            hold, now_s = channel.hold, self._clock()
            if not hold:
                return State(robot, None, None, 0, 0, None, None, None, channel.note, channel.error)
            sending, note = self._due(channel, now_s)
            return State(
                robot, hold.operator, hold.offered, hold.number, hold.sequence, hold.input,
                now_s - hold.input_s if hold.input else None, sending, note, channel.error,
            )  # fmt: skip

    @property
    def states(self) -> list[State]:
        """Of all robots that can be driven."""
        return [self.state(robot) for robot in self._channels]

    def tick(self) -> None:
        """Send what is due, a datagram to each robot at most, and end the hold of who was silent for too long."""
        with self._lock:
            self._listen()
            for channel in self._channels.values():
                hold, now_s = channel.hold, self._clock()
                if channel.stop and now_s < channel.stop_until_s:
                    self._send_stop(channel)
                elif hold and now_s - hold.heard_s > SILENT_S:
                    self._end(channel, f"{hold.operator.name} was silent for {SILENT_S:g} s and lost control")
                elif hold and (motion := self._due(channel, now_s)[0]):
                    self._transmit(channel, hold, motion)

    def hear(self, datagram: bytes, address: str) -> None:
        """What a robot answered to a command: a challenge, which the next one meets."""
        for channel in self._channels.values():
            if channel.signer and channel.vehicle.address == address:
                channel.signer.challenged(datagram)

    def close(self) -> None:
        """End all holds, and the thread. Robots that move are told to stop."""
        self._ended.set()
        if self._thread:
            self._thread.join()
        with self._lock:
            for channel in self._channels.values():
                if channel.hold:
                    self._end(channel, "")
            if self._socket:
                self._socket.close()
                self._socket = None

    def _run(self) -> None:
        """By times that are multiples of the interval, so that a late tick is not followed by a second one at once."""
        begun_s, done = time.monotonic(), 0
        while not self._ended.wait(begun_s + (done + 1) / RATE_HZ - time.monotonic()):
            self.tick()
            done = max(done + 1, math.floor((time.monotonic() - begun_s) * RATE_HZ))

    def _listen(self) -> None:
        """To all that has come, within bounds."""
        if not self._socket:
            return
        with contextlib.suppress(BlockingIOError):
            for _ in range(_AT_ONCE):
                datagram, (address, _) = self._socket.recvfrom(_LONGEST)
                self.hear(datagram, address)

    def _channel(self, robot: str) -> _Channel:
        if robot not in self._channels:
            there = did_you_mean(robot, self._channels) if self._channels else f"no robot has the control task {TASK}"
            raise UserError(f"{robot}: is no robot that can be driven; {there}")
        return self._channels[robot]

    def _hold(self, robot: str, operator: str) -> _Hold:
        """The operator's; Refused if it is somebody else's or nobody's."""
        channel = self._channel(robot)
        if not channel.hold:
            why = f": {channel.note}" if channel.note else ""
            raise Refused(f"{robot}: nobody commands it{why}; take it first")
        if channel.hold.operator.id != operator:
            raise HeldError(robot, channel.hold.operator.name)
        return channel.hold

    def _begin(self, channel: _Channel, operator: Operator, lock: IO[str]) -> None:
        channel.hold = _Hold(operator, lock, self._clock())
        channel.not_before_s = channel.sent_s + APART_S
        channel.note = channel.error = ""

    def _end(self, channel: _Channel, note: str) -> None:
        assert channel.hold
        self._halt(channel)
        if channel.hold.lock:
            channel.hold.lock.close()
        channel.hold, channel.note = None, note

    def _due(self, channel: _Channel, now_s: float) -> tuple[Motion | None, str]:
        """What is to be sent, and why it is not as the input says."""
        hold = channel.hold
        if not hold or not hold.input:
            return None, "waits for the first input"
        if now_s < channel.not_before_s:
            return None, "waits until the robot has forgotten the operator before"
        if now_s - hold.input_s > DEAD_MAN_S:
            return hold.input.resting, "no fresh input: at rest"
        return hold.input, channel.note

    def _halt(self, channel: _Channel) -> None:
        """At the end of a hold: stop now, and not only when the robot misses commands."""
        hold = channel.hold
        if hold and hold.input and hold.sequence:
            self._transmit(channel, hold, hold.input.resting)

    def _send_stop(self, channel: _Channel) -> None:
        if channel.stop and channel.stop.input:
            self._transmit(channel, channel.stop, channel.stop.input)

    def _transmit(self, channel: _Channel, hold: _Hold, motion: Motion) -> None:
        hold.sequence = (hold.sequence + 1) % 2**32
        command = COMMAND.pack(hold.number, hold.sequence, motion.v, motion.omega, motion.boom, motion.enable)
        channel.sent_s = self._clock()
        try:
            datagram = channel.signer.sign(command) if channel.signer else command
            self._send(datagram, (channel.vehicle.address, channel.vehicle.port))
            channel.error = ""
        except OSError as error:  # it is lost, as by radio, and the next one follows
            channel.error = f"{channel.vehicle.address}: {error.strerror or error}"


def vehicles(fleet: Fleet) -> list[Vehicle]:
    """The robots that can be driven, with port and limits as their control task has them."""
    return [_vehicle(fleet, robot) for robot in fleet.robots.values() if TASK in robot.control_tasks]


def _vehicle(fleet: Fleet, robot: Robot) -> Vehicle:
    blocks: dict[str, Any] = yaml.safe_load(identity.control_tasks(fleet, robot)[TASK])["blocks"]
    file = paths.shown(paths.TASKS / f"{TASK}.yml")
    try:
        layout = dict(zip(*(blocks["in"]["parameters"][key] for key in ("names", "types")), strict=True))
        limits = {name: blocks[f"{name}_limit"]["parameters"] for name in ("v", "omega", "boom")}
        found = {name: (float(limit["min"]), float(limit["max"])) for name, limit in limits.items()}
        port = int(blocks["command"]["parameters"]["port"])
        signed = "keys" in blocks["command"]["parameters"]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{file}: {error}: is missing or wrong; a station reads command, in and the limits") from error
    if list(layout.items()) != list(LAYOUT.items()):
        raise UserError(f"{file}: in: {layout}: a station sends {LAYOUT}; make it the same here and in driving.py")
    return Vehicle(robot.name, str(robot.address), port, signed, found)


def _signer(fleet: Fleet, address: str, vehicle: Vehicle) -> Signer | None:
    if not vehicle.signed:
        return None
    robot = next(each for each in fleet.robots.values() if each.name == vehicle.robot)
    return sending.signer(_station(fleet, vehicle, address), robot, vehicle.port, "command")


def _station(fleet: Fleet, vehicle: Vehicle, address: str) -> Host:
    """Which of the fleet's stations this computer is."""
    if address == sending.EVERYWHERE and len(fleet.stations) == 1:
        return fleet.stations[0]
    if address == sending.EVERYWHERE:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:  # sends nothing
            with contextlib.suppress(OSError):
                probe.connect((vehicle.address, vehicle.port))
            address = probe.getsockname()[0]
    for station in fleet.stations:
        if address == str(station.address):
            return station
    stations = ", ".join(f"{station.name} {station.address}" for station in fleet.stations)
    raise UserError(f"{address}: is no station's; {vehicle.robot} obeys {stations}; give this computer one's address")


def _locked(directory: Path, robot: str, operator: Operator) -> IO[str]:
    """One program of this computer sends to a robot. The kernel ends the lock with the program."""
    directory.mkdir(parents=True, exist_ok=True)
    file = (directory / f"drive-{robot}").open("a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        holder = file.read().strip() or "another program"
        file.close()
        raise HeldError(robot, holder, "end that program, or have it release the robot") from None
    return _signed(file, operator)


def _signed(file: IO[str], operator: Operator) -> IO[str]:
    file.truncate(0)
    file.write(f"{operator.name} (process {os.getpid()})\n")
    file.flush()
    return file
