"""What robots tell the station: the messages of `ansible/control_tasks/messages.yml` whose receiver is `stations`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from flotilla.fleet.drawings import Drawing
from flotilla.fleet.model import STATIONS, Fleet, Message
from flotilla.station.recording import Field, Value


@dataclass(frozen=True)
class Stream:
    """Datagrams of one robot's task."""

    robot: str
    task: str
    name: str
    """The message's, without the task's before it."""
    address: str
    """They come from."""
    port: int
    """UDP port of the station."""
    fields: tuple[Field, ...]
    step_s: float
    """The task's period."""
    every: int
    """Steps of the task from one datagram to the next."""
    charge: str | None = None
    """The field that is a battery's state of charge, 0 to 1."""
    attempts: tuple[str, ...] = ()
    """Fields that count what the robot refused since the task began."""
    units: Mapping[str, Sequence[str]] = field(default_factory=dict, compare=False)
    """Of each signal's elements, or one for all, where messages.yml says them."""
    drawings: Mapping[str, Drawing] = field(default_factory=dict, compare=False)
    """What viewers draw of it, by name; `pose` has the topic `/robot1/valves/report/pose`."""

    @property
    def length(self) -> int:
        """Bytes of a datagram."""
        return self.fields[-1].end

    @property
    def rate_hz(self) -> float:
        """Datagrams in a second when nothing is late or lost."""
        return 1 / (self.step_s * self.every)

    @property
    def topic(self) -> str:
        """`/robot1/valves/report`."""
        return f"/{self.robot}/{self.task}/{self.name}"

    def unpack(self, datagram: bytes) -> dict[str, Value]:
        """Its values by name; the length has to be right."""
        return {field.name: field.of(datagram) for field in self.fields}


def streams(fleet: Fleet) -> list[Stream]:
    """All that reach the stations of the fleet; none without a station."""
    return [
        Stream(
            robot=robot.name,
            task=task,
            name=name.removeprefix(f"{task}-"),
            address=str(robot.address),
            port=message.port,
            fields=tuple(_fields(message)),
            step_s=message.step_s,
            every=message.every,
            charge=message.charge,
            attempts=tuple(message.attempts),
            units={name.replace("-", "_"): signal.unit for name, signal in message.signals.items() if signal.unit},
            drawings={name: Drawing(drawn, message.signals) for name, drawn in message.foxglove.items()},
        )
        for robot in fleet.robots.values()
        for task in robot.control_tasks
        for name, message in fleet.messages.items()
        if fleet.stations and (message.sender, message.receiver) == (task, STATIONS)
    ]


def _fields(message: Message) -> Iterator[Field]:
    offset = 0
    for name, signal in message.signals.items():
        field = Field(name, signal.type, signal.width, offset)
        yield field
        offset = field.end
