"""The gate of the flights' hops. No QEMU."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.lab.latency.results import Latency
from flotilla.lab.scenarios import gate

FOUND = {"udp": {"first → second": Latency.of({300: 5, 410: 1}), "four hops": Latency.of({1500: 6})}}


def test_the_accepted_hops_pass(tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    gate.accept(FOUND, file)
    gate.check(FOUND, file)
    assert [path.name for path in tmp_path.iterdir()] == ["baseline.json"]


def test_one_sample_elsewhere_is_noticed(tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    gate.accept(FOUND, file)
    moved = {"udp": FOUND["udp"] | {"first → second": Latency.of({300: 5, 411: 1})}}
    with pytest.raises(UserError) as caught:
        gate.check(moved, file)
    said = str(caught.value)
    assert "udp: first → second: " in said
    assert "410 → 411 µs; 1 samples elsewhere" in said
    assert "make scenarios-accept" in said
    assert "four hops" not in said


def test_without_a_baseline_it_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"baseline.json is missing: .* make scenarios-accept"):
        gate.check(FOUND, tmp_path / "baseline.json")
