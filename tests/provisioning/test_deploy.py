"""Apps brought to a robot: built, sent, run, ended, kept and removed, on one guest with a relay board.

The guest does what robots do, and is reached by the same commands; only the way to it is the test lab's.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flotilla.apps import app, deploy, remote, scaffold
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Board, Fleet
from flotilla.lab.emulators.ir104 import Ir104
from flotilla.lab.qemu.relay_ports import RelayPorts
from flotilla.lab.qemu.ssh import COMMAND_SECONDS
from flotilla.lab.qemu.timing import Deadline
from flotilla.robot import ssh
from tests.conftest import GuestFactory, RobotGuest
from tests.running import judged_by_outcomes

STUBBORN = r"""
#include <signal.h>
#include <stdio.h>
#include <sys/io.h>
#include <unistd.h>

int main(int argc, char **argv)
{
    signal(SIGTERM, SIG_IGN);
    if (argc != 2 || ioperm(0x300, 3, 1)) {
        perror("stubborn");
        return 1;
    }
    outb(0x03, 0x300);
    printf("%s\n", argv[1]);
    fflush(stdout);
    for (;;)
        pause();
}
"""
SAID = "on: 50 % of $HOME"
"""What the service manager must pass on as it stands."""
RELAYS = next(
    part.split("```")[0]
    for part in (paths.PROJECT / "docs" / "how-to" / "apps.md").read_text().split("```yaml\n")[1:]
    if "relays:" in part.split("```")[0]
)
"""The page's example of a safe.yml: two relays of the board at 0x300."""
EACH_KIND = [pytest.param(kind, marks=[] if kind == "block" else [pytest.mark.nightly]) for kind in app.KINDS]
"""The others differ in how they are built, which tests/runtime tries on this computer each time."""


class Bench:
    """The guest, its relays, and the directory of apps."""

    def __init__(self, guest: RobotGuest, relays: Ir104, board: Board, apps: Path) -> None:
        self.guest, self.relays, self.board, self.apps = guest, relays, board, apps

    @contextmanager
    def connection(self, number: int = 4, port: int | None = None) -> Iterator[remote.Connection]:
        """To the guest, as if it were robot `number`, or to another port of this computer."""
        robot = self.guest.robot.model_copy(update={"name": f"robot{number}", "number": number})
        way = ["-p", str(port or self.guest.machine.ssh_port()), "127.0.0.1"]
        with remote.connection(robot, ["ssh", "-F", "none", *ssh.options(robot), *way]) as to:
            yield to

    def new(self, kind: str, name: str) -> Path:
        """A new app as `make new-app` makes it, but that a slow host does not end it; an earlier one is gone."""
        shutil.rmtree(self.apps / name, ignore_errors=True)
        scaffold.create(kind, name, self.apps)
        for task in (self.apps / name).glob("task.yml"):
            task.write_text(judged_by_outcomes(task.read_text()))
        return self.apps / name

    def place(self, directory: Path, *, on_robot: bool = False) -> None:
        """Build and send it; it does not run."""
        with self.connection() as to:
            deploy.place(to, app.load(directory), self.board, on_robot=on_robot)

    def do(self, name: str, run: str) -> str:
        with self.connection() as to:
            return deploy.command(to, name, run)

    def status(self, name: str) -> dict[str, str]:
        return dict(line.split("=", 1) for line in self.do(name, "status").splitlines())


@contextmanager
def running(guest: GuestFactory, fleet: Fleet, apps: Path, image: Path | None = None) -> Iterator[Bench]:
    """Robot 4, which has no task of its own, with a relay board. Its card is the usual one, or `image`."""
    relays = Ir104()
    with RelayPorts(relays) as ports:
        robot = guest(4, image=image, qemu_options={"extra": ports.arguments})
        yield Bench(robot, relays, fleet.boards[robot.robot.board], apps)


