"""Provisioning by `ansible-playbook fleet.yml`: guests of the shipped images on one segment, from flashed cards on.

The tests share the guests and leave them as they should be. What a run did is read from its report.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from flotilla.common import paths
from flotilla.fleet.model import Fleet, Robot
from flotilla.lab.qemu import saved
from flotilla.lab.qemu import virtual_fleet as virtual
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.ssh import Ssh
from flotilla.robot import health, ssh

ANSIBLE = paths.PROJECT / "ansible"
BOOT_SECONDS = 1800
RUN_SECONDS = 1800
REPORTS = paths.BUILD / "reports"

ROBOTS = 1, 2
"""One of each board. The first has a control task, the second has none."""

Report = dict[str, Any]


@dataclass(frozen=True)
class Playbook:
    """A run that has ended."""

    status: int
    said: str
    report: Report

    def outcomes(self) -> dict[str, str]:
        return {name: robot["outcome"] for name, robot in self.report["robots"].items()}

    def repaired(self, name: str) -> list[str]:
        found: list[str] = self.report["robots"][name]["repaired"]
        return found


@dataclass(frozen=True)
class Guests:
    """The running guests."""

    robots: dict[str, Robot]
    machines: dict[str, Guest]
    shells: dict[str, Ssh]
    ports: dict[str, int]
    directory: Path

    def inventory(self, ports: Mapping[str, int]) -> Path:
        """Where the guests are, or where Ansible is to believe they are."""
        file = self.directory / "guests.yml"
        file.write_text(virtual.guests_inventory(ports))
        return file

    def argv(
        self, *more: str, playbook: str = "fleet", inventory: Path = paths.INVENTORY,
        ports: Mapping[str, int] | None = None,
    ) -> list[str]:  # fmt: skip
        program = Path(sys.executable).with_name("ansible-playbook")
        there = self.inventory(ports or self.ports)
        return [str(program), "-i", str(inventory), "-i", str(there), "-l", "guests", f"{playbook}.yml", *more]

    def play(
        self, *more: str, playbook: str = "fleet", environment: Mapping[str, str] | None = None, **where: Any
    ) -> Playbook:
        report = REPORTS / f"{playbook}.json"
        report.unlink(missing_ok=True)
        done = subprocess.run(
            self.argv(*more, playbook=playbook, **where), cwd=ANSIBLE, env=environment or ENVIRONMENT,
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=RUN_SECONDS, check=False,
        )  # fmt: skip
        said = done.stdout + done.stderr
        (self.directory / "ansible.log").write_text(said)
        return Playbook(done.returncode, said, json.loads(report.read_text()) if report.exists() else {"robots": {}})

    def sudo(self, name: str, script: str) -> str:
        return self.shells[name].run(["sudo", "sh", "-ec", script]).stdout


ENVIRONMENT = os.environ | {
    "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    "ANSIBLE_NOCOLOR": "1",
    "BUILD": str(paths.BUILD),
    "KEYS": str(paths.KEYS),
}
AT_ONCE = ("-e", json.dumps({"waves": ["100%"]}))


@contextlib.contextmanager
def running(fleet: Fleet, robots: list[Robot], directory: Path, **plugged: Mapping[str, str]) -> Iterator[Guests]:
    """Guests of these robots on one segment, booted. `plugged`: into ports of some, as `qemu.Options.ports`."""
    with contextlib.ExitStack() as stack:
        machines, segment = stack.enter_context(virtual.running(fleet, robots, directory, plugged))
        ports = {robot.name: segment.ssh_port(robot.address) for robot in robots}
        shells = {}
        for robot in robots:
            port = functools.partial(ports.__getitem__, robot.name)
            shells[robot.name] = stack.enter_context(Ssh(robot, "127.0.0.1", port))
            saved.wait(machines[robot.name], robot, shells[robot.name])
        yield Guests({robot.name: robot for robot in robots}, machines, shells, ports, directory)


@pytest.fixture(scope="module")
def guests(fleet: Fleet, session_artefacts: Path) -> Iterator[Guests]:
    with running(fleet, [fleet.robots[number] for number in ROBOTS], session_artefacts / "fleet") as guests:
        yield guests


DRIFT = [
    (
        "robot1",
        "sed -i 's/kp: .*, kd/kp: 9, kd/' /etc/flotilla/tasks/heading.yml",
        "/etc/flotilla/tasks/heading.yml has another",
    ),
    ("robot1", "sed -i '$d' /etc/flotilla/message-keys", "/etc/flotilla/message-keys has another"),
    ("robot2", "nft flush ruleset", "the rules in force are others"),
    ("robot1", "rm /etc/udev/rules.d/70-robot.rules", "/etc/udev/rules.d/70-robot.rules is missing"),
    ("robot1", "ip address add 10.42.0.77/24 dev eth0", "address 10.42.0.1/24, 10.42.0.77/24"),
    ("robot2", "systemctl stop flotilla-zram", "flotilla-zram.service does not run"),
    ("robot1", "rm -r /etc/systemd/system/multi-user.target.wants", "multi-user.target.wants was removed"),
    (
        "robot2",
        "echo ssh-ed25519 AAAA stranger >>/etc/ssh/authorized_keys/robot",
        "authorized_keys/robot has another",
    ),
]
"""What drifts on each robot, as a script, and how the report names it."""


def test_robots_that_were_just_flashed_are_up_to_date(guests: Guests) -> None:
    """In the waves of a real roll-out. Seen to fail with a file in the layer that no template makes."""
    done = guests.play()
    assert done.status == 0, done.said
    assert done.outcomes() == dict.fromkeys(guests.robots, "up to date"), done.report
    assert done.report["check"] is False
    page = (REPORTS / "fleet.html").read_text()
    assert all(name in page for name in guests.robots)


@pytest.mark.nightly  # each time, unit/test_health.py judges reports
def test_a_robots_own_report_stops_the_roll_out(guests: Guests) -> None:
    """The gyro's port is silent, and then the task is stopped now and then, so that it overruns. The same robots are
    healthy in the test before, where nobody asks for gyro or time."""

    def unhealthy(**wanted: Any) -> str:
        done = guests.play("-e", json.dumps({"health": wanted}))
        assert (done.status != 0, done.outcomes()) == (True, {"robot1": "failed"}), done.said
        (reason,) = done.report["robots"]["robot1"]["unhealthy"]
        assert reason in done.report["robots"]["robot1"]["messages"][0]
        assert reason in (REPORTS / "fleet.html").read_text()
        return str(reason)

    assert unhealthy(overruns_percent=100, required_sensors=["heading.gyro"]).startswith("heading.gyro: its flag is 0")
    group = guests.sudo("robot1", "systemctl show --property ControlGroup --value flotilla-task@heading").strip()
    processes = shlex.quote(f"/sys/fs/cgroup{group}/cgroup.procs")
    # On a busy computer a stop may last longer than the actuator's timeout: the guard ends the task, and it is started
    # again as another process, which is stopped then.
    stop = f"while :; do read pid <{processes} && kill -STOP $pid && sleep 0.02 && kill -CONT $pid; sleep 0.05; done"
    unit = f"systemd-run --unit disturbing -p RuntimeMaxSec={RUN_SECONDS}"
    guests.sudo("robot1", f"{unit} sh -c {shlex.quote(stop)}")
    assert "steps overran, more than 1 %" in unhealthy(overruns_percent=1)
    resume = f"for pid in $(cat {processes}); do kill -CONT $pid; done"
    guests.sudo("robot1", f"systemctl stop disturbing || true; {resume}")
    done = guests.play("-l", "robot1", playbook="tasks")
    assert " overruns in " in done.said
    assert "gyro flag 0" in done.said
    guests.sudo("robot1", "echo planted >/sys/fs/ext4/$(basename $(findmnt -no SOURCE /data))/trigger_fs_error")
    assert unhealthy() == health.READ_ONLY


def test_drift_is_shown_mended_and_gone(guests: Guests) -> None:
    for name, script, _ in DRIFT:
        guests.sudo(name, script)
    of_an_app = "/etc/systemd/system/flotilla-app@some.service.d"
    guests.sudo("robot2", f"ln -s /data/apps/some/unit.d {of_an_app}")
    shown = guests.play("--check", "--diff", *AT_ONCE)
    assert shown.status == 0, shown.said
    assert shown.outcomes() == dict.fromkeys(guests.robots, "would change")
    assert "-ssh-ed25519 AAAA stranger" in shown.said
    assert "+# Every serial port" in shown.said
    keys_now = guests.sudo("robot1", "cat /etc/flotilla/message-keys").split()
    assert not [word for word in keys_now if len(word) == 64 and word in shown.said]
    repaired = guests.play(*AT_ONCE)
    assert repaired.status == 0, repaired.said
    assert repaired.outcomes() == dict.fromkeys(guests.robots, "changed")
    for name, _, words in DRIFT:
        for run in (shown, repaired):
            assert any(words in line for line in run.repaired(name)), (name, words, run.repaired(name))
    again = guests.play(*AT_ONCE)
    assert again.outcomes() == dict.fromkeys(guests.robots, "up to date"), again.report
    assert "kp: 0.3" in guests.sudo("robot1", "cat /etc/flotilla/tasks/heading.yml")
    guests.sudo("robot2", f"rm {of_an_app}")


@pytest.mark.nightly
def test_tasks_take_other_keys(guests: Guests) -> None:
    """They read them when they start. Seen to fail with a role that restarts tasks whose own file drifted."""
    guests.sudo("robot1", "sed -i 's/10.42/10.43/' /etc/flotilla/message-keys; systemctl restart flotilla-task@heading")
    credentials = "cat /run/credentials/flotilla-task@heading.service/message-keys"
    assert "10.43" in guests.sudo("robot1", credentials)
    played = guests.play("-l", "robot1")
    assert played.outcomes() == {"robot1": "changed"}
    assert guests.sudo("robot1", credentials) == guests.sudo("robot1", "cat /etc/flotilla/message-keys")
    assert "10.43" not in guests.sudo("robot1", credentials)


@pytest.mark.nightly
def test_a_robot_that_dies_stops_the_roll_out_and_nothing_is_half_done(guests: Guests) -> None:
    for name in guests.robots:
        guests.sudo(name, "echo 10.42.0.99 stranger >>/etc/hosts; sysctl -q kernel.panic_on_oops=0")
    argv = guests.argv("-e", json.dumps({"waves": [1, 1]}))
    with subprocess.Popen(
        argv, cwd=ANSIBLE, env=ENVIRONMENT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    ) as run:  # fmt: skip
        assert run.stdout
        for line in run.stdout:
            if line.startswith("changed: [robot1]"):
                guests.machines["robot1"].cut()
    assert run.returncode != 0
    report = json.loads((REPORTS / "fleet.json").read_text())
    assert {name: robot["outcome"] for name, robot in report["robots"].items()} == {"robot1": "unreachable"}
    machine = guests.machines["robot1"]
    machine.on()
    machine.console.expect("robot1 login: ", BOOT_SECONDS)
    guests.shells["robot1"].connect()
    completed = guests.play(*AT_ONCE)
    assert completed.status == 0, completed.said
    assert completed.outcomes() | {"robot1": ""} == {"robot1": "", "robot2": "changed"}
    for name in guests.robots:
        assert guests.sudo(name, "grep -c stranger /etc/hosts || true").strip() == "0"
        assert guests.sudo(name, "cat /proc/sys/kernel/panic_on_oops").strip() == "1"


@pytest.mark.nightly
def test_a_wrong_netmask_leaves_the_robot_at_its_old_address(guests: Guests, tmp_path: Path) -> None:
    """The network is too small for the station, which the robot can therefore no longer answer."""
    inventory = altered(tmp_path, "group_vars/all.yml", "10.42.0.0/24", "10.42.0.0/29")
    robots = inventory / "robots.yml"
    robots.write_text(robots.read_text().partition("# Computers of the fleet that are no robots")[0])
    before = guests.sudo("robot2", "find /data/A/etc -type f | sort | xargs sha256sum")
    done = guests.play("-l", "robot2", "-e", "network_trial_s=50", inventory=inventory)
    assert done.outcomes() == {"robot2": "failed"}
    assert "does not answer at 10.42.0.2/29" in done.said
    guests.shells["robot2"].connect(120)
    assert guests.sudo("robot2", "find /data/A/etc -type f | sort | xargs sha256sum") == before
    assert guests.play("-l", "robot2").outcomes() == {"robot2": "up to date"}


def test_the_wrong_robot_is_refused_with_the_reason(guests: Guests, tmp_path: Path) -> None:
    """Someone else answers where robot 2 should, and nobody where robot 1 should. Connections of earlier runs are not
    taken up: robot 1's is known by its port."""
    wrong = guests.ports | {"robot2": guests.ports["robot1"], "robot1": 1}
    anew = ENVIRONMENT | {"ANSIBLE_SSH_CONTROL_PATH_DIR": str(tmp_path)}
    done = guests.play("-l", "robot1,robot2", *AT_ONCE, ports=wrong, environment=anew)
    assert done.outcomes() == {"robot1": "unreachable", "robot2": "unreachable"}, done.report
    assert "Host key verification failed" in done.report["robots"]["robot2"]["messages"][0]
    assert "Connection refused" in done.report["robots"]["robot1"]["messages"][0]


