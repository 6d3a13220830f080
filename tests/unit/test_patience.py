"""Limits of waiting: no test depends on how fast this computer is."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from flotilla.common import paths

GUESTS = ("tests/boot", "tests/provisioning", "tests/end_to_end", "flotilla/lab/qemu")
"""Folders of what waits for emulated guests and for robots in containers."""
ENOUGH_S = 300
"""A limit only ends a run that hangs: what takes seconds on an idle computer takes a minute on a slow one."""
NOTHING_COMES = {"0.3"}
"""Where the expected outcome is that the time passes."""


def short(source: str) -> list[str]:
    """Limits below ENOUGH_S: `timeout N` in scripts of guests, `ping -w N`, `timeout=N` of calls, `Deadline(N)`."""
    found = re.findall(r"(?<![\w.])(?:timeout|ping[^\n]* -w) (\d+(?:\.\d+)?)\b", source)
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        limits = [word.value for word in node.keywords if word.arg == "timeout"]
        if isinstance(node.func, ast.Name) and node.func.id == "Deadline":
            limits += node.args[:1]
        found += [str(limit.value) for limit in limits if isinstance(limit, ast.Constant)]
    return [limit for limit in found if limit != "None" and limit not in NOTHING_COMES and float(limit) < ENOUGH_S]


def sources() -> Iterator[Path]:
    for folder in GUESTS:
        yield from sorted((paths.PROJECT / folder).rglob("*.py"))


def test_nothing_that_waits_for_guests_depends_on_the_speed_of_the_host() -> None:
    """Seen to fail in nine files, for limits of 20 s to 180 s, one of which a busy host has exceeded."""
    found = {str(file.relative_to(paths.PROJECT)): limits for file in sources() if (limits := short(file.read_text()))}
    assert found == {}


def test_short_limits_are_seen() -> None:
    source = """
sh(robot, "timeout 60 sh -c 'until there; do sleep 0.5; done'", timeout=90)
robot.run("ping -q -c 1 -w 20 192.0.2.1", timeout=600)
deadline = Deadline(30)
"""
    assert short(source) == ["60", "20", "90", "30"]
