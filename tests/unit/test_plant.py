"""The floating robot as physics: against closed forms, an integrator of another kind, and its own books.

Each was seen to fail with a defect put into `plant.c` or `plant.py`, which it names.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import fmean, pstdev
from typing import Any

import pytest

from flotilla.common.errors import UserError
from flotilla.lab.plants.plant import ROBOT, THRUSTERS, Plant, library

MASS, INERTIA, FORCE, ARM = 10.5, 0.063, 0.16, 0.05
IDEAL: dict[str, Any] = {
    "thrust_noise": 0,
    "minimum_on_time": 0,
    "opening_delay": 0,
    "closing_delay": 0,
    "tilt": [0, 0],
    "gyro_bias_deg_s": 0,
}
"""Valves without delay, a level table: what a closed form is of."""
ROWS = ((1, 0, -1), (1, 0, 1), (-1, 0, 1), (-1, 0, -1), (0, 1, 1), (0, 1, -1), (0, -1, -1), (0, -1, 1))
"""Force x, force y and torque of each thruster of floating_robot.yml, in FORCE and FORCE · ARM."""


def valves(*opened: int) -> list[bool]:
    return [i in opened for i in range(THRUSTERS)]


FORWARD, SPIN, NONE = valves(0, 1), valves(1, 2), valves()


# --- motion ---


def test_constant_force() -> None:
    """x = F t² / 2 m. Seen to fail with half the weight of a stage."""
    plant = Plant(**IDEAL)
    plant.step(12.3456789, FORWARD)
    assert plant.pose == pytest.approx((2 * FORCE * 12.3456789**2 / 2 / MASS, 0, 0), rel=1e-12, abs=1e-12)
    assert plant.velocity == pytest.approx((2 * FORCE * 12.3456789 / MASS, 0, 0), rel=1e-12, abs=1e-12)


def test_constant_torque() -> None:
    """θ = τ t² / 2 J, with no force. Seen to fail with the torque's sign changed."""
    plant = Plant(**IDEAL)
    plant.step(3, SPIN)
    acceleration = 2 * FORCE * ARM / INERTIA
    assert plant.velocity == pytest.approx((0, 0, 3 * acceleration), rel=1e-12, abs=1e-12)
    assert plant.pose == pytest.approx((0, 0, 9 / 2 * acceleration), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("rate", [0.5, -7.0])
def test_force_while_spinning(rate: float) -> None:
    """v = F / m ω · (sin ωt, 1 − cos ωt), and its integral. Seen to fail with R(−θ) for R(θ), and with another node."""
    plant = Plant(**IDEAL, initial_velocity=[0, 0, rate])
    for _ in range(500):
        plant.step(0.01, FORWARD)
    unit = 2 * FORCE / MASS / rate
    angle = 5 * rate
    velocity = (unit * math.sin(angle), unit * (1 - math.cos(angle)), rate)
    pose = (unit / rate * (1 - math.cos(angle)), unit / rate * (angle - math.sin(angle)), angle)
    assert plant.velocity == pytest.approx(velocity, rel=1e-11)
    assert plant.pose == pytest.approx(pose, rel=1e-11)


@pytest.mark.parametrize("pair", [(0, 2), (1, 3), (4, 6), (5, 7)])
def test_opposing_pair_cancels(pair: tuple[int, int]) -> None:
    """What is left is a torque or nothing. Seen to fail with one thruster's direction turned round."""
    plant = Plant(**IDEAL, initial_pose=[1, 2, 0.7])
    plant.step(5, valves(*pair))
    assert plant.pose[:2] == pytest.approx((1, 2), abs=1e-12)
    turns = sum(ROWS[i][2] for i in pair)
    assert plant.velocity[2] == pytest.approx(turns * FORCE * ARM / INERTIA * 5, rel=1e-12, abs=1e-12)


def test_slope_accelerates() -> None:
    """Along the table's axes, whatever the heading. Seen to fail with the slope turned like a thrust."""
    plant = Plant(**{**IDEAL, "tilt": [3e-4, -1e-4]}, initial_pose=[0, 0, 1], initial_velocity=[0.1, 0, 2])
    plant.step(10)
    assert plant.pose == pytest.approx((1 + 0.015, -0.005, 21), rel=1e-12)
    assert plant.velocity == pytest.approx((0.103, -0.001, 2), rel=1e-12)


def schedule() -> Iterator[tuple[float, list[bool]]]:
    """Eight seconds of firings in all combinations."""
    for i in range(80):
        yield 0.1, [bool(i * 37 % 256 >> thruster & 1) for thruster in range(THRUSTERS)]


TILT = (2e-3, -1e-3)
Vector = tuple[float, ...]


def rates(state: Vector, force: Vector) -> Vector:
    """Derivatives of x, y, θ, vx, vy, ω."""
    _, _, heading, vx, vy, rate = state
    fx, fy, torque = force
    ax = (math.cos(heading) * fx - math.sin(heading) * fy) / MASS + TILT[0]
    ay = (math.sin(heading) * fx + math.cos(heading) * fy) / MASS + TILT[1]
    return vx, vy, rate, ax, ay, torque / INERTIA


def runge_kutta(state: Vector, force: Vector, h: float) -> Vector:
    def moved(by: Vector, step: float) -> Vector:
        return tuple(x + step * v for x, v in zip(state, by, strict=True))

    a = rates(state, force)
    b = rates(moved(a, h / 2), force)
    c = rates(moved(b, h / 2), force)
    d = rates(moved(c, h), force)
    return moved(tuple((p + 2 * q + 2 * r + s) / 6 for p, q, r, s in zip(a, b, c, d, strict=True)), h)


def test_another_integrator_agrees() -> None:
    """The classical Runge-Kutta method, in small steps, with the thrusters' rows written by hand. Seen to fail with a
    valve's force doubled, with sin for cos, and with a torque arm of y · dx + x · dy."""
    plant = Plant(**{**IDEAL, "tilt": list(TILT)}, initial_pose=[0.5, 0.2, 0.3], initial_velocity=[0.1, -0.1, 0.4])
    state: Vector = (0.5, 0.2, 0.3, 0.1, -0.1, 0.4)
    for seconds, opened in schedule():
        plant.step(seconds, opened)
        pushes = [[FORCE * part for part in row] for row, is_open in zip(ROWS, opened, strict=True) if is_open]
        fx, fy, turn = (sum(column) for column in zip((0, 0, 0), *pushes, strict=True))
        for _ in range(100):
            state = runge_kutta(state, (fx, fy, ARM * turn), seconds / 100)
        assert (*plant.pose, *plant.velocity) == pytest.approx(state, rel=1e-9, abs=1e-11)


# --- books ---


def test_energy_and_momentum_balance() -> None:
    """With everything that is not ideal. Seen to fail with work reckoned by the speed at a substep's beginning, with no
    work on the heading, with a slope that does no work, and with impulse in the robot's axes."""
    start = (0.05, -0.02, 0.3)
    plant = Plant(tilt=list(TILT), initial_velocity=list(start))

    def energy(velocity: tuple[float, float, float]) -> float:
        return MASS / 2 * (velocity[0] ** 2 + velocity[1] ** 2) + INERTIA / 2 * velocity[2] ** 2

    seconds = 0.0
    for duration, opened in schedule():
        plant.step(duration, opened)
        seconds += duration
        assert energy(plant.velocity) - energy(start) == pytest.approx(sum(plant.work), rel=1e-9, abs=1e-12)
        for axis in range(2):
            gained = MASS * (plant.velocity[axis] - start[axis])
            assert gained == pytest.approx(plant.impulse[axis] + MASS * TILT[axis] * seconds, rel=1e-9, abs=1e-12)
        assert INERTIA * (plant.velocity[2] - start[2]) == pytest.approx(plant.impulse[2], rel=1e-9, abs=1e-12)
    assert min(abs(work) for work in plant.work) > 1e-4, "nothing was done"


# --- valves ---


def test_valve_opens_and_closes_late() -> None:
    """Seen to fail with the two delays exchanged."""
    plant = Plant(**{**IDEAL, "opening_delay": 0.004, "closing_delay": 0.007})
    plant.step(0.003, FORWARD)
    assert (plant.velocity, plant.switches) == ((0, 0, 0), (0,) * THRUSTERS)
    plant.step(0.017, FORWARD)
    assert plant.on_time[:3] == (0.016, 0.016, 0)
    assert plant.switches[:3] == (1, 1, 0)
    plant.step(0.1, NONE)
    assert plant.on_time[:3] == (0.023, 0.023, 0)
    assert plant.switches[:3] == (2, 2, 0)
    assert plant.impulse[0] == pytest.approx(2 * 0.023 * FORCE, rel=1e-12)
    assert plant.impulse[0] == pytest.approx(MASS * plant.velocity[0], rel=1e-12)


def test_short_pulse_lasts_for_the_minimum() -> None:
    """Seen to fail with the minimum counted from the command, and with a closing that does not wait for it."""
    plant = Plant(**{**IDEAL, "minimum_on_time": 0.02, "opening_delay": 0.005})
    plant.step(0.001, valves(4))
    plant.step(0.05, NONE)
    assert (plant.on_time[4], sum(plant.on_time)) == (0.02, 0.02)
    plant.step(0.03, valves(4))  # a pulse that is long enough is as long as it was told to be
    plant.step(0.05, NONE)
    assert plant.on_time[4] == 0.02 + 0.025
    assert plant.switches[4] == 4


def test_pulse_shorter_than_the_delay_is_lost() -> None:
    """Where there is no minimum. Seen to fail with the opening's delay for the closing's."""
    plant = Plant(**{**IDEAL, "opening_delay": 0.005})
    plant.step(0.004, valves(4))
    plant.step(0.1, NONE)
    assert (plant.on_time[4], plant.switches[4]) == (0, 0)
    plant.step(0.01, valves(4))
    assert (plant.on_time[4], plant.switches[4]) == (0.005, 1)


def test_command_to_open_takes_back_one_to_close() -> None:
    """Seen to fail with a pulse that begins anew."""
    plant = Plant(**{**IDEAL, "opening_delay": 0.002, "closing_delay": 0.005})
    for seconds, opened in ((0.01, valves(4)), (0.004, NONE), (0.01, valves(4))):
        plant.step(seconds, opened)
    assert (plant.on_time[4], plant.switches[4]) == (0.022, 1)


def test_steps_may_be_of_any_length() -> None:
    """The end of a step is no event. Seen to fail with valves that switch at the ends of steps alone."""
    whole, parts = (Plant(tilt=[0, 0]) for _ in range(2))
    for seconds, opened in schedule():
        whole.step(seconds, opened)
        for _ in range(25):
            parts.step(seconds / 25, opened)
    assert parts.on_time == whole.on_time
    assert parts.switches == whole.switches
    assert (*parts.pose, *parts.velocity) == pytest.approx((*whole.pose, *whole.velocity), rel=1e-11, abs=1e-13)


@pytest.mark.parametrize("seconds", [-0.01, 61, math.nan])
def test_time_that_cannot_pass(seconds: float) -> None:
    with pytest.raises(ValueError, match="is not from 0 to 60 s"):
        Plant().step(seconds)


def test_wrong_number_of_valves() -> None:
    with pytest.raises(ValueError, match="7 valves, not 8"):
        Plant().step(0.01, [False] * 7)


def test_longest_time_is_the_headers() -> None:
    plant = Plant(**IDEAL)
    plant.step(60, FORWARD)
    assert plant.on_time[0] == 60


# --- noise ---

READINGS = 10_000


def test_random_numbers_are_splitmix64() -> None:
    """The first five for a seed of 1234567, as other implementations have them. Seen to fail with another shift."""
    state = ctypes.c_uint64(1234567)
    assert [library().plant_random(ctypes.byref(state)) for _ in range(5)] == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]


