"""A robot's card image, booted in QEMU and asked from outside: console, SSH, serial connectors, network.

Checks that any robot must pass run on one guest of each board; what only one board has, on that board's. Three further
boots at the end cut the power, damage a slot and hang the system. Every measure of time is printed and put into
`build/reports/boot.json`; none is judged, because the host is shared.
"""

from __future__ import annotations

import fnmatch
import inspect
import json
import re
import shlex
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

import pytest

from images.builder import card, hwcheck, identity, paths, qemu, tools
from images.builder.boot import ssh_options
from images.builder.errors import UserError
from images.builder.fleet import Board, Fleet
from images.builder.lock import read_lock
from images.builder.tools import Tools
from tests.conftest import GuestFactory, RobotGuest
from tests.lab import figures

pytestmark = pytest.mark.boot

PENTIUM, PC = 3, 2
"""The robots that stand for their boards."""
SYSTEMS = [
    pytest.param((PENTIUM, "lean"), id="smartcoret3-lean"),
    pytest.param((PENTIUM, "debian"), id="smartcoret3-debian"),
    pytest.param((PC, "debian"), id="x86_64-debian"),
    pytest.param((PC, "lean"), id="x86_64-lean", marks=pytest.mark.long),  # its kernel takes ten minutes to build
]
"""Boards and kernels that every image must boot with."""
SECONDS = 60
"""Limit for what takes a few on an idle host."""
IDLE_S = 10
MEMORY_LIMIT_MB = {PENTIUM: 40, PC: 70}
"""In use after boot: MemTotal - MemAvailable, in 10^6 bytes. 64-bit programs and a larger kernel take more."""
PROCESSOR = {PENTIUM: "Pentium III", PC: "Nehalem"}
HARMLESS = {
    r"irqpoll boot option not supported with PREEMPT_RT": "the board asks for it; only a kernel without RT obeys",
    r"ACPI: setting ELCR to [0-9a-f]{4} \(from [0-9a-f]{4}\)": "by acpi=noirq: ACPI's own interrupt becomes a level",
    r"tsc: Unable to calibrate against PIT": "QEMU's timers on a busy host",
    r"tsc: Fast TSC calibration failed": "QEMU's timers on a busy host",
    r"clocksource: .*'(tsc|tsc-early|refined-jiffies|acpi_pm)'": "QEMU's timers on a busy host",
    r"TSC found unstable after boot": "QEMU's timers on a busy host",
    r"APIC calibration not consistent with PM-Timer": "QEMU's timers on a busy host",
    r"acpi resource window .* ignored, not CPU addressable": "QEMU's i440FX offers addresses beyond 32 bits",
    r"Model 'QEMU HARDDISK'.* applying quirks: bridgeok": "QEMU's disk has an old revision number",
    r"Kernel compiled without mitigations": "our 32-bit kernel has none; the board would switch them off",
    r"L1TF: Kernel not compiled for PAE": "of later processors than such boards have",
    r"fail to add MMCONFIG information": "QEMU's i440FX has no extended PCI configuration",
    r"Firmware left e100 interrupts enabled; disabling": "QEMU's BIOS leaves the wired port so",
}
"""Kernel messages of level warning and above that mean nothing, with the reason."""


# What is measured


