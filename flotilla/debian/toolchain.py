"""Programs for robots, compiled by the locked compiler: the same bytes on every development computer."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from flotilla.common import namespace, paths, sandbox
from flotilla.common.errors import UserError
from flotilla.debian import pool, tools
from flotilla.debian.chroot import Chroot
from flotilla.debian.lock import read_lock
from flotilla.fleet.model import Board

_ARCHITECTURES = {
    # The kernel's headers are for both, at the place for one.
    "i386": ["-m32", "-march=i686", "-isystem", "/usr/include/x86_64-linux-gnu"],
    "amd64": ["-m64"],
}
"""Options by Debian's name of the architecture, for the oldest processor that its packages run on."""
Run = Callable[[str, Path, Sequence[str], Path], None]
"""Runs a command among the packages of a lock: `run`, or the same elsewhere."""
LONG_TIMES = ("-D_FILE_OFFSET_BITS=64", "-D_TIME_BITS=64")
"""Options for times beyond 2038, of files and clocks, also where a long has 32 bits. Nothing of the interface of blocks
depends on them."""
_OPTIONS = ["-O2", *LONG_TIMES, "-Wl,--build-id=none", "-s"]


def compile_static(source: Path, board: Board, options: Sequence[str] = ()) -> bytes:
    """A C file as a program that needs nothing of the robot's libraries; errors are the compiler's own words."""
    processor = [f"-march={board.processor}"] if board.processor else []
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".compile-") as directory:
        work = Path(directory)
        shutil.copy(source, work)
        argv = ["gcc-12", *_ARCHITECTURES[board.architecture], *processor, *_OPTIONS, "-static", *options]
        run("toolchain", work, [*argv, "-o", "/out/made", f"/out/{source.name}"], work / "log")
        return (work / "made").read_bytes()


def run(lock_name: str, work: Path, command: Sequence[str], log: Path) -> None:
    """Run a command among the packages of a lock, where `work` is /out; errors are its own words, kept in `log`.

    It runs in a sandbox: Makefiles, and options of compilers, are others' code.
    """
    lock = read_lock(lock_name)
    pool.fill([lock])
    chroot = Chroot(Path("/"), lock.epoch)
    moved = {"/run/faketime": Path(os.environ["FAKETIME_LIBRARIES"])} if chroot.clock else {}
    argv = sandbox.command(
        [*chroot.clock, *command], sandbox.BUILD, root=tools.tree(lock), writable={"/out": work}, mounted=moved,
        environment=chroot.environment,
    )  # fmt: skip
    try:
        namespace.run_logged(__name__, argv, log)
    except UserError as error:
        if refused := sandbox.refusal(namespace.log_text(log), sandbox.BUILD):
            raise UserError(f"{refused}\n{error}") from None
        raise
