"""pytest plugin: a directory for the evidence of each test, kept when the test fails and removed when it passes."""

from __future__ import annotations

import fcntl
import itertools
import re
import shutil
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from flotilla.common import paths

DIRECTORY = paths.BUILD / "test-artefacts"
_FAILED = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed:
        item.stash[_FAILED] = True
        directory = directory_of(item.nodeid)
        if directory.exists():
            report.sections.append(("evidence", paths.shown(directory)))
    return report


@pytest.fixture
def artefacts(request: pytest.FixtureRequest) -> Iterator[Path]:
    """An empty directory of this test, `build/test-artefacts/<test>/`: removed after it passed, kept after it failed.

    Whatever explains a failure goes there: console logs, QMP logs, captures, reports.
    """
    directory = directory_of(request.node.nodeid)
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir(parents=True)
    yield directory
    if not request.node.stash.get(_FAILED, False):
        shutil.rmtree(directory)


@pytest.fixture(scope="session")
def session_artefacts(request: pytest.FixtureRequest) -> Iterator[Path]:
    """A directory of what many tests share, `build/test-artefacts/session-1/`: kept when any test failed.

    Each process that runs tests has one of its own: the first that no other one holds, so that a later run removes what
    a killed one left.
    """
    DIRECTORY.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        with (DIRECTORY / f".session-{number}.lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            directory = DIRECTORY / f"session-{number}"
            shutil.rmtree(directory, ignore_errors=True)
            directory.mkdir()
            yield directory
            if not request.session.testsfailed:
                shutil.rmtree(directory)
            return


def directory_of(nodeid: str) -> Path:
    """Of `tests/boot/test_lab.py::test_time[3]`: `test_lab.test_time-3`."""
    name = re.sub(r"^.*/|\.py\b", "", nodeid).replace("::", ".")
    return DIRECTORY / re.sub(r"[^\w.]+", "-", name).strip("-")