class Report:
    """Figures by board: into a file, and, with the test that measured them, to the end of the run."""

    def __init__(self) -> None:
        self.figures: dict[str, dict[str, float]] = {}
        self._new: list[str] = []

    def add(self, board: str, **figures: float) -> None:
        rounded = {name: round(value, 2) for name, value in figures.items()}
        self.figures.setdefault(board, {}).update(rounded)
        self._new += [f"{board}: {name} {value:g}" for name, value in rounded.items()]

    def take(self) -> list[str]:
        """What was added since the last call, a line each."""
        new, self._new = self._new, []
        return new

    def write(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_name(f".{file.name}.new")
        beside.write_text(json.dumps(self.figures, indent=1, sort_keys=True) + "\n")
        beside.rename(file)


@pytest.fixture(scope="module")
def report() -> Iterator[Report]:
    report = Report()
    yield report
    report.write(paths.BUILD / "reports" / "boot.json")


@pytest.fixture(autouse=True)
def _figures(report: Report, record_property: Callable[[str, object], None]) -> Iterator[None]:
    yield
    for line in report.take():
        record_property(figures.PROPERTY, line)


# Guests


def _settled(guest: GuestFactory, number: int, report: Report, kernel: str | None = None) -> RobotGuest:
    """The shared guest once everything that starts at boot has started."""
    asked = time.monotonic()
    robot = guest(number, kernel)
    reached = time.monotonic()
    sh(robot, "systemctl is-system-running --wait", check=False)
    prompt = rf"{robot.robot.name} login: "
    login = robot.machine.seconds_to(prompt)
    power_on = robot.machine.console.arrival(prompt) - login
    report.add(label(robot), login_s=login)
    if power_on > asked:  # else somebody else had booted it, and its SSH stands since long
        report.add(label(robot), ssh_s=reached - power_on)
    shown = sh(robot, "systemctl show -p UserspaceTimestampMonotonic -p FinishTimestampMonotonic")
    stamps = {name: int(value) / 1e6 for name, value in (line.split("=") for line in shown.splitlines())}
    begun, finish = stamps["UserspaceTimestampMonotonic"], stamps["FinishTimestampMonotonic"]
    report.add(label(robot), kernel_s=begun, userspace_s=finish - begun)
    with robot.image.open("rb") as image:
        image.seek(card.SLOTS[0].start + 40)  # `bytes_used` of the squashfs
        report.add(label(robot), root_mb=int.from_bytes(image.read(8), "little") / 1e6)
    return robot


@pytest.fixture(scope="module")
def pentium(guest: GuestFactory, report: Report) -> RobotGuest:
    """With the kernel that the inventory gives the board."""
    return _settled(guest, PENTIUM, report)


@pytest.fixture(scope="module", params=SYSTEMS)
def robot(request: pytest.FixtureRequest, guest: GuestFactory, report: Report) -> RobotGuest:
    return _settled(guest, request.param[0], report, request.param[1])


@pytest.fixture
def board(robot: RobotGuest) -> Board:
    return robot.board


def label(robot: RobotGuest) -> str:
    """What a figure is about."""
    return f"{robot.board.name} {robot.board.kernel}"


def sh(robot: RobotGuest, script: str, *, check: bool = True, timeout: float = SECONDS) -> str:
    """What a shell script prints as root."""
    return robot.shell.run(["sudo", "sh", "-c", script], check=check, timeout=timeout).stdout.strip()


def call(robot: RobotGuest, function: Callable[..., Any], *arguments: object, timeout: float = SECONDS) -> Any:
    """Result of a Python function that runs there as root; it must import all it needs."""
    source = (
        f"from __future__ import annotations\nimport json, sys\nfrom typing import Any\n{inspect.getsource(function)}\n"
    )
    source += f"print(json.dumps({function.__name__}(*json.loads(sys.argv[1]))))\n"
    argv = ["sudo", "python3", "-", json.dumps(arguments)]
    return json.loads(robot.shell.run(argv, stdin=source, timeout=timeout).stdout)


# Up through the real boot loader


def test_boots_the_card_through_grub(robot: RobotGuest, board: Board) -> None:
    argv = shlex.split((robot.machine.directory / "qemu.command").read_text())
    assert "-kernel" not in argv, "QEMU loaded the kernel past the boot loader"
    assert argv[argv.index("-cpu") + 1] == board.qemu.cpu
    assert re.search(rf"^{robot.robot.name} login: ", robot.machine.console.text, re.MULTILINE)
    model = sh(robot, "grep -m1 'model name' /proc/cpuinfo")
    assert PROCESSOR[robot.robot.number] in model, f"the processor is {model}"


def test_kernel_command_line(robot: RobotGuest, board: Board) -> None:
    words = sh(robot, "cat /proc/cmdline").split()
    slot = card.SLOTS[0]
    expected = [f"root=PARTUUID={slot.partuuid}", *card.kernel_arguments(board), f"flotilla.slot={slot.name}"]
    assert words == ["BOOT_IMAGE=(hd0,msdos1)/A/vmlinuz", *expected]


def test_kernel_is_real_time(robot: RobotGuest) -> None:
    """Each robot has the kernel that it should have."""
    version, release = sh(robot, "uname -v"), sh(robot, "uname -r")
    assert ("-flotilla-rt" in release) == (robot.board.kernel == "lean"), f"the kernel is {release}"
    assert "PREEMPT_RT" in version, f"the kernel is {version}"


def test_scheduler_keeps_no_task_that_sleeps(robot: RobotGuest) -> None:
    """It would take them out later, all at once with interrupts off. Seen to fail without preinit's: DELAY_DEQUEUE."""
    assert sh(robot, "findmnt /sys/kernel/debug", check=False) == "", "it stays mounted"
    mounted = "mount -t debugfs debug /sys/kernel/debug; {}; umount /sys/kernel/debug"
    features = sh(robot, mounted.format("cat /sys/kernel/debug/sched/features")).split()
    assert "NEXT_BUDDY" in features or "NO_NEXT_BUDDY" in features, features
    assert "DELAY_DEQUEUE" not in features
    assert ("NO_DELAY_DEQUEUE" in features) == (robot.board.kernel == "lean"), (
        "Debian's kernel, 6.1, has no such feature"
    )


def test_slot_is_marked_good(robot: RobotGuest) -> None:
    assert _boot_variables(robot) == {"ORDER": "A B", "A_OK": "1", "A_TRY": "0", "B_OK": "0", "B_TRY": "0"}
    assert "/boot" not in sh(robot, "cut -d ' ' -f 2 /proc/mounts").split(), "/boot stays mounted"
    # GRUB counts the try before the kernel starts, so a system that does not confirm would show 1 here.
    assert "flotilla-mark-good.service" in sh(robot, "systemctl list-units --state=active flotilla-*")


def _boot_variables(robot: RobotGuest) -> dict[str, str]:
    listed = sh(robot, "mount /boot && grub-editenv /boot/grub/grubenv list; umount /boot")
    return dict(line.split("=", 1) for line in listed.splitlines())


def test_nothing_failed(robot: RobotGuest) -> None:
    assert sh(robot, "systemctl --failed --plain --no-legend") == ""
    assert sh(robot, "systemctl is-system-running", check=False) == "running"


def test_kernel_has_nothing_to_complain_about(robot: RobotGuest) -> None:
    lines = sh(robot, "dmesg --level emerg,alert,crit,err,warn").splitlines()
    assert not (found := _alarming(lines)), "\n".join(found)
    sh(robot, "echo '<4>a test: trouble' >/dev/kmsg")
    lines = sh(robot, "dmesg --level emerg,alert,crit,err,warn").splitlines()
    assert len(_alarming(lines)) == 1, f"a warning was not seen in {lines}"


def _alarming(lines: list[str]) -> list[str]:
    return [line for line in lines if not any(re.search(pattern, line) for pattern in HARMLESS)]


def test_memory_after_boot(robot: RobotGuest, report: Report) -> None:
    shown = sh(robot, "cat /proc/meminfo")
    kib = {name: int(value) for name, value in re.findall(r"^(\w+): +(\d+) kB", shown, re.MULTILINE)}
    used = (kib["MemTotal"] - kib["MemAvailable"]) * 1024 / 1e6
    report.add(label(robot), memory_used_mb=used)
    limit = MEMORY_LIMIT_MB[robot.robot.number]
    processes = sh(robot, "ps -e -o rss=,comm= --sort=-rss | head")
    assert used <= limit, f"{used:.1f} MB in use (MemTotal - MemAvailable), {limit} allowed; largest:\n{processes}"


# Identity


def test_identity(robot: RobotGuest, fleet: Fleet) -> None:
    assert sh(robot, "hostname") == robot.robot.name
    assert sh(robot, "cat /etc/machine-id") == identity.variables(fleet, robot.robot)["machine_id"]
    for host in identity.hosts(fleet):
        shown = sh(robot, f"getent hosts {host.name}")
        assert str(host.address) in shown.split(), f"{host.name} is {shown!r}, not {host.address}"


def test_it_has_its_address_and_no_other(robot: RobotGuest, board: Board, fleet: Fleet) -> None:
    found = {
        interface["ifname"]: {f"{address['local']}/{address['prefixlen']}" for address in interface["addr_info"]}
        for interface in json.loads(sh(robot, "ip -json address"))
    }
    own = f"{robot.robot.address}/{fleet.network.subnet.prefixlen}"
    assert found == {"lo": {"127.0.0.1/8", "::1/128"}, board.network_interface: {own}}
    routes = [route["dst"] for route in json.loads(sh(robot, "ip -json route"))]
    assert routes == [str(fleet.network.subnet)], f"routes to {routes}"


def _ssh(robot: RobotGuest, command: str, **changes: str) -> subprocess.CompletedProcess[str]:
    """A connection of its own, with other settings than everybody's."""
    options = [word for word in ssh_options(robot.robot) if word != "-o"]
    settings = dict(option.split("=", 1) for option in options) | changes
    argv = ["ssh", "-F", "none", *(f"-o{name}={value}" for name, value in settings.items())]
    argv += ["-p", str(robot.machine.ssh_port()), "127.0.0.1", command]
    return subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)


