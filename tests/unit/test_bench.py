"""The table of `make bench`."""

from __future__ import annotations

from images.builder.bench import Row, table


def test_table_has_ratios_to_the_first_row() -> None:
    rows = [Row("cold", "card", 60.0, 1 << 20, 1), Row("next", "card", 0.6, 512, 5)]
    assert table(rows).splitlines() == [
        "work  seconds   ratio    bytes  made",
        "cold    60.00  1.0000  1.0 MiB  card",
        "next     0.60  0.0100    512 B  card",
    ]
