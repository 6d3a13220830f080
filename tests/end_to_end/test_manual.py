"""Every command of the documents works: each is run as it stands there, or says here why it cannot be.

The tutorial is followed as a whole: its commands and files in their order, with one guest. A block of text below a
command has the command's output; the test compares it, and `RENEW=1` writes it again.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import durable, paths
from flotilla.fleet.model import Fleet
from flotilla.images import verify
from flotilla.lab.qemu.console import SerialConsole
from flotilla.lab.qemu.ssh import Ssh
from flotilla.robot import ssh

DOCS = paths.PROJECT / "docs"
README = paths.PROJECT / "README.md"
TUTORIAL = DOCS / "tutorial.md"
PAGES = [README, *sorted((DOCS / "how-to").glob("*.md"))]
COMMANDS = "sh"
"""Language of code that is commands. Other code is a file when its first line says which."""
NEEDS_ROBOTS = "needs the robots; test_fleet.py plays the same on guests"
ELSEWHERE = {
    "make test": "is what runs this",
    **dict.fromkeys(
        (
            "make rotate-key ROBOT=3",
            "make rotate-key ROBOT=3 RETIRE=1",
            "make rotate-key KEY=operator",
            "make rotate-key KEY=operator RETIRE=1",
            "make revoke-key ROBOT=3",
        ),
        "changes the keys; test_fleet.py does the same with a copy",
    ),
    **dict.fromkeys(
        (
            "make admit-operator NAME=alice KEY_FILE=alice.pub",
            "make admit-operator NAME=alice KEY_FILE=alice.pub DAYS=7 OUT=alice",
            "make admit-operator NAME=alice KEY_FILE=alice.pub FROM=10.42.0.100,10.42.0.128/28",
            "make revoke-operator NAME=alice",
        ),
        "needs a colleague's key, and changes the keys; unit/test_operators.py does the same with a copy",
    ),
    **dict.fromkeys(
        ("make backup-keys OUT=fleet-keys.age", "make restore-keys FILE=fleet-keys.age"),
        "asks for a passphrase; unit/test_keys.py",
    ),
    "make fleet N=2 LINK=ibss": "operations.md starts a fleet; test_radio_cell.py has guests in a cell",
    "lsblk": "shows this computer's disks, no program of ours",
    "make flash ROBOT=3 DEV=/dev/sdX": "needs a card; into a file below, on block devices in unit/test_flash.py",
    "build/venv/bin/python -m serial.tools.miniterm /dev/ttyUSB0 115200": "needs a cable",
    "sudo ip address add 10.42.0.254/24 dev eth0": "changes this computer's network",
    "ping 10.42.0.3": "needs the robot",
    **dict.fromkeys(
        (
            "make wheel",
            "python3 -m venv ~/flotilla",
            '~/flotilla/bin/pip install -c constraints.txt "flotilla[station] @ file://$PWD/flotilla-0.1.0-py3-none-any.whl"',
            "~/flotilla/bin/flotilla init rovers",
            "cd rovers",
            "export PATH=~/flotilla/bin:$PATH",
            "~/flotilla/bin/flotilla image 1",
        ),
        "is for another computer; image/test_package.py does the same",
    ),
    "make hwcheck ROBOT=3": "needs the robot; tests/boot/shared asks guests the same",
    **dict.fromkeys(
        ("make hwcheck TARGET=ssh:root@192.168.1.20 NAME=nuc7", "ssh root@192.168.1.20 'dmesg | grep -i firmware'"),
        "needs the computer; tests/boot/shared asks guests the same",
    ),
    **dict.fromkeys(
        (
            "mkdir -p ../rovers/packages",
            "cp images/packages/pc_uefi.list ../rovers/packages/nuc7.list",
            "echo 'firmware-realtek # Ethernet at full speed' >>../rovers/packages/nuc7.list",
            "make lock ONLY=nuc7 FLEET=../rovers",
            "echo 'htop # shows which process needs the processor' >>../rovers/packages/fleet.list",
            "make lock ONLY=pc_uefi FLEET=../rovers",
            "make boot ROBOT=1 FLEET=../rovers",
        ),
        "needs a fleet with the board; image/test_home.py has one",
    ),
    **dict.fromkeys(
        ("make accept ROBOT=3", "make accept ROBOT=1 PLAN=none RELAYS=1", "make accept ROBOT=3 PLAN=none WATCHDOG=1"),
        "needs the robot; tests/boot/shared/test_robot_acceptance.py accepts a guest",
    ),
    "make latency TARGET=ssh:robot3": "needs the robot; tests/boot/shared/test_robot_acceptance.py measures a guest",
    **dict.fromkeys(
        (
            'make provision ARGS="--check --diff"',
            "make provision",
            "make provision ROBOT=3",
            "make provision PLAYBOOK=tasks",
            'make provision PLAYBOOK=tasks ARGS="-e do=stop -e task=heading"',
            "make provision PLAYBOOK=collect",
            "make provision PLAYBOOK=reboot",
            'make provision ROBOT=3 ARGS="-e current_address=10.42.0.3"',
            'make provision PLAYBOOK=replace ARGS="-e replaced=robot3"',
            'make provision PLAYBOOK=replace ARGS="-e replaced=robot3 -e rotate=true"',
        ),
        NEEDS_ROBOTS,
    ),
    **dict.fromkeys(
        (
            'make update ARGS="--tags stage"',
            "make update",
            'make update ROBOT=3 ARGS="-e stop_tasks=true"',
            'make update ROBOT=3 ARGS="-e go=back"',
            'make update ROBOT=3 ARGS="-e accept_old=4"',
        ),
        "needs the robots; test_update.py plays the same on a guest",
    ),
    **dict.fromkeys(("make releases", "make releases ROBOT=3"), "needs the robots; unit/test_releases.py"),
    **dict.fromkeys(
        ("make cve TRACKER=tracker.json.xz", "make cve TRACKER=tracker.json.xz JSON=1"),
        "needs the tracker's data; unit/test_cve.py",
    ),
    **dict.fromkeys(
        (
            "ssh-keygen -Y sign -n flotilla-release -f KEY smartcoret3.manifest.json",
            'make bundle BOARD=smartcoret3 SIGNATURES="alice.sig bob.sig"',
        ),
        "needs the keys of others; runtime/test_update.py signs so",
    ),
    "sudo make fleet-scale N=32": "test_fleet_scale.py runs it for fewer",
    **dict.fromkeys(
        ("make station-join", "make station-leave"),
        "need an adapter; tests/boot/shared/test_radio.py has a simulated one",
    ),
    'make scenarios FLIGHTS="air air-10"': "test_scenarios.py flies them",
    'make scenarios ON=lockstep FLIGHTS="air air-10"': "test_scenarios_lockstep.py flies them, nightly",
    "make lock": "asks the mirror for other packages; unit/test_lock.py",
    **dict.fromkeys(
        ("sudo cp proxy.crt /usr/local/share/ca-certificates/", "sudo update-ca-certificates"),
        "changes this computer's certificates",
    ),
    "make image ROBOT=5": "needs an added robot; test_one_more_robot builds its image",
    **dict.fromkeys(
        ("make lock ONLY=NAME", "make image ROBOT=6", "make boot ROBOT=6"),
        "needs an added board; unit/test_synthetic_board.py adds one",
    ),
    "make param ROBOT=1 TASK=heading": "needs the robot; test_control_loop.py asks a guest",
    "make param ROBOT=1 TASK=heading PARAM=attitude.kp VALUE=2.5": "needs the robot; test_control_loop.py asks a guest",
    **dict.fromkeys(
        (
            "make scope ROBOT=1 TASK=heading",
            'make scope ROBOT=1 TASK=heading SIGNALS="gyro.rate attitude.out" EVERY=10',
            'make scope ROBOT=1 TASK=heading SIGNALS="gyro.rate attitude.out" TRIGGER="gyro.rate>0.1" BEFORE=100 '
            "ROWS=1000 CSV=push.csv",
        ),
        "needs the robot; test_control_loop.py asks a guest",
    ),
    "make fetch ROBOT=3 TASK=heading": "needs the robot; unit/test_fetch.py",
    **dict.fromkeys(
        (
            "make report FILE=run.mcap",
            "make report FILE=build/recordings/robot3/heading",
            'make convert FILE="log-000001.rec log-000002.rec" OUT=run.mcap',
            "make convert FILE=build/recordings/robot3/heading OUT=run.mat",
            'make convert FILE="build/recordings/robot3/heading/log-*.rec" OUT=run.csv',
        ),
        "needs recordings; unit/test_convert.py and unit/test_report_of_files.py make the like",
    ),
    "make import-model ZIP=hover_ctrl.zip NAME=hover": "needs an archive; runtime/test_imported.py makes one",
    **dict.fromkeys(
        (
            "make station",
            "make station INVENTORY=build/wheeled/station KEYS=build/wheeled/keys",
            "make station REPLAY=build/recordings/2026-05-04T10-30-00.mcap",
        ),
        "serves until Ctrl-C; test_station_page.py in runtime and boot",
    ),
    "ssh -L 8080:127.0.0.1:8080 station": "needs a second computer",
    "make positions ROBOT=1": "sends until Ctrl-C; runtime/test_positions.py has a robot by datagrams",
    **dict.fromkeys(
        ("make drive ROBOT=5", "make drive ROBOT=1 INVENTORY=build/wheeled/station KEYS=build/wheeled/keys"),
        "needs a robot on wheels; runtime/test_drive.py has one by datagrams",
    ),
    **dict.fromkeys(
        (
            "make wheeled N=1 ROOM=corner",
            "make top INVENTORY=build/wheeled/station KEYS=build/wheeled/keys",
            "make record INVENTORY=build/wheeled/station KEYS=build/wheeled/keys",
        ),
        "runs until Ctrl-C; boot/test_wheeled_live.py boots the same",
    ),
    "make deploy ROBOT=3 APP=apps/hover": "runs until Ctrl-C; test_deploy.py",
    "make deploy ROBOT=3 APP=apps/hover RUN=status": "needs the robot; test_deploy.py asks a guest",
    "make deploy ROBOT=3 APP=apps/hover ON_ROBOT=1": "needs the robot; test_deploy.py compiles on a guest",
    **dict.fromkeys(
        ("make new-app KIND=device NAME=sonar", "build/venv/bin/python -m pytest apps/sonar"),
        "leaves an app behind; runtime/test_examples.py makes one elsewhere and runs its test",
    ),
    "make deploy ROBOT=3 APP=apps/sonar": "runs until Ctrl-C and needs the sensor; test_deploy.py",
    "make verify ROBOT=3": "test_verify.py",
    "build/venv/bin/pytest tests/runtime/test_wheeled.py": "is a test by itself",
    "make latency": "test_latency.py measures the same",
    "make latency-accept": "changes what tests compare with",
}
"""Commands that need hardware, a terminal or time, with who does the like."""
NIGHTLY = ("make fleet N=2", "make provision ON=guests", "make fleet-status", "make fleet-down", "make scenarios")
"""They take minutes: guests that test_fleet.py has each time, and a flight as test_scenarios.py flies it each time."""
BEGINNINGS = ("make ", "build/runtime/flotilla-", "mkdir -p build/")
"""Of commands that are ours to run."""
RENEW = os.environ.get("RENEW") == "1"
"""Write the outputs of the tutorial's commands into the pages. In a fresh clone they include downloads and builds."""
_STEP = re.compile(r".*: ([\d.]+ s|\d+ % .*)(; about [\d:]+ left)?|\(took \d+ s\)")
"""A line of `progress`, about work that a cache may save; and the time that a command took."""
_VOLATILE = re.compile(
    r"\d+(\.\d+)?(?= (%|[mµ]?s|[KMG]i?B|steps|overruns|skipped)\b)"
    r"|\b[0-9a-f]{16}|(?<=MainPID=)\d+|(?<=from step )\d+|(?<=Timestamp=).*"
)
"""Measured figures, hashes, process numbers and dates."""
WITHOUT_OUTPUT = ["make setup", "make ssh ROBOT=3"]
"""Commands of the tutorial whose output depends on the computer, or that are a dialogue."""
BOOT = "make boot ROBOT=3"
"""Takes a terminal, and stays."""
BOOT_SECONDS = 1200
"""Until the login prompt: finite, and generous to a busy host."""


