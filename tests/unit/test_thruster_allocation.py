"""Duties of thrusters, judged by scipy's linear programmes, which share nothing with `allocation.c`."""

from __future__ import annotations

import ctypes
import math
import subprocess
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from flotilla.common import paths
from flotilla.lab.plants.plant import COMPILE

SIGNAL = paths.PROJECT / "runtime" / "blocks" / "signal"
MOST = 16
FACETS, TILES = 120, 560
TOLERANCE = 1e-6
"""HiGHS's own is 1e-7 for each bound and each equation."""

Array = NDArray[np.float64]


class _Facets(ctypes.Structure):
    _fields_ = (("normal", ctypes.c_double * 3), ("along", ctypes.c_double), ("against", ctypes.c_double))


class _Tile(ctypes.Structure):
    _fields_ = (
        ("thruster", ctypes.c_uint32 * 3),
        ("full", ctypes.c_uint32),
        ("inverse", ctypes.c_double * 9),
        ("offset", ctypes.c_double * 3),
    )


class _Allocation(ctypes.Structure):
    """As `struct allocation`."""

    _fields_ = (
        ("count", ctypes.c_uint32),
        ("column", ctypes.c_double * 3 * MOST),
        ("facet_count", ctypes.c_uint32),
        ("tile_count", ctypes.c_uint32),
        ("facets", _Facets * FACETS),
        ("tiles", _Tile * TILES),
    )


class Allocation:
    """`allocation.c` with these columns, a force in x and y and a torque for each thruster."""

    def __init__(self, library: ctypes.CDLL, columns: Array) -> None:
        self._library = library
        self._allocation = _Allocation(count=len(columns))
        for i, column in enumerate(columns):
            self._allocation.column[i][:] = column
        library.allocation_prepare(ctypes.byref(self._allocation))

    def __call__(self, wanted: Array) -> tuple[Array, float]:
        duty = (ctypes.c_double * MOST)()
        share: float = self._library.allocate(ctypes.byref(self._allocation), (ctypes.c_double * 3)(*wanted), duty)
        return np.array(duty[: self._allocation.count]), share


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    out = tmp_path_factory.mktemp("allocation") / "allocation.so"
    subprocess.run([*COMPILE, f"-I{paths.PROJECT}/runtime", "-o", out, SIGNAL / "allocation.c", "-lm"], check=True)
    loaded = ctypes.CDLL(str(out))
    loaded.allocation_prepare.restype = None
    loaded.allocate.restype = ctypes.c_double
    return loaded


def _columns(positions: Any, directions: Any, force: Any) -> Array:
    position, direction = np.reshape(positions, (-1, 2)), np.reshape(directions, (-1, 2))
    direction = direction / np.linalg.norm(direction, axis=1)[:, None]
    torque = position[:, 0] * direction[:, 1] - position[:, 1] * direction[:, 0]
    columns: Array = np.column_stack([direction, torque]) * np.broadcast_to(force, len(torque))[:, None]
    return columns


def _geometries() -> Iterator[tuple[str, Array]]:
    """Twenty: any 3 to 16 thrusters, and six whose optimum is often not the only one."""
    for count in range(3, 17):
        random = np.random.default_rng(count)
        angle = random.uniform(0, 2 * math.pi, count)
        yield (
            f"any {count}",
            _columns(
                random.uniform(-0.5, 0.5, (count, 2)),
                np.column_stack([np.cos(angle), np.sin(angle)]),
                random.uniform(0.1, 2, count),
            ),
        )
    arm = 0.05
    floating = [-0.2, arm, -0.2, -arm, 0.2, arm, 0.2, -arm, arm, -0.2, -arm, -0.2, arm, 0.2, -arm, 0.2]
    yield "floating robot", _columns(floating, [1, 0, 1, 0, -1, 0, -1, 0, 0, 1, 0, 1, 0, -1, 0, -1], 0.16)
    corners = [0.15, 0.15, 0.15, 0.15, -0.15, 0.15, -0.15, 0.15, -0.15, -0.15, -0.15, -0.15, 0.15, -0.15, 0.15, -0.15]
    yield "two at each corner", _columns(corners, [1, 0, 0, 1, -1, 0, 0, 1, -1, 0, 0, -1, 1, 0, 0, -1], 0.3)
    ring = [2 * math.pi * k / 8 for k in range(8)]
    places = [[math.cos(a), math.sin(a)] for a in ring for _ in range(2)]
    pushes = [[-s * math.sin(a), s * math.cos(a)] for a in ring for s in (1, -1)]
    yield "a ring of tangents", _columns(places, pushes, 1)
    yield "each twice", _columns(floating * 2, [1, 0, 1, 0, -1, 0, -1, 0, 0, 1, 0, 1, 0, -1, 0, -1] * 2, 0.16)
    yield "one side only", _columns([0, 1, 0, 2, 0, -1, 0, -2, 0, 0.5], [1, 0, 1, 1, 1, -1, 1, 0, 1, 0], 1)
    # As near to a plane as the allocation still tells apart.
    yield (
        "nearly no arms",
        _columns(np.array(floating) * 1e-5, [1, 0, 1, 0, -1, 0, -1, 0, 0, 1, 0, 1, 0, -1, 0, -1], 0.16) * [1, 1, 1e5],
    )


