"""The wheeled robot of `wheeled.c` and its rooms, for tests. Names, units and meaning: `wheeled.h`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError

DIRECTORY = Path(__file__).resolve().parent
ROBOT = DIRECTORY / "wheeled_robot.yml"
ROOMS = DIRECTORY / "rooms"
HEADER = DIRECTORY / "wheeled.h"
SCAN_STEPS = 682

Wall = tuple[float, float, float, float]
"""x, y of one end and of the other, in m."""


def names() -> dict[str, int]:
    """Parameters in the order of the structure, and how many numbers each is."""
    found = re.search(r"struct wheeled_parameters \{(.*?)\n\};", HEADER.read_text(), re.DOTALL)
    assert found, "wheeled.h has no structure of parameters"
    members = re.findall(r"^ {4}double (\w+)(?:\[(\d+)\])?;", found.group(1), re.MULTILINE)
    return {name: int(count or 1) for name, count in members}


def figures(file: Path = ROBOT, /, **changes: float | Sequence[float]) -> list[float]:
    """The parameters of a file but for `changes`, as the block wheeled-robot takes them; UserError says what is wrong
    with either. What a number may be is the block's to say."""
    values = _mapping(file) | changes
    wanted = names()
    for name in values:
        if name not in wanted:
            raise UserError(f"{paths.shown(file)}: {name}: there is no such parameter; there are {', '.join(wanted)}")
    packed: list[float] = []
    for name, count in wanted.items():
        if name not in values:
            raise UserError(f"{paths.shown(file)}: {name}: is missing; give {_numbers(count)}")
        packed += _read(file, name, values[name], count)
    return packed


def walls(room: Path) -> list[float]:
    """The walls of a room's file, one after the other."""
    content = _mapping(room)
    if set(content) != {"walls"} or not isinstance(content["walls"], list):
        raise UserError(f"{paths.shown(room)}: has keys {', '.join(content)}; it needs `walls`, a list, and no other")
    return [number for wall in content["walls"] for number in _read(room, "walls", wall, 4)]


def _mapping(file: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{paths.shown(file)}: cannot be read: {error}") from None
    except yaml.YAMLError as error:
        raise UserError(f"{paths.shown(file)}: is not YAML: {error}") from None
    if not isinstance(content, Mapping):
        raise UserError(f"{paths.shown(file)}: is not a mapping such as `mass: 15`")
    return dict(content)


def _read(file: Path, name: str, value: object, count: int) -> list[float]:
    numbers: list[Any] = list(value) if isinstance(value, list | tuple) else [value]
    good = len(numbers) == count and all(
        isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number) for number in numbers
    )
    if not good:
        raise UserError(f"{paths.shown(file)}: {name}: {value}: is not {_numbers(count)}")
    return [float(number) for number in numbers]


def _numbers(count: int) -> str:
    return "a number" if count == 1 else f"a list of {count} numbers"
