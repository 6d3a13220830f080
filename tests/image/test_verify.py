"""Invariant 1: an image depends on the checkout, the lock and the robot, and on nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet.model import Fleet
from flotilla.images import card, compare
from flotilla.images.build import build

ROBOT = 3
KEPT = paths.BUILD / f"verify-robot{ROBOT}.img"
"""Where a second image stays that differs."""


def verify(*options: str) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, "-m", "flotilla", "verify", str(ROBOT), *options]
    return subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, check=False)


def test_second_build_elsewhere_is_identical() -> None:
    KEPT.touch()  # as an earlier run left it
    done = verify()
    assert done.returncode == 0, done.stderr
    for varied in ("path", "user", "umask", "locale", "time zone", "host name", "clock", "empty cache"):
        assert varied in done.stdout
    assert not (paths.BUILD / "verify").exists()
    assert not KEPT.exists()


@pytest.mark.nightly  # a whole build; unit/test_compare.py names differences
def test_planted_difference_fails_and_is_named() -> None:
    done = verify("--plant")
    assert done.returncode == 1
    lines = [line.strip() for line in done.stderr.splitlines()]
    assert "/etc/planted: only in the second image" in lines
    assert [line for line in lines if line.startswith("/") and "/etc/planted" not in line] == []
    assert any(line.startswith("slot A: differs") for line in lines)
    assert [line for line in lines if ": differs from byte" in line and not line.startswith("slot A")] == []
    assert f"it is kept as {paths.shown(KEPT)}" in lines
    KEPT.unlink()


def test_robots_of_a_board_differ_in_identifier_and_data_partition_only(fleet: Fleet) -> None:
    """The identifier has four bytes of the MBR."""
    one, other = build(fleet, [fleet.robots[number] for number in (3, 4)])
    assert [difference.part.name for difference in compare.differing_parts(one, other)] == ["MBR", "data partition"]
    with one.open("rb") as first, other.open("rb") as second:
        mine, others = first.read(card.SECTOR), second.read(card.SECTOR)
    assert mine[:440] + mine[444:] == others[:440] + others[444:]


@pytest.mark.skipif(os.geteuid() != 0, reason="the account is made for root's second build only")
def test_verify_leaves_no_account() -> None:
    assert "flotilla-verify" not in Path("/etc/passwd").read_text() + Path("/etc/subuid").read_text()
