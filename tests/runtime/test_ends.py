"""Ends of every kind: blocks that misbehave, signals, crashes, tasks that were killed. Outputs are reset after each."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.running import PATIENCE, free_port
from tests.runtime.tasks import HEADERS, PATIENT, PLUGIN, TRACE, Tasks, check_reset, compile_shared, task

pytestmark = pytest.mark.clock


@dataclass(frozen=True)
class Bad:
    """A manner of misbehaviour and what must follow."""

    manner: str
    head: str
    said: str


BAD = [
    Bad("manner: fail, from: 3", "period: 1 ms", "bad: failed as asked in step 3"),
    Bad("manner: start-fail", "period: 1 ms", "bad: the device is on fire"),
    Bad("manner: hang, from: 3", "period: 1 ms", "s, after step 3; outputs are in their reset state"),
    Bad("manner: late, from: 3", "period: 10 ms\noverrun: stop-safe", "us after the next was due, 1 in a row"),
    Bad("manner: late, from: 3", "period: 10 ms\noverruns: 4", "us after the next was due, 4 in a row"),
    Bad("manner: late, from: 3", "period: 10 ms\noverrun: catch-up\noverruns: 4", "4 in a row"),
]


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: f"{bad.manner}, {bad.head}".replace("\n", ", "))
def test_what_a_block_does_wrong_ends_with_outputs_reset(tasks: Tasks, tmp_path: Path, bad: Bad) -> None:
    """Seen to fail without the call of `safe` after the loop, and the hang without the supervision's time limit."""
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + f"bad: {{type: misbehave, parameters: {{{bad.manner}}}}}", bad.head)
    ended = tasks.run(text)
    assert bad.said in ended.err
    if "start" in bad.manner:
        assert ended.status == 4
        assert "outputs of out are in their reset state, but OUTPUTS MAY NOT BE" in ended.err
        assert "IN THEIR RESET STATE: bad (its start failed)\n" in ended.err
    else:
        assert ended.status == 1
        assert "outputs are in their reset state\n" in ended.err
    words = device.read_text().split()
    assert words.count("on") == (0 if "start" in bad.manner else words.index("safe"))
    assert words[-1] == ("safe" if "hang" in bad.manner else "terminated")


def test_a_block_that_does_not_terminate_is_named_and_the_process_ends(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: the process stayed for ever, unless a service manager killed it."""
    out = f"out: {{type: trace, parameters: {{device: {tmp_path / 'device'}}}}}\n"
    ended = tasks.run(task(out + "bad: {type: misbehave, parameters: {manner: terminate-hang}}"), "--steps", "3")
    assert ended.status == 1
    assert "flotilla: bad does not end; outputs are in their reset state\n" in ended.err


def test_a_hang_ends_within_the_shortest_time_out_of_the_actuators(tasks: Tasks, tmp_path: Path) -> None:
    """A second thread counts the second that a hang lasted on at least. Seen to fail: `second` before `safe`."""
    device = tmp_path / "device"
    ended = tasks.run(
        task(
            f"""
witness: {{type: witness, parameters: {{file: {device}, from: 3}}}}
slow: {{type: trace, parameters: {{device: {tmp_path / "slow"}, timeout: 60}}}}
quick: {{type: trace, parameters: {{device: {device}, timeout: 0.1}}}}
bad: {{type: misbehave, parameters: {{manner: hang, from: 3}}}}
""",
            "period: 10 ms\noverruns: 0",
        )
    )
    assert ended.status == 1
    assert device.read_text().split() == ["on"] * 4 + ["safe"]
    assert (tmp_path / "slow").read_text().split() == ["on"] * 4 + ["safe"]


def test_a_time_out_shorter_than_some_periods_allows_late_steps(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail with the time-out alone as the limit."""
    device = tmp_path / "device"
    out = f"out: {{type: trace, parameters: {{device: {device}, timeout: 0.001}}}}\n"
    late = "bad: {type: misbehave, parameters: {manner: late, from: 1, until: 2, late_s: 1}}"
    ended = tasks.run(task(out + late, "period: 500 ms"), "--steps", "3")
    assert ended.status == 0, ended.err
    assert device.read_text().split() == ["on"] * 3 + ["safe", "terminated"]


def test_an_actuators_time_out_is_a_number(tasks: Tasks, tmp_path: Path) -> None:
    source = (PLUGIN / "misbehave.c").read_text().replace("    double timeout;", "    int64_t timeout;")
    (tmp_path / "wrong.c").write_text(source)
    compile_shared(tmp_path / "wrong.c", tmp_path / "wrong.so", f"-I{HEADERS}")
    lines = Tasks(tasks.program, tmp_path, tmp_path).refusal(task("a: {type: trace, parameters: {device: /dev/x}}"))
    assert "block trace: an actuator's time-out is not a double" in lines[0]


ASKING = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP}
FATAL = {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS, signal.SIGTRAP}
HARMLESS = {signal.SIGPIPE, signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH}
SIGNALS = {number for number in signal.valid_signals() if number < signal.SIGRTMIN} | {
    signal.SIGRTMIN, signal.SIGRTMIN + 1, signal.SIGRTMAX,
}  # fmt: skip


