"""Run a build stage as root of a world of its own, without being root.

The stage gets its own mount, process and (for ordinary users) user namespace. Whatever it mounts and starts ends with
it: when the builder dies, however it dies, the kernel ends the stage and takes its mounts away.
"""

from __future__ import annotations

import os
import pwd
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from flotilla.common import paths, progress, together
from flotilla.common.errors import UserError

_CAPABILITIES = {
    "CAP_CHOWN": (0, "gives files to the users of the image"),
    "CAP_DAC_OVERRIDE": (1, "writes the files of these users"),
    "CAP_FOWNER": (3, "sets the modes of their files"),
    "CAP_FSETID": (4, "keeps set-group-ID bits"),
    "CAP_SETGID": (6, "runs programs of packages as other groups"),
    "CAP_SETUID": (7, "runs them as other users"),
    "CAP_SYS_CHROOT": (18, "runs the locked tools in their tree"),
    "CAP_SYS_ADMIN": (21, "mounts, in namespaces of its own"),
    "CAP_SETFCAP": (31, "gives programs capabilities, such as ping's, which is set-user-ID without"),
}
"""What a stage needs of root: the numbers (linux/capability.h), and what a build does with each."""


ERROR = re.compile(r"(^|[\s:])(fatal )?error:|undefined reference to|\*\*\* \[")
"""What compilers, linkers and make write in a line that says why they failed."""
_TAIL = 30
"""Lines of a log that an error shows."""
_LOG_BYTES = 4 << 20
"""Of the beginning of a log, and of its end, where errors are looked for."""


def missing_capabilities(status: str) -> list[str]:
    """Those that a process has not, by its /proc/PID/status."""
    effective = int(re.findall(r"^CapEff:\s*([0-9a-f]+)$", status, re.MULTILINE)[0], 16)
    return [f"{name} ({what})" for name, (number, what) in _CAPABILITIES.items() if not effective >> number & 1]


def _check_capabilities() -> None:
    """Root of a container, or of a service, may have few: packages are then installed otherwise, and nothing fails."""
    # Of a program that root starts, whatever this one gave up.
    status = subprocess.run(["cat", "/proc/self/status"], capture_output=True, text=True, check=True).stdout
    if missing := missing_capabilities(status):
        options = " ".join(f"--cap-add={each.split()[0].removeprefix('CAP_')}" for each in missing)
        raise UserError(
            f"root has no {', '.join(missing)} here, which building an image needs; give the container these "
            f"capabilities (docker run {options} …), or build as an ordinary user"
        )


_PROC = Path("/proc")
_ETC = Path("/etc")
_CONTAINERS = (Path("/.dockerenv"), Path("/run/.containerenv"), Path("/run/systemd/container"))
"""Files that container managers make: Docker, Podman, systemd-nspawn and LXC."""
_SETTINGS = {
    "kernel.unprivileged_userns_clone": ("0", "1"),
    "user.max_user_namespaces": ("0", "10000"),
    "kernel.apparmor_restrict_unprivileged_userns": ("1", "0"),
}
"""Settings of the kernel: the value that forbids user namespaces, and one that allows them."""
_USERS = 65536
"""Users that a stage of an ordinary user maps."""


def cause(stderr: str, *, user: bool | None = None) -> str:
    """Why this computer does not permit a namespace, with the remedy; empty where the cause is none of the known ones.

    `stderr`: the output of the failed program. `user`: whether root asked for a user namespace, too.
    """
    root = os.geteuid() == 0
    contained = any(file.exists() for file in _CONTAINERS)
    for setting, (forbidding, allowing) in _SETTINGS.items():
        file = _PROC / "sys" / setting.replace(".", "/")
        applies = not root or (user and setting == "user.max_user_namespaces")
        if applies and file.exists() and file.read_text().strip() == forbidding:
            where = "on the computer that runs this container, " if contained else ""
            kept = "/etc/sysctl.d/60-flotilla.conf"
            return (
                f"{file}: {forbidding}: this computer forbids user namespaces, which building needs; {where}"
                f"allow them with `echo {setting}={allowing} | sudo tee -a {kept} && sudo sysctl -p {kept}`"
            )
    mapping = not root and any(word in stderr for word in ("subuid", "subgid", "newuidmap", "newgidmap", "id_map"))
    if mapping and (fault := _missing_range() or _powerless_newuidmap()):
        return fault
    if not (_PROC / "self/ns/user").exists():
        return "this kernel has no user namespaces (CONFIG_USER_NS); build on a computer whose kernel has them"
    if contained:
        return (
            "this container forbids them; start it with `docker run --security-opt seccomp=unconfined --security-opt "
            "apparmor=unconfined --security-opt systempaths=unconfined …`, or with these options of podman"
        )
    return ""


def _missing_range() -> str:
    number = str(os.geteuid())
    name = next((account.pw_name for account in pwd.getpwall() if str(account.pw_uid) == number), number)
    files = [_ETC / "subuid", _ETC / "subgid"]
    ranges = [
        [(who, int(first), int(count)) for who, first, count in re.findall(r"(?m)^([^:\n]+):(\d+):(\d+)$", text)]
        for text in (file.read_text() if file.exists() else "" for file in files)
    ]
    # unshare(1) takes the first one.
    lacking = [
        str(file)
        for file, found in zip(files, ranges, strict=True)
        if next((count for who, _, count in found if who in (name, number)), 0) < _USERS
    ]
    if not lacking:
        return ""
    free = max([100000, *(first + count for found in ranges for _, first, count in found)])
    span = f"{free}-{free + _USERS - 1}"
    return (
        f"{', '.join(lacking)}: no range of {_USERS} for {name}, whom building without root gives as many users; "
        f"add one with `sudo usermod --add-subuids {span} --add-subgids {span} {name}`"
    )


