"""The floating robot of `plant.c`, for tests in real time on this computer. Names, units and meaning: `plant.h`."""

from __future__ import annotations

import ctypes
import functools
import math
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from flotilla.common import cache, paths
from flotilla.common.errors import UserError

DIRECTORY = Path(__file__).resolve().parent
ROBOT = DIRECTORY / "floating_robot.yml"
SOURCES = (DIRECTORY / "plant.c", DIRECTORY / "plant.h")
THRUSTERS = 8
LONGEST_SECONDS = 60
"""Of one step."""

COMPILE = ("cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-shared", "-fPIC")


class _Range(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("unit", ctypes.c_char_p),
        ("offset", ctypes.c_uint32),
        ("count", ctypes.c_uint32),
        ("uniform", ctypes.c_bool),
        ("least", ctypes.c_double),
        ("most", ctypes.c_double),
    )


class Motion(ctypes.Structure):
    """As `struct plant_motion`: `pose` x m, y m, heading rad; `velocity` m/s, m/s, rad/s."""

    _fields_ = (("pose", ctypes.c_double * 3), ("velocity", ctypes.c_double * 3))


class Account(ctypes.Structure):
    """As `struct plant_account`: J, N·s, N·m·s, ns."""

    _fields_ = (
        ("work_thrusters", ctypes.c_double),
        ("work_tilt", ctypes.c_double),
        ("impulse", ctypes.c_double * 2),
        ("angular_impulse", ctypes.c_double),
        ("on_time_ns", ctypes.c_int64 * THRUSTERS),
        ("switches", ctypes.c_uint32 * THRUSTERS),
    )


Values = Mapping[str, float | Sequence[float]]
"""Parameters by name."""


class Plant:
    """A floating robot at its initial pose, its valves closed."""

    def __init__(self, file: Path = ROBOT, **changes: float | Sequence[float]) -> None:
        """The robot that `file` describes, but for `changes`; UserError names what is wrong with either."""
        self._library = library()
        parameters = _packed(self._library, file, {**_read(file), **changes})
        why = ctypes.create_string_buffer(200)
        if not self._library.plant_check(parameters, why, len(why)):
            raise UserError(f"{paths.shown(file)}: {why.value.decode()}")
        self._plant = ctypes.create_string_buffer(self._library.plant_size())
        self._library.plant_begin(self._plant, parameters)
        self._motion: Motion = self._library.plant_motion(self._plant).contents
        self._account: Account = self._library.plant_account(self._plant).contents

    def step(self, seconds: float, valves: Sequence[bool] = (False,) * THRUSTERS) -> None:
        """Command the valves, True to open, and let time pass, in whole nanoseconds."""
        if len(valves) != THRUSTERS:
            raise ValueError(f"{len(valves)} valves, not {THRUSTERS}")
        if not 0 <= seconds <= LONGEST_SECONDS:  # which NaN is not
            raise ValueError(f"{seconds} s is not from 0 to {LONGEST_SECONDS} s")
        commands = (ctypes.c_bool * THRUSTERS)(*valves)
        done: bool = self._library.plant_advance(self._plant, round(seconds * 1e9), commands)
        assert done, "plant.h has another longest time"

    @property
    def pose(self) -> tuple[float, float, float]:
        """x and y in m, heading in rad, from x to y and not wrapped."""
        x, y, heading = self._motion.pose
        return x, y, heading

    @property
    def velocity(self) -> tuple[float, float, float]:
        """x and y in m/s in the table's axes, turn rate in rad/s."""
        x, y, rate = self._motion.velocity
        return x, y, rate

    @property
    def on_time(self) -> tuple[float, ...]:
        """Seconds that each valve has been open."""
        return tuple(ns / 1e9 for ns in self._account.on_time_ns)

    @property
    def switches(self) -> tuple[int, ...]:
        """How often each valve has opened or closed."""
        return tuple(self._account.switches)

    @property
    def work(self) -> tuple[float, float]:
        """Done since the beginning by thrusters and by the table's slope, in J."""
        return self._account.work_thrusters, self._account.work_tilt

    @property
    def impulse(self) -> tuple[float, float, float]:
        """Of the thrusters since the beginning: x and y in N·s in the table's axes, angular in N·m·s."""
        x, y = self._account.impulse
        return x, y, self._account.angular_impulse

    def igps(self) -> tuple[float, float]:
        """x and y in m as measured; another deviate with each call."""
        position = (ctypes.c_double * 2)()
        self._library.plant_igps(self._plant, position)
        return position[0], position[1]

    def gyro_deg_s(self) -> float:
        """Turn rate in °/s as measured, clockwise positive; another deviate with each call."""
        rate: float = self._library.plant_gyro_deg_s(self._plant)
        return rate


