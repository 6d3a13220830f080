"""Fixtures of the runtime's tests.

`runtime/tests/plugin/misbehave.c` is what misbehaves; it is built here as a stranger would build a plug-in.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian import runtime
from tests.runtime.tasks import HEADERS, PLUGIN, Tasks, compile_shared


@pytest.fixture(scope="session")
def plugins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the misbehaving plug-in."""
    directory = tmp_path_factory.mktemp("blocks")
    compile_shared(PLUGIN / "misbehave.c", directory / "misbehave.so", f"-I{HEADERS}")
    return directory


@pytest.fixture
def local_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This computer's compiler in place of the locked one; outputs in the test's directory."""

    def command(work: Path, _: str, argv: Sequence[str], *_run: object) -> None:
        runtime.copy_sources(work, "include")
        argv = [word.replace("/out", str(work)) for word in argv]
        done = subprocess.run(argv, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(done.stderr)

    monkeypatch.setattr(runtime, "command", command)
    monkeypatch.setattr(paths, "BUILD", tmp_path)


@pytest.fixture
def tasks(flotilla_run: Path, plugins: Path, tmp_path: Path) -> Tasks:
    return Tasks(flotilla_run, plugins, tmp_path)


@pytest.fixture
def running(tasks: Tasks, tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start a task and wait for its first step."""
    started = []

    def start(text: str) -> subprocess.Popen[str]:
        argv = tasks.argv(text, "--watch", "a.out")
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout
        assert process.stdout.readline(), process.stderr and process.stderr.read()
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()