def test_deviates_are_nearly_normal() -> None:
    """Mean, deviation, and how many lie within 1, 2 and 3. Seen to fail with a sum of eight."""
    state = ctypes.c_uint64(0)
    found = [library().plant_deviate(ctypes.byref(state)) for _ in range(READINGS)]
    assert abs(fmean(found)) < 4 / math.sqrt(READINGS)
    assert pstdev(found) == pytest.approx(1, abs=4 / math.sqrt(2 * READINGS))
    for bound, share in ((1, 0.6827), (2, 0.9545), (3, 0.9973)):
        within = sum(abs(each) < bound for each in found) / READINGS
        assert within == pytest.approx(share, abs=0.01 if bound < 3 else 0.002)
    assert all(each * 65536 == int(each * 65536) for each in found)


def test_position_noise() -> None:
    """1 mm per axis, one reading and one axis not knowing of another. Seen to fail with one for both axes."""
    plant = Plant(**IDEAL, initial_pose=[2, -1, 0.5])
    readings = [plant.igps() for _ in range(READINGS)]
    for axis, place in ((0, 2), (1, -1)):
        errors = [reading[axis] - place for reading in readings]
        assert fmean(errors) == pytest.approx(0, abs=4e-3 / math.sqrt(READINGS))
        assert pstdev(errors) == pytest.approx(1e-3, rel=0.03)
        assert abs(fmean(a * b for a, b in pairwise(errors))) < 4e-6 / math.sqrt(READINGS)
    assert abs(fmean((x - 2) * (y + 1) for x, y in readings)) < 4e-6 / math.sqrt(READINGS)


