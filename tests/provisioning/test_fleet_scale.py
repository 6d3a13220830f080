"""Robots in containers: `fleet.yml` finds them as it finds robots, repairs drift, and nothing of them stays.

This module is also what runs in their namespaces (`main`), since only there they can be reached.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.common import namespace, paths
from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.lab.containers import container, scale
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import Deadline, LabError

RUN_SECONDS = 600
DRIFT = {
    "echo 10.42.0.99 stranger >>/etc/hosts": "/etc/hosts has another content",
    "rm /etc/chrony/chrony.conf": "/etc/chrony/chrony.conf is missing",
    "rm -r /etc/systemd/system/multi-user.target.wants": "multi-user.target.wants was removed",
    "sysctl -q kernel.panic_on_oops=0": "kernel.panic_on_oops = 0, not 1",
    "systemctl stop nftables": "nftables.service does not run",
}
"""What drifts on robot 2, and how the report names it."""
OF_ANOTHER = {"nft flush ruleset": "the rules in force are others"}
"""On robot 3: where the firewall's service starts again, it loads the rules, whatever their role does."""


@pytest.fixture(autouse=True)
def _where_they_can_be() -> None:
    try:
        container.check()
    except UserError as error:
        pytest.skip(str(error))


def test_growth_is_measured_and_nothing_stays() -> None:
    before = left()
    done = subprocess.run(scale_command("4"), cwd=paths.PROJECT, capture_output=True, text=True, check=False,
                          timeout=RUN_SECONDS)  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(scale.RESULT.read_text())
    assert [sample["robots"] for sample in result["samples"]] == [1, 2, 4]
    assert all(sample[field] > 0 for sample in result["samples"] for field in (*scale.TIMES, "boot_s", "memory_mib"))
    assert result["lines"].keys() == set(scale.TIMES)
    assert "no robot was changed" in done.stdout
    assert left() == before


def test_drift_is_found_and_mended(fleet: Fleet, tmp_path: Path) -> None:
    """The first run also shows that a run which changed a robot is refused.

    Seen to pass, when all drift was one robot's, with a role of the firewall that did nothing."""
    directory = scale.describe(4, fleet.robots[4].board, tmp_path / "inventory")
    image = scale.image_for(fleet, fleet.robots[4].board)
    module = "tests.provisioning.test_fleet_scale"
    done = scale.run_inside(tmp_path, module, directory, image, tmp_path, timeout=RUN_SECONDS)
    assert done.returncode == 0, done.stderr
    refused, first, second = json.loads(done.stdout)
    names = [f"robot{number}" for number in range(1, 5)]
    outcomes = [{name: robot["outcome"] for name, robot in run.items()} for run in (first, second)]
    assert outcomes == [
        dict.fromkeys(names, "up to date") | {"robot2": "changed", "robot3": "changed"},
        dict.fromkeys(names, "up to date"),
    ]
    for name, drift in (("robot2", DRIFT), ("robot3", OF_ANOTHER)):
        for words in drift.values():
            assert any(words in line for line in first[name]["repaired"]), (words, first[name]["repaired"])
        assert name in refused
    assert "robot1" not in refused


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGKILL])
def test_nothing_stays_of_a_run_that_was_ended(ended_by: signal.Signals) -> None:
    """Ctrl-C goes to all processes of the terminal; a killed run can do nothing, and the next one cleans up."""
    before = left()
    run = subprocess.Popen(
        scale_command("2"), cwd=paths.PROJECT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    wait_until(lambda: any("/sbin/init" in found for found in left() - before))
    if ended_by == signal.SIGINT:
        os.killpg(run.pid, ended_by)
    else:
        run.kill()
    _, said = run.communicate(timeout=RUN_SECONDS)
    assert run.returncode == (130 if ended_by == signal.SIGINT else -ended_by), said
    wait_until(lambda: not [found for found in left() - before if not found.startswith("control group")])
    container.clean()
    assert left() == before


def scale_command(*argv: str) -> list[str]:
    return [sys.executable, "-m", "flotilla", "fleet-scale", *argv]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = Deadline(RUN_SECONDS)
    while not condition():
        assert not deadline.expired
        time.sleep(0.05)


def left() -> set[str]:
    """What there is of robots in containers here, in words: processes, control groups, loop devices, networks."""
    found = {f"network {path.name}" for path in Path("/sys/class/net").iterdir()}
    # Other programs of this computer have loop devices, too.
    loops = [path.read_text() for path in Path("/sys/block").glob("loop*/loop/backing_file")]
    found |= {f"loop device of {file}" for file in loops if file.startswith(str(paths.IMAGES))}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if "/flotilla-light-" in (process / "cgroup").read_text():
                found.add(f"process {process.name} {(process / 'cmdline').read_text()}")
        except OSError:
            continue  # it has ended meanwhile
    script = "mount -t cgroup2 none /mnt && ls /mnt"
    groups = subprocess.run([*namespace.prefix(), "sh", "-c", script], capture_output=True, text=True, check=True)
    return found | {f"control group {name}" for name in groups.stdout.split() if name.startswith("flotilla-light")}


def main(directory: Path, image: Path, log: Path) -> None:
    """In namespaces: let two robots drift, play twice; print what was refused of the first run, and both reports."""
    fleet = inventory.load_fleet(directory)
    robots = list(fleet.robots.values())
    container.boot(fleet, robots, image, log)
    for number, drift in ((2, DRIFT), (3, OF_ANOTHER)):
        with Ssh(fleet.robots[number], str(fleet.robots[number].address)) as shell:
            for script in drift:
                shell.run(["sudo", "sh", "-ec", script])
    first = scale.play([directory])
    try:
        first.check_unchanged([robot.name for robot in robots])
        refused = ""
    except LabError as error:
        refused = str(error)
    second = scale.play([directory])
    print(json.dumps([refused, first.robots, second.robots]))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