@pytest.mark.nightly
def test_a_card_in_another_computer_is_noticed(guests: Guests, tmp_path: Path) -> None:
    robots = (paths.INVENTORY / "robots.yml").read_text()
    lines = "        robot2:\n          number: 2\n          address: 10.42.0.2\n"
    assert lines in robots
    inventory = altered(tmp_path, "robots.yml", lines, "")
    altered_robots = inventory / "robots.yml"
    altered_robots.write_text(altered_robots.read_text().replace("        robot3:\n", lines + "        robot3:\n"))
    done = guests.play("-l", "robot2", inventory=inventory)
    assert done.outcomes() == {"robot2": "failed"}
    assert "put the card where it belongs" in done.report["robots"]["robot2"]["messages"][0]


@pytest.mark.nightly
def test_a_full_card_is_left_as_it_is(guests: Guests) -> None:
    guests.sudo("robot2", "echo stranger >>/etc/hosts; dd if=/dev/zero of=/data/full bs=1M 2>/dev/null || true")
    done = guests.play("-l", "robot2")
    assert done.outcomes() == {"robot2": "failed"}
    assert "bytes left" in done.report["robots"]["robot2"]["messages"][0]
    guests.sudo("robot2", "rm /data/full")
    assert guests.play("-l", "robot2").outcomes() == {"robot2": "changed"}


