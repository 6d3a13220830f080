"""What examples/ has runs on this computer; tests of the kinds of apps build copies of the apps under other names."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.apps import app, scaffold
from flotilla.common import paths
from tests.runtime.tasks import HEADERS, compile_shared

EXAMPLES = paths.PROJECT / "examples"


def run(flotilla_run: Path, task: Path, blocks: Path, steps: int, signal: str) -> list[float]:
    """What a signal is in each step, where time is counted."""
    file = blocks / "task.yml"
    file.write_text(task.read_text().replace("priority: 64", "priority: 0"))
    argv = [
        str(flotilla_run),
        "--blocks",
        str(blocks),
        "--no-wait",
        "--steps",
        str(steps),
        "--watch",
        signal,
        str(file),
    ]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True)
    return [json.loads(line)[signal] for line in done.stdout.splitlines()]


def test_there_is_one_of_each_kind_and_the_readme_names_all() -> None:
    """Seen to fail with own-loop/ removed, and with its line in the README."""
    kinds = {kind: app.load(EXAMPLES / name).description.kind for kind, name in scaffold.OF_KIND.items()}
    assert kinds == {kind: kind for kind in app.KINDS} | {"device": "block"}
    tracked = {path.name for path in EXAMPLES.iterdir()} - {"README.md"}
    text = (EXAMPLES / "README.md").read_text()
    assert {name for name in tracked if f"| `{name}" not in text} == set()
    assert tracked == {*scaffold.OF_KIND.values(), "closed-loop.yml"}


def test_the_control_task_reaches_its_set_point(flotilla_run: Path, tmp_path: Path) -> None:
    """Seen to fail with the sign of kp changed."""
    values = run(flotilla_run, EXAMPLES / "closed-loop.yml", tmp_path, 300, "plant.out")
    assert values[0] == 0
    assert values[-1] == pytest.approx(1, abs=1e-3)


def test_the_block_is_a_saw(flotilla_run: Path, tmp_path: Path) -> None:
    """Two teeth of 0.5 a second, doubled. Seen to fail with the tooth that does not fall back."""
    compile_shared(EXAMPLES / "saw-tooth" / "saw_tooth.c", tmp_path / "saw.so", f"-I{HEADERS}")
    values = run(flotilla_run, EXAMPLES / "saw-tooth" / "task.yml", tmp_path, 400, "scaled.out")
    assert max(values) < 2
    assert sum(after < before for before, after in itertools.pairwise(values)) == 2


def test_a_new_driver_passes_its_own_test(flotilla_run: Path, tmp_path: Path) -> None:
    """As docs/how-to/drivers.md runs it, under another name. Seen to fail with a parser that reads frames of three
    digits, of five, or without their R; with a step that takes a limit as a range; and with a flag that stays 1."""
    scaffold.create("device", "my-sonar", tmp_path)
    argv = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path / "my-sonar")]
    done = subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 passed" in done.stdout


def test_the_page_about_drivers_quotes_the_driver() -> None:
    """Seen to fail with an R in lower case in the page."""
    quoted = re.findall(r"^```c\n(.*?)^```$", (paths.PROJECT / "docs/how-to/drivers.md").read_text(), re.M | re.S)
    source = (EXAMPLES / "range-finder" / "range_finder.c").read_text()
    assert quoted
    assert [text for text in quoted if text not in source] == []


def test_the_program_compiles_by_its_makefile(tmp_path: Path) -> None:
    """Without a warning. Seen to fail with an unused variable in main.c."""
    for name in ("Makefile", "main.c"):
        (tmp_path / name).write_text((EXAMPLES / "own-loop" / name).read_text())
    environment = os.environ | {"CFLAGS": "-Werror"}
    done = subprocess.run(["make", "-C", tmp_path], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "own-loop").exists()
