"""Parameters of a running task, read and set through its socket, on this computer."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

TASK = """
period: {period}
blocks:
  a: {{type: gain, in: {{in: 1}}, parameters: {{factor: 2}}}}
  pid: {{type: pid, in: {{set_point: 0, measurement: a.out}}, parameters: {{kp: 0.3, min: -1, max: {max}}}}}
  trigger: {{type: schmitt-trigger, in: {{in: a.out}}, parameters: {{on: 3, off: {off}}}}}
  camera: {{type: image-processor, in: {{image: {image}, flag: 1, sequence: 1}},
           parameters: {{width: 2, height: 1, threshold: {threshold}}}}}
{more}
"""
USUAL = {"period": "10 ms", "max": "1", "off": "1", "image": "[0, 0]", "threshold": "100", "more": ""}
SECONDS = 30
"""Time limit of what takes none."""


class Running:
    """A task that runs, and listens."""

    def __init__(self, program: Path, directory: Path, *options: str, **values: str) -> None:
        self.program, self.control, self.file = program, directory / "control", directory / "task.yml"
        self.file.write_text(TASK.format(**USUAL | values))
        ready = directory / "ready"
        ready.unlink(missing_ok=True)
        environment = os.environ | {"RUNTIME_DIRECTORY": str(directory), "NOTIFY_SOCKET": str(ready)}
        argv = [str(program), "--watch", "a.out", *options, str(self.file)]
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
            notified.bind(str(ready))
            notified.settimeout(SECONDS)
            self.process = subprocess.Popen(
                argv, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            assert notified.recv(64).startswith(b"READY=1")

    def param(self, *words: str) -> subprocess.CompletedProcess[str]:
        argv = [str(self.program.with_name("flotilla-param")), "--control", str(self.control), "task", *words]
        return subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)

    def status(self, *more: str) -> subprocess.CompletedProcess[str]:
        argv = [str(self.program.with_name("flotilla-param")), "--control", str(self.control), *more, "task"]
        return subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)

    def told(self) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self.status("--status=json").stdout)
        return told

    def connected(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(SECONDS)
        connection.connect(str(self.control))
        return connection

    def row(self) -> dict[str, Any]:
        assert self.process.stdout
        row: dict[str, Any] = json.loads(self.process.stdout.readline())
        return row

    def end(self) -> tuple[list[dict[str, Any]], str]:
        """What it said until it ended as it was asked to."""
        self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=SECONDS)
        assert self.process.returncode == 0, err
        return [json.loads(line) for line in out.splitlines()], err


Start = Callable[..., Running]


@pytest.fixture
def start(flotilla_run: Path, tmp_path: Path) -> Iterator[Start]:
    started: list[Running] = []

    def start(*options: str, **values: str) -> Running:
        started.append(Running(flotilla_run, tmp_path, *options, **values))
        return started[-1]

    yield start
    for running in started:
        running.process.kill()
        running.process.communicate()


def test_a_parameter_changes_between_two_steps_and_is_logged(start: Start) -> None:
    """Seen to fail with a step told that is one too early."""
    running = start()
    first = running.row()
    assert first["a.out"] == 2
    done = running.param("a.factor", "-3.5")
    assert (done.returncode, done.stderr) == (0, "")
    match = re.fullmatch(r"a\.factor: 2 → -3\.5 from step (\d+) on\n", done.stdout)
    assert match, done.stdout
    step = int(match[1])
    assert running.param("a.factor").stdout == "-3.5\n"
    while (row := running.row())["step"] < step:
        assert row["a.out"] == 2
    assert (row["step"], row["a.out"]) == (step, -3.5)
    rows, err = running.end()
    assert {row["a.out"] for row in rows} <= {-3.5}
    assert f"flotilla: task: user {os.getuid()}: {done.stdout}" in err


def test_all_parameters_are_listed(start: Start) -> None:
    lines = start().param().stdout.splitlines()
    assert "a.factor: 2, tunable" in lines
    assert "pid.filter: 0 s, tunable, 0 to inf" in lines
    assert "pid.anti_windup: clamping, clamping|back-calculation|none" in lines
    assert "camera.threshold: 100, tunable, 0 to 254" in lines


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("camera.threshold", {"threshold": "255"}),
        ("camera.threshold", {"threshold": "1.5"}),
        ("pid.max", {"max": "-2"}),
        ("trigger.off", {"off": "3.5"}),
        ("pid.max", {"max": "high"}),
    ],
)
def test_a_value_is_refused_in_the_words_of_the_task_file(start: Start, name: str, values: dict[str, str]) -> None:
    """Seen to fail without `configure`, which compares parameters with each other."""
    running = start()
    before = running.param(name).stdout
    ((_, value),) = values.items()
    refused = running.param(name, value)
    assert refused.returncode == 1
    assert running.param(name).stdout == before
    running.end()
    running.file.write_text(TASK.format(**USUAL | values))
    checked = subprocess.run(
        [str(running.program), "--check", str(running.file)],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert checked.returncode == 2
    assert refused.stderr.removeprefix("flotilla-param: task task: ") == re.sub(r"^.*?:\d+: ", "", checked.stderr)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("b.factor", "1"), "the task has no block b; it has a, pid, trigger, camera"),
        (("a.faktor",), "block a: gain has no parameter faktor; it has factor"),
        (("factor", "1"), "factor is not BLOCK.PARAMETER"),
        (("pid.turn", "1"), "block pid: parameter turn cannot be set while the task runs"),
        (("camera.threshold", ""), "block camera: parameter threshold: nothing is not a whole number"),
    ],
)
def test_what_cannot_be_is_said(start: Start, words: tuple[str, ...], said: str) -> None:
    refused = start().param(*words)
    assert (refused.returncode, refused.stdout, refused.stderr) == (1, "", f"flotilla-param: task task: {said}\n")


# As root of namespaces of its own, with a /run of its own: what services of a name have there, and what is said of it.
# Without locked memory: a namespace has little of it, and a program that counts branches needs more for its threads.
SERVICES = """
import os, pathlib, resource, subprocess, sys
program, task, *directories = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))
subprocess.run(["mount", "-t", "tmpfs", "tmpfs", "/run"], check=True)
for number, directory in enumerate(directories):
    os.makedirs(directory)
    copy = pathlib.Path(f"/run/{number}.yml")
    copy.write_bytes(pathlib.Path(task).read_bytes())
    process = subprocess.Popen(
        [program, "--watch", "a.out", copy], env=os.environ | {"RUNTIME_DIRECTORY": directory}, stdout=subprocess.PIPE
    )
    assert process.stdout.readline()
