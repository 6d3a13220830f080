"""`make deploy` interrupted at every moment, and programs that fail: on a robot in a container, by the command line.

This module is also what runs in the robot's namespaces (`main`), and the command line with an interrupt planted in it
(`deploy`). Programs are shell scripts, so that nothing has to be compiled.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, cast
from unittest import mock

import pytest

from flotilla.apps import app, builder, remote
from flotilla.cli import main as command_line
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.fleet.model import Board, Fleet
from flotilla.lab.containers import container, scale
from flotilla.lab.qemu.ssh import Ssh

RUN_SECONDS = 1800
RUNS = "trap 'exit 0' TERM; echo on >>$STATE_DIRECTORY/actuator; echo runs; while :; do sleep 0.05; done"
FAILS = "echo on >>$STATE_DIRECTORY/actuator; exit 7"
FAILS_WHEN_ASKED = "while ! [ -e $STATE_DIRECTORY/fail ]; do sleep 0.05; done; " + FAILS
SPINS = "trap '' TERM; echo runs; while :; do :; done"
UNIT = "flotilla-app@hover.service"


@pytest.fixture(scope="module")
def said(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What `main` found, by scenario."""
    try:
        container.check()
    except UserError as error:
        pytest.skip(str(error))
    work = tmp_path_factory.mktemp("light")
    directory = scale.describe(1, fleet.robots[4].board, work / "inventory")
    image = scale.image_for(fleet, fleet.robots[4].board)
    module = "tests.provisioning.test_deploy_interrupted"
    done = scale.run_inside(work, module, "main", directory, image, work, timeout=RUN_SECONDS)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.mark.parametrize("moment", ["before", "at once", "running"])
def test_an_interrupt_ends_the_app(said: dict[str, Any], moment: str) -> None:
    """Seen to fail at once after the start: the app ran on, for the robot was told to stop it before it started."""
    assert said[moment]["state"] == "inactive", said[moment]
    assert said[moment]["status"] == 0, said[moment]


def test_a_second_interrupt_ends_it_too(said: dict[str, Any]) -> None:
    """It comes when the first one has closed the run's input. Seen to fail when it came with a line of the log: on a
    slow host the robot had cancelled the start, and there was none."""
    assert said["twice"]["state"] == "inactive", said["twice"]
    assert said["twice"]["status"] == 130
    assert "interrupted; robot1: hover is inactive, version " in said["twice"]["err"]


def test_an_interrupt_says_what_the_robot_has(said: dict[str, Any]) -> None:
    """Seen to fail with the words that the last good outputs are untouched, when the kept app had been replaced."""
    before, sending, sent = said["kept"], said["sending"], said["sent"]
    assert before["state"] == "active"
    old, new = before["version"], sent["version"]
    assert old != new
    assert (sending["status"], sent["status"]) == (130, 130)
    assert f"interrupted; robot1: hover is active, version {old}, and starts with the robot" in sending["err"]
    assert f"interrupted; robot1: hover is inactive, version {new}, and starts with the robot" in sent["err"]
    assert (sending["state"], sent["state"]) == ("active", "inactive")


def test_what_fails_in_the_foreground_is_not_started_again(said: dict[str, Any]) -> None:
    """Seen to fail with five starts: the actuator moved five times. What goes on by itself does start again."""
    assert said["fails"]["starts"] == 1, said["fails"]
    assert said["fails"]["status"] == 1
    assert "hover ended: exit-code" in said["fails"]["err"]
    assert said["fails in the background"]["starts"] > 1


def test_a_removed_app_leaves_no_failed_unit(said: dict[str, Any]) -> None:
    """Provisioning ends a roll-out on a robot that has one."""
    assert UNIT in said["failed before"]
    assert said["failed after"] == ""


def test_a_program_that_spins_leaves_the_processor_to_others_and_is_ended(said: dict[str, Any]) -> None:
    """Seen to fail with nice -20: on one processor it took 87 s until the service manager had ended it."""
    assert said["spins"]["nice"] == "0"
    assert said["spins"]["state"] == "failed"
    assert "hover ended: timeout" in said["spins"]["err"]


class Station:
    """In the namespaces: the robot, and an app whose program changes."""

    def __init__(self, directory: Path, work: Path, shell: Ssh) -> None:
        self.directory, self.app, self.shell = directory, work / "hover", shell
        self.app.mkdir()
        (self.app / "app.yml").write_text("kind: make\nprogram: hover\nfiles: []\n")
        (self.app / "Makefile").touch()

    def deploy(self, script: str, moment: str = "never", *options: str) -> dict[str, Any]:
        """`make deploy` of a program, interrupted at a moment; what came of it."""
        (self.app / "hover").write_text(f"#!/bin/sh\n{script}\n")
        argv = [
            sys.executable,
            "-m",
            "tests.provisioning.test_deploy_interrupted",
            "deploy",
            str(self.directory),
            moment,
        ]
        argv += ["1", str(self.app), *options]
        done = subprocess.run(
            argv, capture_output=True, text=True, timeout=RUN_SECONDS, check=False, start_new_session=True
        )
        found = {"status": done.returncode, "err": done.stderr[-2000:], "out": done.stdout[-2000:]}
        found["state"] = self.root(f"systemctl show -P ActiveState {UNIT}")
        found["version"] = self.root("readlink /data/apps/hover || true").partition("@")[2]
        return found

    def root(self, script: str) -> str:
        return self.shell.run(["sudo", "sh", "-c", script]).stdout.strip()

    def starts(self) -> int:
        return int(self.root("cat /var/lib/flotilla-apps/hover/actuator 2>/dev/null | wc -l"))