def test_gyro_is_clockwise_positive_in_degrees() -> None:
    """Bias and 0.003 °/s. Seen to fail with the sign changed, and without the bias."""
    plant = Plant(**{**IDEAL, "gyro_bias_deg_s": 0.01}, initial_velocity=[0, 0, 0.1])
    readings = [plant.gyro_deg_s() for _ in range(READINGS)]
    assert fmean(readings) == pytest.approx(0.01 - math.degrees(0.1), abs=4 * 0.003 / math.sqrt(READINGS))
    assert pstdev(readings) == pytest.approx(0.003, rel=0.03)


def test_thrust_is_drawn_at_each_opening() -> None:
    """5 % about the nominal, constant while a valve is open. Seen to fail with one drawn at each step."""
    plant = Plant(**{**IDEAL, "thrust_noise": 0.05})

    def thrust() -> float:
        """N, the mean of 10 ms."""
        before = plant.impulse[2]
        plant.step(0.01, valves(1))
        return (plant.impulse[2] - before) / ARM / 0.01

    found = []
    for _ in range(2000):
        found.append(thrust())
        assert thrust() == pytest.approx(found[-1], rel=1e-9)
        plant.step(0.01, NONE)
    assert fmean(found) == pytest.approx(FORCE, abs=4 * 0.05 * FORCE / math.sqrt(2000))
    assert pstdev(found) == pytest.approx(0.05 * FORCE, rel=0.06)


