"""What control programs rely on: limits, priorities, an awake processor, watchdog and clock."""

from __future__ import annotations

import fnmatch
import re
import time

import yaml

from flotilla.fleet import identity
from flotilla.fleet.model import Board, Fleet
from flotilla.robot import board_draft, hwcheck
from tests.boot.guests import label, sh, until
from tests.boot.shared.conftest import Report
from tests.conftest import RobotGuest

IDLE_S = 10


def test_limits_of_control_programs(robot: RobotGuest) -> None:
    assert "realtime" in robot.shell.run(["id", "-Gn"]).stdout.split()
    shown = robot.shell.run(["bash", "-c", "ulimit -r; ulimit -l; ulimit -e"]).stdout.split()
    assert shown == ["90", "unlimited", "40"], f"rtprio, memlock, nice: {shown}"
    assert robot.shell.run(["chrt", "--fifo", "90", "true"], check=False).returncode == 0
    assert robot.shell.run(["chrt", "--fifo", "91", "true"], check=False).returncode != 0, "no limit is in force"


def test_interrupt_threads_have_their_priorities(robot: RobotGuest, board: Board) -> None:
    table = [line.split() for line in sh(robot, "cat /etc/flotilla/irq-priorities").splitlines()]
    rules = [(line[0], line[1]) for line in table if line and not line[0].startswith("#")]
    wrong, checked = [], set()
    for line in sh(robot, "ps -e -o comm=,cls=,rtprio=").splitlines():
        name, policy, priority = line.rsplit(maxsplit=2)
        wanted = [value for pattern, value in rules if fnmatch.fnmatchcase(name, pattern)]
        # The console's thread comes and goes with the log-in prompt, and nothing urgent hangs on it.
        if not wanted or name.endswith(f"-{board.console_tty}"):
            continue
        checked.add(name)
        if (policy, priority) != ("FF", wanted[-1]):
            wrong.append(f"{name}: {policy} {priority} instead of {wanted[-1]}")
    assert not wrong, "; ".join(wrong)
    expected = {f"-{board.network_interface}", f"napi/{board.network_interface}-"}
    # Ports on one interrupt have one thread, named after the first of them that was opened.
    if robot.robot.devices:
        expected.add("-ttyS")
    if robot.board.kernel == "lean":
        expected.add("tty-flip")
    for part in expected:
        assert any(part in name for name in checked), f"no thread of *{part}* among {sorted(checked)}"


def test_isolated_processors_are_left_to_control_tasks(robot: RobotGuest, board: Board) -> None:
    """Seen to fail without `isolcpus=` and, for interrupts, without `irqaffinity=`."""
    isolated = ",".join(map(str, board.isolated_processors))
    assert sh(robot, "nproc --all") == str(board.processors)
    assert sh(robot, "cat /sys/devices/system/cpu/isolated") == isolated
    if not isolated:
        return
    others = ",".join(str(each) for each in range(board.processors) if each not in board.isolated_processors)
    said = sh(robot, "cat /proc/[0-9]*/status 2>/dev/null; true")
    # Kernel threads have no memory of their own; some belong to a processor.
    programs = [one for one in said.split("Name:\t") if "VmRSS" in one]
    where = {one.split("\n")[0]: found[1] for one in programs if (found := re.search(r"Cpus_allowed_list:\t(.*)", one))}
    assert {"systemd", "sshd"} <= where.keys()
    assert {name: each for name, each in where.items() if each != others} == {}
    interrupts = sh(robot, "cat /proc/irq/*/effective_affinity_list").split()
    assert set(interrupts) == {others}
    task = "period: 10 ms\npriority: 80\ncpu: {}\nblocks:\n  a: {{type: gain, in: {{in: 1}}}}\n"
    script = (
        "cat >/run/one.yml; flotilla-run /run/one.yml & pid=$!; "
        "while [ -e /proc/$pid ] && ! grep -q guard /proc/$pid/task/*/comm; do sleep 0.1; done; "
        "cat /proc/$pid/task/*/status; kill $pid; wait $pid"
    )
    for processor in range(board.processors):
        done = robot.shell.run(["sudo", "sh", "-c", script], stdin=task.format(processor), check=False)
        assert set(re.findall(r"Cpus_allowed_list:\t(.*)", done.stdout)) == {str(processor)}, done


