"""How tests are handed to several processes."""

from __future__ import annotations

from flotilla.common import paths
from tests import tiers

TESTS = paths.PROJECT / "tests"


def test_what_a_shared_guest_is_asked_goes_to_one_process_and_other_files_each_to_one() -> None:
    def together(*tests: str) -> int:
        """In how many processes."""
        return len({tiers.together(f"tests/boot/{test}") for test in tests})

    assert (
        together("shared/test_boot.py::test_a[x86_64-debian]", "shared/test_dds.py::test_b[a/b-x86_64-debian-c]") == 1
    )
    assert (
        together("shared/test_boot.py::test_a[smartcoret3-debian]", "shared/test_dds.py::test_b", "shared/a.py::b[3]")
        == 1
    )
    assert (
        together("shared/test_boot.py::test_a[x86_64-debian]", "shared/test_boot.py::test_a[smartcoret3-debian]") == 2
    )
    assert (
        together("shared/test_boot.py::test_a[smartcoret3-lean]", "shared/test_boot.py::test_a[smartcoret3-debian]")
        == 2
    )
    assert together("test_latency.py::test_a[b/c]", "test_latency.py::test_b", "test_lab.py::test_a") == 2


def test_what_is_named_is_there_and_each_folder_has_a_tier() -> None:
    there = {path.name for path in TESTS.rglob("*")}
    assert set(tiers.SAME_PLACE) <= there
    assert all((paths.PROJECT / path).is_file() for path in tiers.SAME_PLACE.values())
    assert {file.relative_to(TESTS).parts[0] for file in TESTS.rglob("test_*.py")} == set(tiers.TIERS)
