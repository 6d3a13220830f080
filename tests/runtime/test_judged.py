"""Mathematical blocks on random signals, judged by scipy and numpy, which share nothing with them.

Each comparison prints how many there were and the largest difference: `pytest -s` shows them.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from tests.running import PATIENCE
from tests.runtime.tasks import HEADERS, PLUGIN, compile_shared

Array = NDArray[np.float64]
Run = Callable[..., Mapping[str, Array]]
PERIOD_S = 0.01


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the plug-in whose block gives the rows of a file."""
    directory = tmp_path_factory.mktemp("blocks")
    compile_shared(PLUGIN / "table.c", directory / "table.so", f"-I{HEADERS}")
    return directory


@pytest.fixture
def run(flotilla_run: Path, tables: Path, tmp_path: Path) -> Run:
    """What the block `it` gives, by output and step, when its inputs are wired to tables of these rows."""

    def run(it: str, outputs: str, **inputs: Array) -> Mapping[str, Array]:
        lines = [f"period: {PERIOD_S} s", "blocks:"]
        for name, rows in inputs.items():
            (tmp_path / name).write_bytes(np.ascontiguousarray(rows, dtype=float).tobytes())
            shape = f"width: {rows.shape[1]}, rows: {len(rows)}"
            lines.append(f"  {name}: {{type: table, parameters: {{file: {tmp_path / name}, {shape}}}}}")
        (tmp_path / "task.yml").write_text("\n".join([*lines, f"  it: {it}", ""]))
        watched = ",".join(f"it.{output}" for output in outputs.split())
        steps = str(len(next(iter(inputs.values()))))
        command = [flotilla_run, "--blocks", tables, "--no-wait", "--steps", steps, "--watch", watched]
        done = subprocess.run([*command, "task.yml"], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        found = [json.loads(line) for line in done.stdout.splitlines()]
        return {output: np.array([row[f"it.{output}"] for row in found], float) for output in outputs.split()}

    return run


def judge(what: str, found: ArrayLike, expected: ArrayLike, tolerance: float) -> None:
    difference = np.abs(np.asarray(found, float) - np.asarray(expected, float))
    print(f"{what}: {difference.size} comparisons, largest difference {difference.max():.2g}")
    assert difference.size
    assert difference.max() <= tolerance, what


def angles(random: np.random.Generator, count: int) -> Array:
    """Yaw, pitch and roll: anywhere, and at ±90° of pitch, exactly and ever less so."""
    drawn = random.uniform([-np.pi, -np.pi / 2, -np.pi], [np.pi, np.pi / 2, np.pi], (count, 3))
    beside = np.concatenate([[0.0], 10.0 ** -np.arange(18)])
    upright = np.resize(np.concatenate([np.pi / 2 - beside, beside - np.pi / 2]), count // 2)
    drawn[: count // 2, 1] = np.clip(upright, -np.pi / 2, np.pi / 2)
    return np.asarray(drawn)


def apart(one: Array, other: Array) -> Array:
    """Largest difference of an element of two unit quaternions, of either sign."""
    sign = np.sign(np.sum(one * other, axis=1, keepdims=True))
    return np.asarray(np.abs(one - sign * other).max(axis=1))


def test_angles_of_quaternions(run: Run) -> None:
    """Of any length. Seen to fail: at 90° of pitch an element of the orientation was off by 0.7."""
    random = np.random.default_rng(1)
    drawn = angles(random, 8000)
    quaternions = Rotation.from_euler("ZYX", drawn).as_quat()
    lengths = 10 ** random.uniform(-3, 3, (len(drawn), 1))
    found = run(
        "{type: quaternion-to-angles, in: {quaternion: from.out}}", "roll pitch yaw", **{"from": lengths * quaternions}
    )
    orientation = Rotation.from_euler("ZYX", np.column_stack([found["yaw"], found["pitch"], found["roll"]]))
    judge("quaternion-to-angles, orientation", apart(orientation.as_quat(), quaternions), 0, 1e-13)
    judge("quaternion-to-angles, pitch", found["pitch"], drawn[:, 1], 2e-15)
    for name, column in {"yaw": 0, "roll": 2}.items():
        away = slice(len(drawn) // 2, None)
        around = np.angle(np.exp(1j * (found[name] - drawn[:, column])))[away]
        judge(f"quaternion-to-angles, {name}", around * np.cos(drawn[away, 1]), 0, 1e-14)
        assert np.abs(found[name]).max() <= np.pi


def test_quaternions_of_angles(run: Run) -> None:
    drawn = angles(np.random.default_rng(2), 8000)
    found = run(
        '{type: angles-to-quaternion, in: {yaw: "from.out[0]", pitch: "from.out[1]", roll: "from.out[2]"}}',
        "quaternion",
        **{"from": drawn},
    )
    expected = Rotation.from_euler("ZYX", drawn).as_quat()
    judge("angles-to-quaternion", apart(found["quaternion"], expected), 0, 1e-15)
