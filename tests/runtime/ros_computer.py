"""A computer with ROS 2, as far as DDS shows it, without any code of this project: Dust DDS, another implementation.

As a program: `python -m tests.runtime.ros_computer hear TYPE TOPIC BYTES` prints each message of so many bytes as JSON;
`say TYPE TOPIC MESSAGE` publishes one, in hexadecimal, again and again.

Dust DDS's binding for Python knows no arrays and no floats. So a message is a structure of 32-bit words to it, which is
the same on the wire; rosbags makes these bytes, and reads them.
"""

from __future__ import annotations

import dataclasses
import json
import struct
import sys
import time
from typing import Any

import dust_dds

dds: Any = dust_dds
"""Its stubs are wrong about enumerations."""


def type_of(name: str, length: int) -> Any:
    """A structure of `length` bytes, of the name by which ROS's middlewares announce a message's type."""
    package, kind, message = name.split("/")
    kinds = [dds.TypeKind.uint32] * (length // 4) + [dds.TypeKind.uint8] * (length % 4)
    structure: Any = dataclasses.make_dataclass("Message", [(f"part{i}", each) for i, each in enumerate(kinds)])
    structure.__name__ = f"{package}::{kind}::dds_::{message}_"
    return structure


def layout(length: int) -> struct.Struct:
    """Between bytes and the structure's members."""
    return struct.Struct(f"<{length // 4}I{length % 4}B")


def hear(name: str, topic: str, length: int) -> None:
    """Ask for reliable delivery, as ROS's subscribers do by default."""
    structure = type_of(name, length)
    participant = dds.DomainParticipantFactory.get_instance().create_participant(domain_id=0)
    qos = dds.DataReaderQos(
        reliability=dds.ReliabilityQosPolicy(
            kind=dds.ReliabilityQosPolicyKind.Reliable, max_blocking_time=dds.DurationKind.Infinite()
        )
    )
    reader = participant.create_subscriber().create_datareader(participant.create_topic(f"rt{topic}", structure), qos)
    arrived = reader.get_statuscondition()
    arrived.set_enabled_statuses([dds.StatusKind.DataAvailable])
    waiting = dds.WaitSet()
    waiting.attach_condition(dds.Condition.StatusCondition(arrived))
    while waiting.wait(dds.Duration(sec=60, nanosec=0)):
        for sample in reader.take(max_samples=1):
            (writer,) = (reader.get_matched_publication_data(each) for each in reader.get_matched_publications())
            message = layout(length).pack(*dataclasses.astuple(sample.get_data()))
            row = {"message": message.hex(), "user_data": bytes(writer.get_user_data().get_value()).decode()}
            print(json.dumps(row), flush=True)


def say(name: str, topic: str, message: bytes) -> None:
    structure = type_of(name, len(message))
    participant = dds.DomainParticipantFactory.get_instance().create_participant(domain_id=0)
    writer = participant.create_publisher().create_datawriter(participant.create_topic(f"rt{topic}", structure))
    while True:
        writer.write(structure(*layout(len(message)).unpack(message)))
        time.sleep(0.05)  # the rate of a sensor


if __name__ == "__main__":
    role, *words = sys.argv[1:]
    if role == "hear":
        hear(words[0], words[1], int(words[2]))
    else:
        say(words[0], words[1], bytes.fromhex(words[2]))