@pytest.mark.parametrize("opened", [FORWARD, SPIN])
def test_how_often_a_sensor_is_read_changes_nothing_else(opened: list[bool]) -> None:
    """Seen to fail with one stream of random numbers for all."""
    read, unread = Plant(), Plant()
    for _ in range(20):
        read.step(0.02, opened)
        unread.step(0.02, opened)
        read.igps()
        read.step(0.02, NONE)
        unread.step(0.02, NONE)
    assert read.pose == unread.pose
    assert read.gyro_deg_s() == unread.gyro_deg_s()


def flight(seed: int) -> bytes:
    """Everything that a plant says, over a few seconds, to the bit."""
    plant = Plant(seed=seed)
    said = b""
    for seconds, opened in schedule():
        plant.step(seconds, opened)
        numbers = (*plant.pose, *plant.velocity, *plant.on_time, *plant.work, *plant.impulse, *plant.igps())
        said += struct.pack(f"<{len(numbers) + 1}d", *numbers, plant.gyro_deg_s())
    return said


def test_seed_decides() -> None:
    """Seen to fail with a seed that is passed over, and with one taken from the clock."""
    assert flight(7) == flight(7)
    assert flight(7) != flight(8)


# --- parameters ---

WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no mass": ({"mass": 0}, "mass: 0 is not from 0.001 to 1e+06 kg"),
    "negative inertia": ({"inertia": -1}, "inertia: -1 is not from 1e-06 to 1e+06 kg·m²"),
    "a text": ({"mass": "heavy"}, "mass: heavy: is not a number from 0.001 to 1e+06 kg"),
    "a boolean": ({"mass": True}, "mass: True: is not a number"),
    "no number": (
        {"tilt": [math.nan, 0]},
        "tilt: [nan, 0]: is not a list of 2 numbers from -10 to 10 m/s², or one for all",
    ),
    "too few": ({"positions": [0.1] * 15}, "is not a list of 16 numbers from -100 to 100 m"),
    "one for all": ({"positions": 0}, "positions: 0: is not a list of 16 numbers from -100 to 100 m"),
    "forces": ({"force": [0.1] * 7}, "is not a list of 8 numbers from 0 to 1e+06 N, or one for all"),
    "one force": ({"force": [0.1] * 7 + [-1]}, "force: -1 is not from 0 to 1e+06 N"),
    "direction": ({"directions": [1] * 14 + [0, 0]}, "directions: thruster 7 pushes nowhere; give x and y"),
    "half a seed": ({"seed": 1.5}, "seed: 1.5 is not a whole number"),
    "unknown": ({"masss": 1}, "masss: there is no such parameter; there are mass, inertia, positions"),
}


@pytest.mark.parametrize("changes", list(WRONG))
def test_wrong_parameters(changes: str) -> None:
    with pytest.raises(UserError) as error:
        Plant(**WRONG[changes][0])
    assert str(error.value).startswith("flotilla/lab/plants/floating_robot.yml: ")
    assert WRONG[changes][1] in str(error.value)


FILES = {
    "missing": ("".join(ROBOT.read_text().partition("mass: 10.5")[2:]), "mass: is missing; give a number from 0.001"),
    "no mapping": ("- mass", "is not a mapping of parameters such as `mass: 10.5`"),
    "no YAML": ("mass: [", "is not YAML: "),
}


@pytest.mark.parametrize("text", list(FILES))
def test_wrong_file(text: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.yml"
    file.write_text(FILES[text][0])
    with pytest.raises(UserError) as error:
        Plant(file)
    assert str(error.value).startswith(f"{file}: {FILES[text][1]}")


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"robot\.yml: cannot be read: "):
        Plant(tmp_path / "robot.yml")
