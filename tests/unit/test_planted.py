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
