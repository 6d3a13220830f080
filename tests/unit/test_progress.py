"""Progress: a step says how it ended, whatever way it ended."""

from __future__ import annotations

import re

import pytest

from images.builder import progress


@pytest.mark.parametrize("terminal", [False, True])
def test_end_of_a_step(terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "_TERMINAL", terminal)
    monkeypatch.setattr(progress, "VERBOSE", False)
    with progress.step("work"):
        pass
    assert re.search(r"work: \d+\.\d s\n$", capsys.readouterr().err)
    with pytest.raises(KeyboardInterrupt), progress.step("work"):
        raise KeyboardInterrupt
    assert re.search(r"work: failed after \d+\.\d s\n$", capsys.readouterr().err)
