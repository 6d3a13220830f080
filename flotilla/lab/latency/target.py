"""The same scenarios on a robot, in real time, over SSH: on the board what virtual time can only compare.

Nothing is installed: the measurement lies in `/run/latency` while it runs. Nothing repeats either, so nothing is gated.
A robot may be so late that the kernel's tracer misses periods: that is a finding, which the report names.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

from flotilla.common import cache, progress
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.lab.latency import compiler, results, run, subject
from flotilla.lab.latency import measure as measure_on_robot
from flotilla.lab.latency.results import Results
from flotilla.lab.qemu.ssh import Ssh
from flotilla.robot import ssh

_DIRECTORY = "/run/latency"
_SLACK_S = 120


def named(fleet: Fleet, target: str) -> Robot:
    """The robot of `ssh:robot3`."""
    kind, _, name = target.partition(":")
    robots = {robot.name: robot for robot in fleet.robots.values()}
    if kind != "ssh" or name not in robots:
        raise UserError(f"--target {target}: write ssh:NAME; the inventory has {', '.join(sorted(robots))}")
    return robots[name]


def connect(robot: Robot) -> Ssh:
    """A shell on the guest of `make boot` when one runs, else on the robot, as `make ssh` has it."""
    port = ssh.forwarded_port(robot)
    return Ssh(robot, "127.0.0.1", lambda: port) if port else Ssh(robot, str(robot.address))


def measure(robot: Robot, board: Board, shell: Ssh, plan: results.Plan, out: Path) -> Results:
    """Measure a robot through its shell; `results.json` is in `out` when it is done."""
    out.mkdir(parents=True, exist_ok=True)
    scenarios = [scenario for scenario in run.planned(plan) if not scenario.without]  # those need a boot of their own
    described = [scenario.describe(run.SECONDS[plan]) for scenario in scenarios]
    files = {name: (subject.HERE / name).read_bytes() for name in ("measure.py", "timerlat.py")}
    files["serial_latency"] = compiler.programs(board)["serial_latency"]
    files["plan.json"] = json.dumps({"scenarios": described}).encode()
    free = {name: board.ports[port].tty for name, port in _free_ports(robot, board).items()}
    shell.run(["sudo", "install", "-d", "-o", "robot", _DIRECTORY, "/dev/robot"])
    try:
        for name, content in files.items():
            shell.write(f"{_DIRECTORY}/{name}", content)
        shell.run(["chmod", "+x", f"{_DIRECTORY}/serial_latency"])
        for name, tty in free.items():
            shell.run(["sudo", "ln", "-sf", f"/dev/{tty}", f"/dev/robot/{name}"])
        seconds = sum(run.SECONDS[plan] * scenario.share for scenario in scenarios)
        title = f"latency of {robot.name}: {len(scenarios)} scenarios"
        whole_s, begun = seconds + 2 * measure_on_robot.WARM_UP_S * len(scenarios), time.monotonic()
        with progress.step(title, lambda: progress.Far(min(time.monotonic() - begun, whole_s), whole_s, "seconds")):
            script = [f"{_DIRECTORY}/{name}" for name in ("measure.py", "plan.json", "results")]
            limit_s = _SLACK_S + sum(scenario["timeout_s"] for scenario in described)
            shell.run(["sudo", "touch", script[-1]])
            shell.run(["sudo", "python3", *script], timeout=limit_s)
        content = shell.read(script[-1])
    finally:
        links = [f"/dev/robot/{name}" for name in free]
        shell.run(["sudo", "rm", "-rf", _DIRECTORY, *links], check=False)
    (out / "raw-0").write_bytes(content)
    binding = results.Binding(
        kernel="", root="", measurement=cache.digest(*files.values()), machine=robot.name, qemu="", firmware=""
    )
    where = f"{robot.name}, real time"
    found = run.results_of(board, plan, binding, [results.received(content)], scenarios, where, misses=True)
    (out / "results.json").write_text(found.text())
    return found


def _free_ports(robot: Robot, board: Board) -> dict[str, str]:
    """The measured connectors, but for those that have a device plugged in."""
    used = {device.port for device in robot.devices.values()}
    return {name: port for name, port in subject.tested_ports(board).items() if port not in used}
