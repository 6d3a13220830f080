"""Times beyond 2038 where a long has 32 bits: all C that is compiled for robots has 64-bit times."""

from __future__ import annotations

import os
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from flotilla.apps import app, builder, scaffold
from flotilla.debian import runtime, toolchain, tools
from flotilla.debian.lock import read_lock, runtime_lock
from flotilla.fleet import inventory
from flotilla.fleet.model import System

PC104 = System("i386", "bookworm")
IN_2040 = datetime(2040, 1, 1, tzinfo=UTC).timestamp()

TASK = """
period: 10 ms
priority: 0
overruns: 0
blocks:
  a: {type: constant, parameters: {value: 1}}
"""

ASSERTION = """
#include <sys/types.h>
#include <time.h>
_Static_assert(sizeof(time_t) == 8 && sizeof(off_t) == 8, "of 32 bits");
"""


def test_a_task_file_of_2040_is_run(tmp_path: Path) -> None:
    """Seen to fail: `Value too large for defined data type`, and status 3."""
    subprocess.run(["dpkg-deb", "-x", runtime.build(PC104).package, tmp_path], check=True)
    task = tmp_path / "late.yml"
    task.write_text(TASK)
    os.utime(task, (IN_2040, IN_2040))
    argv = tools.command(tools.tree(read_lock(runtime_lock(PC104))), tmp_path / "usr/bin/flotilla-run", "i386")
    done = subprocess.run([*argv, "--steps", "3", str(task)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("kind", ["block", "model", "program", "static"])
def test_code_of_apps_has_long_times(tmp_path: Path, kind: str) -> None:
    """Seen to fail: `static assertion failed: "of 32 bits"`, of each kind."""
    board = inventory.load_fleet().boards["smartcoret3"]
    source = tmp_path / "main.c"
    source.write_text(f"{ASSERTION}int main(void) {{ return 0; }}\n")
    if kind == "block":
        source.write_text(f"#include <flotilla/block.h>\n{ASSERTION}")
        assert runtime.compile_plugin(source, PC104)
    elif kind == "model":  # as generated code is compiled, and sources of units
        assert runtime.compile_shared(source, [source.name], PC104, ["-std=gnu11"])
    elif kind == "static":
        assert toolchain.compile_static(source, board)
    else:
        scaffold.create("make", "late", tmp_path)
        written = tmp_path / "late/main.c"
        written.write_text(written.read_text() + ASSERTION)
        (out := tmp_path / "out").mkdir()
        builder.build(app.load(tmp_path / "late"), board, out)
