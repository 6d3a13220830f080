"""`make bench`: its table, and what it compares with."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.common.errors import UserError
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