@pytest.fixture(scope="module")
def bench(module_guest: GuestFactory, fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with running(module_guest, fleet, tmp_path_factory.mktemp("apps")) as bench:
        yield bench


def measured(said: str) -> tuple[float, int]:
    """Period in ms and number of steps in an app's report."""
    match = re.search(r"^period (\S+) ms, (\d+) steps, \d+ overruns, \d+ skipped\njitter: mean .* max ", said)
    assert match, said
    return float(match[1]), int(match[2])


@pytest.mark.parametrize("kind", EACH_KIND)
def test_a_new_app_runs_until_it_is_interrupted_and_reports(bench: Bench, kind: str) -> None:
    """Seen to fail where the app did not start at all: then there is no report, and no line to interrupt at."""
    name = f"new-{kind}"
    lines: list[str] = []

    def show(line: str) -> None:
        lines.append(line)
        if line.startswith("Started"):
            raise KeyboardInterrupt

    with bench.connection() as to:
        said = deploy.deploy(to, bench.new(kind, name), bench.board, keep=False, show=show)
    period_ms, steps = measured(said)
    assert (period_ms, steps > 0) == (10, True)
    assert any("Deactivated successfully" in line for line in lines), "the log ends before the app does"
    assert bench.status(name)["ActiveState"] == "inactive"
    print(said)


@pytest.mark.parametrize("kind", EACH_KIND)
def test_it_starts_and_stops_by_itself_again_and_again(bench: Bench, kind: str) -> None:
    name = f"again-{kind}"
    bench.place(bench.new(kind, name))
    for _ in range(2):
        assert "ActiveState=active" in bench.do(name, "start")
        assert measured(bench.do(name, "stop"))[1] > 0
    assert bench.status(name)["ActiveState"] == "inactive"


def test_a_program_that_ignores_sigterm_is_ended_and_its_relays_are_reset(bench: Bench) -> None:
    """Without safe.yml they stay on, and are off only once the next version is there and has ended."""
    directory = bench.new("make", "stubborn")
    (directory / "main.c").write_text(STUBBORN)
    (directory / "app.yml").write_text(f"kind: make\nprogram: stubborn\nio_ports: true\narguments: ['{SAID}']\n")
    bench.place(directory)
    bench.do("stubborn", "start")
    assert bench.relays.wait_relays(on=True), "the program does not start"
    bench.do("stubborn", "stop")
    assert any(bench.relays.relays), "nothing resets them, and yet they are off"
    (directory / "safe.yml").write_text(RELAYS)
    bench.place(directory)
    for _ in range(2):
        bench.do("stubborn", "start")
        assert bench.relays.wait_relays(on=True), "the program does not start"
        assert bench.do("stubborn", "stop") == "", "it measures nothing"
        assert bench.relays.wait_relays(on=False), "relays stay on after their program was ended"
    assert bench.status("stubborn")["ActiveState"] == "failed"
    log = bench.guest.shell.run(["sudo", "journalctl", "-o", "cat", "-u", "flotilla-app@stubborn"]).stdout
    assert SAID in log.splitlines()


SPINNING_TASK = """
period: 10 ms
priority: 70
restart: resume
blocks:
  teeth: {type: spinning}
  relays: {type: ir104-pbf, in: {command: [1, 1], flag: 1}, parameters: {base: 0x300, channels: [1, 2]}}
"""


@pytest.mark.nightly
def test_a_step_that_spins_without_end_is_ended_until_it_is_given_up(bench: Bench) -> None:
    """On one processor nothing else runs meanwhile."""
    directory = bench.new("block", "spinning")
    source = directory / "spinning.c"
    source.write_text(source.read_text().replace("*phase +=", "while (block->step > 20)\n        ;\n    *phase +="))
    (directory / "task.yml").write_text(judged_by_outcomes(SPINNING_TASK))
    bench.place(directory)
    before = len(bench.relays.log)
    bench.do("spinning", "start")
    deadline = Deadline(COMMAND_SECONDS)
    while (status := bench.status("spinning"))["ActiveState"] != "failed" and not deadline.expired:
        pass  # asking takes a second
    assert status["ActiveState"] == "failed", status
    # Whoever waits for them to be on may come too late.
    switched = [each.on for each in bench.relays.log[before:] if each.relay == 1]
    assert switched == [True, False] * 5, "relays stay on while a step spins, or the app does not start"
    assert not any(bench.relays.relays)
    log = bench.guest.shell.run(["sudo", "journalctl", "-o", "cat", "-u", "flotilla-app@spinning"]).stdout
    assert len(re.findall(r"no step ended for \S+ s, after step 21; outputs are in their reset state", log)) == 5
    bench.do("spinning", "remove")


LEAKING = r"""
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

int main(void)
{
    if (mlockall(MCL_CURRENT | MCL_FUTURE))
        perror("mlockall");
    for (;;) {
        char *memory = malloc(1 << 20);
        if (memory)
            memset(memory, 1, 1 << 20);
    }
}
"""


def test_an_app_that_leaks_is_killed_and_nothing_else(bench: Bench) -> None:
    """Five times, and is given up. The connection is the same all the time: its sshd is an ordinary process."""
    session = bench.guest.shell.run(["sh", "-c", "echo $PPID"]).stdout
    directory = bench.new("make", "leaking")
    (directory / "main.c").write_text(LEAKING)
    (directory / "app.yml").write_text("kind: make\nprogram: leaking\n")
    bench.place(directory)
    bench.guest.shell.run(["sudo", "systemctl", "start", "--no-block", "flotilla-app@leaking"])
    deadline = Deadline(COMMAND_SECONDS)
    while (status := bench.status("leaking"))["ActiveState"] != "failed" and not deadline.expired:
        pass  # asking takes a second
    assert status["ActiveState"] == "failed", status
    kernel = bench.guest.shell.run(["sudo", "journalctl", "-k", "-b", "-o", "cat"]).stdout
    killed = re.findall(r"out of memory: Killed process \d+ \((\w+)\)", kernel, re.IGNORECASE)
    assert (set(killed), len(killed)) == ({"leaking"}, 5), killed
    assert bench.guest.shell.run(["sh", "-c", "echo $PPID"]).stdout == session
    bench.do("leaking", "remove")


@pytest.mark.nightly  # it starts the robot anew, which takes minutes
def test_a_kept_app_starts_with_the_robot(bench: Bench) -> None:
    """Power fails as soon as the command is done. An app that is not kept shows that the restart was one."""
    with bench.connection() as to:
        said = deploy.deploy(to, bench.new("block", "kept"), bench.board, keep=True, show=print)
    assert "ActiveState=active" in said
    assert "for good: apps: [kept] in robots.yml" in said
    bench.place(bench.new("block", "not-kept"))
    bench.do("not-kept", "start")
    bench.guest.machine.reset()
    bench.guest.wait_booted()
    after = bench.status("kept")
    assert (after["ActiveState"], after["Kept"], after["NRestarts"]) == ("active", "yes", "0")
    assert bench.status("not-kept")["ActiveState"] == "inactive"
    assert measured(bench.do("kept", "stop"))[1] > 0


@pytest.mark.nightly
@pytest.mark.parametrize("kind", app.KINDS)
def test_a_robot_compiles_what_this_computer_does_to_the_byte(bench: Bench, kind: str) -> None:
    """A version is the hash of an app's files. It runs, and nothing stays of its build but the compiler.

    Seen to fail with another optimisation on the robot.
    """
    name = f"there-{kind}"
    directory = bench.new(kind, name)
    bench.place(directory)
    version = bench.status(name)["Version"]
    bench.do(name, "remove")
    bench.place(directory, on_robot=True)
    assert bench.status(name)["Version"] == version
    assert "ActiveState=active" in bench.do(name, "start")
    assert measured(bench.do(name, "stop"))[1] > 0
    left = bench.guest.shell.run(["sudo", "find", "/data/compilers", "-mindepth", "1"]).stdout.split()
    assert [Path(path).suffix for path in left] == [".squashfs"]
    assert "/data/compilers" not in bench.guest.shell.run(["sudo", "losetup", "-l"]).stdout
    bench.do(name, "remove")


@pytest.mark.nightly
def test_what_a_robot_does_not_compile_is_not_deployed(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """The compiler's words come here; what it was given cannot reach the robot."""
    directory = bench.new("make", "wrong")
    bench.place(directory)
    bench.do("wrong", "start")
    before = runs(bench, "wrong")
    program, makefile = directory / "main.c", directory / "Makefile"
    good = program.read_text()
    program.write_text(good + "\nint wrong = ;\n")
    with pytest.raises(
        UserError, match=r"nothing was built: robot4: it does not compile \(status 2\); what it said is"
    ):
        bench.place(directory, on_robot=True)
    words = r"main\.c:\d+:\d+: error: expected expression before .;."
    assert re.search(words, capsys.readouterr().err)
    assert re.search(words, (paths.BUILD / "compile-i386.log").read_text())
    program.write_text(good)
    makefile.write_text("all:\n\tid -u; ls -d /data; nice; touch /usr/mine; touch /dev/mine; false\n")
    with pytest.raises(UserError, match="it does not compile"):
        bench.place(directory, on_robot=True)
    said = capsys.readouterr().err
    assert "\n65534\n19\n" in said.replace("ls: cannot access '/data': No such file or directory\n", "")
    assert said.count("touch: cannot touch") == 2
    assert runs(bench, "wrong") == before
    bench.do("wrong", "remove")


@pytest.mark.nightly
def test_a_robot_without_room_for_the_compiler_says_so(bench: Bench) -> None:
    directory = bench.new("block", "no-room")
    shell = bench.guest.shell
    fill = "rm -rf /data/compilers; fallocate -l $(($(df --output=avail -k /data | tail -n 1) - 32768))K /data/filler"
    shell.run(["sudo", "sh", "-c", fill])
    try:
        with pytest.raises(
            UserError, match=r"/data has \d+ KiB left, and the compiler needs \d+ KiB; compile on the dev"
        ):
            bench.place(directory, on_robot=True)
    finally:
        shell.run(["sudo", "rm", "/data/filler"])
    with pytest.raises(UserError, match="there is no app no-room"):
        bench.do("no-room", "start")


def runs(bench: Bench, name: str) -> tuple[str, str]:
    """Which version of an app runs, as which process."""
    status = bench.status(name)
    assert status["ActiveState"] == "active", status
    return status["Version"], status["MainPID"]


def test_what_does_not_compile_or_check_is_not_deployed(bench: Bench) -> None:
    directory = bench.new("block", "broken")
    bench.place(directory)
    bench.do("broken", "start")
    before = runs(bench, "broken")
    source, task = directory / "broken.c", directory / "task.yml"
    good = source.read_text()
    source.write_text(good.replace("*phase +=", "*phaze +="))
    with pytest.raises(UserError, match=r"(?s)nothing was built: .*broken\.c:\d+:\d+: error: .phaze. undeclared"):
        bench.place(directory)
    source.write_text(good)
    task.write_text(task.read_text().replace("teeth.out", "teeth.aut"))
    with pytest.raises(UserError, match=r"broken/task\.yml:\d+: block scaled: .*teeth\.aut"):
        bench.place(directory)
    source.write_text(good.replace('.name = "broken"', '.name = "gain"'))
    with pytest.raises(UserError, match=r"broken\.so: block gain: another block has that name"):
        bench.place(directory)
    assert runs(bench, "broken") == before
    bench.do("broken", "remove")


@pytest.mark.nightly
def test_a_full_data_partition_refuses_and_leaves_the_last_good_app(bench: Bench) -> None:
    directory = bench.new("block", "room")
    bench.place(directory)
    bench.do("room", "start")
    before = runs(bench, "room")
    task = directory / "task.yml"
    task.write_text(task.read_text().replace("factor: 2", "factor: 3"))
    shell = bench.guest.shell
    fill = "fallocate -l $(($(df --output=avail -k /data | tail -n 1) - 3072))K /data/filler"
    shell.run(["sudo", "sh", "-c", fill])
    try:
        with pytest.raises(UserError, match=r"robot4: /data has +\d+ KiB left, and the app needs \d+ KiB"):
            bench.place(directory)
        assert runs(bench, "room") == before
    finally:
        shell.run(["sudo", "rm", "/data/filler"])
    bench.place(directory)
    bench.do("room", "start")
    assert runs(bench, "room") != before
    assert shell.run(["sudo", "sh", "-c", "ls -d /data/apps/.room*"]).stdout.count("\n") == 1, "old versions stay"


def test_a_board_that_is_another_one_is_refused(bench: Bench, fleet: Fleet) -> None:
    with (
        bench.connection() as to,
        pytest.raises(UserError, match="it is an i686, but its board in the inventory is not"),
    ):
        deploy.deploy(to, bench.new("block", "other"), fleet.boards["x86_64"], keep=False, show=print)
    with pytest.raises(UserError, match="there is no app other"):
        bench.do("other", "start")


def test_another_robots_card_is_refused(bench: Bench) -> None:
    with bench.connection(3) as to, pytest.raises(UserError, match=r"robot3: rejected, because its host key is not"):
        deploy.command(to, "other", "status")


def test_a_robot_that_is_not_there_is_said(bench: Bench) -> None:
    with bench.connection(port=1) as to, pytest.raises(UserError, match=r"robot4 did not answer: .*refused"):
        deploy.command(to, "other", "status")


def test_nothing_stays_of_an_app_that_was_removed(bench: Bench) -> None:
    with bench.connection() as to:
        deploy.deploy(to, bench.new("make", "gone"), bench.board, keep=True, show=print)
    shell = bench.guest.shell
    left = ["sudo", "find", "/data", "-xdev", "-name", "*gone*", "-not", "-path", "/data/.work/*"]
    assert "/data/apps/gone\n" in shell.run(left).stdout
    assert bench.do("gone", "remove") == "gone is gone from robot4"
    kept = [path for path in shell.run(left).stdout.splitlines() if not path.startswith("/data/A/etc/")]
    assert kept == []
    assert shell.run(["sudo", "find", "/etc/systemd/system", "-name", "*gone*"]).stdout == ""
    with pytest.raises(UserError, match="there is no app gone"):
        bench.do("gone", "stop")