def test_host_key_is_the_pinned_one(robot: RobotGuest, tmp_path: Path) -> None:
    """All other tests come in by the pinned key; with another's pinned, nobody does."""
    known = tmp_path / "known_hosts"
    other = (paths.KEYS / "operator_ed25519.pub").read_text().split()[:2]
    known.write_text(f"{robot.robot.name} {' '.join(other)}\n")
    done = _ssh(robot, "true", UserKnownHostsFile=str(known))
    assert done.returncode == 255, f"let in with a wrong host key pinned: {done}"
    assert "Host key verification failed" in done.stderr, done.stderr
    assert _ssh(robot, "echo in").stdout == "in\n"


def test_nobody_else_gets_in(robot: RobotGuest, tmp_path: Path) -> None:
    as_root = _ssh(robot, "true", User="root")
    assert as_root.returncode == 255, f"root was let in: {as_root}"
    assert "Permission denied (publickey)" in as_root.stderr, as_root.stderr
    key = tmp_path / "key"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)], check=True)
    stranger = _ssh(robot, "true", IdentityFile=str(key))
    # The only method named is the one offered: passwords are not asked for.
    assert "Permission denied (publickey)" in stranger.stderr, f"a strange key: {stranger}"


def test_nobody_has_a_password(robot: RobotGuest) -> None:
    fields = [line.split(":") for line in sh(robot, "cat /etc/shadow").splitlines()]
    assert len(fields) > 10, f"that is not the shadow file: {fields}"
    assert not (found := [line[0] for line in fields if line[1] not in ("!", "*", "!*")]), f"not locked: {found}"
    done = robot.shell.run(["su", "-c", "id"], check=False, stdin="robot\n")
    assert done.returncode, f"became root by a password: {done.stdout}"


def test_robot_becomes_root(robot: RobotGuest) -> None:
    assert robot.shell.run(["id", "-u"]).stdout == "1000\n"
    assert robot.shell.run(["sudo", "-n", "id", "-u"]).stdout == "0\n"


# Storage


def test_root_is_read_only(robot: RobotGuest) -> None:
    kind, options = sh(robot, "findmnt -n -o FSTYPE,OPTIONS /").split()
    assert kind == "squashfs"
    assert "ro" in options.split(","), f"the root is mounted {options}"
    for path in ("/new", "/usr/bin/new", "/root/new"):
        done = robot.shell.run(["sudo", "touch", path], check=False)
        assert "Read-only file system" in done.stderr, f"touch {path}: status {done.returncode}: {done.stderr}"


@pytest.mark.parametrize("layer", ["etc", "var", "home"])
def test_layer_is_writable_and_on_the_data_partition(robot: RobotGuest, layer: str) -> None:
    try:
        sh(robot, f"echo kept >/{layer}/a-test")
        assert sh(robot, f"cat /data/{layer}/a-test") == "kept"
    finally:
        sh(robot, f"rm -f /{layer}/a-test")


def test_data_partition_has_grown_to_the_card(robot: RobotGuest) -> None:
    disk, partition = sh(robot, 'findmnt -n -o SOURCE /data | sed "s/\\(.*\\)4/\\1 \\14/"').split()
    whole, data = (int(sh(robot, f"blockdev --getsize64 {device}")) for device in (disk, partition))
    size = int(sh(robot, "findmnt -n -b -o SIZE /data"))
    assert whole == qemu.CARD_BYTES // 512 * 512
    assert data > whole - card.DATA.start - card.MIB, f"{partition} has {data} bytes of a card of {whole}"
    assert size > 0.9 * data, f"the file system has {size} bytes of a partition of {data}"


def test_swap_is_in_memory_only(robot: RobotGuest) -> None:
    devices = [line.split()[0] for line in sh(robot, "cat /proc/swaps").splitlines()[1:]]
    assert devices == ["/dev/zram0"]


def test_journal_is_kept_and_bounded(robot: RobotGuest) -> None:
    lines = sh(robot, "journalctl --no-pager -o cat -b SYSLOG_IDENTIFIER=systemd-journald")
    found = re.search(r"System Journal \(/var/log/journal/\w+\) is \S+, max (\S+),", lines)
    assert found, f"no journal on the card:\n{lines}"
    assert found[1] == "16.0M", f"the journal may take {found[1]}"


# Network services


def test_only_ssh_and_time_listen(robot: RobotGuest) -> None:
    assert _listeners(robot) == {("tcp", "22", "sshd"), ("udp", "123", "chronyd")}
    sh(robot, "systemd-run --quiet --unit a-test busybox nc -l -p 2323")
    try:
        found = _listeners(robot)
        assert any(port == "2323" for _, port, _ in found), f"a further listener was not seen: {found}"
    finally:
        sh(robot, "systemctl stop a-test")


def _listeners(robot: RobotGuest) -> set[tuple[str, str, str]]:
    found = set()
    for line in sh(robot, "ss --no-header --tcp --udp --raw --packet --listening --numeric --processes").splitlines():
        kind, _, _, _, address, *_ = line.split()
        program = re.search(r'\(\("([^"]+)"', line)
        found.add((kind, address.rpartition(":")[2], program[1] if program else "?"))
    return found


