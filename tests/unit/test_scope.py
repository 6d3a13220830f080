"""Signals of a robot's task from the station: what is asked of the robot, and what becomes of its answers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from ipaddress import IPv4Address
from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import scope, ssh

ROBOT = Robot(name="robot3", number=3, board="smartcoret3", address=IPv4Address("10.0.0.3"))
COMMAND = scope.words("heading", ["a.b"], csv=True, every=None, rows=None, trigger=None, before=None)


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A directory of the robot's programs: ssh runs what it is sent in a shell, as there."""
    monkeypatch.setattr(ssh, "command", lambda _: ["sh", "-c", 'PATH="$0:$PATH" exec sh -c "$1"', str(tmp_path)])
    return tmp_path


def program(directory: Path, script: str) -> None:
    file = directory / "flotilla-scope"
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(0o755)


def test_words_reach_the_robot_as_they_are(robot: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Seen to fail with words that are joined by blanks: `>` made a file of the robot's."""
    program(robot, 'for word; do echo "<$word>"; done')
    command = scope.words("heading", ["a.b", "c.d[1]"], csv=False, every=2, rows=3, trigger="a.b>-1", before=1)
    scope.show(ROBOT, command)
    assert capfd.readouterr().out.split() == [
        "<--every=2>", "<--rows=3>", "<--trigger=a.b>-1>", "<--before=1>", "<-->", "<heading>", "<a.b>", "<c.d[1]>"
    ]  # fmt: skip


def test_rows_are_kept_and_a_file_without_rows_is_not(robot: Path, tmp_path: Path) -> None:
    file = tmp_path / "out.csv"
    file.write_text("former")
    program(robot, "echo step,a.b; echo 'flotilla-scope: task heading has ended' >&2; exit 1")
    with pytest.raises(UserError, match=r"^robot3: task heading has ended$"):
        scope.record(ROBOT, COMMAND, file)
    assert file.read_text() == "former"
    program(robot, "echo step,a.b; echo 9,8; echo 'flotilla-scope: task heading has ended' >&2; exit 1")
    with pytest.raises(UserError, match=r"^robot3: task heading has ended$"):
        scope.record(ROBOT, COMMAND, file)
    assert file.read_text() == "step,a.b\n9,8\n"
    program(robot, "echo step,a.b; echo 1,2; echo 2,3")
    assert scope.record(ROBOT, COMMAND, file) == 2
    assert file.read_text() == "step,a.b\n1,2\n2,3\n"
    with pytest.raises(
        UserError, match=r"nowhere/out.csv: No such file or directory; name a file that can be written$"
    ):
        scope.record(ROBOT, COMMAND, tmp_path / "nowhere" / "out.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flotilla-scope", "out.csv"]


INTERRUPTED = """
import sys
from pathlib import Path
from flotilla.robot import scope, ssh
from tests.unit.test_scope import COMMAND, ROBOT
ssh.command = lambda _: ["sh", "-c", 'PATH="$0:$PATH" exec sh -c "$1"', sys.argv[1]]
print(scope.record(ROBOT, COMMAND, Path(sys.argv[2])))
"""


def test_an_interruption_keeps_whole_rows(robot: Path, tmp_path: Path) -> None:
    """Seen to fail with the line that was cut."""
    file, ready = tmp_path / "out.csv", tmp_path / "ready"
    os.mkfifo(ready)
    program(robot, f"trap '' INT; echo step,a.b; echo 1,2; printf 2,; echo >{ready}; exec sleep 1000")
    argv = [sys.executable, "-c", INTERRUPTED, str(robot), str(file)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        ready.read_text()
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    assert (process.returncode, out) == (0, "1\n")
    assert file.read_text() == "step,a.b\n1,2\n"


def test_its_reason_is_ours(robot: Path) -> None:
    program(robot, "echo 'flotilla-scope: no task heading runs here' >&2; exit 1")
    with pytest.raises(UserError, match=r"^robot3: no task heading runs here$"):
        scope.show(ROBOT, ["flotilla-scope", "heading"])
    program(robot, "echo 'ssh: connect to host: No route' >&2; exit 255")
    with pytest.raises(UserError, match=r"^robot3 did not answer: ssh: connect to host: No route; is it on"):
        scope.show(ROBOT, ["flotilla-scope", "heading"])
