"""A chroot in which locked tools run: the same environment, devices and time wherever and whenever a stage runs.

For use inside the namespaces of a stage (`namespace.run_stage`), which take the mounts away when it ends.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from flotilla.common import namespace

DEVICES = ("null", "zero", "full", "random", "urandom", "tty")


class Chroot:
    """Runs programs of the tree `root`, with SOURCE_DATE_EPOCH `epoch`."""

    def __init__(self, root: Path, epoch: int) -> None:
        self.root = root
        self.environment = {
            "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
            "LC_ALL": "C.UTF-8",
            "TZ": "UTC",
            "HOME": "/root",
            "SOURCE_DATE_EPOCH": str(epoch),
        }
        self.clock: list[str] = []
        if "FAKETIME_LIBRARIES" in os.environ:  # make verify; `env`, because the place exists inside the chroot only
            moved = namespace.moved_clock() | {"LD_PRELOAD": "/run/faketime/$LIB/libfaketime.so.1"}
            self.clock = ["env", *(f"{name}={value}" for name, value in moved.items())]

    def run(self, *argv: str) -> str:
        """Run a program; its standard output. A failure ends the stage."""
        output = self._run(argv, subprocess.PIPE)
        print(output, flush=True)
        return output

    def log(self, *argv: str) -> None:
        """Run a program whose output, line by line, is the stage's. A failure ends the stage."""
        self._run(argv, None)

    def _run(self, argv: Sequence[str], output: int | None) -> str:
        print("+", *argv, flush=True)
        done = subprocess.run(
            ["chroot", str(self.root), *self.clock, *argv], env=self.environment, stdout=output, text=True
        )
        if done.returncode != 0:
            print(done.stdout or "", flush=True)
            raise SystemExit(f"{argv[0]} failed with status {done.returncode}")
        return done.stdout or ""

    def provide_clock(self) -> None:
        """Where the clock is moved: the library that does it, and the semaphores that it insists on."""
        if self.clock:
            (self.root / "dev/shm").mkdir(parents=True, exist_ok=True)
            (self.root / "run/faketime").mkdir(parents=True, exist_ok=True)
            mount("--bind", os.environ["FAKETIME_LIBRARIES"], self.root / "run/faketime")

    def provide_system(self, **directories: str | Path) -> None:
        """Mount what programs expect of a system, and directories of the host by their names in the tree."""
        for name in ("tmp", "run", "dev"):
            mount("-t", "tmpfs", "-o", "mode=755", "flotilla", self.root / name)
        for node in DEVICES:
            (self.root / "dev" / node).touch()
            mount("--bind", f"/dev/{node}", self.root / "dev" / node)
        mount("-t", "proc", "proc", self.root / "proc")
        for name, directory in directories.items():
            mount("--bind", directory, self.root / name)
        self.provide_clock()


def mount(*arguments: str | Path) -> None:
    subprocess.run(["mount", *map(str, arguments)], check=True)