GEOMETRIES = dict(_geometries())


def _commands(columns: Array, count: int, seed: int) -> Iterator[Array]:
    """Of all directions, from nothing to twice of what there is; and those that lie on edges and corners."""
    random = np.random.default_rng(seed)
    for i in range(count):
        wanted = random.uniform(-1, 1, 3) * np.abs(columns).sum(axis=0) * random.uniform(0, 1)
        match i % 8:
            case 0:
                wanted[random.integers(3)] = 0
            case 1:
                wanted = np.eye(3)[random.integers(3)] * wanted
            case 2:  # what some thrusters make that are on all the time, or half of it
                wanted = random.integers(0, 2, len(columns)) @ columns * random.choice([0.5, 1])
            case 3:
                wanted = wanted * 1e-6
        yield wanted


def _judge(columns: Array, wanted: Array, duty: Array, share: float) -> None:
    """That the duties are possible, make as much of the command as can be made, and that with the least sum."""
    assert ((duty >= 0) & (duty <= 1)).all()
    made = duty @ columns
    strength = np.abs(columns).sum(axis=0)
    assert np.abs(made - share * wanted).max() <= 1e-8 * strength.max(), (wanted, duty)
    if share < 1:  # at 1 there is no more
        size = np.abs(wanted / strength).max()
        direction = np.column_stack([columns.T, -wanted / size])
        most = linprog([*np.zeros(len(columns)), -1], A_eq=direction, b_eq=np.zeros(3), bounds=(0, 1))
        assert most.status == 0, most.message
        assert share * size == pytest.approx(min(-most.fun, size), abs=TOLERANCE), wanted
    least = linprog(np.ones(len(columns)), A_eq=columns.T, b_eq=made, bounds=(0, 1))
    assert least.status == 0, least.message
    assert duty.sum() == pytest.approx(least.fun, abs=TOLERANCE * len(columns)), wanted


def _judge_geometry(library: ctypes.CDLL, name: str, count: int) -> None:
    columns = GEOMETRIES[name]
    allocate = Allocation(library, columns)
    over = 0
    for wanted in _commands(columns, count, seed=1):
        duty, share = allocate(wanted)
        _judge(columns, wanted, duty, share)
        over += share < 1
    assert 0 < over < count


@pytest.mark.parametrize("name", GEOMETRIES)
def test_linprog_finds_nothing_better(library: ctypes.CDLL, name: str) -> None:
    _judge_geometry(library, name, 100)


@pytest.mark.nightly
@pytest.mark.parametrize("name", GEOMETRIES)
def test_linprog_finds_nothing_better_in_ten_thousand(library: ctypes.CDLL, name: str) -> None:
    _judge_geometry(library, name, 10_000)


def test_a_small_change_of_the_command_is_one_of_the_duties(library: ctypes.CDLL) -> None:
    """No thruster jumps, so valves do not flicker: along lines through all that can be made, the largest step of a duty
    becomes small where the line is divided further. Where thrusters can make no command of some direction, what they
    make does jump as the command turns away."""
    tried = 0
    for columns in GEOMETRIES.values():
        allocate = Allocation(library, columns)
        tiny = 1e-3 * np.abs(columns).sum(axis=0).min() * np.eye(3)
        if any(allocate(sign * axis)[1] < 1 for axis in tiny for sign in (1, -1)):
            continue
        tried += 1
        lines = zip(_commands(columns, 20, seed=2), _commands(columns, 20, seed=3), strict=True)
        assert max(_largest_jump(allocate, begin, end) for begin, end in lines) < 1e-3
    assert tried >= 12


def _largest_jump(allocate: Allocation, begin: Array, end: Array) -> float:
    for parts in (500, *[2] * 25):
        points = [begin + (end - begin) * k / parts for k in range(parts + 1)]
        jumps = np.abs(np.diff([allocate(point)[0] for point in points], axis=0)).max(axis=1)
        widest = int(jumps.argmax())
        begin, end = points[widest], points[widest + 1]
    return float(jumps.max())


def test_the_judge_sees_what_is_wrong(library: ctypes.CDLL) -> None:
    columns = GEOMETRIES["floating robot"]
    allocate = Allocation(library, columns)
    wanted = np.array([0.32, 0.1, 0.002])
    duty, share = allocate(wanted)
    _judge(columns, wanted, duty, share)
    opposed = duty + 0.01 * np.array([1, 1, 1, 1, 0, 0, 0, 0]) * (duty < 0.9)
    for wrong, said in [(duty / 2, share), (duty / 2, share / 2), (opposed, share)]:
        with pytest.raises(AssertionError):
            _judge(columns, wanted, wrong, said)