def test_firewall_admits_the_fleet_alone(robot: RobotGuest, fleet: Fleet) -> None:
    """By packets from a neighbour, a network namespace at the other end of a virtual cable."""
    taken = [host.address for host in identity.hosts(fleet)]
    inside = next(address for address in fleet.network.subnet.hosts() if address not in taken)
    dds = 7400 + 250 * fleet.network.dds_domain + 10
    closed = call(robot, probe_firewall, str(inside), dds, "")
    open_for_fleet = {"tcp 22", f"udp {dds}", "udp 5000", "ping"}
    assert set(closed["inside"]) == open_for_fleet, f"from {inside}: {closed['inside']}"
    assert closed["outside"] == [], f"from outside the subnet: {closed['outside']}"
    opened = call(robot, probe_firewall, str(inside), dds, "insert rule inet flotilla input accept")
    everything = open_for_fleet | {"tcp 2323", "udp 2323"}
    assert set(opened["outside"]) == everything, f"with an open firewall only {opened} came through: a blind probe"


def probe_firewall(inside: str, dds_port: int, rule: str) -> dict[str, list[str]]:
    """What gets in from an address of the fleet and from one outside, with `rule` added meanwhile."""
    import ctypes
    import select
    import socket
    import subprocess
    import time
    from contextlib import ExitStack
    from pathlib import Path

    def run(command: str) -> None:
        subprocess.run(command.split(), check=True, stdout=subprocess.DEVNULL)

    libc = ctypes.CDLL(None, use_errno=True)
    target, outside = "192.0.2.1", "192.0.2.2"
    passed: dict[str, list[str]] = {"inside": [], "outside": []}
    with ExitStack() as cleanup:
        run("ip netns add neighbour")
        cleanup.callback(run, "ip netns delete neighbour")
        run("ip link add probe0 type veth peer name probe1 netns neighbour")
        cleanup.callback(run, "ip link delete probe0")
        run(f"ip address add {target}/30 dev probe0")
        run("ip link set probe0 up")
        run(f"ip route add {inside}/32 dev probe0")
        for address in (f"{outside}/30", f"{inside}/32"):
            run(f"ip -netns neighbour address add {address} dev probe1")
        run("ip -netns neighbour link set probe1 up")
        if rule:
            cleanup.callback(run, "nft -f /etc/nftables.conf")
            run(f"nft {rule}")
        receivers = {}
        for port in (5000, dds_port, 2323):
            receiver = cleanup.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            receiver.bind((target, port))
            receivers[receiver] = port
        listener = cleanup.enter_context(socket.create_server((target, 2323)))
        listener.listen()
        home = cleanup.enter_context(Path("/proc/self/ns/net").open())
        away = cleanup.enter_context(Path("/run/netns/neighbour").open())
        calls = {}
        assert libc.setns(away.fileno(), 0) == 0
        for name, address in (("inside", inside), ("outside", outside)):
            for port in (22, 2323):
                caller = cleanup.enter_context(socket.socket())
                caller.setblocking(False)
                caller.bind((address, 0))
                caller.connect_ex((target, port))
                calls[caller] = (name, port)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.bind((address, 0))
                for port in receivers.values():
                    sender.sendto(name.encode(), (target, port))
        assert libc.setns(home.fileno(), 0) == 0
        for name, address in (("inside", inside), ("outside", outside)):
            ping = f"ip netns exec neighbour ping -q -c 1 -W 1 -I {address} {target}".split()
            if subprocess.run(ping, stdout=subprocess.DEVNULL).returncode == 0:
                passed[name].append("ping")
        end = time.monotonic() + 2  # what is dropped never answers
        while (left := end - time.monotonic()) > 0:
            readable, writable, _ = select.select(list(receivers), list(calls), [], left)
            for receiver in readable:
                passed[receiver.recv(100).decode()].append(f"udp {receivers[receiver]}")
            for caller in writable:
                name, port = calls.pop(caller)
                if caller.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0:
                    passed[name].append(f"tcp {port}")
    return passed


# Real time and devices


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
        if not wanted or name.endswith(f"-{board.console.tty}"):
            continue
        checked.add(name)
        if (policy, priority) != ("FF", wanted[-1]):
            wrong.append(f"{name}: {policy} {priority} instead of {wanted[-1]}")
    assert not wrong, "; ".join(wrong)
    expected = {f"-{board.network_interface}"}
    # Ports on one interrupt have one thread, named after the first of them that was opened.
    if robot.robot.devices:
        expected.add("-ttyS")
    for part in expected:
        assert any(part in name for name in checked), f"no thread of *{part}* among {sorted(checked)}"


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


def test_service_manager_feeds_the_watchdog(robot: RobotGuest) -> None:
    shown = sh(robot, "systemctl show -p RuntimeWatchdogUSec -p WatchdogDevice")
    assert set(shown.splitlines()) == {"RuntimeWatchdogUSec=30s", "WatchdogDevice=/dev/watchdog"}
    assert "/dev/watchdog" in sh(robot, "readlink /proc/1/fd/*").splitlines(), "process 1 does not hold the watchdog"


def test_clock_follows_the_fleet(robot: RobotGuest, fleet: Fleet) -> None:
    others = {str(host.address) for host in identity.hosts(fleet) if host != robot.robot}
    sources = {line.split(",")[2] for line in sh(robot, "chronyc -n -c sources").splitlines()}
    assert sources == others
    # Alone, it leads, at the stratum of orphans, once the others did not answer.
    sh(robot, "timeout 60 sh -c 'until chronyc -n tracking | grep -q 7F7F0101; do sleep 0.5; done'", timeout=90)
    reference, _, stratum, *_ = sh(robot, "chronyc -n -c tracking").split(",")
    assert (reference, stratum) == ("7F7F0101", "10"), "not in orphan mode"


def test_serial_ports_of_the_board(robot: RobotGuest, board: Board) -> None:
    uarts = _uarts(robot)
    for name, port in board.ports.items():
        assert uarts[port.tty]["uart"] == "16550A", f"{name}: {port.tty} is {uarts[port.tty]}"
        trigger = sh(robot, f"cat /sys/class/tty/{port.tty}/rx_trig_bytes")
        assert trigger == "1", f"{name}: the interrupt comes after {trigger} bytes"


def _uarts(robot: RobotGuest) -> dict[str, dict[str, str]]:
    lines = sh(robot, "cat /proc/tty/driver/serial").splitlines()[1:]
    fields = [line.split() for line in lines]
    return {
        f"ttyS{line[0].rstrip(':')}": dict(word.split(":", 1) for word in line[1:] if ":" in word) for line in fields
    }


