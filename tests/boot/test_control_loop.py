"""A control loop through the shipped image: an emulated gyro on its serial port, relays read as they are written.

The plant is a robot that floats and turns without friction. It lives here, on the host, and its time is the control
task's: each step that the task makes with another sample of the gyro takes it a period further. So a host that stops
the guest for a while stops the plant too, and how late a step is, which depends on the host, is not judged, only what
comes of it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, privileges
from flotilla.fleet.model import Fleet
from flotilla.fleet.transport import duration_s
from flotilla.lab.acceptance import relays
from flotilla.lab.emulators.dsp3000 import Dsp3000
from flotilla.lab.emulators.ir104 import Ir104
from flotilla.lab.emulators.serial_line import SerialLine, UnixSocket
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.relay_ports import RelayPorts
from flotilla.lab.qemu.timing import LabError
from flotilla.robot import parameters, scope, ssh
from tests.conftest import RobotGuest

UNIT = "flotilla-task@heading.service"
TASK = paths.TASKS / "heading.yml"
INERTIA_KG_M2 = 0.25
TASK_USER, OTHER_TASK, APP = (privileges.USERS[name] for name in ("control1", "control2", "app"))
"""Users of the task, of a second one, and of apps."""
SECONDS = 600
DDS_SECURITY = "/etc/flotilla/dds-security.xml"
OWN = {
    "kill -0 {target}",
    "flotilla-param heading attitude.kp",
    "ls /var/lib/flotilla/heading",
    "head -c 1 /run/credentials/flotilla-task@heading.service/message-keys",
    "test -r /dev/robot/gyro",
}
"""What a control task may do to itself."""
ATTEMPTS = OWN | {
    "cat /proc/{target}/environ",
    "head -c 1 /etc/flotilla/message-keys",
    "head -c 1 /etc/chrony/chrony.keys",
    "head -c 1 /etc/ssh/ssh_host_ed25519_key",
    "test -w /etc/ssh/authorized_keys/robot",
    "test -w /home/robot",
    "test -w /etc/systemd/system",
    "test -w /run/systemd/system",
    "test -w /etc/flotilla/tasks/heading.yml",
    "test -w /data",
    "test -r /dev/sda",
    "test -w /dev/mem",
    "test -w /proc/sysrq-trigger",
    "kill -0 1",
    "kill -0 $(pidof -s sshd)",
    "sudo -n true",
    "systemctl reset-failed flotilla-task@heading.service",
}


class Plant:
    """Turns by the torque of the open valves; counterclockwise is positive."""

    def __init__(self) -> None:
        task = yaml.safe_load(TASK.read_text())
        parameters = task["blocks"]["thrusters"]["parameters"]
        places, pushes = parameters["positions"], parameters["directions"]
        self._torques = [
            parameters["force"] * (places[i] * pushes[i + 1] - places[i + 1] * pushes[i]) for i in range(0, 16, 2)
        ]
        self._period = duration_s(task["period"])
        self._at = 0.0
        self._sampled = False
        self.board = Ir104(after_write=self._step)
        self.heading_rad = 0.0
        self.rate_rad_s = 0.0

    def _step(self, offset: int) -> None:
        """A step of the task writes each register once, and all valves are on the first."""
        if offset or not self._sampled:
            return
        self._sampled = False
        valves = self.board.relays[: len(self._torques)]
        torque = sum(torque for torque, on in zip(self._torques, valves, strict=True) if on)
        self._at += self._period
        self.rate_rad_s += torque / INERTIA_KG_M2 * self._period
        self.heading_rad += self.rate_rad_s * self._period

    def gyro_deg_s(self, _: float) -> float:
        """The rate, clockwise, as the gyro measures it."""
        self._sampled = True
        return -math.degrees(self.rate_rad_s)

    def kick(self, rate_rad_s: float) -> None:
        """A disturbance: somebody bumps into the robot."""
        with self.board.lock:
            self.rate_rad_s += rate_rad_s

    def holds(self, heading_rad: float, seconds: float = 2.0) -> Callable[[], bool]:
        """Whether it has been near a heading, and slow, for some seconds of its own time."""
        since = math.inf

        def held() -> bool:
            nonlocal since
            near = abs(self.heading_rad - heading_rad) < math.radians(3) and abs(self.rate_rad_s) < math.radians(2)
            since = min(since, self._at) if near else math.inf
            return self._at - since >= seconds

        return held


class Loop:
    """The guest, its gyro, its relays and what they move."""

    def __init__(self, robot: RobotGuest, gyro: SerialLine, plant: Plant) -> None:
        self.robot, self.gyro, self.plant, self.board = robot, gyro, plant, plant.board

    def unit(self, name: str) -> str:
        return self.robot.shell.run(["sudo", "systemctl", "show", "-P", name, UNIT]).stdout.strip()

    def main_pid(self, then: str = "") -> int:
        """The task's process, awaited while there is none: on a busy host late steps end it, and systemd starts it.

        `then` is a command of the shell for this very process, `$pid`.
        """
        running = f'systemctl -q is-active {UNIT} && pid=$(systemctl show -P MainPID {UNIT}) && [ "$pid" != 0 ]'
        wait = f"until {running}; do sleep 0.1; done; {then}\necho $pid"
        return int(self.robot.shell.run(["sudo", "sh", "-e"], stdin=wait, timeout=SECONDS).stdout)

    def of_one_process(self, ask: Callable[[int], None]) -> None:
        """Asks and judges the task's process, and does so anew if another one took its place meanwhile."""
        for _ in range(10):
            pid = self.main_pid()
            try:
                return ask(pid)
            except (AssertionError, LabError, UserError):
                if self.main_pid() == pid:
                    raise
        pytest.fail(f"{UNIT} was started anew ten times while it was asked")


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Loop]:
    """Robot 1 with gyro and relays, booted; its task has started with it."""
    module_guest = request.getfixturevalue("module_guest")
    plant = Plant()
    with ExitStack() as stack:
        ports = stack.enter_context(RelayPorts(plant.board))
        path = tmp_path_factory.mktemp("gyro") / "socket"
        options = {"extra": ports.arguments, "ports": {"COM5": qemu.unix_socket(path)}}
        robot = module_guest(1, boot=False, qemu_options=options)
        robot.machine.prepare()
        gyro = stack.enter_context(SerialLine(Dsp3000(plant.gyro_deg_s), UnixSocket(str(path))))
        robot.machine.on()
        robot.wait_booted()
        yield Loop(robot, gyro, plant)


