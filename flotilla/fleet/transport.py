"""What control tasks' templates make of messages: parameters of pack and unpack, and blocks that send and receive.

In a template, `message("state")` is the message of that name in `messages.yml`, as this task on this robot uses it:

    message:
      type: pack
      in: { step: clock.step, ... }
      parameters:
  {{ message("state").layout }}
    to_control:
  {{ message("state").send("message.out") }}

The inventory names the transport between tasks (`network.transport`): UDP, or DDS topics. Both carry the same bytes.
Each message by UDP proves who sent it and that it is new.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isclose

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.yaml_file import did_you_mean
from flotilla.fleet.message_keys import CREDENTIAL
from flotilla.fleet.model import STATIONS, Fleet, Host, Message, Robot

_EXPEDITED = 46
"""DSCP of messages between tasks (RFC 3246): radios send them before others."""
_SECONDS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}


@dataclass(frozen=True)
class Hop:
    """A message as one task on one robot uses it."""

    name: str
    message: Message
    fleet: Fleet
    robot: Robot
    task: str

    @property
    def every(self) -> int:
        """Steps of the sender from one message to the next."""
        return self.message.every

    @property
    def layout(self) -> str:
        """The parameters that make a block pack or unpack it; lines of a mapping below `parameters:`."""
        signals = self.message.signals
        rows: dict[str, Sequence[object]] = {
            "names": list(signals),
            "types": [signal.type for signal in signals.values()],
            "widths": [signal.width for signal in signals.values()],
        }
        return "\n".join(f"      {key}: {_flow(values)}" for key, values in rows.items())

    @property
    def stood_by(self) -> bool:
        """Whether a further robot of the fleet is a hot standby for the sender."""
        return self.message.standby and len(self.fleet.robots_with(self.message.sender)) > 1

    def send(self, data: str, made_of: str = "", silent: str = "") -> str:
        """The keys of a block that sends `data` to each robot that has the receiver, hot standbys included, or to all
        stations.

        `made_of`: the block whose message it is made of. It sends nothing in a step without a new one: who gets none
        then has such a step, too, and a repeated message would take the place of the next. `silent`: the output that is
        true while the sender has nothing good to say; where there is a hot standby, it then sends nothing, so that
        receivers turn to the other one.
        """
        self._check("sends", self.message.sender)
        message, network = self.message, self.fleet.network
        inputs = {"data": data}
        if made_of:
            inputs["sequence"] = f"{made_of}.sequence"
        if silent and self.stood_by:
            inputs["withhold"] = silent
        if message.receiver == STATIONS:
            to = {"address": addresses(self.fleet.stations), "port": message.port, "length": message.bytes}
            return _block("udp-send", message.every, inputs, to | {"keys": CREDENTIAL})
        if network.transport == "dds":
            return _block("dds-publish", message.every, inputs, {**self._topic, "robot": self.robot.number})
        receivers = self.fleet.robots_with(message.receiver)
        to = {"address": addresses(receivers), "port": message.port, "length": message.bytes, "dscp": _EXPEDITED}
        return _block("udp-send", message.every, inputs, to | {"keys": CREDENTIAL})

    @property
    def receive(self) -> str:
        """The keys of a block that receives it from the sender and its hot standbys: outputs data, flag, age, sequence,
        sender. A hot standby is listened to after three periods without a message of the sender."""
        self._check("receives", self.message.receiver)
        message, fleet = self.message, self.fleet
        senders = fleet.robots_with(message.sender) if message.standby else [fleet.robot_with(message.sender)]
        timeout = {"timeout": f"{(message.deadline_ms or 0) / 1e3:g}"}
        if fleet.network.transport == "dds":
            numbers = _flow([robot.number for robot in senders])
            return _block("dds-subscribe", 1, {}, {**self._topic, "robot": numbers, **timeout})
        self._check_port()
        come = {"port": message.port, "from": addresses(senders), "length": message.bytes, **timeout}
        return _block("udp-receive", 1, {}, come | {"keys": CREDENTIAL})

    @property
    def _topic(self) -> dict[str, object]:
        network = self.fleet.network
        topic = {"type": "bytes", "bytes": self.message.bytes, "topic": self.name, "domain": network.dds_domain}
        return topic | ({"partition": "robot"} if network.dds_security else {})

    def _check(self, does: str, task: str) -> None:
        if self.task != task:
            raise UserError(
                f"{_file()}: {self.name}: {task} {does} it, and {self.task} wants to; make it a message of its own"
            )

    def _check_port(self) -> None:
        admitted = self.fleet.network.udp_ports
        ranges = ([int(end) for end in ports.split("-")] for ports in admitted)
        if not any(ends[0] <= self.message.port <= ends[-1] for ends in ranges):
            raise UserError(
                f"{_file()}: {self.name}.port: {self.message.port}: robots' firewalls drop it; a port of "
                f"{', '.join(admitted)}, or add it to network.udp_ports in group_vars/all.yml"
            )


def hop(fleet: Fleet, robot: Robot, task: str, name: str) -> Hop:
    """The message `name`, for the template of `task` on `robot`; UserError if there is none."""
    if name not in fleet.messages:
        known = did_you_mean(name, fleet.messages) if fleet.messages else "there are none"
        raise UserError(f"message {name}: is not in {_file()}; {known}")
    return Hop(name, fleet.messages[name], fleet, robot, task)


def addresses(hosts: Sequence[Host]) -> str:
    """Of these hosts, as a parameter: one, or a list."""
    listed = ", ".join(str(host.address) for host in hosts)
    return f"[{listed}]" if len(hosts) > 1 else listed


def problems(fleet: Fleet, name: str, task: object) -> Iterator[str]:
    """Where the period of a control task, rendered and parsed, is not the one that its messages' rates say. What is no
    period at all is the runtime's to say."""
    period = str(task.get("period")) if isinstance(task, dict) else ""
    try:
        period_s = duration_s(period)
    except ValueError:
        return
    for message, described in fleet.messages.items():
        if described.sender == name and not isclose(described.step_s, period_s):
            yield (
                f"period: {period}: with it {message} comes {1 / (period_s * described.every):g} times a second, "
                f"and {_file()} has {described.rate_hz:g}; correct period, or rate_hz or every there"
            )


def duration_s(text: str) -> float:
    """Of a task file's `10 ms`; ValueError if it is none above 0."""
    number = text.rstrip("nuµms ")
    found = float(number) * _SECONDS.get(text[len(number) :].strip(), 0)
    if found > 0:
        return found
    raise ValueError(f"{text} is no duration; such as 10 ms")


def _block(kind: str, every: int, inputs: Mapping[str, object], parameters: Mapping[str, object]) -> str:
    """Whole lines, so that an empty one follows where the template's own line ends."""
    lines = {"type": kind} | ({"every": str(every)} if every > 1 else {}) | ({"in": _flow(inputs)} if inputs else {})
    return "".join(f"    {key}: {value}\n" for key, value in (lines | {"parameters": _flow(parameters)}).items())


def _flow(values: Mapping[str, object] | Sequence[object]) -> str:
    """In YAML's flow style."""
    if isinstance(values, Mapping):
        return f"{{ {', '.join(f'{key}: {value}' for key, value in values.items())} }}"
    return f"[{', '.join(map(str, values))}]"


def _file() -> str:
    return paths.shown(paths.TASKS / paths.MESSAGES)
