"""Progress: a terminal sees something move each second, a log has a line at each part's end, estimates are right."""

from __future__ import annotations

import argparse
import itertools
import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from flotilla.common import paths, progress
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.common.progress import Far
from flotilla.debian import kernel, runtime
from flotilla.images import rootfs, verify
from flotilla.lab.containers import scale
from flotilla.lab.latency import command
from flotilla.lab.latency import run as latency
from flotilla.lab.scenarios import command as scenarios
from flotilla.lab.scenarios import fly, virtual
from flotilla.lab.scenarios.plans import plans

PATIENCE_S = 60
"""For a process to start, on however busy a computer."""


class Clock:
    """Time that passes when it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(progress, "_now", lambda: self.now)

    def wait(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[], list[str]]:
    """Lines without a terminal."""
    monkeypatch.setattr(progress, "_TERMINAL", False)
    monkeypatch.setattr(progress, "VERBOSE", False)
    return lambda: capsys.readouterr().err.splitlines()


@pytest.fixture
def picture(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[progress.Step], str]:
    """What a terminal shows a second later."""
    monkeypatch.setattr(progress, "_TERMINAL", True)
    monkeypatch.setattr(progress, "_COLOUR", False)
    monkeypatch.setattr(progress, "VERBOSE", False)
    monkeypatch.setenv("COLUMNS", "120")

    def seen(step: progress.Step) -> str:
        step.tick()
        return capsys.readouterr().err.rpartition("\r\033[K")[2]

    return seen


@pytest.mark.parametrize("terminal", [False, True])
def test_end_of_a_step(terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "_TERMINAL", terminal)
    monkeypatch.setattr(progress, "VERBOSE", False)
    with progress.step("work"):
        pass
    assert re.search(r"work: \d+\.\d s\n$", capsys.readouterr().err)
    with pytest.raises(KeyboardInterrupt), progress.step("work"):
        raise KeyboardInterrupt
    assert re.search(r"work: failed after \d+\.\d s\n$", capsys.readouterr().err)


def test_what_how_far_and_how_long_still(clock: Clock, picture: Callable[[progress.Step], str]) -> None:
    """The rate counts from when something was known first: what came before says nothing about the rest."""
    with progress.step("work") as step:
        assert picture(step)[1:] == " work: 0:00"
        clock.wait(40)
        step.at(0, 200, "files", "compile")
        assert picture(step)[1:] == " work: compile, 0 % of 200 files, 0:40"
        clock.wait(2)
        step.at(2, 200, "files", "compile")
        assert picture(step)[1:] == " work: compile, 1 % of 200 files, 0:42"  # too early to say
        clock.wait(8)
        step.at(50, 200, "files", "compile")
        assert picture(step)[1:] == " work: compile, 25 % of 200 files, 0:50, about 0:30 left"
        clock.wait(12)
        assert picture(step)[1:] == " work: compile, 25 % of 200 files, 1:02, about 0:18 left"
        clock.wait(60)
        assert picture(step)[1:].endswith("2:02, about 0:00 left")
        step.at(200, 200, "files")
        assert picture(step)[1:] == " work: 100 % of 200 files, 2:02"


def test_each_second_shows_another_picture(clock: Clock, picture: Callable[[progress.Step], str]) -> None:
    """However little is known."""
    with progress.step("work") as step:
        seen = []
        for _ in range(5):
            clock.wait(1)
            seen.append(picture(step))
    assert all(before != after for before, after in itertools.pairwise(seen)), seen


def test_of_steps_within_each_other_the_innermost_is_shown(picture: Callable[[progress.Step], str]) -> None:
    with progress.step("outer") as outer:
        with progress.step("inner") as inner:
            assert "inner" in picture(inner)
            assert picture(outer) == ""
        assert "outer" in picture(outer)


def test_a_picture_is_one_line(picture: Callable[[progress.Step], str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrapped line could not be overwritten."""
    monkeypatch.setenv("COLUMNS", "20")
    with progress.step("a title that is too long for it") as step:
        step.at(1, 2, "halves")
        assert len(picture(step)) == 19
        monkeypatch.setenv("COLUMNS", "50")
        assert picture(step)[1:] == " a title that is too lo…: 50 % of 2 halves, 0:00"


