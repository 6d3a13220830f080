"""Programs for robots, compiled by the locked compiler: the same bytes on every development computer."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from images.builder import namespace, paths, pool, tools
from images.builder.chroot import Chroot
from images.builder.lock import read_lock

_ARCHITECTURES = {
    # The kernel's headers are for both, at the place for one.
    "i386": ["-m32", "-march=pentium3", "-isystem", "/usr/include/x86_64-linux-gnu"],
    "amd64": ["-m64"],
}
"""Options by Debian's name of the architecture. The oldest i386 boards are of the Pentium III class."""
_OPTIONS = ["-O2", "-Wl,--build-id=none", "-s"]


def compile_static(source: Path, architecture: str, options: Sequence[str] = ()) -> bytes:
    """A C file as a program that needs nothing of the robot's libraries; errors are the compiler's own words."""
    return compile_by("toolchain", ["gcc-12", *_ARCHITECTURES[architecture], *_OPTIONS, "-static", *options], [source])


def compile_by(lock_name: str, command: Sequence[str], sources: Sequence[Path], libraries: Sequence[str] = ()) -> bytes:
    """What `command`, a compiler of that lock, makes of the first of `sources`; beside it lie the others, files or
    directories."""
    lock = read_lock(lock_name)
    pool.fill([lock])
    tree = tools.tree(lock)
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".compile-") as directory:
        work = Path(directory)
        for source in sources:
            (shutil.copytree if source.is_dir() else shutil.copy)(source, work / source.name)
        line = [*command, "-o", "/out/made", f"/out/{sources[0].name}", *libraries]
        stage = {"tools": str(tree), "epoch": lock.epoch, "out": directory, "command": line}
        namespace.run_stage(__name__, [json.dumps(stage)], work / "log")
        return (work / "made").read_bytes()


def main(description: str) -> None:
    """The stage: one command in a chroot of the toolchain."""
    stage = json.loads(description)
    chroot = Chroot(Path(stage["tools"]), stage["epoch"])
    chroot.provide_system(out=stage["out"])
    chroot.log(*stage["command"])


if __name__ == "__main__":
    main(sys.argv[1])