def test_the_task_starts_with_the_robot(loop: Loop) -> None:
    """Nothing but late steps ends it, which is the host's doing while it boots.

    It may end at any moment, so the starts are counted before the reasons, each of which is written before its start.
    """
    loop.main_pid()
    starts = int(loop.unit("NRestarts"))
    journal = ["sudo", "sh", "-c", f"journalctl --sync && journalctl -b -o cat -u {UNIT}"]
    said = [line for line in loop.robot.shell.run(journal).stdout.splitlines() if line.startswith("flotilla: ")]
    late = [line for line in said if re.search(r"\d+ in a row|no step ended for", line)]
    assert len(late) >= starts, said
    assert len(late) <= int(loop.unit("NRestarts")) + 1, said


def test_heading_is_held_through_a_disturbance(loop: Loop) -> None:
    """Seen to fail, with QEMU stopped for a third of the time, while TCP kept ten seconds of samples: up to 649 °/s."""
    heading = loop.plant.heading_rad
    loop.plant.kick(math.radians(15))
    assert loop.board.wait(lambda: abs(loop.plant.heading_rad - heading) > math.radians(1), SECONDS), (
        "the kick turns it"
    )
    assert loop.board.wait(loop.plant.holds(heading), SECONDS), (
        f"{math.degrees(loop.plant.heading_rad - heading):.1f}° off, {math.degrees(loop.plant.rate_rad_s):.1f} °/s"
    )


def test_a_gyro_that_is_unplugged_closes_the_valves_until_it_is_back(loop: Loop) -> None:
    loop.plant.kick(math.radians(15))
    assert loop.board.wait_relays(on=True)
    loop.gyro.unplug()
    assert loop.board.wait_relays(on=False), "valves stay open without a gyro"
    switched = len(loop.board.log)
    loop.main_pid()  # a second or so in which nothing may move
    assert len(loop.board.log) == switched
    loop.gyro.replug()
    assert loop.board.wait_relays(on=True), "control does not resume"
    assert loop.board.wait(lambda: abs(loop.plant.rate_rad_s) < math.radians(2), SECONDS)


