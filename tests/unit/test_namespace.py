"""Stages in namespaces: what they leave behind, and what is said where the host forbids them."""

from __future__ import annotations

import os
import pwd
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from flotilla.common import namespace, sandbox
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
        namespace.run_stage("flotilla.debian.no_such_stage", [], tmp_path / "log")


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
    assert "user.max_user_namespaces=10000 | sudo tee" in done.stdout
    assert done.stdout.splitlines()[-1] == f"-{signal.SIGKILL.value}"


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A computer of an ordinary user that forbids nothing: its /proc, /etc, newuidmap and marks of containers."""
    for name, text in {
        "proc/self/ns/user": "",
        "proc/self/status": "NoNewPrivs:\t0\n",
        "etc/subuid": "bob:100000:65536\n1000:165536:65536\n",
        "etc/subgid": "bob:100000:65536\n1000:165536:65536\n",
        "bin/newuidmap": "",
        "bin/newgidmap": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for name in ("newuidmap", "newgidmap"):
        (tmp_path / "bin" / name).chmod(0o4755)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(pwd, "getpwall", list)
    monkeypatch.setattr(namespace, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(namespace, "_ETC", tmp_path / "etc")
    monkeypatch.setattr(namespace, "_CONTAINERS", (tmp_path / ".dockerenv",))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    return tmp_path


DENIED = "unshare: write failed /proc/self/uid_map: Operation not permitted"
NO_RANGE = "newuidmap: uid range [1-65536) -> [100000-165535) not allowed"
_CAUSES: dict[str, tuple[str, dict[str, str | None], list[str]]] = {
    "switched off by Debian's setting": (
        "unshare: unshare failed: Operation not permitted",
        {"proc/sys/kernel/unprivileged_userns_clone": "0\n"},
        ["unprivileged_userns_clone: 0: this computer forbids user namespaces",
         "`echo kernel.unprivileged_userns_clone=1 | sudo tee -a /etc/sysctl.d/60-flotilla.conf && sudo sysctl -p "],
    ),
    "switched off in a container": (
        "unshare: unshare failed: No space left on device",
        {"proc/sys/user/max_user_namespaces": "0\n", ".dockerenv": ""},
        ["max_user_namespaces: 0: this computer forbids user namespaces",
         "on the computer that runs this container, allow them with `echo user.max_user_namespaces=10000 | "],
    ),
    # Of Ubuntu 24.04's AppArmor, which lets a namespace be made and then takes its privileges.
    **{
        f"restricted by AppArmor, {n}": (
            stderr,
            {"proc/sys/kernel/apparmor_restrict_unprivileged_userns": "1\n"},
            ["apparmor_restrict_unprivileged_userns: 1: this computer forbids user namespaces",
             "`echo kernel.apparmor_restrict_unprivileged_userns=0 | sudo tee "],
        )
        for n, stderr in enumerate([
            DENIED,
            "unshare: cannot change root filesystem propagation: Permission denied",
            "mount: /mnt: permission denied.\n       dmesg(1) may have more information after failed system call.",
        ])
    },
    "no range": (
        NO_RANGE,
        {"etc/subuid": "bob:100000:65536\n", "etc/subgid": "bob:100000:65536\n"},
        ["etc/subuid, ", "etc/subgid: no range of 65536 for 1000",
         "`sudo usermod --add-subuids 165536-231071 --add-subgids 165536-231071 1000`"],
    ),
    "no range of groups": (
        "newgidmap: gid range [1-65536) -> [100000-165535) not allowed",
        {"etc/subgid": ""},
        ["etc/subgid: no range of 65536", "--add-subgids 231072-296607 1000`"],
    ),
    "a short range": (NO_RANGE, {"etc/subuid": "1000:100000:1000\n"}, ["etc/subuid: no range of 65536 for 1000"]),
    "no files of ranges": (
        "unshare: no line matching user \"ada\" in /etc/subuid",
        {"etc/subuid": None, "etc/subgid": None},
        ["no range of 65536", "--add-subuids 100000-165535 "],
    ),
    "no new privileges": (
        "newuidmap: write to uid_map failed: Operation not permitted",
        {"proc/self/status": "NoNewPrivs:\t1\n"},
        ["no program may gain privileges here (no_new_privs)", "`--security-opt no-new-privileges`"],
    ),
    "newuidmap without privilege": (
        "newuidmap: write to uid_map failed: Operation not permitted",
        {"bin/newuidmap": "no privileges"},
        ["newuidmap: has neither the set-user-ID bit nor capabilities", "`sudo apt-get install --reinstall uidmap`"],
    ),
    "a kernel without": (
        "unshare: unshare failed: Invalid argument",
        {"proc/self/ns/user": None},
        ["this kernel has no user namespaces (CONFIG_USER_NS)"],
    ),
    "a container": (
        "unshare: unshare failed: Operation not permitted",
        {".dockerenv": ""},
        ["this container forbids them; start it with `docker run --security-opt seccomp=unconfined "],
    ),
    "unknown": ("unshare: unshare failed: Operation not permitted", {}, ["build on a computer, or in a virtual "]),
}  # fmt: skip
"""By what forbids namespaces: what a program writes then, files of the computer, and parts of the message."""


@pytest.mark.parametrize("case", _CAUSES)
def test_a_refused_namespace_has_the_remedy_of_its_cause(host: Path, case: str) -> None:
    """Seen to fail: each message offered to build as root through sudo, for half of the causes it had nothing else, and
    the range was one that others had."""
    stderr, files, parts = _CAUSES[case]
    for name, text in files.items():
        (host / name).parent.mkdir(parents=True, exist_ok=True)
        (host / name).unlink() if text is None else (host / name).write_text(text)
        if name.startswith("bin/"):
            (host / name).chmod(0o755)
    message = str(namespace._refusal(stderr))
    assert message.startswith(f"this computer refuses a mount namespace: {stderr.strip()}; ")
    assert [part for part in parts if part not in message] == [], message
    assert "as root" not in message


def test_a_refused_sandbox_has_the_same_remedies(host: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail: it was to install bubblewrap, which was there. Root's sandbox has a user namespace, too."""
    (host / "proc/sys/user").mkdir(parents=True)
    (host / "proc/sys/user/max_user_namespaces").write_text("0\n")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    said = sandbox.refusal("bwrap: Creating new namespace failed: No space left on device\n", sandbox.CHECK)
    assert "sudo tee -a /etc/sysctl.d/60-flotilla.conf" in str(said)
    assert "apt-get install --no-install-recommends bubblewrap" in str(
        sandbox.refusal("bwrap: is missing\n", sandbox.CHECK)
    )


