"""What the programs list, what services of tasks and apps may take, and what threads share."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import paths


def test_blocks_are_listed_with_ports_units_and_source(flotilla_run: Path) -> None:
    program = str(flotilla_run.with_name("flotilla-blocks"))
    listed = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert "\ngain " in listed
    detailed = subprocess.run([program, "gain"], capture_output=True, text=True, check=True).stdout
    assert "default 1; tunable" in detailed
    wrong = subprocess.run([program, "gian"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert "the nearest is gain" in wrong.stderr


@pytest.mark.parametrize("name", ["flotilla-run", "flotilla-blocks"])
def test_a_program_exports_the_interface_of_blocks_alone(flotilla_run: Path, name: str) -> None:
    """Seen to fail with 186 functions of its own, which took the place of those of plug-ins and units. The C library's
    variables have a version."""
    listed = subprocess.run(
        ["nm", "-D", "--defined-only", flotilla_run.with_name(name)], capture_output=True, text=True, check=True
    ).stdout
    exported = {line.split()[-1] for line in listed.splitlines()}
    public = (paths.PROJECT / "runtime" / "include" / "flotilla").glob("*.h")
    declared = set(re.findall(r"\b(fl_\w+)\(", "".join(path.read_text() for path in public)))
    assert {symbol for symbol in exported if "@" not in symbol and not symbol.startswith("fl_")} == set()
    assert declared - exported <= {"fl_interval_s"}, "an inline function"


def test_a_leak_of_an_app_is_its_own(flotilla_run: Path) -> None:
    """Sessions of sshd have an adjustment of 0. Seen to fail: apps had -900, all memory and all of it locked."""

    def unit(name: str) -> dict[str, str]:
        lines = flotilla_run.with_name(f"flotilla-{name}@.service").read_text().splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))

    app, control = unit("app"), unit("task")
    assert int(app["OOMScoreAdjust"]) > 0 > int(control["OOMScoreAdjust"])
    assert app["LimitMEMLOCK"] != "infinity"
    assert int(app["TasksMax"]) <= int(control["TasksMax"])
    shares = [int(each["MemoryMax"].removesuffix("%")) for each in (app, control)]
    assert shares[0] < shares[1] < 75, "what kills one process leaves the robot enough"
    assert app["MemorySwapMax"] == control["MemorySwapMax"] == "0"


def test_what_threads_share_under_thread_sanitizer(flotilla_run: Path) -> None:
    """Seen to fail: rings, triple buffers and changes with relaxed stores are reported as races."""
    directory = flotilla_run.parent.with_name("runtime-threads")
    meson = [str(Path(sys.executable).with_name("meson"))]
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    options = ["-Dtests=true", "-Db_sanitize=thread", "-Dbuildtype=debugoptimized"]
    programs = ["test_executive_change", "test_core_ring", "test_core_serial"]
    for argv in (
        [*meson, "setup", *(["--reconfigure"] if directory.exists() else []), str(directory), "runtime", *options],
        [*meson, "compile", "-C", str(directory), *programs],
        *([str(directory / "tests" / program)] for program in programs),
    ):
        done = subprocess.run(argv, cwd=paths.PROJECT, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{argv}\n{done.stdout}{done.stderr}"
        assert "WARNING: ThreadSanitizer" not in done.stderr