def test_devices_have_names_and_rates(pentium: RobotGuest, fleet: Fleet) -> None:
    board = pentium.board
    assert pentium.robot.devices, "the fleet of the tests has no device on this robot"
    assert set(sh(pentium, "ls /dev/robot").split()) == set(pentium.robot.devices)
    for name, device in pentium.robot.devices.items():
        tty = board.ports[device.port].tty
        assert sh(pentium, f"readlink -f /dev/robot/{name}") == f"/dev/{tty}"
        speed = pentium.shell.run(["stty", "-F", f"/dev/robot/{name}", "speed"]).stdout.strip()
        assert int(speed) == device.baud, f"{name}: {speed} bit/s"


EIGHT = [f"COM{number}" for number in range(5, 13)]


def test_eight_port_board_serves_all_ports_at_once(pentium: RobotGuest, fleet: Fleet) -> None:
    """Both ways on every port while they share interrupts, each byte to the right connector."""
    ports = {name: pentium.board.ports[name].tty for name in EIGHT}
    uarts = _uarts(pentium)
    lines = {name: uarts[tty]["irq"] for name, tty in ports.items()}
    assert len(set(lines.values())) < len(lines), f"no two ports share an interrupt: {lines}"
    ends = {name: pentium.machine.port(name) for name in EIGHT}
    try:
        with ThreadPoolExecutor() as threads:
            inside = threads.submit(call, pentium, exchange, {tty: f"to {name}\n" for name, tty in ports.items()})
            outgoing = {name: end.read_until(b"\n").decode() for name, end in ends.items()}
            for name, end in ends.items():
                end.write(f"from {name}\n".encode())
            incoming = inside.result()
    finally:
        for end in ends.values():
            end.close()
    assert outgoing == {name: f"to {name}\n" for name in EIGHT}, "what came out of the connectors"
    assert incoming == {tty: f"from {name}\n" for name, tty in ports.items()}, "what arrived at the devices"


def exchange(lines: dict[str, str]) -> dict[str, str]:
    """Write a line to each port, then read one from each, all open at once."""
    import os
    import select
    import time
    import tty

    ports = {name: os.open(f"/dev/{name}", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK) for name in lines}
    received = dict.fromkeys(lines, b"")
    for name, port in ports.items():
        tty.setraw(port)
        os.write(port, lines[name].encode())
    end = time.monotonic() + 20
    while (left := end - time.monotonic()) > 0 and not all(line.endswith(b"\n") for line in received.values()):
        readable, _, _ = select.select(list(ports.values()), [], [], left)
        for name, port in ports.items():
            if port in readable:
                received[name] += os.read(port, 100)
    for port in ports.values():
        os.close(port)
    return {name: line.decode() for name, line in received.items()}


def test_device_is_read_by_its_name(pentium: RobotGuest) -> None:
    (name, device), *_ = pentium.robot.devices.items()
    end = pentium.machine.port(device.port)
    try:
        sh(pentium, f"timeout 0.5 cat /dev/robot/{name}", check=False)  # what lay there
        end.write(b"0123456789\r\n" * 20)
        got = pentium.shell.run(["timeout", "20", "head", "-c", "240", f"/dev/robot/{name}"], check=False).stdout
    finally:
        end.close()
    assert got == "0123456789\r\n" * 20, f"{got!r} arrived at /dev/robot/{name}"


def test_port_stays_open_whoever_takes_it_as_a_terminal(pentium: RobotGuest) -> None:
    """Or its interrupt thread would end, and the next one start without its priority."""
    threads = "ps -e -o pid=,comm= | grep ' irq/.*-ttyS'"
    before = sh(pentium, threads)
    for name in pentium.robot.devices:
        sh(pentium, f"setsid --wait cat </dev/null >/dev/robot/{name}")
        sh(pentium, f"setsid --wait stty -F /dev/robot/{name} speed")
    assert sh(pentium, threads) == before


# DDS


def test_dds_configuration_reaches_everyone(robot: RobotGuest) -> None:
    expected = "file:///etc/flotilla/cyclonedds.xml"
    assert robot.shell.run(["sh", "-c", "echo $CYCLONEDDS_URI"]).stdout.strip() == expected
    try:
        sh(robot, "systemd-run --quiet --unit a-test -p Type=oneshot sh -c 'env >/run/a-test'")  # returns at its end
        service = sh(robot, "sed -n 's/^CYCLONEDDS_URI=//p' /run/a-test")
    finally:
        sh(robot, "rm -f /run/a-test")
    assert service == expected, f"a service sees {service!r}"
    assert sh(robot, "sysctl -n net.core.rmem_max") == "2097152"


@pytest.fixture(scope="module")
def dds(pentium: RobotGuest, fleet: Fleet) -> dict[str, Any]:
    """What DDS does with the configuration as shipped, and with others."""
    shipped = pentium.shell.read("/etc/flotilla/cyclonedds.xml").decode()
    changed = _edited(
        shipped,
        (r"<AllowMulticast>.*?<", "<AllowMulticast>true<"),
        (r"<MaxMessageSize>.*?<", "<MaxMessageSize>3000B<"),
        (r"<FragmentSize>.*?<", "<FragmentSize>500B<"),
        (r"<MaxAutoParticipantIndex>.*?<", "<MaxAutoParticipantIndex>3<"),
        (r"(?s)<Peers>.*?</Peers>", f'<Peers><Peer Address="{pentium.robot.address}"/></Peers>'),
        (r"<MultipleReceiveThreads>.*?<", "<MultipleReceiveThreads>false<"),
        (r"(?s)<Threads>.*?</Threads>", ""),
    )
    alone = _edited(
        shipped,
        (r'<NetworkInterface name=".*?"', '<NetworkInterface name="lo"'),
        (r"<ParticipantIndex>.*?<", "<ParticipantIndex>none<"),
    )
    greedy = _edited(shipped, (r'<SocketReceiveBufferSize min=".*?"', '<SocketReceiveBufferSize min="8MB"'))
    runs = {"shipped": (shipped, 2), "changed": (changed, 2), "alone": (alone, 1), "greedy": (greedy, 1)}
    domain = fleet.network.dds_domain
    return {name: call(pentium, observe_dds, text, domain, count, 3) for name, (text, count) in runs.items()}