def test_the_inventory_is_checked_before_anything_is_done(guests: Guests, tmp_path: Path) -> None:
    inventory = altered(tmp_path, "robots.yml", "number: 4", "number: 3")
    done = guests.play("-l", "robot2", inventory=inventory)
    assert done.outcomes() == {"robot2": "failed"}
    assert "is robot3's number" in done.report["robots"]["robot2"]["messages"][0]


@pytest.mark.nightly
def test_a_task_is_stopped_and_started(guests: Guests) -> None:
    def state(done: Playbook) -> str:
        assert done.status == 0, done.said
        found: str = done.report["robots"]["robot1"]["state"]["tasks"]["flotilla-task@heading.service"]["ActiveState"]
        return found

    for do, after in (("stop", "inactive"), ("status", "inactive"), ("start", "active")):
        done = guests.play("-l", "robot1,robot2", "-e", f"do={do}", "-e", "task=heading", playbook="tasks")
        assert state(done) == after
    refused = guests.play("-l", "robot1", "-e", "do=halt", playbook="tasks")
    assert "do=halt: one of status, deploy" in refused.said


@pytest.mark.nightly
def test_what_robots_say_and_record_is_collected(guests: Guests) -> None:
    guests.sudo("robot1", "cd /var/lib/flotilla/heading; echo 1,2,3 >some.csv; chown --reference=. some.csv")
    done = guests.play("-l", "robot1", playbook="collect")
    assert done.status == 0, done.said
    place = paths.BUILD / "collected" / "robot1"
    assert "flotilla-task@heading" in (place / "journal.txt").read_text()
    assert "Linux version" in (place / "dmesg.txt").read_text()
    assert json.loads((place / "state.json").read_text())["hostname"] == "robot1"
    assert (place / "heading" / "some.csv").read_text() == "1,2,3\n"
    guests.sudo("robot1", "rm /var/lib/flotilla/heading/some.csv")


