"""Work at the same time: all of it, or the first error and nothing left running."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import namespace, together
from flotilla.common.errors import UserError

PATIENCE_S = 60


class Endless:
    """A program that runs until it is killed; it says when it does."""

    def __init__(self, directory: Path) -> None:
        self.log = directory / "log"
        self.fifo = directory / "fifo"
        os.mkfifo(self.fifo)

    def run(self) -> None:
        namespace.run_logged("endless", ["sh", "-c", f"echo $$ >{self.fifo}; exec sleep 1000"], self.log)

    def number(self) -> int:
        """Of its process, once it runs."""
        return int(self.fifo.read_text())


@pytest.fixture
def endless(tmp_path: Path) -> Endless:
    return Endless(tmp_path)


def gone(number: int) -> bool:
    with suppress(ProcessLookupError):
        os.kill(number, 0)
        return False
    return True


def test_all_runs_at_the_same_time() -> None:
    meeting = threading.Barrier(3, timeout=PATIENCE_S)
    together.run(meeting.wait, meeting.wait, meeting.wait)


def failing(endless: Endless, seen: list[int]) -> Callable[[], None]:
    def fail() -> None:
        seen.append(endless.number())
        raise UserError("the first error")

    return fail


def test_the_first_error_ends_the_others_and_is_the_one_that_is_raised(endless: Endless) -> None:
    seen: list[int] = []
    with pytest.raises(UserError, match=r"^the first error$"):
        together.run(endless.run, failing(endless, seen))
    assert gone(seen[0])


def test_work_within_work_ends_too(endless: Endless) -> None:
    seen: list[int] = []
    with pytest.raises(UserError, match=r"^the first error$"):
        together.run(lambda: together.run(endless.run, lambda: None), failing(endless, seen))
    assert gone(seen[0])


def test_nothing_starts_to_run_once_another_has_failed(endless: Endless, tmp_path: Path) -> None:
    def stubborn() -> None:
        with suppress(UserError):
            endless.run()
        namespace.run_logged("second", ["sleep", "1000"], tmp_path / "second")

    with pytest.raises(UserError, match=r"^the first error$"):
        together.run(stubborn, failing(endless, []))


def test_an_interruption_ends_all(endless: Endless) -> None:
    main, seen = threading.main_thread().ident, []
    assert main

    def interrupt() -> None:
        seen.append(endless.number())
        signal.pthread_kill(main, signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        together.run(endless.run, interrupt)
    assert gone(seen[0])


def test_an_interruption_ends_what_has_begun(endless: Endless, monkeypatch: pytest.MonkeyPatch) -> None:
    """While not all of the work has begun. Seen to wait for what had, for as long as that took."""
    submit = ThreadPoolExecutor.submit
    seen: list[int] = []

    def interrupted(*arguments: Any) -> Any:
        if seen:
            raise KeyboardInterrupt
        begun = submit(*arguments)
        seen.append(endless.number())
        return begun

    monkeypatch.setattr(ThreadPoolExecutor, "submit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        together.run(endless.run, lambda: None)
    assert gone(seen[0])


def test_a_program_of_nobody_elses_runs_as_ever(tmp_path: Path) -> None:
    namespace.run_logged("alone", ["echo", "done"], tmp_path / "log")
    assert (tmp_path / "log").read_text() == "done\n"