def test_a_log_has_a_line_at_each_parts_end(clock: Clock, log: Callable[[], list[str]]) -> None:
    with progress.step("work") as step:
        for done, part in enumerate(("boot", "fly", "land")):
            step.at(done, 3, part=part)
            clock.wait(10)
        step.at(3, 3, part="land")
    assert log() == [
        "work: boot: 10.0 s; about 0:20 left",
        "work: fly: 10.0 s; about 0:10 left",
        "work: land: 10.0 s",
        "work: 30.0 s",
    ]


def test_a_log_has_quarters_of_what_has_no_parts(clock: Clock, log: Callable[[], list[str]]) -> None:
    with progress.step("long") as step:
        for done in range(101):
            step.at(done, 100, "files")
            clock.wait(2)
    with progress.step("short") as step:
        for done in range(101):
            step.at(done, 100, "files")
    assert log() == [
        "long: 25 % of 100 files after 0:50; about 2:30 left",
        "long: 50 % of 100 files after 1:40; about 1:40 left",
        "long: 75 % of 100 files after 2:30; about 0:50 left",
        "long: 100 % of 100 files after 3:20",
        "long: 202.0 s",
        "short: 0.0 s",
    ]


def test_lines_of_work_that_shows_progress_itself_come_once(clock: Clock, log: Callable[[], list[str]]) -> None:
    written = ""
    with progress.step("verify", lambda: verify.far(written, own_kernel=False)) as step:
        step.tick()
        for line in (
            "unpack 89 build tools: 10.0 s",
            "unfinished",
            "runtime for i386: 50 % of 190 files after 0:31; about 0:25 left",
            "runtime for i386: 56.0 s",
            "root file system of x (178 packages): kernel: 6.1 s; about 0:38 left",
        ):
            clock.wait(20)
            written += f"{line}\n"
            step.tick()
            step.tick()
    assert log() == [
        "verify: unpack 89 build tools: 10.0 s; about 2:28 left",
        "verify: runtime for i386: 50 % of 190 files after 0:31; about 3:00 left",
        "verify: runtime for i386: 56.0 s; about 2:10 left",
        "verify: root file system of x (178 packages): kernel: 6.1 s; about 1:50 left",
        "verify: 100.0 s",
    ]


def test_a_second_image_shows_how_far_it_is(clock: Clock, picture: Callable[[progress.Step], str]) -> None:
    """Seen to fail: it showed the last part that had ended, and not how long the rest takes."""
    written = "unpack 89 build tools: 10.0 s\n"
    with progress.step("second image", lambda: verify.far(written, own_kernel=False)) as step:
        assert "build tools: 10.0 s, 11 %, 0:00" in picture(step)
        clock.wait(60)
        written += "runtime for i386: 56.0 s\n"
        assert "i386: 56.0 s, 38 %, 1:00, about 2:22 left" in picture(step)
        written += "root file system of x (178 packages): 101.0 s\n"
        assert "100 %" in picture(step)


# As a process

PLANTED = """
import sys, threading
from pathlib import Path
from flotilla.common import progress
log, end = map(Path, sys.argv[1:])
progress._SURE_S = 0
def far():
    done = progress.text(log).count("done")
    print(f"looked at {done}", flush=True)
    return progress.Far(done, 4, "parts", f"part {done}")
with progress.step("planted", far):
    with end.open():
        pass
print("and more")
"""
"""A step that ends when somebody opens its fifo; how far it is, its log says."""


def planted(tmp_path: Path, output: int, **environment: str) -> subprocess.Popen[bytes]:
    os.mkfifo(tmp_path / "end")
    own = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "V")}
    argv = [*DIE_WITH_PARENT, sys.executable, "-c", PLANTED, str(tmp_path / "log"), str(tmp_path / "end")]
    settings = own | {"PYTHONPATH": str(paths.PROJECT), "TERM": "xterm", "COLUMNS": "100"} | environment
    return subprocess.Popen(argv, env=settings, stdout=subprocess.PIPE, stderr=output, stdin=subprocess.DEVNULL)


def until(descriptor: int, pattern: str, seen: str = "") -> str:
    """What is written until it has the pattern."""
    while not re.search(pattern, seen):
        assert select.select([descriptor], [], [], PATIENCE_S)[0], seen
        seen += os.read(descriptor, 4096).decode()
    return seen