@functools.cache
def library() -> ctypes.CDLL:
    """`plant.c`, compiled for this computer unless it was before."""
    compiler = subprocess.run([COMPILE[0], "--version"], capture_output=True, text=True, check=True).stdout
    key = cache.digest(compiler, platform.machine(), " ".join(COMPILE), *SOURCES)

    def make(out: Path) -> None:
        subprocess.run([*COMPILE, "-o", str(out / "plant.so"), str(SOURCES[0]), "-lm"], check=True)

    loaded = ctypes.CDLL(str(cache.result("plant", key, make) / "plant.so"))
    loaded.plant_check.restype = ctypes.c_bool
    loaded.plant_check.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_size_t)
    loaded.plant_size.restype = ctypes.c_size_t
    loaded.plant_begin.restype = None
    loaded.plant_begin.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    loaded.plant_advance.restype = ctypes.c_bool
    loaded.plant_advance.argtypes = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p)
    loaded.plant_motion.restype = ctypes.POINTER(Motion)
    loaded.plant_motion.argtypes = (ctypes.c_void_p,)
    loaded.plant_account.restype = ctypes.POINTER(Account)
    loaded.plant_account.argtypes = (ctypes.c_void_p,)
    loaded.plant_igps.restype = None
    loaded.plant_igps.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    loaded.plant_gyro_deg_s.restype = ctypes.c_double
    loaded.plant_gyro_deg_s.argtypes = (ctypes.c_void_p,)
    loaded.plant_random.restype = ctypes.c_uint64
    loaded.plant_random.argtypes = (ctypes.c_void_p,)
    loaded.plant_deviate.restype = ctypes.c_double
    loaded.plant_deviate.argtypes = (ctypes.c_void_p,)
    return loaded


def _read(file: Path) -> dict[str, Any]:
    shown = paths.shown(file)
    try:
        content = yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{shown}: cannot be read: {error}") from None
    except yaml.YAMLError as error:
        raise UserError(f"{shown}: is not YAML: {error}") from None
    if not isinstance(content, dict):
        raise UserError(f"{shown}: is not a mapping of parameters such as `mass: 10.5`")
    return content


def _packed(library: ctypes.CDLL, file: Path, values: Values) -> ctypes.Array[ctypes.c_double]:
    """`struct plant_parameters`: doubles, as `plant_ranges` says."""
    count = ctypes.c_uint32.in_dll(library, "plant_range_count").value
    ranges = {each.name.decode(): each for each in (_Range * count).in_dll(library, "plant_ranges")}
    for name in values:
        if name not in ranges:
            raise UserError(f"{paths.shown(file)}: {name}: there is no such parameter; there are {', '.join(ranges)}")
    size = max(each.offset + each.count for each in ranges.values())
    packed: ctypes.Array[ctypes.c_double] = (ctypes.c_double * size)()
    for name, limits in ranges.items():
        if name not in values:
            raise UserError(f"{paths.shown(file)}: {name}: is missing; give {_wanted(limits)}")
        value = values[name]
        numbers: list[Any] = list(value) if isinstance(value, list | tuple) else [value]
        if limits.uniform and len(numbers) == 1:
            numbers *= limits.count
        if len(numbers) != limits.count or not all(_is_number(number) for number in numbers):
            raise UserError(f"{paths.shown(file)}: {name}: {value}: is not {_wanted(limits)}")
        packed[limits.offset : limits.offset + limits.count] = numbers
    return packed


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _wanted(limits: _Range) -> str:
    number = f"from {limits.least:g} to {limits.most:g} {limits.unit.decode()}".rstrip()
    if limits.count == 1:
        return f"a number {number}"
    return f"a list of {limits.count} numbers {number}" + (", or one for all" if limits.uniform else "")