def test_a_second_start_is_refused(loop: Loop) -> None:
    def refused(pid: int) -> None:
        start = ["timeout", str(SECONDS // 2), "flotilla-run", "/etc/flotilla/tasks/heading.yml"]
        done = loop.robot.shell.run(start, check=False)
        assert done.returncode == 3
        assert f"runs already, as process {pid}; end that first" in done.stderr

    loop.of_one_process(refused)


def test_a_stopped_executive_is_ended_by_the_watchdog_and_the_valves_close(loop: Loop) -> None:
    """Seen to fail without WatchdogSec=: the valves stay as they were."""
    loop.plant.kick(math.radians(15))
    assert loop.board.wait_relays(on=True)
    pid = loop.main_pid("kill -STOP $pid")
    assert loop.board.wait_relays(on=False), "valves stay open while the executive is stopped"
    wait_restarted(loop, pid)


def test_a_killed_executive_is_restarted(loop: Loop, record_property: Callable[[str, object], None]) -> None:
    pid = loop.main_pid("kill -KILL $pid")
    wait_restarted(loop, pid)
    loop.plant.kick(math.radians(15))
    assert loop.board.wait_relays(on=True), "the restarted task does not control"
    said = loop.robot.shell.run(["sudo", "journalctl", "-o", "json", "-u", UNIT, "--no-pager"]).stdout.splitlines()
    entries = [json.loads(line) for line in said]
    died = [e for e in entries if "killed" in str(e["MESSAGE"]) and "KILL" in str(e["MESSAGE"])][-1]
    started = [e for e in entries if str(e["MESSAGE"]).startswith("Started")][-1]
    gap_ms = (int(started["__MONOTONIC_TIMESTAMP"]) - int(died["__MONOTONIC_TIMESTAMP"])) / 1000
    print(f"killed to started again: {gap_ms:.0f} ms")


def wait_restarted(loop: Loop, pid: int) -> None:
    """Until another process is the task's and the unit is active."""
    another = f'[ "$(systemctl show -P MainPID {UNIT})" != {pid} ] && systemctl -q is-active {UNIT}'
    loop.robot.shell.script(f"until {another}; do sleep 0.1; done", timeout=SECONDS)


def test_the_task_has_only_the_privileges_it_needs(loop: Loop) -> None:
    def has(pid: int) -> None:
        status = loop.robot.shell.run(["cat", f"/proc/{pid}/status"]).stdout
        fields = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
        cap_sys_rawio = 1 << 17
        for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"):
            assert int(fields[name], 16) == cap_sys_rawio, name
        assert fields["Uid"].split() == [str(TASK_USER)] * 4
        assert fields["NoNewPrivs"].strip() == "1"
        assert "VmLck" in fields
        assert not fields["VmLck"].startswith("       0"), "memory is not locked"

    loop.of_one_process(has)
    properties = "CapabilityBoundingSet,AmbientCapabilities"
    others = ["sudo", "systemctl", "show", "-p", properties, "flotilla-task@control.service"]
    shown = loop.robot.shell.run(others).stdout.splitlines()
    assert sorted(shown) == ["AmbientCapabilities=", "CapabilityBoundingSet="], "it drives no I/O ports"


def attempted(loop: Loop, target: int, *user: str) -> set[str]:
    """What succeeds as a user, of what somebody tries who has taken over a task. None of it changes anything."""
    script = "\n".join(f"({each.format(target=target)}) >/dev/null 2>&1 && echo '{each}'" for each in ATTEMPTS)
    said = loop.robot.shell.run(["sudo", *user, "sh"], stdin=f"{script}\ntrue\n", timeout=SECONDS).stdout
    return set(said.splitlines())


def test_who_takes_over_a_task_or_an_app_takes_over_nothing_else(loop: Loop) -> None:
    """With a task's user and groups. Seen to fail as user `robot`, whom tasks once ran as: it could write to the
    operator's home folder, from which the next shell takes commands, and signal sshd; and as `control`, whom all tasks
    once ran as: one could signal, tune and read another."""

    def takes_over(pid: int) -> None:
        status = loop.robot.shell.run(["cat", f"/proc/{pid}/status"]).stdout
        (found,) = re.findall(r"^Groups:\t(.*)$", status, re.MULTILINE)

        def as_user(number: int) -> list[str]:
            groups = [each for each in found.split() if each != str(TASK_USER)] + [str(number)]
            own = [f"--reuid={number}", f"--regid={number}", f"--groups={','.join(groups)}"]
            return ["setpriv", *own, "--bounding-set=-all", "--no-new-privs"]

        assert attempted(loop, pid) == set(ATTEMPTS), "root may, so these are attempts"
        assert attempted(loop, pid, *as_user(TASK_USER)) == OWN
        assert attempted(loop, pid, *as_user(OTHER_TASK)) == set()
        assert attempted(loop, pid, *as_user(APP)) == set()

    loop.of_one_process(takes_over)


def test_the_control_thread_is_real_time(loop: Loop) -> None:
    def is_real_time(pid: int) -> None:
        threads = loop.robot.shell.run(["ps", "-L", "-o", "comm=,cls=,rtprio=", "-p", str(pid)]).stdout
        classes = {line.split()[0]: line.split()[1:] for line in threads.splitlines()}
        assert classes["heading"] == ["FF", "80"]
        assert classes["gyro"] == ["FF", "79"]

    loop.of_one_process(is_real_time)


def test_parameters_are_set_from_the_station(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = loop.robot.robot
    monkeypatch.setattr(ssh, "forwarded_port", lambda _: loop.robot.machine.ssh_port())
    file = yaml.safe_load(TASK.read_text())["blocks"]["attitude"]["parameters"]

    def are_set(_: int) -> None:
        assert parameters.param(robot, "heading", "attitude.kp") == str(file["kp"])
        said = parameters.param(robot, "heading", "attitude.kp", "0.35")
        assert re.fullmatch(rf"attitude\.kp: {file['kp']} → 0\.35 from step \d+ on", said)
        assert parameters.param(robot, "heading", "attitude.kp") == "0.35"
        journal = ["sudo", "journalctl", "-o", "cat", "-u", UNIT, "--no-pager"]
        assert f"flotilla: heading: user 1000: {said}" in loop.robot.shell.run(journal).stdout.splitlines()
        message = "robot1: task heading: block attitude: parameter filter: -1 is outside 0 to "
        with pytest.raises(UserError, match=message):
            parameters.param(robot, "heading", "attitude.filter", "-1")
        with pytest.raises(UserError, match="robot1: no task bearing runs here"):
            parameters.param(robot, "bearing")
        parameters.param(robot, "heading", "attitude.kp", str(file["kp"]))

    loop.of_one_process(are_set)


def watching(*signals: str) -> list[str]:
    return scope.words("heading", signals, every=5, rows=20, trigger=None, before=None, csv=True)


def test_signals_are_watched_from_the_station(loop: Loop, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By the user who may log in, as the station does."""
    robot = loop.robot.robot
    monkeypatch.setattr(ssh, "forwarded_port", lambda _: loop.robot.machine.ssh_port())

    def are_watched(pid: int) -> None:
        file = tmp_path / f"rates-{pid}.csv"
        assert scope.record(robot, watching("gyro.rate", "gyro.flag"), file) == 20
        head, *rows = [line.split(",") for line in file.read_text().splitlines()]
        assert head == ["step", "release_ns", "lost", "gyro.rate", "gyro.flag"]
        steps = [int(row[0]) for row in rows]
        assert steps == list(range(steps[0], steps[0] + 100, 5))
        unknown = r"robot1: task heading: gyro\.rat: dsp3000 has no output rat; it has rate, "
        with pytest.raises(UserError, match=unknown):
            scope.show(robot, watching("gyro.rat"))

    loop.of_one_process(are_watched)


def test_parameters_are_the_users_of_the_task_alone(loop: Loop) -> None:
    argv = ["sudo", "-u", "nobody", "flotilla-param", "heading", "attitude.kp", "1"]

    def refused(_: int) -> None:
        done = loop.robot.shell.run(argv, check=False)
        assert (done.returncode, done.stdout) == (1, "")
        assert "task heading answers the user that it runs as" in done.stderr

    loop.of_one_process(refused)


def test_a_stopped_task_leaves_its_outputs_reset(loop: Loop) -> None:
    """By itself: `success`. A slow host may take longer to stop it than a robot, or end it by late steps just then."""
    drop_in = f"/run/systemd/system/{UNIT}.d"
    results: list[str] = []
    as_root = ["sudo", "sh", "-e"]
    patient = (
        f"mkdir {drop_in}; printf '[Service]\\nTimeoutStopSec=60\\n' >{drop_in}/patient.conf; systemctl daemon-reload"
    )
    loop.robot.shell.run(as_root, stdin=patient)
    while "success" not in results and len(results) < 5:
        loop.main_pid()
        loop.plant.kick(math.radians(15))
        assert loop.board.wait_relays(on=True)
        loop.robot.shell.run(["sudo", "systemctl", "stop", UNIT])
        assert loop.board.wait_relays(on=False)
        results.append(loop.unit("Result"))
        loop.robot.shell.run(["sudo", "systemctl", "start", UNIT])
    loop.robot.shell.run(as_root, stdin=f"rm -r {drop_in}; systemctl daemon-reload")
    assert results[-1] == "success", results


def test_task_file_is_the_inventorys(loop: Loop, tmp_path: Path) -> None:
    assert loop.robot.shell.run(["cat", "/etc/flotilla/tasks/heading.yml"]).stdout == TASK.read_text()


def test_relays_are_watched_one_by_one(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """By `make accept RELAYS=1`; the third relay is stuck. Whoever watches looks at the emulated board."""
    (described,) = relays.boards(loop.robot.robot)
    some = replace(described, channels=(1, 3, 8))  # each takes an emulated Pentium III five seconds
    monkeypatch.setattr(relays, "boards", lambda _: [some])
    asked = []

    def person(question: str) -> bool:
        asked.append(question)
        number = int(re.findall(r"relay (\d+)", question)[0])
        return [at for at, on in enumerate(loop.board.relays, 1) if on] == [number]

    loop.board.stuck[3] = False
    try:
        watched = relays.watch(loop.robot.robot, loop.robot.shell, person)
    finally:
        loop.board.stuck.clear()
    assert asked[0] == "heading: is relay 1 on, and no other?"
    assert [relay.number for relay in watched] == [1, 3, 8]
    assert [relay.number for relay in watched if not relay.seen] == [3]
    assert all(relay.mismatch for relay in watched), "these ports read back the same, whatever was written"
    loop.main_pid()  # it controls again


def test_dds_proves_who_the_robot_is(loop: Loop, fleet: Fleet) -> None:
    """With `dds_security`, as provisioning would bring it: the task starts, and a program with its configuration and as
    its user has the plug-ins. The last of the file's tests, for the robot keeps it. Seen to fail while the credential
    was missing: the task did not start."""
    network = fleet.network.model_copy(update={"dds_security": True})
    files = identity.render(fleet.model_copy(update={"network": network}), loop.robot.robot)
    names = ("dds-security.xml", "dds-security.conf", "cyclonedds.xml")
    brought = {str(path): content.decode() for path, (content, _) in files.items() if path.name in names}
    assert len(brought) == len(names)
    write = [f"mkdir -p {Path(path).parent}; cat >{path} <<'END'\n{text}END" for path, text in brought.items()]
    restart = f"systemctl daemon-reload; systemctl reset-failed {UNIT}; systemctl restart {UNIT}"
    user = f"prlimit --rtprio=99 setpriv --reuid={TASK_USER} --regid={TASK_USER} --clear-groups"
    ask = f"""
    export "$(tr '\\0' '\\n' </proc/$pid/environ | grep ^CYCLONEDDS_URI=)"
    {user} ddsperf -i {network.dds_domain} -D 600 sub >/dev/null 2>&1 &
    while [ -d /proc/$! ] && ! grep libdds_security_crypto /proc/$!/maps; do sleep 0.1; done
    kill $!
    """
    there = ["sudo", "sh", "-e"]
    loop.robot.shell.run(there, stdin="\n".join([*write, f"chmod 600 {DDS_SECURITY}", restart, ""]), timeout=SECONDS)

    def has_plugins(pid: int) -> None:
        said = loop.robot.shell.run(there, stdin=f"pid={pid}\n{ask}", timeout=SECONDS).stdout
        assert "libdds_security_crypto.so" in said

    loop.of_one_process(has_plugins)