def _edited(text: str, *changes: tuple[str, str]) -> str:
    for pattern, replacement in changes:
        text, count = re.subn(pattern, replacement, text)
        assert count == 1, f"{pattern} is {count} times in cyclonedds.xml"
    return text


_DDS_HOUSEKEEPING = ("recv", "tev", "gc", "dq.builtins")
"""Cyclone's threads that need not be in time."""


def _dds_case(option: str, read: Callable[[dict[str, Any]], object], expected: object, other: str = "changed") -> Any:
    return pytest.param(read, expected, other, id=option)


def _asked(run: dict[str, Any], *, own: bool) -> list[tuple[str, int]]:
    """Where on its own computer, or on others, an announcement went: addresses, and ports of participants."""
    asked = [(peer, port) for peer, port in run["sent"] if port >= 10 and port % 2 == 0]
    return [(peer, port) for peer, port in asked if (peer in run["advertised"]) == own]


@pytest.mark.parametrize(
    ("read", "expected", "other"),
    [
        _dds_case("NetworkInterface", lambda run: run["advertised"], ["own"], "alone"),
        _dds_case("AllowMulticast", lambda run: "239.255.0.1" in run["groups"], False),
        _dds_case("AllowMulticast-sent", lambda run: any(peer.startswith("239.") for peer, _ in run["sent"]), False),
        _dds_case("MaxMessageSize", lambda run: 1000 < run["largest"] <= 1400, True),
        _dds_case("FragmentSize", lambda run: run["fragments"], [1300]),
        _dds_case("ParticipantIndex", lambda run: {0, 1, 2, 3} <= set(run["bound"]), True, "alone"),
        _dds_case("MaxAutoParticipantIndex", lambda run: len(_asked(run, own=True)), 6),
        _dds_case("Peers", lambda run: _asked(run, own=False), "everyone"),
        _dds_case("MultipleReceiveThreads", lambda run: sorted(set(run["threads"]) & {"recvMC", "recvUC"}), ["recvUC"]),
        _dds_case("Scheduling", lambda run: run["real_time"], dict.fromkeys(_DDS_HOUSEKEEPING, 40)),
        _dds_case("StackSize", lambda run: run["stacks"] >= 5, True),
        _dds_case("SocketReceiveBufferSize", lambda run: run["ended"], [None, None], "greedy"),
    ],
)
def test_dds_obeys(
    dds: dict[str, Any],
    pentium: RobotGuest,
    fleet: Fleet,
    read: Callable[[dict[str, Any]], object],
    expected: object,
    other: str,
) -> None:
    """Each option of cyclonedds.xml has the effect it is there for, and another value has another."""
    if expected == ["own"]:
        expected = [str(pentium.robot.address)]
    if expected == "everyone":
        others = [robot for robot in fleet.robots.values() if robot.number != pentium.robot.number]
        expected = sorted(
            (str(robot.address), 10 + 2 * program)
            for robot in others
            for program in range(len(robot.control_tasks) + 1)
        )
    assert read(dds["shipped"]) == expected, f"as shipped: {dds['shipped']}"
    assert read(dds[other]) != expected, f"with another value, the same: {dds[other]}"


def test_dds_delivers(dds: dict[str, Any]) -> None:
    assert re.search(r"size 8000 total \d+ lost 0 ", dds["shipped"]["said"][0]), dds["shipped"]["said"]


def observe_dds(configuration: str, domain: int, processes: int, seconds: float) -> dict[str, Any]:
    """What a subscriber, and a publisher of 8000 bytes, do with a configuration: on the wire and in the kernel.

    Ports are counted from the domain's own. What goes to other computers is seen before it needs them to answer.
    """
    import os
    import re
    import select
    import socket
    import struct
    import subprocess
    import time
    from contextlib import ExitStack
    from pathlib import Path

    first = 7400 + 250 * domain
    table = f"""table inet observed {{
        set sent {{ type ipv4_addr . inet_service; flags dynamic; size 1024; }}
        chain output {{
            type filter hook output priority -10;
            udp dport {first}-{first + 249} add @sent {{ ip daddr . udp dport }}
        }}
    }}"""
    found: dict[str, Any] = {}
    payloads = []

    def shown(*argv: str) -> str:
        return subprocess.run(argv, capture_output=True, text=True, check=True).stdout

    with ExitStack() as cleanup:
        wire = cleanup.enter_context(socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0800)))
        wire.setsockopt(socket.SOL_SOCKET, 33, 4 << 20)  # SO_RCVBUFFORCE
        wire.bind(("lo", 0x0800))
        file = Path("/tmp/observed.xml")
        file.write_text(configuration)
        cleanup.callback(file.unlink)
        subprocess.run(["nft", "-f", "-"], input=table, text=True, check=True)
        cleanup.callback(shown, "nft", "delete", "table", "inet", "observed")
        running = []
        for role in [["sub"], ["pub", "20Hz", "size", "8000"]][:processes]:
            log = Path(f"/tmp/observed.{role[0]}")
            cleanup.callback(log.unlink)
            output = cleanup.enter_context(log.open("w"))
            environment = {**os.environ, "CYCLONEDDS_URI": f"file://{file}"}
            argv = ["ddsperf", "-i", str(domain), *role]
            process = subprocess.Popen(argv, env=environment, stdout=output, stderr=output)
            cleanup.callback(process.wait)
            cleanup.callback(process.kill)
            running.append((process, log))
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and all(process.poll() is None for process, _ in running):
            if select.select([wire], [], [], min(left, 0.2))[0]:
                packet = wire.recv(65536)
                header = (packet[0] & 15) * 4
                if packet[9] == 17 and first <= struct.unpack_from("!H", packet, header + 2)[0] < first + 250:
                    payloads.append(packet[header + 8 :])
        found["ended"] = [process.poll() for process, _ in running]
        tasks = [path for process, _ in running for path in Path(f"/proc/{process.pid}/task").glob("*/comm")]
        found["threads"] = sorted({path.read_text().strip() for path in tasks})
        after = {path: path.with_name("stat").read_text().rpartition(")")[2].split() for path in tasks}  # proc(5)
        found["real_time"] = {
            path.read_text().strip(): int(stat[37]) for path, stat in after.items() if stat[37] != "0"
        }
        there = [Path(f"/proc/{process.pid}/maps") for process, _ in running if process.poll() is None]
        maps = [line for path in there for line in path.read_text().splitlines()]
        spans = [line.split()[0].split("-") for line in maps if " rw-p 00000000 00:00 0" in line]
        found["stacks"] = sum(int(end, 16) - int(begin, 16) == 256 << 10 for begin, end in spans)
        groups = re.findall(r"^\t+([0-9A-F]{8}) ", Path("/proc/net/igmp").read_text(), re.M)
        found["groups"] = sorted({socket.inet_ntoa(struct.pack("=I", int(group, 16))) for group in groups})
        bound = re.findall(r":(\d+) +\S+ +users:\(\(\"ddsperf", shown("ss", "-Huanp"))
        found["bound"] = sorted(int(port) - first - 10 for port in bound)
        sent = re.findall(r"([\d.]+) \. (\d+)", shown("nft", "list set inet observed sent"))
        found["sent"] = sorted((peer, int(port) - first) for peer, port in sent)
        found["said"] = [log.read_text()[-1000:] for _, log in running]
    advertised, fragments = set(), set()
    for payload in payloads:
        # A locator: kind 1 (UDP over IPv4), port, sixteen bytes of address.
        for locator in re.finditer(rb"\x01\0\0\0..\0\0\0{12}(.{4})", payload, re.S):
            advertised.add(socket.inet_ntoa(locator[1]))
        position = 20  # behind the header of RTPS
        while position + 4 <= len(payload):
            kind, _, length = struct.unpack_from("<BBH", payload, position)
            if kind == 0x16:  # DATA_FRAG
                fragments.add(struct.unpack_from("<H", payload, position + 30)[0])
            position += 4 + length if length else len(payload)
    found["advertised"], found["fragments"] = sorted(advertised), sorted(fragments)
    found["largest"] = max(map(len, payloads), default=0)
    return found


