"""The measurement's own program, as one static file."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from images.builder import paths, progress
from images.builder.errors import UserError
from images.builder.fleet import Board

_FLAGS = {"i386": ["-m32", "-march=i686"], "amd64": []}
"""Of Debian's architectures. Nothing beyond a Pentium III may be used."""


def compile_static(source: Path, board: Board, out: Path) -> bytes:
    """Compile a C program for a board; its bytes follow from source and compiler."""
    compiler = shutil.which("gcc")
    flags = _FLAGS[board.architecture]
    argv = [compiler or "gcc", *flags, "-std=gnu11", "-static", "-O2", "-Wall", "-Wextra", "-Werror", "-pthread"]
    argv += ["-ffile-prefix-map=" + str(source.parent) + "=.", "-Wl,--build-id=none", "-s", "-o", str(out), str(source)]
    progress.command(argv)
    done = subprocess.run(argv, capture_output=True, text=True, check=False) if compiler else None
    if done is None or done.returncode:
        reason = done.stderr.strip() if done else "gcc is missing"
        raise UserError(
            f"{paths.shown(source)} cannot be compiled: {reason}; a compiler for both kinds of board: "
            "sudo apt-get install gcc gcc-multilib libc6-dev-i386"
        )
    return out.read_bytes()