def main(directory: Path, image: Path, work: Path) -> None:
    """Every scenario on one robot; what was found, as the last line."""
    fleet = inventory.load_fleet(directory)
    container.boot(fleet, list(fleet.robots.values()), image, work)
    found: dict[str, Any] = {}
    with Ssh(fleet.robots[1], str(fleet.robots[1].address)) as shell:
        station = Station(directory, work, shell)
        # The capability that robots in containers lack.
        drop_in = "/run/systemd/system/flotilla-app@.service.d"
        station.root(f"mkdir -p {drop_in}; printf '[Service]\\nAmbientCapabilities=\\n' >{drop_in}/light.conf")
        station.root("systemctl daemon-reload")
        for moment in ("before", "at once", "running", "twice"):
            found[moment] = station.deploy(RUNS, moment)
            station.root(f"systemctl stop {UNIT}")
        found["kept"] = station.deploy(RUNS, "never", "--keep")
        found["sending"] = station.deploy(f"{RUNS} # new", "sending", "--keep")
        found["sent"] = station.deploy(f"{RUNS} # new", "sent", "--keep")
        station.root("rm -rf /var/lib/flotilla-apps/hover/actuator")
        found["fails"] = station.deploy(FAILS) | {"starts": station.starts()}
        found["fails in the background"] = station.deploy(FAILS_WHEN_ASKED, "never", "--keep")
        station.root("touch /var/lib/flotilla-apps/hover/fail")
        station.root(f"for _ in $(seq 300); do ! systemctl is-failed -q {UNIT} || break; sleep 0.1; done")
        found["fails in the background"]["starts"] = station.starts() - 1
        found["failed before"] = station.root("systemctl --failed --plain --no-legend")
        station.deploy(FAILS, "never", "--run", "remove")
        found["failed after"] = station.root("systemctl --failed --plain --no-legend")
        found["spins"] = station.deploy(SPINS, "running") | {"nice": station.root(f"systemctl show -P Nice {UNIT}")}
    print(json.dumps(found))


def deploy(directory: Path, moment: str, argv: Sequence[str]) -> int:
    """The command line, interrupted by itself at a moment."""
    fleet = inventory.load_fleet(directory)

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    class InterruptedAgain:
        """The run's input, which an interrupt closes: the second interrupt comes with that, whatever the robot does."""

        def __init__(self, file: Any) -> None:
            self._file = file

        def close(self) -> None:
            if not self._file.closed:
                self._file.close()
                interrupt()

    def build(subject: app.App, _: Board, out: Path, *_run: object) -> None:
        assert isinstance(subject.description, app.Make)
        (out / "unit.d").mkdir(parents=True)
        shutil.copy(subject.directory / "hover", out)
        (out / "hover").chmod(0o755)
        service = builder.service(subject, subject.description, safe=False)
        (out / "unit.d" / "program.conf").write_text(service)

    class Popen(subprocess.Popen[Any]):
        """Of the ssh that is started."""

        def __init__(self, argv: Any, **options: Any) -> None:
            runs = "flotilla run hover" in argv[-1]
            if runs and moment == "before":
                interrupt()
            super().__init__(argv, **options)
            if runs and moment == "at once":
                interrupt()
            if runs and moment == "twice":
                self.stdin = cast(IO[Any], InterruptedAgain(self.stdin))
            if "flotilla receive hover" in argv[-1] and moment == "sending":
                interrupt()

    def show(line: str, **options: Any) -> None:
        real_print(line, **options)
        if line == "runs" and moment in ("running", "twice"):
            interrupt()

    def send(*arguments: Any) -> None:
        real_send(*arguments)
        if moment == "sent":
            interrupt()

    real_send = remote.send
    sys.argv = ["flotilla", "deploy", *argv]
    with (
        mock.patch.object(inventory, "load_fleet", return_value=fleet),
        mock.patch.object(builder, "build", build),
        mock.patch.object(remote, "send", send),
        mock.patch.object(subprocess, "Popen", Popen),
        mock.patch("builtins.print", show),
    ):
        return command_line.main()


real_print = print

if __name__ == "__main__":
    if sys.argv[1] == "main":
        main(*map(Path, sys.argv[2:]))
    else:
        sys.exit(deploy(Path(sys.argv[2]), sys.argv[3], sys.argv[4:]))
