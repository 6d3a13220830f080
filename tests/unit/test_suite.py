"""What `make test` runs, and the parts of `make test-all`."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from tests import costs, suite

TESTS = paths.PROJECT / "tests"


def functions(file: Path) -> set[str]:
    """Names of a file's tests."""
    return {node.name for node in ast.parse(file.read_text()).body if isinstance(node, ast.FunctionDef)}


def test_what_is_named_is_there() -> None:
    """Or a test that was renamed would leave `make test`, and nobody notice. A parameter is checked when it is run."""
    for names in suite.named().values():
        for name in names:
            file, _, function = name.partition("::")
            path = file.partition("[")[0]
            assert (TESTS / path).is_file(), f"suite.yml: {name}: there is no such file"
            assert not function or function.partition("[")[0] in functions(TESTS / path), f"suite.yml: no test {name}"


def test_no_area_is_left_without_a_test() -> None:
    assert all(suite.named().values())
    names = [name for names in suite.named().values() for name in names]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("nodeid", "stays"),
    [
        ("tests/boot/test_a.py::test_one[x]", True),
        ("tests/boot/test_b.py::test_one", True),
        ("tests/boot/test_b.py::test_one[x]", True),
        ("tests/boot/test_b.py::test_two", False),
        ("tests/boot/test_c.py::test_one[x/y-z]", True),
        ("tests/boot/test_c.py::test_one[z]", False),
        ("tests/boot/test_d.py::test_one[x]", True),
        ("tests/boot/test_d.py::test_one[y]", False),
        ("tests/provisioning/test_a.py::test_one", False),
        ("tests/unit/test_any.py::test_one", True),
        ("tests/unit/test_any.py::test_dear", False),
        ("tests/unit/test_named.py::test_dear", True),
    ],
)
def test_those_stay_that_are_named_or_cheap(nodeid: str, stays: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(costs, "of", lambda nodeid: suite.CHEAP_S + ("dear" in nodeid))
    names = ["boot/test_a.py", "boot/test_b.py::test_one", "boot/test_c.py::test_one[x/y-z]", "boot/test_d.py[x]"]
    names.append("unit/test_named.py")
    assert suite.stays(nodeid, names) == stays


@pytest.mark.parametrize("count", [1, 3, 8])
def test_parts_hold_each_group_once_and_are_about_equal(count: int) -> None:
    groups = {f"tests/boot/test_{number}.py": float(number % 17 * 10) for number in range(100)}
    parts = suite.parts(groups, count)
    assert sorted(name for part in parts for name in part) == sorted(groups)
    assert parts == suite.parts(dict(reversed(groups.items())), count), "it depends on the order of collection"
    loads = [sum(groups[name] for name in part) + suite.CHECKS_S * (part is parts[0]) for part in parts]
    assert max(loads) - min(loads) <= max(groups.values())


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "a/b", "1/0", "01/2", "-1/2"])
def test_a_part_that_there_is_not_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=f"PART={text}.*PART=3/8"):
        suite.asked_part(text)


def run_pytest(directory: Path, *options: str, **environment: str) -> list[str]:
    """What pytest prints with the plugins of the suite."""
    variables = {name: value for name, value in os.environ.items() if name not in ("PART", "COSTS")}
    variables |= environment | {"PYTHONPATH": str(paths.PROJECT)}
    argv = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options]
    done = subprocess.run(argv, cwd=directory, env=variables, capture_output=True, text=True)
    return [*done.stdout.splitlines(), f"status {done.returncode}"]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Six files of tests, in folders of two tiers; one test fails."""
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  unit: x\n  boot: x\n  nightly: x\n")
    for folder in ("unit", "boot"):
        (tmp_path / "tests" / folder).mkdir(parents=True)
        for number in range(3):
            (tmp_path / "tests" / folder / f"test_{folder}_{number}.py").write_text(
                "def test_a(): pass\ndef test_b(): pass\n"
            )
    text = "import pytest\n@pytest.mark.parametrize('a', ['x y'])\ndef test_it(a): assert a == 1\n"
    (tmp_path / "tests" / "unit" / "test_red.py").write_text(text)
    return tmp_path


PLUGINS = ("-p", "tests.tiers", "-p", "tests.costs", "-p", "tests.suite")


def test_a_part_without_tests_is_no_failure(project: Path) -> None:
    for number, text in ((1, "13 deselected"), (2, "passed")):
        lines = run_pytest(project, *PLUGINS, "-k", "not red", PART=f"{number}/3")
        assert text in lines[-2]
        assert lines[-1] == "status 0", lines


def collected(project: Path, *options: str, **environment: str) -> list[str]:
    plugins = () if project == paths.PROJECT else PLUGINS  # tests/conftest.py has them
    lines = run_pytest(project, *plugins, "--collect-only", "-q", *options, **environment)
    return [line for line in lines if "::" in line]


def test_the_parts_together_are_all_of_it(project: Path) -> None:
    """`make test-all` drops nothing, `make test` what needs guests and is not named."""
    everything = collected(project)
    assert len(everything) == 13
    parts = [collected(project, PART=f"{number}/3") for number in (1, 2, 3)]
    assert sorted(test for part in parts for test in part) == sorted(everything)
    assert [bool(part) for part in parts] == [False, True, True], "these cost less than the checks of the first"
    each_time, others = collected(project, "-m", "not nightly"), collected(project, "-m", "nightly")
    assert {test.split("/")[1] for test in each_time} == {"unit"}
    assert sorted(each_time + others) == sorted(everything)


@pytest.mark.parametrize("more", [(), ("-n", "1")], ids=["one process", "xdist"])
def test_a_failure_begins_with_the_command_that_repeats_it(project: Path, more: tuple[str, ...]) -> None:
    lines = run_pytest(project, *PLUGINS, *more)
    (title,) = [number for number, line in enumerate(lines) if "test_it[x y] ___" in line]
    command = lines[title + (2 if more else 1)]  # below the name of the process, if there are several
    assert command.startswith("to repeat it alone: "), lines
    assert command.endswith("bin/pytest 'tests/unit/test_red.py::test_it[x y]'")
    assert any("13 tests, about 1.0 processor minutes" in line for line in lines), lines


def test_each_name_is_that_of_a_test_of_each_time() -> None:
    """As pytest collects them, with their parameters: whatever is marked `nightly` itself stays so."""
    found = collected(paths.PROJECT, "-m", "not nightly", "tests")
    for name in (name for names in suite.named().values() for name in names):
        assert any(suite.stays(test, [name]) for test in found), f"suite.yml names {name}, which `make test` leaves out"


def test_costs_are_of_tests_that_are_there() -> None:
    """What was renamed is measured anew by `python -m tests.costs keep`."""
    for nodeid in costs.kept():
        path, _, function = nodeid.partition("::")
        file = paths.PROJECT / path
        assert file.is_file(), f"costs.json: {path} is gone"
        assert function.partition("[")[0] in functions(file), f"costs.json: {nodeid} is gone"
