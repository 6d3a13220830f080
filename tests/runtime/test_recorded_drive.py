"""The wheeled robot's tasks in a closed loop with its plant, recorded by the block and drawn by the station."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml

from flotilla.lab.wheeled import by_wires
from flotilla.lab.wheeled.by_wires import Command, Course
from flotilla.station import convert, pictures, report
from tests.running import PATIENCE
from tests.runtime import test_plant_blocks
from tests.station import decoded

command = test_plant_blocks.command

_SIGNALS = {
    "pose": ("drive_pose.out", "double", 3), "motion": ("drive_motion.out", "double", 2),
    "wanted": ("drive_wanted.out", "double", 2), "free": ("drive_stop.free", "double", 1),
    "alive": ("drive_alive.out", "boolean", 1), "seeing": ("drive_seeing.out", "boolean", 1),
    "limited": ("drive_stop.limited", "boolean", 1),
}  # fmt: skip
"""As drive-report has them."""
_SECONDS = 22
_TOWARDS = [Command(0, enable=False), Command(0.5), Command(1, v=0.5), Command(18, heard=False)]
"""Towards a wall until it stops, and no more commands."""


@pytest.fixture(scope="module")
def files(command: list[str | Path], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A ring of small files."""
    place = tmp_path_factory.mktemp("drive")
    task = by_wires.task([Course(_SECONDS, _TOWARDS)], by_wires.fleet(), place)
    parameters = {
        "directory": str(place), "names": list(_SIGNALS), "types": [kind for _, kind, _ in _SIGNALS.values()],
        "widths": [width for _, _, width in _SIGNALS.values()], "buffer": 60, "file_bytes": 8192, "files": 100,
    }  # fmt: skip
    wires = {name: wire for name, (wire, _, _) in _SIGNALS.items()}
    task["blocks"]["report"] = {"type": "recorder", "every": 10, "in": wires, "parameters": parameters}
    (place / "drive.yml").write_text(yaml.safe_dump(task))
    steps = str(round(_SECONDS / by_wires.PERIOD_S))
    argv = [*command, "--no-wait", "--steps", steps, place / "drive.yml"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    return sorted(place.glob("*.rec"))


def test_a_drive_that_was_recorded_is_drawn_with_its_speeds_and_states(files: list[Path], tmp_path: Path) -> None:
    assert len(files) > 2
    ((topic,), notes) = report.read(files[::-1])
    assert notes == []
    assert list(topic.signals["step"]) == list(range(_SECONDS * 10))
    seconds = (topic.times_ns - topic.times_ns[0]) / 1e9
    assert np.allclose(np.diff(seconds), 0.1)
    states = {state.name: state for state in pictures.states(topic, seconds)}
    assert states["limited"].longest_s > 1
    # Before the first command, and from when the last one is too old.
    (_, silent) = states["not alive"].spans_s
    assert silent[0] == pytest.approx(18, abs=0.5)
    assert silent[1] == pytest.approx(_SECONDS, abs=0.2)
    text = report.write(files, tmp_path / "drive.html").read_text()
    for title in ("path", "/report: speeds, commanded and driven", "/report: free", "/report: flags"):
        assert f"{title}</text>" in text, title
    assert "distance from commanded" not in text
    assert re.search(r"limited</td>\n<td>\d+</td>", text)


def test_a_ring_of_files_becomes_one(files: list[Path], tmp_path: Path) -> None:
    convert.convert([files[0].parent], tmp_path / "drive.mcap")
    messages = [message for _, message in decoded(tmp_path / "drive.mcap")]
    assert [message.step for message in messages] == list(range(_SECONDS * 10))
    x = [message.pose[0] for message in messages]
    assert x[0] == 0
    assert max(x) > 1
