"""The report of a robot's hardware: what is read out of what it says.

Seen to fail: `parse` without the mark of the next check, `summary` without the case of a missing flag.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import hwcheck, ssh

ANSWERS = {
    "processor": "processor\t: 0\nflags\t\t: fpu tsc cmov apic\n",
    "hardware latency": "Max Latency: 23us\nSamples recorded: 2\n",
    "serial ports": "serinfo:1.0 driver revision:\n0: uart:16550A port:000003F8 irq:4\n1: uart:unknown port:0 irq:0\n",
}
SUMMARY = """\
pae: no (Debian's RT kernel for i386 needs it; `kernel: lean` does not)
cmov: yes
nopl: no (some programs for i686 use it)
tsc: yes
apic: yes
constant_tsc: no (without it, the time stamp counter may change its rate)
hardware latency: 23us
ttyS0: 16550A port:000003F8 irq:4"""


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A robot that runs what it is sent, with other commands in place of the real ones."""
    monkeypatch.setattr(hwcheck, "CHECKS", {name: f"printf '{text}'" for name, text in ANSWERS.items()})
    monkeypatch.setattr(ssh, "command", lambda _: ["env"])
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    (tmp_path / "sudo").symlink_to("/usr/bin/env")
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    return tmp_path


@pytest.fixture
def robot() -> Robot:
    return Robot.model_validate({"name": "robot3", "number": 3, "address": "10.42.0.3", "board": "smartcoret3"})


def test_report(answering: Path, robot: Robot) -> None:
    said = hwcheck.check(robot, seconds=1)
    assert said.startswith(SUMMARY)
    report = (answering / "reports" / "hwcheck-robot3.txt").read_text()
    assert report.startswith(f"== summary\n{SUMMARY}\n\n== processor\n{ANSWERS['processor']}")


def test_a_check_that_fails_is_no_failure_of_the_report() -> None:
    script = "echo '=== flotilla hwcheck: disks'\nsh -c 'echo none; exit 3'\necho '=== flotilla hwcheck: status' $?\n"
    output = subprocess.run(["sh"], input=script, capture_output=True, text=True, check=True).stdout
    assert hwcheck.parse(output) == {"disks": (3, "none\n")}


def test_unmeasured_latency_is_said() -> None:
    found = {name: (0, text) for name, text in ANSWERS.items()} | {"hardware latency": (1, "no tracer\n")}
    assert "hardware latency: not measured (status 1)" in hwcheck.summary(found)


def test_silence_is_an_error(answering: Path, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ssh, "command", lambda _: ["sh", "-c", "echo no route >&2; exit 255"])
    with pytest.raises(UserError, match="robot3 did not answer: no route; is it on and reachable"):
        hwcheck.check(robot, seconds=1)
    assert not (answering / "reports").exists()
