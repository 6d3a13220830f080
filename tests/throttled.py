"""Runs tests again and again on a slow or busy computer, and prints which were ever red.

    python -m tests.throttled 50% 5 -- -m 'not nightly' tests/boot/test_control_loop.py
    python -m tests.throttled busy 3 -- tests/runtime

The first word is the share of this computer's processors that the tests get. With `busy`, as many programs as there are
processors compute beside them, for random times. What follows `--` are pytest's arguments. A share needs root.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from flotilla.common.errors import UserError
from tests import costs

CGROUPS = Path("/sys/fs/cgroup")
_PERIOD_US = 100_000
_SPELL_S = 3.0
"""Of a neighbour that computes, or rests: at most."""


def share_of(text: str) -> float:
    """`50%` as a part of one."""
    number = text.removesuffix("%")
    if not text.endswith("%") or not number.isdigit() or not 1 <= int(number) <= 100:
        raise UserError(f"{text}: write a share such as 25%, or busy")
    return int(number) / 100


@contextmanager
def group(share: float, root: Path = CGROUPS) -> Iterator[Path]:
    """A control group of that share of all processors; its file that takes processes."""
    second = (root / "cgroup.controllers").exists()
    quota_us = round(share * (os.cpu_count() or 1) * _PERIOD_US)
    directory = (root if second else root / "cpu") / f"flotilla-throttled-{os.getpid()}"
    limits = (
        {"cpu.max": f"{quota_us} {_PERIOD_US}"}
        if second
        else {"cpu.cfs_period_us": str(_PERIOD_US), "cpu.cfs_quota_us": str(quota_us)}
    )
    try:
        if second:
            (root / "cgroup.subtree_control").write_text("+cpu")
        directory.mkdir()
        for name, value in limits.items():
            (directory / name).write_text(value)
    except OSError as error:
        raise UserError(
            f"{directory}: no limit of the processor can be set ({error.strerror}); run it as root"
        ) from error
    try:
        yield directory / "cgroup.procs"
    finally:
        for name in limits if root != CGROUPS else ():
            (directory / name).unlink()
        directory.rmdir()


@contextmanager
def neighbours(seed: int) -> Iterator[None]:
    """Programs that compute beside the body, in spells of random lengths."""
    over = threading.Event()

    def one(number: int) -> None:
        chance = random.Random(f"{seed} {number}")
        while not over.is_set():
            with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as spinning:
                over.wait(chance.uniform(0, _SPELL_S))
                spinning.kill()
            over.wait(chance.uniform(0, _SPELL_S))

    threads = [threading.Thread(target=one, args=[number]) for number in range(os.cpu_count() or 1)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def run(how: str, words: Sequence[str], seed: int, file: Path) -> int:
    """pytest once; its status."""
    argv = [sys.executable, "-m", "pytest", "-q", *words]
    with ExitStack() as stack:
        if how == "busy":
            stack.enter_context(neighbours(seed))
        else:
            procs = stack.enter_context(group(share_of(how)))
            argv = ["sh", "-c", 'echo $$ >"$0" && exec "$@"', str(procs), *argv]
        return subprocess.run(argv, env=os.environ | {"COSTS": str(file)}, check=False).returncode


def table(how: str, runs: int, statuses: Sequence[int], red: Counter[str]) -> str:
    """Which tests were red, and how often."""
    bad = sum(status != 0 for status in statuses)
    lines = [f"{how}: {runs} runs, {bad} of them red"]
    return "\n".join([*lines, *(f"{count:>4} of {runs}  {name}" for name, count in red.most_common())])


def main(argv: Sequence[str]) -> int:
    if len(argv) < 4 or argv[2] != "--" or not argv[1].isdigit():
        print(__doc__, file=sys.stderr)
        return 2
    how, runs, words = argv[0], int(argv[1]), argv[3:]
    red: Counter[str] = Counter()
    statuses = []
    try:
        for number in range(runs):
            with tempfile.TemporaryDirectory() as directory:
                file = Path(directory, "costs")
                statuses.append(run(how, words, number, file))
                red.update({row["test"] for row in costs.rows(file) if row["failed"]} if file.exists() else {})
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(how, runs, statuses, red))
    return int(any(statuses))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