# Ad hoc radio


def test_radio_joins_the_cell_whenever_it_is_plugged_in(pentium: RobotGuest, fleet: Fleet) -> None:
    """With simulated radios, and the files that a fleet with `link: ibss` would have."""
    assert fleet.network.ibss
    radio = fleet.network.model_copy(update={"link": "ibss"})
    rendered = identity.render(fleet.model_copy(update={"network": radio}), pentium.robot)
    rules = rendered[PurePosixPath("/etc/udev/rules.d/70-robot.rules")][0]
    cell = f"Joined IBSS {fleet.network.ibss.bssid} (on wlan0)"
    try:
        sh(pentium, "mkdir -p /run/udev/rules.d")
        for path, content in (
            ("/etc/flotilla/ibss.conf", rendered[PurePosixPath("/etc/flotilla/ibss.conf")][0]),
            ("/run/udev/rules.d/71-a-test.rules", rules),
        ):
            pentium.shell.run(["sudo", "tee", path], stdin=content.decode())
        sh(pentium, "udevadm control --reload")
        for plugged in ("plugged in", "plugged in again"):
            sh(pentium, "modprobe mac80211_hwsim radios=2")
            sh(pentium, "timeout 30 sh -c 'until systemctl -q is-active flotilla-ibss@wlan0; do sleep 0.2; done'")
            link = sh(pentium, "iw dev wlan0 link")
            assert cell in link, f"{plugged}: {link}"
            assert f"SSID: {fleet.network.ibss.ssid}" in link, f"{plugged}: {link}"
            assert f"freq: {fleet.network.ibss.frequency_mhz}" in link, f"{plugged}: {link}"
            assert "type IBSS" in sh(pentium, "iw dev wlan0 info")
            assert "type managed" in sh(pentium, "iw dev wlan1 info"), (
                "the radio that no unit was started for joined too"
            )
            sh(pentium, "modprobe -r mac80211_hwsim")
            sh(pentium, "timeout 30 sh -c 'while systemctl -q is-active flotilla-ibss@wlan0; do sleep 0.2; done'")
    finally:
        sh(pentium, "rm -f /etc/flotilla/ibss.conf /run/udev/rules.d/71-a-test.rules; udevadm control --reload")
        sh(pentium, "modprobe -r mac80211_hwsim cfg80211; systemctl reset-failed", check=False)
    assert sh(pentium, "ls /sys/class/ieee80211", check=False) == ""


# Accidents: guests of their own


@pytest.fixture(scope="module")
def toolset() -> Tools:
    lock = read_lock("tools")
    return Tools(tools.tree(lock), lock.epoch)


def test_power_cut_while_writing(fresh_guest: GuestFactory, fleet: Fleet, toolset: Tools, tmp_path: Path) -> None:
    robot = fresh_guest(PENTIUM)
    sh(robot, "systemctl is-system-running --wait", check=False)
    # Each line is on the card before the next is begun; what has no fsync is written too, all the time.
    writer = 'n=0; while :; do n=$((n+1)); echo "line $n" >>/data/lines; sync /data/lines; '
    writer += "dd if=/dev/urandom of=/data/bulk-$((n % 8)) bs=64k count=8 status=none; done"
    robot.shell.run(["sudo", "systemd-run", "--quiet", "sh", "-c", writer])
    count = int(
        sh(robot, "timeout 50 sh -c 'until grep -q \"line 20\" /data/lines; do sleep 0.1; done' && wc -l </data/lines")
    )
    robot.machine.cut()

    robot.machine.on()
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    messages = sh(robot, "dmesg")
    assert re.search(r"EXT4-fs \(sd.4\): recovery complete", messages), (
        f"the journal had nothing to replay:\n{messages}"
    )
    lines = sh(robot, "cat /data/lines").splitlines()
    assert lines == [f"line {number}" for number in range(1, len(lines) + 1)], f"torn: {lines}"
    # One more than was seen may have been under way.
    assert len(lines) >= count - 1, f"{count} lines were on the card, {len(lines)} are"
    test_identity(robot, fleet)
    test_nothing_failed(robot)
    assert sh(robot, "cat /sys/fs/ext4/sd?4/errors_count") == "0"
    sh(robot, "systemctl --no-block poweroff", check=False)  # there is no logind to heed a power button
    robot.machine.wait_off(SECONDS)

    whole, data = tmp_path / "card", tmp_path / "data"
    overlay = robot.machine.directory / "card.qcow2"
    subprocess.run([qemu.find_tool("qemu-img"), "convert", "-O", "raw", str(overlay), str(whole)], check=True)
    size = (qemu.CARD_BYTES - card.DATA.start) // card.MIB
    copy = ["dd", f"if={whole}", f"of={data}", "bs=1M", f"skip={card.DATA.start // card.MIB}", f"count={size}"]
    subprocess.run([*copy, "conv=sparse", "status=none"], check=True)
    toolset.run("usr/sbin/e2fsck", "-f", "-n", data)