def test_processor_stays_awake(robot: RobotGuest) -> None:
    if robot.board.kernel == "lean":  # has no idle states to choose from: the processor halts, and no more
        assert sh(robot, "cat /sys/devices/system/cpu/cpuidle/current_driver 2>&1", check=False).endswith("directory")
        return
    read = "od -A n -t d4 /dev/cpu_dma_latency"
    assert sh(robot, read) == "0", "µs that the processor may take to wake up"
    sh(robot, "systemctl stop flotilla-dma-latency")
    try:
        assert sh(robot, read) != "0", "0 µs although nobody asks for it: the check is blind"
    finally:
        sh(robot, "systemctl start flotilla-dma-latency")


def test_an_idle_robot_leaves_the_host_alone(robot: RobotGuest, report: Report) -> None:
    """How much of a host's processor the guest takes when nothing happens: printed, since the host is shared."""
    before, begun = robot.machine.processor_s, time.monotonic()
    time.sleep(IDLE_S)  # what is measured is that nothing happens
    share = (robot.machine.processor_s - before) / (time.monotonic() - begun)
    report.add(label(robot), idle_host_percent=100 * share)
    assert share > 0, "the guest's time is not counted"


def test_hardware_can_be_reported(robot: RobotGuest) -> None:
    """What `make hwcheck` asks, every kernel and board can answer."""
    found = hwcheck.parse(sh(robot, hwcheck.script(seconds=1)))
    assert {name: text for name, (status, text) in found.items() if status and name != "hardware latency"} == {}
    summary = hwcheck.summary(found).splitlines()
    assert "tsc: yes" in summary
    assert any(line.startswith("hardware latency: ") and "not measured" not in line for line in summary), summary
    ports = {line.partition(":")[0] for line in summary if line.startswith("ttyS")}
    assert ports == {port.tty for port in robot.board.ports.values()}


def test_the_boards_file_can_be_drafted(robot: RobotGuest) -> None:
    """As `make hwcheck TARGET=` drafts it from a computer that nobody has described: what can be seen is right."""
    board = robot.board
    found = board_draft.read(sh(robot, board_draft.SCRIPT))
    drafted = yaml.safe_load(board_draft.render(found, "drafted"))["board"]
    same = ("architecture", "suite", "firmware", "processors", "network_interface")
    assert {key: drafted[key] for key in same} == {key: getattr(board, key) for key in same}
    assert drafted["ports"] == {name: {"tty": port.tty} for name, port in board.ports.items()}
    assert {*found["disk"][0].split()[1:]} <= {*board.disk_modules}
    assert drafted["modules"] == board.modules
    count = len(board.ports)
    assert drafted["kernel_arguments"] == ([f"8250.nr_uarts={count}"] if count > 4 else [])


def test_service_manager_feeds_the_watchdog(robot: RobotGuest) -> None:
    shown = sh(robot, "systemctl show -p RuntimeWatchdogUSec -p WatchdogDevice")
    assert set(shown.splitlines()) == {"RuntimeWatchdogUSec=30s", "WatchdogDevice=/dev/watchdog"}
    assert "/dev/watchdog" in sh(robot, "readlink /proc/1/fd/*").splitlines(), "process 1 does not hold the watchdog"


def test_clock_follows_the_fleet(robot: RobotGuest, fleet: Fleet) -> None:
    others = {str(host.address) for host in identity.hosts(fleet) if host != robot.robot}
    sources = {line.split(",")[2] for line in sh(robot, "chronyc -n -c sources").splitlines()}
    assert sources == others
    # Alone, it leads, at the stratum of orphans, once the others did not answer.
    until(robot, "chronyc -n tracking | grep -q 7F7F0101")
    reference, _, stratum, *_ = sh(robot, "chronyc -n -c tracking").split(",")
    assert (reference, stratum) == ("7F7F0101", "10"), "not in orphan mode"