_COMMENT = re.compile(r"""('[^']*'|"[^"]*")|#.*""")
"""Of the shell: a `#` in quotes begins none."""


@dataclass(frozen=True)
class Code:
    """A fenced block of a page."""

    language: str
    text: str
    printed: str = ""
    """The block of text that follows."""

    @property
    def commands(self) -> list[str]:
        """One a line, without comments."""
        lines = self.text.splitlines() if self.language == COMMANDS else []
        return [command for line in lines if (command := _COMMENT.sub(r"\1", line).strip())]

    @property
    def file(self) -> Path | None:
        """The app's file that the first line names."""
        named = re.match(r"(?:/\*|#) (apps/\S+):", self.text)
        return paths.PROJECT / named[1] if named else None


def code(page: Path) -> list[Code]:
    pattern = r"^```(\w*)\n(.*?)^```$(?:\n\n```text\n(.*?)^```$)?"
    return [Code(*fence) for fence in re.findall(pattern, page.read_text(), re.MULTILINE | re.DOTALL)]


def commands(*pages: Path) -> list[str]:
    """Each once."""
    return list(dict.fromkeys(command for page in pages for block in code(page) for command in block.commands))


def run(command: str) -> None:
    """Fails also if a page has another output of the command."""
    begun = time.monotonic()
    done = subprocess.run(
        command,
        shell=True,
        cwd=paths.PROJECT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, f"{command}: {done.stdout}"
    check(command, done.stdout, time.monotonic() - begun)


def check(command: str, printed: str, took_s: float) -> None:
    """Compare, or write, the output wherever README and tutorial have this command alone above an output. The README
    has no lines of progress."""
    for page in (README, TUTORIAL):
        for block in [block for block in code(page) if block.printed and block.commands == [command]]:
            if RENEW:
                above = f"```{COMMANDS}\n{block.text}```\n\n```text\n"
                lines = [line for line in printed.splitlines() if page == TUTORIAL or not _STEP.fullmatch(line)]
                new = "\n".join([above.rstrip(), *lines, f"(took {took_s:.0f} s)\n"])
                durable.write(page, page.read_text().replace(above + block.printed, new))
            else:
                assert comparable(block.printed) == comparable(printed), f"{page}: {command}: write it again by RENEW=1"


def comparable(printed: str) -> list[str]:
    """Lines without what differs from run to run."""
    lines = [line.rstrip() for line in printed.splitlines()]
    return [_VOLATILE.sub("0", line) for line in lines if line and not _STEP.fullmatch(line)]


def left_to_run() -> list[Any]:
    """Of the pages, without what the tutorial's test runs."""
    others = [command for command in commands(*PAGES) if command not in {*ELSEWHERE, *commands(TUTORIAL)}]
    others += [command for command in commands(TUTORIAL) if command in NIGHTLY]
    return [pytest.param(each, marks=[pytest.mark.nightly] if each in NIGHTLY else []) for each in others]


@pytest.mark.parametrize("command", left_to_run())
def test_command(command: str, flotilla_run: Path) -> None:
    assert command.startswith(BEGINNINGS), "not ours to run here: say in ELSEWHERE why"
    run(command)


def test_no_reason_outlives_its_command() -> None:
    assert set(ELSEWHERE) <= set(commands(*PAGES))
    assert BOOT in commands(TUTORIAL)
    without = [command for block in code(TUTORIAL) for command in block.commands if not block.printed]
    assert without == WITHOUT_OUTPUT, "an output is below one command each"
    assert set(NIGHTLY) <= set(commands(*PAGES, TUTORIAL))
    assert not set(ELSEWHERE) & set(commands(TUTORIAL)), "the tutorial is run as it stands"


def test_an_output_differs_by_more_than_figures() -> None:
    first = "root: 25 % of 9 packages after 1:29; about 0:57 left\nroot: kernel: 4.0 s; about 0:09 left\nroot: 9.0 s\n"
    first += "b.img: 84.2 MiB, sha256 5ac09214e1994074…\nMainPID=331\n2 steps\n(took 14 s)\n"
    again = "b.img: 9 MiB, sha256 0123456789abcdef…\nMainPID=7\n99 steps\n"
    assert comparable(first) == comparable(again)
    for old, new in (("b.img", "c.img"), ("MiB", "KiB"), ("PID", "Pid"), ("99 steps\n", ""), ("steps", "overruns")):
        assert comparable(first) != comparable(again.replace(old, new)), old


class Terminal:
    """A command on a terminal of its own; the wire of a console (`console.Line`)."""

    def __init__(self, command: str) -> None:
        self._ours, theirs = os.openpty()
        self.process = subprocess.Popen(
            command, shell=True, cwd=paths.PROJECT, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        os.close(theirs)

    def recv(self, size: int, /) -> bytes:
        try:
            return os.read(self._ours, size)
        except OSError:  # nobody has the other end any more
            return b""

    def sendall(self, data: bytes, /) -> None:
        os.write(self._ours, data)

    def close(self) -> None:
        os.close(self._ours)


@contextmanager
def booted(fleet: Fleet, log: Path) -> Iterator[None]:
    """BOOT on a terminal while the body runs, once it lets `make ssh` in; then Ctrl-A X."""
    terminal = Terminal(BOOT)
    console = SerialConsole(log, lambda: f"status {terminal.process.poll()}")
    begun = time.monotonic()
    try:
        console.attach(terminal)
        console.expect(r"robot3 login: ", BOOT_SECONDS)
        head = console.text.partition("\x1b")[0]  # then GRUB clears the screen
        check(BOOT, f"{head.rstrip()}\n…\nrobot3 login:", time.monotonic() - begun)
        port = ssh.forwarded_port(fleet.robots[3])
        assert port
        with Ssh(fleet.robots[3], "127.0.0.1", lambda: port) as shell:
            shell.connect()
        yield
        console.send("\x01x")
        assert terminal.process.wait(BOOT_SECONDS) == 0
    finally:
        with suppress(ProcessLookupError):
            os.killpg(terminal.process.pid, signal.SIGKILL)
        terminal.process.wait()
        console.close()


def test_a_stranger_follows_the_tutorial_to_a_block_of_their_own(fleet: Fleet, tmp_path: Path) -> None:
    """From an installed computer to a guest that runs the block of the page, as the page says."""
    app = paths.PROJECT / "apps" / "hover"
    assert not app.exists(), "the tutorial's app is there already; move it away"
    blocks = code(TUTORIAL)
    at = [BOOT in block.commands for block in blocks].index(True)
    try:
        follow(blocks[:at])
        with booted(fleet, tmp_path / "terminal.log"):
            follow(blocks[at + 1 :])
    finally:
        shutil.rmtree(app, ignore_errors=True)
        with suppress(OSError):  # not there, or somebody's apps are in it
            app.parent.rmdir()


def follow(blocks: list[Code]) -> None:
    for block in blocks:
        if block.file:
            assert block.file.exists(), f"{block.file}: the page makes it before it is changed"
            block.file.write_text(block.text)
        for command in block.commands:
            if command not in NIGHTLY:
                assert command.startswith(BEGINNINGS)
                run(command)


def test_flash_into_a_file(tmp_path: Path) -> None:
    card = tmp_path / "card.img"
    run(f"make flash ROBOT=3 CARD={card}")
    assert card.read_bytes() == (paths.IMAGES / "robot3.img").read_bytes()


def test_one_more_robot(tmp_path: Path) -> None:
    """Three copied lines in a copy of the checkout, with the results that this one's builds left."""
    checkout, keys = tmp_path / "checkout", tmp_path / "keys"
    verify.copy_checkout(checkout)
    shutil.copytree(paths.KEYS, keys)
    robots = checkout / paths.INVENTORY.relative_to(paths.PROJECT) / "robots.yml"
    lines = re.search(r"^ *robot4:\n.*\n.*\n", robots.read_text(), re.MULTILINE)
    assert lines
    added = lines[0].replace("robot4", "robot5").replace("number: 4", "number: 5").replace("10.42.0.4", "10.42.0.5")
    robots.write_text(robots.read_text().replace(lines[0], lines[0] + added))
    argv = [sys.executable, "-m", "flotilla", "image", "5"]
    environment = os.environ | {"BUILD": str(paths.BUILD), "KEYS": str(keys)}
    try:
        done = subprocess.run(argv, cwd=checkout, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert (paths.IMAGES / "robot5.img").exists()
        assert "root file system" not in done.stderr  # the board's results were of use
    finally:
        for output in paths.IMAGES.glob("robot5.*"):
            output.unlink()
