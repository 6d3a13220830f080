"""The runtime as it is on the robots."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from flotilla.common import paths
from tests.conftest import GuestFactory


@pytest.mark.parametrize("number", [3, pytest.param(2, marks=pytest.mark.nightly)])
def test_every_block_is_on_the_robot(guest: GuestFactory, flotilla_run: Path, number: int) -> None:
    """Those of plug-ins too, which only load where their libraries are there."""
    here = subprocess.run(
        [flotilla_run.with_name("flotilla-blocks")], capture_output=True, text=True, check=True
    ).stdout
    there = guest(number).shell.run(["flotilla-blocks"]).stdout
    names = {line.split()[0] for line in there.splitlines()}
    assert names >= {line.split()[0] for line in here.splitlines()}
    assert names >= {"dds-publish", "frame-grabber-iidc", "gain"}


@pytest.mark.nightly  # each time, tests/runtime runs tasks on this computer
def test_task_on_the_other_architecture(guest: GuestFactory) -> None:
    pc = guest(2)
    pc.shell.run(["tee", "/tmp/task.yml"], stdin=(paths.TASKS / "heartbeat.yml").read_text())
    argv = ["sudo", "flotilla-run", "--steps", "20", "--watch", "half.out", "/tmp/task.yml"]
    rows = [json.loads(line) for line in pc.shell.run(argv).stdout.splitlines()]
    assert [row["half.out"] for row in rows] == [0.5] * 20
