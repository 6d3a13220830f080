"""`make bench`: its table, and what it compares with."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.fleet.model import Fleet
from images.builder import bench_robots
from images.builder.bench import Row, mkosi_program, table


def test_table_has_ratios_to_the_first_row() -> None:
    rows = [Row("cold", "card", 60.0, 1 << 20, 1), Row("next", "card", 0.6, 512, 5)]
    assert table(rows).splitlines() == [
        "work  seconds   ratio    bytes  made",
        "cold    60.00  1.0000  1.0 MiB  card",
        "next     0.60  0.0100    512 B  card",
    ]


def test_mkosi_is_the_users_to_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MKOSI", raising=False)
    assert mkosi_program() is None
    program = tmp_path / "mkosi"
    monkeypatch.setenv("MKOSI", str(program))
    with pytest.raises(UserError, match=r"MKOSI=.*/mkosi: no program; .*bin/mkosi"):
        mkosi_program()
    program.touch(mode=0o755)
    assert mkosi_program() == str(program)


def test_further_robots_take_what_is_free(fleet: Fleet) -> None:
    one, there = fleet.robots[3], list(fleet.robots.values())
    made = bench_robots.like(fleet, one, 100)
    for field in ("name", "number", "address"):
        values = [getattr(robot, field) for robot in [*made, *there, *fleet.stations] if hasattr(robot, field)]
        assert len(set(values)) == len(values), field
    assert {(robot.board, tuple(robot.devices)) for robot in made} == {(one.board, tuple(one.devices))}
    assert all(robot.address in fleet.network.subnet for robot in made)
    with pytest.raises(UserError, match=r"^300 robots are to be measured, and the fleet has .* for 246 more"):
        bench_robots.like(fleet, one, 300)