@pytest.mark.parametrize("number", sorted(SIGNALS - {signal.SIGKILL, signal.SIGSTOP} - HARMLESS))
def test_each_signal_that_ends_it_does_so_with_outputs_reset(
    running: Callable[[str], subprocess.Popen[str]], tmp_path: Path, number: int
) -> None:
    """SIGKILL and SIGSTOP cannot be caught. Seen to fail for all but TERM, INT and HUP: outputs stayed on."""
    device = tmp_path / "device"
    process = running(task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT))
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    check_reset(device)
    if number in FATAL | {signal.SIGRTMIN}:  # its status says so, and a core is left where one is wanted
        assert process.returncode == -number
    elif number in ASKING:
        assert process.returncode == 0
    else:
        assert (process.returncode, f"signal {number}" in err) == (1, True)


def test_other_signals_do_not_end_it(running: Callable[[str], subprocess.Popen[str]], tmp_path: Path) -> None:
    """A reader that is gone is noticed where something is printed for it, below."""
    device = tmp_path / "device"
    process = running(task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT))
    for number in HARMLESS:
        process.send_signal(number)
    assert process.stdout
    before = json.loads(process.stdout.readline())["step"]
    while json.loads(process.stdout.readline())["step"] < before + 100:
        assert process.poll() is None
    assert set(device.read_text().split()) == {"on"}


