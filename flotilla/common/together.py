"""Independent work at the same time that succeeds or fails as one."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar, copy_context


class _Group:
    """The processes that work of one call of `run` waits for, calls within that work included."""

    def __init__(self, outer: _Group | None) -> None:
        self._outer = outer
        self._lock = threading.Lock()
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._ended = False

    @contextmanager
    def holding(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        with self._lock:
            self._processes.add(process)
            if self._ended:
                process.kill()
        try:
            with self._outer.holding(process) if self._outer else nullcontext():
                yield
        finally:
            with self._lock:
                self._processes.remove(process)

    def end(self) -> None:
        with self._lock:
            self._ended = True
            for process in self._processes:
                process.kill()


_group: ContextVar[_Group | None] = ContextVar("_group", default=None)


def run(*works: Callable[[], object]) -> None:
    """Do all of it, a thread each. The first failure kills the others' processes, and is raised when all have ended."""
    group = _Group(_group.get())
    token = _group.set(group)
    try:
        with ThreadPoolExecutor(len(works)) as threads:
            try:
                coming = [threads.submit(copy_context().run, work) for work in works]
                for future in as_completed(coming):
                    future.result()
            except BaseException:
                group.end()
                raise
    finally:
        _group.reset(token)


def at_low_priority(work: Callable[[], object]) -> None:
    """Do it in a thread of the lowest priority, which what it starts has, too: other work goes first."""
    with ThreadPoolExecutor(1, initializer=os.nice, initargs=(19,)) as thread:
        thread.submit(copy_context().run, work).result()


@contextmanager
def ending(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """While the body waits for `process`: it is killed where work that `run` does at the same time fails."""
    group = _group.get()
    with group.holding(process) if group else nullcontext():
        yield
