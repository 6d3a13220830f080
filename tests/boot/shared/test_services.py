"""Services that other people's bytes or code reach: what each could do if somebody took it over."""

from __future__ import annotations

import json
import re
from pathlib import Path

import yaml

from flotilla.fleet import privileges
from tests.boot.guests import sh
from tests.boot.shared.probes import forbidden
from tests.conftest import RobotGuest

EXPOSURE = {"flotilla-task@any.service": 3.4, "flotilla-app@any.service": 3.4}
"""At most, by `systemd-analyze security`: 0 could do nothing, 10 anything. What the rest would cost stands in
docs/decisions/0079-system-calls-of-services.md."""


def _exposure(robot: RobotGuest, *units: str) -> dict[str, float]:
    said = sh(robot, f"systemd-analyze security --no-pager {' '.join(units)} | grep 'Overall exposure'")
    return {unit: float(level) for unit, level in re.findall(r"level for (\S+): ([0-9.]+)", said)}


def test_what_may_be_taken_over_has_few_rights(robot: RobotGuest) -> None:
    """Seen to fail without restrictions of system calls: tasks had 6.4."""
    found = _exposure(robot, *EXPOSURE)
    print(found)
    assert set(found) == set(EXPOSURE)
    exposed = {unit: level for unit, level in found.items() if level > EXPOSURE[unit]}
    assert not exposed, exposed
    assert _exposure(robot, "ssh.service")["ssh.service"] > 9, "the figures tell services apart"


UNIT = "flotilla-task@forbidden.service"
DROP_IN = """[Service]
Type=oneshot
ExecStart=
ExecStart=/usr/bin/python3 /run/forbidden.py
ExecStopPost=
Restart=no
WatchdogSec=0
StandardOutput=truncate:/run/forbidden.json
"""


def test_a_control_task_makes_no_system_call_that_it_does_not_need(robot: RobotGuest) -> None:
    """In a control task's own service, but for what that executes. Its user may make each elsewhere.

    Seen to fail without restrictions of system calls: each call but one succeeded.
    """
    for file, text in {
        "/run/forbidden.py": Path(forbidden.__file__).read_text(),
        f"/run/systemd/system/{UNIT}.d/execute.conf": DROP_IN,
    }.items():
        robot.shell.run(["sudo", "install", "-D", "/dev/stdin", file], stdin=text)
    try:
        elsewhere = json.loads(
            sh(robot, "setpriv --reuid=control --regid=control --clear-groups python3 /run/forbidden.py")
        )
        sh(robot, f"systemctl daemon-reload; systemctl start {UNIT}")
        assert json.loads(sh(robot, "cat /run/forbidden.json")) == []
        assert len(elsewhere) == 6, elsewhere
    finally:
        sh(robot, f"rm -r /run/forbidden* /run/systemd/system/{UNIT}.d; systemctl daemon-reload")


TASKS = {
    "tells": "told: { type: queue-send, in: { data: 7 }, parameters: { name: /told } }",
    "hears": "heard: { type: queue-receive, parameters: { name: /told, timeout: 60 } }",
}
ON_ANOTHER = {
    "tune it": "flotilla-param hears heard.timeout 1",
    "read its files": "ls /var/lib/flotilla/hears /run/flotilla/hears",
    "signal it": "kill -0 {pid}",
}
"""What whoever has taken over a control task tries on another one."""


def test_control_tasks_share_queues_and_nothing_else(robot: RobotGuest) -> None:
    """Seen to fail while fchown(2) was refused ("belongs to another user"), and with one user for all."""
    users = dict(zip(TASKS, privileges.task_users(len(TASKS)), strict=True))
    units = {name: f"flotilla-task@{name}.service" for name in TASKS}
    for number, (name, block) in enumerate(TASKS.items()):
        task = f"period: 100 ms\npriority: 10\nblocks:\n  {block}\n"
        for file, text in {
            f"/etc/flotilla/tasks/{name}.yml": task,
            f"/run/systemd/system/{units[name]}.d/user.conf": privileges.user(number, yaml.safe_load(task)),
        }.items():
            robot.shell.run(["sudo", "install", "-D", "-m", "644", "/dev/stdin", file], stdin=text)
    try:
        sh(robot, f"systemctl daemon-reload; systemctl start {' '.join(units.values())}")
        heard = robot.shell.run(["flotilla-scope", "--rows=1", "--csv", "--", "hears", "heard.data"]).stdout
        assert float(heard.split(",")[-1]) == 7
        pid = sh(robot, f"systemctl show -P MainPID {units['hears']}")
        for name, wanted in {"hears": set(ON_ANOTHER), "tells": set()}.items():
            status = sh(robot, f"cat /proc/$(systemctl show -P MainPID {units[name]})/status")
            (groups,) = re.findall(r"^Groups:\t(.+?) *$", status, re.MULTILINE)
            become = f"setpriv --reuid={users[name]} --regid={users[name]} --groups={groups.replace(' ', ',')}"
            done = {
                what
                for what, command in ON_ANOTHER.items()
                if sh(robot, f"{become} sh -c '{command.format(pid=pid)}' >/dev/null 2>&1 && echo done", check=False)
            }
            assert done == wanted, f"as the user of {name}"
    finally:
        for name, unit in units.items():
            sh(robot, f"systemctl stop {unit}; rm -r /etc/flotilla/tasks/{name}.yml /run/systemd/system/{unit}.d")
        sh(robot, "systemctl daemon-reload")
