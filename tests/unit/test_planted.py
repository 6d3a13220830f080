"""The faults that `make test` has to notice can be planted: their places are there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from tests import planted

FAULTS = planted.faults()


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_can_be_planted(name: str, tmp_path: Path) -> None:
    """`python -m tests.planted` plants them; that takes an hour."""
    fault = FAULTS[name]
    copy = tmp_path / fault.file
    copy.parent.mkdir(parents=True)
    shutil.copy(paths.PROJECT / fault.file, copy)
    fault.plant(tmp_path)
    assert copy.read_text() != (paths.PROJECT / fault.file).read_text()
    assert all((paths.PROJECT / "tests" / place).exists() for place in fault.tests)
    with pytest.raises(UserError, match="is there 0 times"):
        fault.plant(tmp_path)


def test_a_card_that_is_missing_is_no_fault_that_was_noticed(tmp_path: Path) -> None:
    """Seen to fail: whoever starts robot 1 was named as the first to notice valves that stay open."""
    log = tmp_path / "log"
    log.write_text(
        "build/images/robot1.img is missing; build it: make image ROBOT=1\nERROR tests/boot/test_a.py::test_b - x\n"
    )
    with pytest.raises(UserError, match="images: robot 1 is missing"):
        planted.first_failed(log)
    log.write_text("FAILED tests/boot/test_a.py::test_b - assert 1 == 2\n")
    assert planted.first_failed(log) == "tests/boot/test_a.py::test_b"