def test_damaged_slot_falls_back_and_a_hang_ends(fresh_guest: GuestFactory, toolset: Tools, tmp_path: Path) -> None:
    """Slot A is damaged and has one try left, slot B is good; then the running system hangs. One card for both."""
    robot = fresh_guest(PENTIUM, boot=False)
    broken = _with_broken_first_slot(robot.image, tmp_path, toolset)
    qemu.make_overlay(broken, robot.machine.directory / "card.qcow2", qemu.CARD_BYTES)
    robot.machine.on()
    robot.machine.console.expect(r"Kernel panic", 2 * SECONDS)
    robot.wait_booted()
    sh(robot, "systemctl is-system-running --wait", check=False)
    words = sh(robot, "cat /proc/cmdline").split()
    assert {"flotilla.slot=B", f"root=PARTUUID={card.SLOTS[1].partuuid}"} <= set(words), f"booted {' '.join(words)}"
    assert re.search(r"sd.3$", sh(robot, "findmnt -n -o SOURCE /"))
    assert _boot_variables(robot) == {"ORDER": "A B", "A_OK": "1", "A_TRY": "3", "B_OK": "1", "B_TRY": "0"}
    test_nothing_failed(robot)

    # The service manager alone stands still; the kernel, and all else, goes on.
    robot.machine.execute("watchdog-set-action", action="pause")
    sh(robot, "echo 1 >/sys/fs/cgroup/init.scope/cgroup.freeze")
    while robot.machine.wait_event("WATCHDOG", 90)["data"]["action"] != "pause":
        pass  # of a boot that took the host longer than the watchdog waits


def test_environment_block_is_repaired(fresh_guest: GuestFactory) -> None:
    """A boot with a block that says nothing, then states that only the running system can repair."""
    robot = fresh_guest(PENTIUM)
    sh(robot, "systemctl is-system-running --wait", check=False)
    good = {"ORDER": "A B", "A_OK": "1", "A_TRY": "0", "B_OK": "1", "B_TRY": "0"}
    mark, env = "/usr/lib/flotilla/mark-good", "/boot/grub/grubenv"
    plant = "mount -o rw $(findfs PARTUUID=464c4f54-01) /boot; {}; umount /boot; sync"
    for broken in (
        f": >{env}", f"rm {env}", f"dd if=/dev/zero of={env} bs=1024 count=1",
        f"dd if=/dev/urandom of={env} bs=1024 count=1",
        f"truncate -s 700 {env}", f"rm {env}; mkdir {env}", f"truncate -s 1M {env}", "rm -r /boot/grub",
        f"dd if=/dev/zero of={env} bs=512 count=1 conv=notrunc",
    ):  # fmt: skip
        sh(robot, plant.format(broken))
        sh(robot, mark)
        assert _boot_variables(robot) == good, broken
        assert "/boot" not in sh(robot, "cut -d ' ' -f 2 /proc/mounts").split(), f"{broken}: /boot stays mounted"
        # A second time nothing is written: neither the block nor anything else of the card's.
        statistics = "sync; cat /sys/block/sda/sda1/stat"  # the seventh: sectors written
        before = sh(robot, statistics).split()[6]
        sh(robot, mark)
        assert sh(robot, statistics).split()[6] == before, f"{broken}: a good block was written again"
    sh(robot, plant.format(f"sed -i s/B_TRY=0/B_TRY=2/ {env} && truncate -s 1024 {env}"))
    sh(robot, mark)
    assert _boot_variables(robot) == good | {"B_TRY": "2"}, "what the other slot had is kept"
    sh(robot, "e2fsck -f -n $(findfs PARTUUID=464c4f54-01)")

    for broken in (f": >{env}", f"rm {env}"):
        sh(robot, plant.format(broken))
        robot.machine.reset()
        robot.wait_booted()
        sh(robot, "systemctl is-system-running --wait", check=False)
        assert _boot_variables(robot) == good, f"after a boot with {broken}"
        test_nothing_failed(robot)


def _with_broken_first_slot(image: Path, directory: Path, toolset: Tools) -> Path:
    """A copy of a card whose slot B is what slot A was, and A erased; A has one try left."""
    broken, boot, kernel = directory / "card", directory / "boot", directory / "file"
    subprocess.run(["cp", "--sparse=always", str(image), str(broken)], check=True)
    first, second = card.SLOTS
    with broken.open("r+b") as file:
        file.seek(first.start)
        root = file.read(first.size)
        file.seek(second.start)
        file.write(root.rstrip(b"\0"))
        file.seek(first.start)
        file.write(bytes(16 * card.MIB))
        file.seek(card.BOOT.start)
        content = file.read(card.BOOT.size)
        before, after = (
            f"# GRUB Environment Block\nORDER=A B\nA_OK=1\nA_TRY={tries}\nB_OK={good}\nB_TRY=0\n".encode()
            for tries, good in ((0, 0), (2, 1))
        )
        assert content.count(before) == 1, "the environment block is not where it was"
        boot.write_bytes(content.replace(before, after))
        listing = toolset.run("usr/sbin/debugfs", "-R", "ls -p /A", boot)
        for name in re.findall(r"^/\d+/100\d+/\d+/\d+/([^/]+)/", listing, re.MULTILINE):
            toolset.run("usr/sbin/debugfs", "-R", f"dump /A/{name} {kernel}", boot)
            toolset.run("usr/sbin/debugfs", "-w", "-R", f"write {kernel} /B/{name}", boot)
        try:
            toolset.run("usr/sbin/e2fsck", "-f", "-n", boot)
        except UserError as error:
            pytest.fail(f"this test made a bad boot partition: {error}")
        file.seek(card.BOOT.start)
        file.write(boot.read_bytes())
    return broken
