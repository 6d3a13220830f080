"""The shell of root on a robot that scripts share, with one of this computer in its place."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator

import pytest

from flotilla.fleet.model import Fleet
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import Expired, LabError


@pytest.fixture
def shell(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ssh]:
    monkeypatch.setattr(
        Ssh, "start",
        lambda *_: subprocess.Popen(["sh"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True),
    )  # fmt: skip
    with Ssh(fleet.robots[1], "localhost") as ssh:
        yield ssh


def test_a_script_says_what_it_said(shell: Ssh) -> None:
    for text, said in (
        ("echo one; echo 'two'\"'\"", "one\ntwo'\n"),
        ("printf no-end", "no-end"),
        (":", ""),
        ("cat", ""),
    ):
        assert shell.script(text).stdout == said
    long = "x" * 300_000
    assert shell.script(f"printf {long[:100_000]}; head -c 200000 /dev/zero | tr '\\0' x").stdout == long


def test_the_next_script_finds_nothing_of_the_one_before(shell: Ssh) -> None:
    shell.script("cd /; some=1; exec 3>&-; umask 777")
    assert shell.script("echo $some $PWD").stdout.strip() != "1 /"
    with pytest.raises(LabError, match=r"status 2"):
        shell.script("if then (")
    assert shell.script("echo there").stdout == "there\n"


def test_errors_and_status_are_told_apart(shell: Ssh) -> None:
    done = shell.script("echo out; echo err >&2; exit 7", check=False)
    assert (done.returncode, done.stdout, done.stderr) == (7, "out\n", "err")
    with pytest.raises(LabError, match=r"exit 7: status 7\nout\nerr"):
        shell.script("echo out; echo err >&2; exit 7")


def test_a_script_without_an_end_is_left_and_the_next_one_runs(shell: Ssh) -> None:
    with pytest.raises(Expired, match=r"no end within 0\.5 s\nbegun"):
        shell.script("echo begun; exec sleep 60", timeout=0.5)
    assert shell.script("echo there").stdout == "there\n"


def test_a_shell_that_ended_is_noticed(shell: Ssh) -> None:
    with pytest.raises(LabError, match="the connection ended"):
        shell.script("kill -9 $PPID; sleep 1")
    assert shell.script("echo there").stdout == "there\n"
