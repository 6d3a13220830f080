"""The parts of `make verify` that need no build."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.images import verify

NOW = datetime.now(UTC)


def log(path: Path, days: int, without: str = "") -> Path:
    clocks = [clock for clock in ("stage", "tools", "target") if clock != without]
    path.write_text("".join(f"clock of the {clock}: {NOW + timedelta(days=days):%F}\n" for clock in clocks))
    return path


def test_accepts_a_moved_clock(tmp_path: Path) -> None:
    verify.check_clock(log(tmp_path / "log", 40), NOW)


def test_refuses_a_clock_that_stood_still(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"clock did not move: stage saw"):
        verify.check_clock(log(tmp_path / "log", 0), NOW)


@pytest.mark.parametrize("clock", ["stage", "tools", "target"])
def test_refuses_a_clock_that_nobody_saw(tmp_path: Path, clock: str) -> None:
    with pytest.raises(UserError, match=f"{clock} saw none"):
        verify.check_clock(log(tmp_path / "log", 40, without=clock), NOW)


def test_checkout_is_copied_without_outputs_and_as_cloned_by_another(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    verify.copy_checkout(copy)
    executable, plain = "images/install-host-packages", "Makefile"
    for name, mode in ((executable, 0o700), (plain, 0o600), ("images", 0o700)):
        assert (copy / name).stat().st_mode & 0o777 == mode
    assert (copy / plain).read_bytes() == (paths.PROJECT / plain).read_bytes()
    assert not (copy / ".git").exists()
    assert not (copy / paths.KEYS.relative_to(paths.PROJECT)).exists()
    assert not (copy / paths.BUILD.relative_to(paths.PROJECT)).exists()


def test_place_keeps_clear_of_what_is_needed() -> None:
    everywhere = [Path(place, "checkout") for place in ("/mnt", "/srv", "/opt", "/media")]
    assert verify.place_for([Path("/home/somebody/checkout")]) == "/mnt"
    assert verify.place_for(everywhere[:1]) != "/mnt"
    with pytest.raises(UserError, match="move one of them"):
        verify.place_for(everywhere)