@pytest.mark.nightly
def test_robots_restart_and_are_healthy(guests: Guests) -> None:
    before = guests.sudo("robot2", "cat /proc/sys/kernel/random/boot_id")
    done = guests.play("-l", "robot2", playbook="reboot")
    assert done.status == 0, done.said
    guests.shells["robot2"].connect()
    assert guests.sudo("robot2", "cat /proc/sys/kernel/random/boot_id") != before


@pytest.fixture(scope="module")
def own_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, for the last tests of these guests: what they make is in no other test's hands."""
    keys = tmp_path_factory.mktemp("own") / "keys"
    shutil.copytree(paths.KEYS, keys)
    return keys


def with_keys(keys: Path) -> dict[str, str]:
    return ENVIRONMENT | {"KEYS": str(keys)}


def flotilla(keys: Path, *words: str) -> str:
    argv = [sys.executable, "-m", "flotilla", *words]
    done = subprocess.run(argv, cwd=paths.PROJECT, env=with_keys(keys), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.nightly
def test_a_new_card_can_get_a_new_host_key_everywhere(guests: Guests, own_keys: Path) -> None:
    old = (own_keys / "robot2_ed25519.pub").read_text().split()[1]
    more = ("-l", "guests,localhost", "-e", json.dumps({"replaced": "robot2", "rotate": True}), *AT_ONCE)
    done = guests.play(*more, playbook="replace", environment=with_keys(own_keys))
    assert done.status == 0, done.said
    new = (own_keys / "robot2_ed25519.pub").read_text().split()[1]
    assert new != old
    assert old not in (own_keys / "known_hosts").read_text()
    known = guests.sudo("robot1", "cat /etc/ssh/ssh_known_hosts")
    assert new in known
    assert old not in known
    again = guests.play("-l", "robot2", environment=with_keys(own_keys))
    assert again.outcomes() == {"robot2": "up to date"}


@pytest.mark.nightly
def test_the_operators_key_is_rotated_and_no_robot_is_lost(guests: Guests, own_keys: Path) -> None:
    def admitted(name: str, key: Path) -> bool:
        settings = {
            "IdentityFile": key, "IdentitiesOnly": "yes", "BatchMode": "yes", "HostKeyAlias": name,
            "UserKnownHostsFile": own_keys / "known_hosts", "StrictHostKeyChecking": "yes",
        }  # fmt: skip
        words = [word for setting, value in settings.items() for word in ("-o", f"{setting}={value}")]
        argv = ["ssh", "-F", "none", *words, "-p", str(guests.ports[name]), "robot@127.0.0.1", "true"]
        done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=RUN_SECONDS)
        assert done.returncode == 0 or "Permission denied" in done.stderr, done.stderr
        return done.returncode == 0

    flotilla(own_keys, "rotate-key", "operator")
    new, former = own_keys / "operator_ed25519", own_keys / "operator_ed25519.retired"
    assert (admitted("robot1", new), admitted("robot1", former)) == (False, True)
    done = guests.play(*AT_ONCE, environment=with_keys(own_keys))
    assert done.outcomes() == dict.fromkeys(guests.robots, "changed"), done.said
    for name in guests.robots:
        assert (admitted(name, new), admitted(name, former)) == (True, False)
    flotilla(own_keys, "rotate-key", "operator", "--retire", "--force")
    again = guests.play(*AT_ONCE, environment=with_keys(own_keys))
    assert again.outcomes() == dict.fromkeys(guests.robots, "up to date"), again.said


