"""Plants the faults of planted.yml, one at a time, and says which test notices each first.

    python -m tests.planted [NAME…]

Each is planted in a copy of the checkout with an environment and outputs of its own, below build/planted; it begins
with this checkout's pool, cache and keys. The status is 1 where a fault was not noticed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pydantic

from flotilla.common import paths, yaml_file
from flotilla.common.errors import UserError
from flotilla.images import verify

FILE = Path(__file__).with_suffix(".yml")
WORK = paths.BUILD / "planted"
_MISSING = re.compile(r"is missing; build it: make image ROBOT=(\d+)")
"""Said by tests/conftest.py."""
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


class Fault(pydantic.BaseModel):
    """A fault, and who has to notice it."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    file: str
    """Where it is planted, from the checkout on."""
    old: str
    """What is there, once."""
    new: str
    """What it becomes."""
    tests: list[str]
    """What `make test` runs of the area: files and folders below tests/."""
    images: list[int] = []
    """Robots whose cards these tests start."""

    def plant(self, checkout: Path) -> None:
        path = checkout / self.file
        text = path.read_text()
        if text.count(self.old) != 1:
            raise UserError(f"planted.yml: {self.file}: {self.old!r} is there {text.count(self.old)} times, not once")
        path.write_text(text.replace(self.old, self.new))


def faults() -> dict[str, Fault]:
    return yaml_file.read(FILE, pydantic.RootModel[dict[str, Fault]]).root


def noticed(fault: Fault, log: Path) -> str | None:
    """The first test that fails where the fault is planted; None: none does."""
    checkout, outputs = WORK / "checkout", WORK / "build"
    shutil.rmtree(checkout, ignore_errors=True)
    verify.copy_checkout(checkout)
    fault.plant(checkout)
    environment = os.environ | {"BUILD": str(outputs), "KEYS": str(WORK / "keys")}
    with log.open("w") as said:

        def run(*argv: str | Path) -> int:
            return subprocess.run(argv, cwd=checkout, env=environment, stdout=said, stderr=said, check=False).returncode

        python = outputs / "venv" / "bin" / "python"
        if run("make", "setup-tests"):
            raise UserError(f"make setup-tests failed: see {paths.shown(log)}")
        for robot in fault.images:
            if run(python, "-m", "flotilla", "image", str(robot)):
                return f"make image ROBOT={robot}"
        tests = [f"tests/{name}" for name in fault.tests]
        status = run(python, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not nightly", *tests)
    if status == 0:
        return None
    return first_failed(log)


def first_failed(log: Path) -> str:
    """Of a run that failed. A test whose card nobody built has noticed nothing."""
    said = log.read_text()
    if missing := _MISSING.search(said):
        raise UserError(f"planted.yml: images: robot {missing[1]} is missing, whose card {paths.shown(log)} asks for")
    failed = _FAILED.search(said)
    if not failed:
        raise UserError(f"pytest failed without a failed test: see {paths.shown(log)}")
    return failed[1]


def begin() -> None:
    """What all copies share, which they may change."""
    shutil.rmtree(WORK, ignore_errors=True)
    shutil.copytree(paths.KEYS, WORK / "keys")
    for name in ("cache", "pool"):
        shutil.copytree(paths.BUILD / name, WORK / "build" / name, symlinks=True, copy_function=os.link)


def main(names: Sequence[str]) -> int:
    known = faults()
    if unknown := set(names) - set(known):
        raise UserError(f"planted.yml has no {', '.join(sorted(unknown))}; it has {', '.join(known)}")
    missed = 0
    begin()
    for name in names or known:
        begun = time.monotonic()
        found = noticed(known[name], WORK.with_name(f"planted-{name.replace(' ', '-')}.log"))
        missed += found is None
        print(f"{name}: {found or 'NOT NOTICED'}, {time.monotonic() - begun:.0f} s", flush=True)
    shutil.rmtree(WORK, ignore_errors=True)
    return int(missed > 0)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(f"error: {error}")
