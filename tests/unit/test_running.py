"""How tests read what a task prints."""

from __future__ import annotations

import subprocess

import pytest

from tests.running import Task


def test_a_row_that_is_cut_means_that_the_task_ended() -> None:
    """Seen to fail: the half row raised a JSONDecodeError, which hid the end and its status."""
    script = """printf '{"gain.y": 1}\\n{"gain.y'; exit 3"""
    with subprocess.Popen(["sh", "-c", script], stdout=subprocess.PIPE, text=True) as process:
        rows = Task(process).rows()
        assert next(rows) == {"y": 1}
        with pytest.raises(AssertionError, match=r'the task ended, status 3; the last row was \{"gain\.y$'):
            next(rows)