def _powerless_newuidmap() -> str:
    """Why it cannot map users though there is a range."""
    if re.search(r"^NoNewPrivs:\s*1$", (_PROC / "self/status").read_text(), re.MULTILINE):
        return (
            "no program may gain privileges here (no_new_privs), so newuidmap maps no users; build outside of the "
            "sandbox that this shell is in, or start the container without `--security-opt no-new-privileges`"
        )
    for program in ("newuidmap", "newgidmap"):
        file = Path(shutil.which(program) or f"/usr/bin/{program}")
        capable = file.exists() and (file.stat().st_mode & stat.S_ISUID or "security.capability" in os.listxattr(file))
        if not capable:
            return (
                f"{file}: has neither the set-user-ID bit nor capabilities, so it maps no users; "
                "`sudo apt-get install --reinstall uidmap` restores it"
            )
    return ""


def _refusal(stderr: str) -> UserError:
    """What a host that forbids namespaces means for its user."""
    remedy = cause(stderr) or "build on a computer, or in a virtual machine or container, that allows one"
    return UserError(f"this computer refuses a mount namespace: {stderr.strip()}; {remedy}")


def prefix(*more: str, root: bool | None = None) -> list[str]:
    """The command that puts what follows it into namespaces; for ordinary users with a mapping of users.

    `more` are further options of unshare(1); `root` says who runs the command, where that is somebody else.
    """
    root = os.geteuid() == 0 if root is None else root
    mapping = [] if root else ["--map-auto", "--map-root-user"]
    # The stage must not outlive the builder, even one that was killed.
    options = [*mapping, "--mount", "--pid", "--fork", "--kill-child", *more]
    return ["setpriv", "--pdeathsig", "KILL", "unshare", *options, "--"]


def check() -> None:
    """Refuse early, with the remedy, where the host does not allow namespaces.

    unshare(1) forks a child that maps users, and leaves it waiting for ever when the kernel refuses: so not the end of
    what they write is awaited, but that of the program itself, and the rest of its group is killed.
    """
    if os.geteuid() == 0:
        _check_capabilities()
    argv = [*prefix(), "mount", "-t", "tmpfs", "none", "/mnt"]
    with tempfile.TemporaryFile("w+") as output:
        probe = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=output, stderr=output, process_group=0)
        try:
            os.waitid(os.P_PID, probe.pid, os.WEXITED | os.WNOWAIT)  # its number stays the group's until it is reaped
        finally:
            os.killpg(probe.pid, signal.SIGKILL)
            status = probe.wait()
        output.seek(0)
        if status:
            raise _refusal(output.read())


def moved_clock() -> dict[str, str]:
    """libfaketime's variables, where `make verify` moves this build's clock; they must reach every program of it.

    All but the one by which programs share a semaphore: that may be of another user, root directory or word size.
    """
    return {
        name: value
        for name, value in os.environ.items()
        if (name in ("LD_PRELOAD", "NO_FAKE_STAT") or name.startswith("FAKETIME")) and name != "FAKETIME_SHARED"
    }


def run_stage(module: str, arguments: Sequence[str], log: Path) -> None:
    """Run `python -m module arguments` in namespaces, as `run_logged` does."""
    argv = [*prefix(), sys.executable, "-m", module, *arguments]
    environment = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "LC_ALL": "C.UTF-8",
        "TZ": "UTC",
        "PYTHONPATH": str(paths.IMPORTS),
    }
    environment |= {name: os.environ[name] for name in ("FLEET", "BUILD", "V") if name in os.environ} | moved_clock()
    run_logged(module, argv, log, environment)


def run_logged(title: str, argv: Sequence[str], log: Path, environment: Mapping[str, str] = os.environ) -> None:
    """Run a command that ends with the builder; its output goes to `log`, whose end is shown on failure."""
    progress.command(argv)
    with log.open("wb") as output:
        process = subprocess.Popen(argv, env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            with together.ending(process):
                status = process.wait()
        finally:
            process.kill()
    if status != 0:
        said = telling(log_text(log))
        raise UserError(f"{title} failed (status {status}); the end of {paths.shown(log)}:\n{said}")


def log_text(log: Path) -> str:
    """A log; of a long one, which somebody's build may write without end, the beginning and the end."""
    with log.open("rb") as file:
        head = file.read(_LOG_BYTES)
        left = file.seek(0, os.SEEK_END) - len(head)
        file.seek(-min(left, _LOG_BYTES), os.SEEK_END)
        tail = file.read(_LOG_BYTES)
    return (head + (b"\n" if left > _LOG_BYTES else b"") + tail).decode(errors="replace")


def telling(text: str) -> str:
    """The end of a log, and before it the errors that came earlier: a compiler's warnings may come after them."""
    lines = text.splitlines()
    early = [line for line in lines[:-_TAIL] if ERROR.search(line)][:10]
    return "\n".join([*early, *(["…"] if early else []), *lines[-_TAIL:]])
