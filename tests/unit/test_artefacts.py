"""Places of evidence."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from flotilla.common import paths

TEST = """
def test_it(session_artefacts):
    (session_artefacts / "mine").touch()
    print("at", session_artefacts.name, flush=True)
    input()
    assert (session_artefacts / "mine").exists()
"""


def test_two_runs_of_one_checkout_leave_each_other_alone(tmp_path: Path) -> None:
    """Seen to fail, in a test of latency, while another run began: both had the directory `session-gw0`, and the later
    one removed what the guests of the other one were to use."""
    (tmp_path / "test_it.py").write_text(TEST)
    (tmp_path / "build/test-artefacts/session-1").mkdir(parents=True)
    (tmp_path / "build/test-artefacts/session-1/left-by-a-killed-run").touch()
    argv = [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "-p", "tests.artefacts", "test_it.py"]
    environment = os.environ | {"BUILD": str(tmp_path / "build"), "PYTHONPATH": str(paths.PROJECT)}
    runs = []
    for _ in range(2):
        run = subprocess.Popen(
            argv, cwd=tmp_path, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        runs.append(run)
        assert run.stdout
        while (line := run.stdout.readline()) and not line.startswith("at "):
            pass
    for run in runs:
        out, _ = run.communicate("\n")
        assert run.returncode == 0, out
    assert [path.name for path in (tmp_path / "build/test-artefacts").iterdir() if path.is_dir()] == []