@pytest.mark.parametrize("no_colour", [False, True])
def test_a_terminal_sees_it_move(tmp_path: Path, no_colour: bool) -> None:
    """Seen to fail before there were ticks: the picture of the beginning stayed until the step's end."""
    ours, theirs = pty.openpty()
    process = planted(tmp_path, theirs, **({"NO_COLOR": "1"} if no_colour else {}))
    os.close(theirs)
    seen = until(ours, r"(?s)planted.*planted.*planted: part 0, 0 % of 4 parts")
    (tmp_path / "log").write_text("done\n")
    seen = until(ours, r"planted: part 1, 25 % of 4 parts, \d+:\d\d, about \d+:\d\d left", seen)
    (tmp_path / "end").write_text("")
    seen = until(ours, r"planted: \d+\.\d s", seen)
    assert process.communicate(timeout=PATIENCE_S)[0].endswith(b"and more\n")
    os.close(ours)
    pictures = [each for each in seen.split("\r\033[K") if "part" in each]
    assert len(set(pictures)) == len(pictures), pictures
    assert ("\033[36m" in seen) != no_colour


def test_a_log_has_neither_colour_nor_carriage_returns(tmp_path: Path) -> None:
    ours, theirs = os.pipe()
    process = planted(tmp_path, theirs)
    os.close(theirs)
    assert process.stdout
    until(process.stdout.fileno(), "looked at 0")
    (tmp_path / "log").write_text("done\n")
    seen = until(ours, r"planted: part 0: \d+\.\d s; about \d+:\d\d left\n")
    (tmp_path / "end").write_text("")
    seen = until(ours, r"planted: \d+\.\d s\n", seen)
    process.communicate(timeout=PATIENCE_S)
    os.close(ours)
    assert "\r" not in seen
    assert "\033" not in seen


def test_a_command_is_quiet_unless_it_fails(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "_TERMINAL", False)
    monkeypatch.setattr(progress, "VERBOSE", False)
    assert progress.main("right", sys.executable, "-c", "print('much')") == 0
    assert re.fullmatch(r"right: \d+\.\d s\n", "".join(capfd.readouterr()))
    assert progress.main("wrong", sys.executable, "-c", "print('why'); raise SystemExit(3)") == 3
    assert re.fullmatch(r"wrong: failed after \d+\.\d s\nwhy\n", "".join(capfd.readouterr()))


# How far each long command is, by what its work leaves behind


def test_a_kernel_by_the_files_that_are_compiled() -> None:
    log = "  HOSTCC  scripts/x\n  CC      a.o\n  CC [M]  b.o\n  LD      c.o\n"
    assert kernel.far(log, 8) == Far(2, 8, "files compiled")


def test_a_root_by_its_packages_and_parts() -> None:
    assert rootfs.far("", 2).done == 0
    begun = "== packages\nI: Unpacking the base system...\nI: Unpacking a...\nSetting up b:i386 (1:2-3) ...\n"
    half = rootfs.far(begun, 2)
    assert (half.done, half.part) == (40, "packages")
    later = rootfs.far(begun + "== packages: 80.0 s\n== kernel\n", 2)
    assert (later.done, later.part) == (80, "kernel")


def test_what_debootstrap_says_is_in_the_log_at_once(tmp_path: Path) -> None:
    """Seen to fail when its output was kept until it had ended: 0 % all the while."""
    stage = mock.Mock(target=tmp_path)
    rootfs._bootstrap(stage, "i386", "bookworm", ["a"])
    assert [call[0] for call in stage.method_calls] == ["shown_in_tools", "shown_in_target"]


def test_the_stages_parts_are_those_that_are_weighed() -> None:
    """A new part has to say how long it takes."""
    source = Path(rootfs.__file__).read_text()
    assert ["packages", *re.findall(r'_timed\("(\w+)"\)', source)] == list(rootfs._SECONDS)


def test_the_runtime_by_what_ninja_counts() -> None:
    assert runtime.far("") == Far()
    assert runtime.far("[1/176] Compiling\nwarning\n[44/176] Compiling\n") == Far(44, 176, "files")


FLIGHTS = {"udp": 18.0, "cut-open": 8.0}