def test_errors_are_shown_though_many_warnings_follow() -> None:
    """Seen to fail: of a log, its last 30 lines were shown, which were warnings."""
    warnings = [f"b.c:{n}:1: warning: unused variable 'x{n}'" for n in range(200)]
    log = ["gcc -c", "a.c:3:2: error: unknown type name 'wheel'", "  wheel x;", *warnings, "make: *** [all] Error 1"]
    assert namespace.telling("\n".join(log)).splitlines() == [log[1], "…", *log[-30:]]
    assert namespace.telling("\n".join(log[:20])).splitlines() == log[:20]


@pytest.mark.parametrize("size", [0, 10, namespace._LOG_BYTES, namespace._LOG_BYTES + 5, 2 * namespace._LOG_BYTES])
def test_a_log_is_read_once_as_it_is(tmp_path: Path, size: int) -> None:
    content = (b"0123456789" * (size // 10 + 1))[:size]
    (tmp_path / "log").write_bytes(content)
    assert namespace.log_text(tmp_path / "log").encode() == content


def test_a_log_without_end_takes_little_memory(tmp_path: Path) -> None:
    """Seen to fail: a MemoryError, because all of it was read."""
    with (tmp_path / "log").open("wb") as log:
        log.write(b"a.c:1:1: error: unknown type name 'wheel'\n")
        log.seek(1 << 40)
        log.write(b"\nmake: *** [all] Error 1\n")
    text = namespace.log_text(tmp_path / "log")
    assert len(text) <= 2 * namespace._LOG_BYTES + 1
    said = namespace.telling(text).splitlines()
    assert said[0].endswith("unknown type name 'wheel'")
    assert said[-1] == "make: *** [all] Error 1"


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
