"""How tests are handed to several processes."""

from __future__ import annotations

from flotilla.common import paths
from tests import tiers

TESTS = paths.PROJECT / "tests"


def test_a_folder_named_shared_goes_to_one_process_and_other_files_each_to_one() -> None:
    first, second, alone = (
        tiers.together(f"tests/boot/{file}::test_a[b/c]")
        for file in ("shared/test_boot.py", "shared/test_dds.py", "test_latency.py")
    )
    assert first == second != alone
    assert alone != tiers.together("tests/boot/test_lab.py::test_a")


def test_what_is_named_is_there_and_each_folder_has_a_tier() -> None:
    there = {path.name for path in TESTS.rglob("*")}
    assert set(tiers.SAME_PLACE) <= there
    assert all((paths.PROJECT / path).is_file() for path in tiers.SAME_PLACE.values())
    assert {file.relative_to(TESTS).parts[0] for file in TESTS.rglob("test_*.py")} == set(tiers.TIERS)