@pytest.mark.parametrize(
    ("console", "done", "part"),
    [
        ("", 0, "boot"),
        ("latency login: flight: udp 0 s\n", 0, "udp"),
        ("latency login: flight: udp 0 s\nflight: udp 5 s\n", 5, "udp"),
        ("flight: udp 0 s\nflight: udp 5 s\nflight: udp 18 s\nflight: cut-op", 18, "udp"),
        ("flight: udp 18 s\nflight: cut-open 5 s\n", 23, "cut-open"),
    ],
)
def test_flights_by_what_the_guest_tells(console: str, done: float, part: str) -> None:
    assert virtual.far(console, FLIGHTS) == Far(done, 26, "virtual seconds", part)


@pytest.mark.parametrize(
    ("console", "done", "part"),
    [
        ("[    0.0] booting\n", 0, "boot"),
        ("latency login: latency: idle\n", 0, "idle (1 of 2)"),
        ("latency login: latency: idle\nSignal 15\nlatency: timerlat-everything\n", 60, "timerlat-everything (2 of 2)"),
        ("latency: idle\nlatency: timerlat", 0, "idle (1 of 2)"),
    ],
)
def test_latency_by_the_scenario_that_runs(console: str, done: float, part: str) -> None:
    assert latency.far(console, {"idle": 60, "timerlat-everything": 10}) == Far(done, 70, "virtual seconds", part)


def test_light_robots_by_those_that_have_booted() -> None:
    assert scale.far("robot1\n", 2) == Far(1, 2, "robots booted", "boot")
    assert scale.far("robot1\nrobot2\n", 2) == Far(part="fleet.yml")


def test_a_flight_tells_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fly.py writes in the guest is what the host reads."""
    now = 50.0
    console = tmp_path / "console"
    console.touch()
    told: list[Far] = []

    def sleep(seconds: float) -> None:
        nonlocal now
        now += seconds
        told.append(virtual.far(console.read_text(), FLIGHTS))

    monkeypatch.setattr(fly, "CONSOLE", console)
    monkeypatch.setattr(time, "monotonic", lambda: now)
    monkeypatch.setattr(time, "sleep", sleep)
    fly.wait_until(0.5, "udp", 50.0)
    fly.wait_until(10.0, "udp", 50.0)
    fly.wait_until(18.0, "udp", 50.0)
    assert now == 68.0
    assert [far.done for far in told] == [0, 0, 5, 5, 15]


# What is said at the start


def test_the_default_flight_takes_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    parser = argparse.ArgumentParser()
    scenarios.arguments(parser)
    default = parser.parse_args([])
    there = {plan.name: plan for plan in plans(default.side)}
    chosen = [there[name] for name in scenarios.chosen(default.flights, there)]
    said = scenarios.how_long(chosen, [])
    minutes = re.fullmatch(r"scenarios: udp; 18 virtual seconds, about (\d+) minutes on two cores", said)
    assert minutes
    assert int(minutes[1]) <= 5
    everything = [there[name] for name in scenarios.chosen([scenarios.ALL], there)]
    said = scenarios.how_long(everything, ["smartcoret3"])
    assert said.startswith("scenarios: udp, air, dds, loss,")
    assert "\nkernels to build first: smartcoret3, each about 7 minutes on two cores" in said


@pytest.mark.parametrize(("words", "minutes"), [([], 5), (["--plan", "standard"], 75)])
def test_latency_says_what_it_measures_and_how_long(words: list[str], minutes: int) -> None:
    parser = argparse.ArgumentParser()
    command.latency_arguments(parser)
    asked = parser.parse_args(["--board", "smartcoret3", *words])
    systems = command.systems(asked)
    said = command.how_long(systems, [])
    found = re.fullmatch(r"to measure: (.*); about (\d+) minutes on two cores", said)
    assert found
    assert int(found[2]) <= minutes
    assert found[1].startswith("smartcoret3-lean")
    assert found[1].endswith("smartcoret3-no-rt-quick")
    assert command.kernels(systems) == ["smartcoret3", "smartcoret3-no-rt"]


def test_a_robot_is_measured_long() -> None:
    parser = argparse.ArgumentParser()
    command.latency_arguments(parser)
    assert command.plan(parser.parse_args(["--target", "ssh:robot3"])) == "standard"
    assert command.plan(parser.parse_args([])) == "quick"