def test_a_reader_that_is_gone_ends_it_with_outputs_reset(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: SIGPIPE left the outputs on, status -13."""
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT)
    argv = tasks.argv(text, "--watch", "a.out")
    with subprocess.Popen(argv, stdout=subprocess.PIPE) as process:
        head = subprocess.run(["head", "-3"], stdin=process.stdout, capture_output=True, text=True, check=True)
        assert process.stdout
        process.stdout.close()
        assert process.wait(60) == 0
    assert [json.loads(line)["step"] for line in head.stdout.splitlines()] == [0, 1, 2]
    check_reset(device)


CRASHES = {
    "fault": -signal.SIGSEGV, "abort": -signal.SIGABRT, "exit": 1, "overflow": -signal.SIGSEGV,
    "thread-fault": -signal.SIGSEGV, "thread-exit": 1, "safe-fault": -signal.SIGSEGV, "safe-hang": 4,
}  # fmt: skip


@pytest.mark.parametrize(("manner", "status"), CRASHES.items())
def test_a_block_that_ends_the_process_leaves_outputs_reset(
    tasks: Tasks, tmp_path: Path, manner: str, status: int
) -> None:
    """`safe` runs from the last block to the first. One that crashes there keeps no other block from its own, one that
    hangs no process alive. Seen to fail in all cases: outputs stayed on. Then, but for exit(), without a word."""
    device = tmp_path / "device"
    bad = f"bad: {{type: misbehave, parameters: {{manner: {manner}, from: 3}}}}\n"
    blocks = (bad + TRACE.format(file=device)) if manner == "safe-hang" else (TRACE.format(file=device) + bad)
    ended = tasks.run(task(blocks, PATIENT))
    assert ended.status == status, ended.err
    check_reset(device)
    assert ("a block has called exit()" in ended.err) == manner.endswith("exit")
    crash = {"abort": "SIGABRT"}.get(manner, "SIGSEGV") if status < 0 else "nothing"
    who = "thread bad" if manner.startswith("thread") else "block bad"
    said = re.search(rf"^flotilla: {who}: {crash} at address 0x\w+, in (\S+)\+0x[0-9a-f]+", ended.err, re.M)
    assert bool(said) == (status < 0), ended.err
    assert not said or said[1] == ("misbehave.so" if crash == "SIGSEGV" else "libc.so.6")


@pytest.mark.parametrize(("manner", "ends"), [("safe-not", False), ("safe-not, from: 1000000000", True)])
def test_outputs_that_could_not_be_reset_are_said(tasks: Tasks, tmp_path: Path, manner: str, ends: bool) -> None:
    """Also where the task ends as it was asked to. Seen to fail: "outputs are in their reset state", status 1 and 0."""
    bad = f"bad: {{type: misbehave, parameters: {{manner: {manner}}}}}\n"
    ended = tasks.run(task(TRACE.format(file=tmp_path / "device") + bad, PATIENT), "--steps", "10")
    assert ended.status == 4
    assert ended.err.endswith(
        "outputs of out are in their reset state, but OUTPUTS MAY NOT BE IN THEIR RESET STATE: bad (the bus is down)\n"
    )
    assert ("all steps are done" in ended.err) == ends


def test_an_actuator_that_another_task_has_is_not_said_to_be_reset(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: "outputs are in their reset state" while the other task went on to drive them."""
    first = tasks.argv(task(TRACE.format(file=tmp_path / "device") + "a: {type: gain, in: {in: 1}}", PATIENT))
    with subprocess.Popen([*first, "--watch", "a.out"], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout
            assert process.stdout.readline()
            other = tmp_path / "other"
            other.mkdir()
            later = "later: {{type: trace, parameters: {{device: {file}}}}}\n".format(file=tmp_path / "free")
            text = task(TRACE.format(file=tmp_path / "device") + later, PATIENT)
            for options in ((), ("--safe",)):
                ended = Tasks(tasks.program, tasks.plugins, other).run(text, *options)
                assert ended.status == 4
                assert "out: device" in ended.err
                assert "OUTPUTS MAY NOT BE IN THEIR RESET STATE: out (its start failed)" in ended.err
                assert ("later (it was not started)" in ended.err) == (not options)
        finally:
            process.kill()
    assert "safe" not in (tmp_path / "device").read_text().split()


def test_no_step_follows_when_a_late_one_was_given_up(tasks: Tasks, tmp_path: Path) -> None:
    """Nobody reads stderr, and the step ends after all. Seen to fail: `on` after `safe`, and the process lived on."""
    device = tmp_path / "device"
    bad = "bad: {type: misbehave, parameters: {manner: late, from: 3, until: 4, late_s: 5}}\n"
    text = task(bad + TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT)
    unread, full = os.pipe()
    with subprocess.Popen(tasks.argv(text, "--watch", "a.out"), stdout=subprocess.PIPE, stderr=full) as process:
        assert process.stdout
        assert process.stdout.readline()
        flags = fcntl.fcntl(full, fcntl.F_GETFL)
        fcntl.fcntl(full, fcntl.F_SETFL, flags | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(full, bytes(1))
        fcntl.fcntl(full, fcntl.F_SETFL, flags)
        try:
            assert process.wait(60) == 1
        finally:
            process.kill()
            os.close(unread)
            os.close(full)
    check_reset(device)


HEARD = "heard: {{type: udp-receive, parameters: {{port: {port}, length: 1, timeout: 3600}}}}"


def test_a_task_that_waits_for_hours_ends_when_it_is_asked_to(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail where the thread sleeps until its next step: the service manager's patience is two seconds."""
    device = tmp_path / "device"
    waiting = {
        "a step": task(TRACE.format(file=device), "period: 3600 s"),
        "a trigger": task(
            TRACE.format(file=device) + HEARD.format(port=free_port()),
            "period: 3000 s\ntrigger: heard",
        ),
    }
    for text in waiting.values():
        with listening(tmp_path / "notify") as told:
            process = subprocess.Popen(tasks.argv(text), env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")})
            try:
                while b"READY=1" not in told.recv(4096):
                    pass
                process.send_signal(signal.SIGTERM)
                assert process.wait(PATIENCE) == 0
            finally:
                process.kill()
                process.wait()
        assert device.read_text().split()[-2:] == ["safe", "terminated"]
        assert "on" not in device.read_text().split()


def test_a_task_says_that_it_is_alive_for_as_long_as_its_next_step_may_take(tasks: Tasks, tmp_path: Path) -> None:
    """The first step comes up to three periods after the start when the trigger is silent.

    Seen to fail where a task is alive for one period after its start or its last step.
    """
    period = 0.5
    argv = tasks.argv(
        task(HEARD.format(port=free_port()), f"period: {period} s\ntrigger: heard"), "--watch", "heard.flag"
    )
    environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "50000"}
    with listening(tmp_path / "notify") as told, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as rows:
        rows.connect(str(tmp_path / "notify"))  # rows and words in one order: one thread says both
        process = subprocess.Popen(argv, env=environment, stdout=rows.fileno())
        try:
            started, said = time.monotonic(), b""
            while b"READY=1" not in said:
                said = told.recv(4096)
                started = time.monotonic()
            while b"WATCHDOG=1" not in said or time.monotonic() < started + 1.4 * period:
                assert b"heard.flag" not in said, "it is silent before its first step"
                said = told.recv(4096)
        finally:
            process.kill()
            process.wait()


@contextmanager
def listening(path: Path) -> Iterator[socket.socket]:
    """Where a task says how it is, as to the service manager."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(path))
        told.settimeout(PATIENCE)
        yield told
    path.unlink()


def test_a_second_start_is_refused_and_a_killed_one_leaves_no_lock(
    tasks: Tasks, running: Callable[[str], subprocess.Popen[str]]
) -> None:
    text = task("a: {type: gain, in: {in: 1}}")
    first = running(text)
    again = tasks.run(text, "--steps", "1")
    assert again.status == 3
    assert f"runs already, as process {first.pid}; end that first" in again.err
    first.kill()
    first.wait()
    assert tasks.run(text, "--steps", "1").status == 0


def test_outputs_are_reset_after_a_task_was_killed(
    tasks: Tasks, running: Callable[[str], subprocess.Popen[str]], tmp_path: Path
) -> None:
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}")
    process = running(text)
    process.kill()
    process.wait()
    assert device.read_text().split()[-1] == "on"
    assert tasks.run(text, "--safe").status == 0
    assert device.read_text().split()[-2:] == ["safe", "terminated"]


def test_one_task_moves_an_actuator(
    tasks: Tasks, running: Callable[[str], subprocess.Popen[str]], tmp_path: Path
) -> None:
    """Neither another task nor `--safe` touches it meanwhile; a task that was killed holds nothing. Seen to fail: both
    did."""
    device = tmp_path / "device"
    text = task(TRACE.format(file=device) + "a: {type: gain, in: {in: 1}}", PATIENT)
    first = running(text)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "link").symlink_to(device)
    other = Tasks(tasks.program, tasks.plugins, tmp_path / "other")
    held = f"held by process {first.pid} ({tasks.program} --blocks"
    for path in (device, tmp_path / "other" / "link"):
        for options in ([], ["--safe"]):
            ended = other.run(task(TRACE.format(file=path)), *options)
            assert ended.status == 4
            assert f'device "{path}" is {held}' in ended.err
    assert set(device.read_text().split()) == {"on"}
    first.kill()
    first.wait()
    assert other.run(task(TRACE.format(file=device)), "--safe").status == 0
    assert other.run(task(TRACE.format(file=device)), "--steps", "1").status == 0
    assert device.read_text().split()[-5:] == ["safe", "terminated", "on", "safe", "terminated"]


def test_outputs_are_reset_where_nobody_hears_of_a_failure(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail: the first message ended the process (SIGPIPE), and the second block stayed as it was."""
    device = tmp_path / "device"
    bad = "bad: {type: misbehave, parameters: {manner: start-fail}}\n"
    unread, broken = os.pipe()
    os.close(unread)
    argv = tasks.argv(task(bad + TRACE.format(file=device)), "--safe")
    status = subprocess.run(argv, stderr=broken, timeout=60, check=False).returncode
    os.close(broken)
    assert (status, device.read_text().split()) == (4, ["safe", "terminated"])


def lines_of(tasks: Tasks, text: str, *options: str, journal: bool = True) -> list[str]:
    """What the task writes to a stream that it is told, or not, to be the journal (systemd.exec(5), sd-daemon(3))."""
    read, write = os.pipe()
    with os.fdopen(read, encoding="utf-8") as lines:
        stream = os.fstat(write)
        told = {"JOURNAL_STREAM": f"{stream.st_dev}:{stream.st_ino if journal else 1}"}
        subprocess.run(tasks.argv(text, *options), stderr=write, env={**os.environ, **told}, timeout=60, check=False)
        os.close(write)
        return lines.readlines()


@pytest.mark.parametrize(
    ("block", "options", "start"),
    [
        ("{type: misbehave, parameters: {manner: fail}}", (), "<3>flotilla: "),
        ("{type: misbehave, parameters: {manner: fault}}", (), "<3>flotilla: block a: SIGSEGV "),
        ("{type: misbehave, parameters: {manner: exit}}", (), "<3>flotilla: a block has called exit(); "),
        ("{type: none}", (), "<3>"),
        ("{type: urg, parameters: {device: /dev/none}}", ("--steps", "1"), "<4>a: cannot open /dev/none: "),
    ],
)
def test_lines_of_the_journal_have_their_priority(
    tasks: Tasks, block: str, options: tuple[str, ...], start: str
) -> None:
    """None elsewhere. Seen to fail: no line had one, so that all were information."""
    text = task("a: " + block)
    (line,) = lines_of(tasks, text, *options)
    assert line.startswith(start)
    assert lines_of(tasks, text, *options, journal=False) == [line[3:]]
