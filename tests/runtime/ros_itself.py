"""ROS 2 itself, with its default middleware; for the environment that requirements/ros.lock describes.

`hear TYPE TOPIC` prints each message, in hexadecimal, as ROS serializes it; `say TYPE TOPIC MESSAGE` publishes one.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any

import rclpy
from rclpy.serialization import deserialize_message, serialize_message


def type_of(name: str) -> Any:
    package, kind, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), message)


def main(role: str, name: str, topic: str, message: str = "") -> None:
    kind = type_of(name)
    rclpy.init()
    node = rclpy.create_node("computer")
    if role == "hear":
        node.create_subscription(kind, topic, lambda heard: print(serialize_message(heard).hex(), flush=True), 10)
    else:
        publisher = node.create_publisher(kind, topic, 10)
        said = deserialize_message(bytes.fromhex(message), kind)
        node.create_timer(0.05, lambda: publisher.publish(said))  # the rate of a sensor
    rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:])