@pytest.mark.nightly
def test_a_stolen_robot_that_comes_back_is_refused(guests: Guests, own_keys: Path, tmp_path: Path) -> None:
    """By the station; the others get the same line by provisioning. The last test: the robot has lost its key."""
    stolen = (own_keys / "robot2_ed25519.pub").read_text().split()[1]
    flotilla(own_keys, "revoke-key", "2")
    anew = with_keys(own_keys) | {"ANSIBLE_SSH_CONTROL_PATH_DIR": str(tmp_path)}
    refused = guests.play("-l", "robot2", environment=anew)
    assert refused.outcomes() == {"robot2": "unreachable"}
    assert "REVOKED" in refused.report["robots"]["robot2"]["messages"][0], refused.report
    done = guests.play("-l", "robot1", environment=anew)
    assert done.outcomes() == {"robot1": "changed"}, done.said
    assert f"@revoked * ssh-ed25519 {stolen}" in guests.sudo("robot1", "cat /etc/ssh/ssh_known_hosts").splitlines()


def altered(directory: Path, file: str, old: str, new: str) -> Path:
    """A copy of the inventory in which one text is another."""
    inventory = directory / "inventory"
    shutil.copytree(paths.INVENTORY, inventory)
    path = inventory / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return inventory


@pytest.mark.nightly  # the manual's commands, which tests run, are the same ones
def test_the_virtual_fleet_runs_in_the_background(fleet: Fleet) -> None:
    """`make fleet N=1`: found again, asked, ended; what a killed one left is no obstacle."""
    command = [sys.executable, "-m", "flotilla", "fleet"]

    def run(*argv: str) -> str:
        done = subprocess.run(
            [*command, *argv], cwd=paths.PROJECT, capture_output=True, text=True, timeout=600, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    robot = fleet.robots[1]
    virtual.DIRECTORY.mkdir(parents=True, exist_ok=True)
    virtual.GUESTS.write_text("left behind by a fleet that was killed")
    assert "no virtual fleet runs" in run("status")
    try:
        assert "robot1 on port" in run("up", "1")
        assert "runs already" in run("up", "1")
        assert "flotilla-task@heading.service running" in run("status")
        assert (
            ssh.forwarded_port(robot)
            == yaml.safe_load(virtual.GUESTS.read_text())["guests"]["hosts"]["robot1"]["ansible_port"]
        )
    finally:
        assert "1 guests ended" in run("down")
    assert ssh.forwarded_port(robot) is None
    assert "no virtual fleet runs" in run("down")