os.execl(program.replace("flotilla-run", "flotilla-param"), "flotilla-param", "hover", "pid.max")
"""


@pytest.mark.parametrize(
    ("directories", "status", "said"),
    [
        (["/run/flotilla/hover"], 0, "1\n"),
        (["/run/flotilla-apps/hover"], 0, "1\n"),
        (
            ["/run/flotilla/hover", "/run/flotilla-apps/hover"],
            1,
            "flotilla-param: a control task and an app are named hover: say which by --control "
            "/run/flotilla/hover/control or /run/flotilla-apps/hover/control\n",
        ),
        ([], 1, "flotilla-param: no task hover runs here: nobody listens at /run/flotilla/hover/control\n"),
    ],
)
def test_an_app_is_found_by_its_name_too(
    flotilla_run: Path, tmp_path: Path, directories: list[str], status: int, said: str
) -> None:
    """Seen to fail for an app: no task hover runs here."""
    (tmp_path / "task.yml").write_text(TASK.format(**USUAL))
    argv = ["unshare", "--user", "--map-root-user", "--mount", "--pid", "--fork", "--kill-child"]
    argv += [sys.executable, "-c", SERVICES, str(flotilla_run), str(tmp_path / "task.yml"), *directories]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)
    shown = done.stdout if status == 0 else done.stderr.splitlines(keepends=True)[-1]
    assert (done.returncode, shown) == (status, said)


def test_no_such_task(flotilla_run: Path, tmp_path: Path) -> None:
    param = str(flotilla_run.with_name("flotilla-param"))
    argv = [param, "--control", str(tmp_path / "control"), "heading", "pid.kp"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert done.returncode == 1
    assert done.stderr == f"flotilla-param: no task heading runs here: nobody listens at {tmp_path}/control\n"


@pytest.mark.parametrize(
    "request_", [b"set\n", b"\n", b"set a.factor\n", b"list all\n", b"get a.factor 1\n", b"status xml\n"]
)
def test_a_wrong_request_is_answered(start: Start, request_: bytes) -> None:
    with start().connected() as client:
        client.sendall(request_)
        assert client.makefile().read() == (
            "error\nunknown request; known are list, get BLOCK.PARAMETER, set BLOCK.PARAMETER VALUE, confirm "
            "BLOCK.PARAMETER OLD VALUE, status, "
            "status json, signals, watch SIGNAL...\n"
        )


RUDE = {"silent": b"", "half a line": b"set a.fac", "endless": b"x" * 100_000, "no text": b"set a.factor \0\n"}


@pytest.mark.parametrize("bytes_", RUDE.values(), ids=RUDE.keys())
def test_a_rude_client_delays_neither_others_nor_the_end(start: Start, bytes_: bytes) -> None:
    """Each has two seconds. Seen to fail without a deadline, and the end without the event that asks for it."""
    running = start()
    with ExitStack() as clients:
        first = clients.enter_context(running.connected())
        first.setblocking(False)
        if bytes_:
            first.send(bytes_)
        assert running.param("a.factor", "4").returncode == 0
        while running.row()["a.out"] != 4:  # steps go on
            pass
        for _ in range(8):
            clients.enter_context(running.connected()).send(bytes_[:100])
        running.end()


def test_a_flood_of_requests_stops_nobody(start: Start) -> None:
    running = start()
    with ExitStack() as clients:
        for _ in range(8):
            clients.enter_context(running.connected()).sendall(b"list\n")  # and it does not read
        assert running.param("a.factor", "4").returncode == 0
        running.end()


def test_a_change_that_nobody_waits_for_any_more_is_withdrawn(start: Start) -> None:
    """Its first step is at least a minute away. Seen to fail, by the time limit, without a look at the client."""
    running = start(period="60 s")
    with running.connected() as client:
        client.sendall(b"set a.factor 3\n")
    assert running.param("a.factor").stdout == "2\n"


def test_the_socket_is_its_users_alone_and_goes_with_the_task(start: Start) -> None:
    running = start()
    mode = stat.S_IMODE(running.control.stat().st_mode)
    os.umask(umask := os.umask(0))
    assert mode == 0o660 & ~umask, "nobody else's, and its group's only where the umask lets it"
    running.end()
    assert not running.control.exists()


def test_a_socket_that_was_left_behind_is_replaced(start: Start) -> None:
    first = start()
    first.process.kill()
    first.process.wait()
    assert first.control.exists()
    assert start().param("a.factor").stdout == "2\n"


def test_anothers_socket_and_what_is_none_stay(start: Start, tmp_path: Path) -> None:
    running = start()
    other, file = tmp_path / "other.yml", tmp_path / "file"
    other.write_text(TASK.format(**USUAL))
    file.write_text("mine")
    for path in (running.control, file):
        argv = [str(running.program), "--steps", "1", "--control", str(path), str(other)]
        refused = subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)
        assert refused.returncode == 2
        assert f"{path}: it exists, and is another task's socket or not a socket" in refused.stderr
    assert file.read_text() == "mine"
    assert running.param("a.factor").stdout == "2\n"


def test_a_task_says_how_it_does(start: Start) -> None:
    """Stopped for 20 periods it overruns; a sensor is heard. Seen to fail where the control thread tells nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = free.getsockname()
    running = start(
        more=f"  heard: {{type: udp-receive, parameters: {{port: {address[1]}, length: 1, timeout: 3600}}}}"
    )
    end = time.monotonic() + SECONDS
    while not (told := running.told())["steps"]:
        assert time.monotonic() < end
    assert (told["task"], told["period_s"], told["timeouts"]) == ("task", 0.01, 0)
    assert told["sensors"].keys() == {"camera", "heard"}
    assert told["sensors"]["heard"]["flag"] is False
    before = told["overruns"]
    running.process.send_signal(signal.SIGSTOP)
    time.sleep(0.2)
    running.process.send_signal(signal.SIGCONT)
    while (told := running.told())["overruns"] == before:
        assert time.monotonic() < end
    assert told["skipped"] >= 18
    assert 0 <= told["last_overrun"]["ago_s"] < told["running_s"]
    assert 0 <= told["last_overrun"]["step"] < told["steps"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.sendto(b"1", address)
        one.sendto(b"of another length", address)
    while not (sensor := running.told()["sensors"]["heard"])["flag"]:
        assert time.monotonic() < end
    assert 0 <= sensor["age_s"] < SECONDS
    while not (refused := running.told()["refused"]):
        assert time.monotonic() < end
    assert refused == {"heard": {"refused": 1}}
    lines = running.status("--status").stdout
    assert re.search(
        r"^overruns: \d+, \d+ releases skipped; the last [\d.]+ s ago: step \d+ ended [\d.]+ s late$", lines, re.M
    )
    assert re.search(r"^heard: flag 1, age [\d.]+ s$", lines, re.M)
    assert lines.endswith("\nrefused by heard: 1 refused\n")


def test_a_wrong_wish_for_status_is_said(start: Start) -> None:
    running = start()
    refused = running.status("--status=xml")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == "flotilla-param: --status=xml: there is --status and --status=json\n"
    assert running.status("--status", "other").returncode == 2


LIMITED = """
  speed: {type: limit, in: {in: a.out}, parameters: {min: 0, max: 0.5}, bounds: {max: [0, 0.8]}}
  turn: {type: limit, in: {in: a.out}, parameters: {min: 0, max: 0.5}}
"""


def test_limits_of_safety_are_set_within_bounds_and_confirmed(flotilla_run: Path, tmp_path: Path) -> None:
    """Before there were bounds, one command set `speed.max` to 1e9."""
    running = Running(flotilla_run, tmp_path, more=LIMITED)
    try:
        listed = running.param().stdout
        assert "speed.max: 0.5, tunable, 0 to 0.8\n" in listed
        assert "turn.max: 0.5\n" in listed
        for words, said in (
            (("speed.max", "0.7"), "speed.max is a limit of safety: 0.5 → 0.7; confirm it"),
            (("--confirm", "0.4", "task", "speed.max", "0.7"), "0.5 → 0.7; confirm it"),
            (("speed.max", "1e9"), "block speed: parameter max: 1e9 is outside 0 to 0.8, its bounds in the task file"),
            (("--confirm", "0.5", "task", "speed.max", "1e9"), "1e9 is outside 0 to 0.8"),
            (
                ("turn.max", "0.4"),
                "block turn: parameter max is a limit of safety, and the task file gives it no bounds",
            ),
        ):
            refused = asked(running, words)
            assert (refused.returncode, said in refused.stderr) == (1, True), refused.stderr
        assert running.param("speed.max").stdout == "0.5\n"
        done = asked(running, ("--confirm", "0.5", "task", "speed.max", "0.7"))
        assert done.returncode == 0, done.stderr
        assert "speed.max: 0.5 → 0.7 from step" in done.stdout
        assert running.param("speed.max").stdout == "0.7\n"
    finally:
        running.process.send_signal(signal.SIGTERM)
        _, logged = running.process.communicate(timeout=SECONDS)
    assert re.search(rf"^flotilla: \S+: user {os.getuid()}: speed\.max: 0\.5 → 0\.7 from step", logged, re.M)


def asked(running: Running, words: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    """Of flotilla-param; `--confirm` comes before the task."""
    if words[0] != "--confirm":
        return running.param(*words)
    argv = [str(running.program.with_name("flotilla-param")), "--control", str(running.control), *words]
    return subprocess.run(argv, capture_output=True, text=True, timeout=SECONDS, check=False)


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ("{top: [0, 1]}", "block speed: bounds: limit has no parameter top"),
        ("{initial: [0, 1]}", "block speed: bounds: initial is no number that can be set while the task runs"),
        ("{max: [1, 0]}", "block speed: bounds: max: is not a list of the least and the greatest value"),
        ("{max: 1}", "block speed: bounds: max: is not a list of the least and the greatest value"),
    ],
)
def test_bounds_that_are_none(flotilla_run: Path, tmp_path: Path, bounds: str, said: str) -> None:
    file = tmp_path / "task.yml"
    more = f"  speed: {{type: limit, in: {{in: a.out}}, parameters: {{min: 0, max: 0.5}}, bounds: {bounds}}}"
    file.write_text(TASK.format(**USUAL | {"more": more}))
    done = subprocess.run([flotilla_run, "--check", file], capture_output=True, text=True, check=False)
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr
