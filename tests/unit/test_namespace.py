"""Stages in namespaces: what they leave behind, and what is said where the host forbids them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import namespace
from flotilla.common.errors import UserError


def _mounts() -> str:
    return Path("/proc/self/mounts").read_text()


def test_mounts_of_a_stage_are_its_own() -> None:
    before = _mounts()
    script = "mount -t tmpfs none /mnt && grep -c ' /mnt ' /proc/self/mounts"
    done = subprocess.run([*namespace.prefix(), "sh", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "1"
    assert _mounts() == before


def test_a_killed_builder_takes_its_stage_along(tmp_path: Path) -> None:
    """The builder is killed so that it cannot clean up; the stage's end of a pipe tells that all of it is gone."""
    read, write = os.pipe()
    code = (
        "import subprocess, sys\nfrom flotilla.common import namespace\n"
        "stage = [*namespace.prefix(), 'sh', '-c', 'echo started; sleep 600 & wait']\n"
        "subprocess.run(stage, pass_fds=[int(sys.argv[1])])\n"
    )
    builder = subprocess.Popen(
        [sys.executable, "-c", code, str(write)],
        pass_fds=[write],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[2],
    )
    os.close(write)
    assert builder.stdout is not None
    assert builder.stdout.readline() == b"started\n"
    builder.send_signal(signal.SIGKILL)
    builder.wait()
    assert os.read(read, 1) == b"", "the pipe is closed by the last process of the stage"
    os.close(read)
    builder.stdout.close()


def test_the_end_of_the_log_is_shown_when_a_stage_fails(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no_such_stage failed \(status 1\).*\n.*No module named"):
        namespace.run_stage("images.builder.no_such_stage", [], tmp_path / "log")


REFUSED = """
import os
from flotilla.common import namespace
from flotilla.common.errors import UserError
os.geteuid = lambda: 1000
try:
    namespace.check()
except UserError as error:
    print(error)
print(os.waitstatus_to_exitcode(os.waitpid(-1, 0)[1]))
"""
"""As process 1, which inherits what unshare(1) left behind."""


def test_a_refused_user_namespace_is_said_and_nothing_stays_behind(tmp_path: Path) -> None:
    """In a user namespace that allows none below it. A user without a range gets no farther than that."""
    (tmp_path / "ranges").write_text("root:100000:65536\n")
    script = (
        'mount --bind "$1" /etc/subuid; mount --bind "$1" /etc/subgid; echo 0 >/proc/sys/user/max_user_namespaces; '
        'exec "$2" -c "$3"'
    )
    world = ["unshare", "--user", "--map-root-user", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
    done = subprocess.run(
        [*world, "sh", "-ec", script, "sh", tmp_path / "ranges", sys.executable, REFUSED],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "/proc/sys/user/max_user_namespaces: 0: this computer forbids user namespaces" in done.stdout
    assert done.stdout.splitlines()[-1] == f"-{signal.SIGKILL.value}"


@pytest.mark.parametrize(
    "stderr",
    [
        "unshare: write failed /proc/self/uid_map: Operation not permitted",
        "unshare: cannot change root filesystem propagation: Permission denied",
        "mount: /mnt: permission denied.\n       dmesg(1) may have more information after failed mount system call.",
    ],
)
def test_a_forbidden_user_namespace_names_the_setting(monkeypatch: pytest.MonkeyPatch, stderr: str) -> None:
    """Of Ubuntu 24.04's AppArmor, which lets a namespace be made and then takes its privileges."""
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    real = Path.read_text
    monkeypatch.setattr(Path, "exists", lambda path: "apparmor_restrict" in str(path))
    monkeypatch.setattr(Path, "read_text", lambda path, *rest: "1\n" if "apparmor" in str(path) else real(path, *rest))
    message = str(namespace._refusal(stderr))
    assert "apparmor_restrict_unprivileged_userns: 1: this computer forbids user namespaces" in message
    assert "sudo sysctl kernel.apparmor_restrict_unprivileged_userns=0" in message
    assert "sudo make image" in message


def test_a_user_without_a_range_is_told_how_to_get_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setenv("USER", "ada")
    message = str(namespace._refusal("newuidmap: uid range [1-65536) -> [100000-165535) not allowed"))
    assert message.startswith("/etc/subuid: no range for ada")
    assert "--add-subuids" in message


def test_errors_are_shown_though_many_warnings_follow() -> None:
    """Seen to fail: of a log, its last 30 lines were shown, which were warnings."""
    warnings = [f"b.c:{n}:1: warning: unused variable 'x{n}'" for n in range(200)]
    log = ["gcc -c", "a.c:3:2: error: unknown type name 'wheel'", "  wheel x;", *warnings, "make: *** [all] Error 1"]
    assert namespace.telling("\n".join(log)).splitlines() == [log[1], "…", *log[-30:]]
    assert namespace.telling("\n".join(log[:20])).splitlines() == log[:20]


CHECK = """
from flotilla.common import namespace
from flotilla.common.errors import UserError
try:
    namespace.check()
except UserError as error:
    print(error)
"""


@pytest.mark.parametrize("name", [*namespace._CAPABILITIES, ""])
def test_root_without_a_capability_is_told_which(name: str) -> None:
    """Seen to fail: without CAP_SETFCAP, an image was made whose ping is set-user-ID. In a user namespace, so that
    ordinary users' tests have a root to take something from; that of root itself is no other."""
    dropped = name.removeprefix("CAP_").lower()
    less = ["setpriv", f"--bounding-set=-{dropped}", f"--inh-caps=-{dropped}", "--"] if name else []
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", *less, sys.executable, "-c", CHECK],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.count("CAP_") == bool(name)
    if name:
        assert f"root has no {name} (" in done.stdout
        assert f"docker run --cap-add={name.removeprefix('CAP_')} " in done.stdout
