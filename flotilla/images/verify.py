"""Prove that an image depends on nothing but the checkout: build it a second time under other circumstances, compare.

The second build starts from an empty cache, in a copy of the checkout elsewhere, as another kind of user, with another
umask, locale, time zone, host name and day. Everything it needs to be elsewhere (mounts, host name, an account) exists
in namespaces of its own, so that this computer is left as it was, however the build ends.

The clock is moved by libfaketime. It reaches every program but static ones and, in an i386 root, those that ask by the
interface for 64-bit times: coreutils. dpkg, Perl, Python and useradd see the other day.
"""

from __future__ import annotations

import json
import os
import pwd
import re
import shutil
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from flotilla.common import cache, namespace, paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import kernel, pool, tools
from flotilla.debian.lock import Lock, board_lock, read_lock
from flotilla.fleet import keys
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.images import build, compare

_USER = "flotilla-verify"
_FIRST_USER = 61000
_SUBORDINATE = 1_000_000_000
"""First of the users that the ordinary user may map: far from those that real accounts map."""
_HOST = "elsewhere"
_ZONE = "Asia/Kathmandu"
_UMASK = 0o077
_DAYS = 40
_TRIPLETS = {"amd64": "x86_64-linux-gnu", "i386": "i386-linux-gnu"}
_PLACES = ("/mnt", "/srv", "/opt", "/media")
_PLANTED = "etc/planted"
_SECONDS = {"unpack": 25.0, "runtime": 55.0, "root file system": 130.0}
"""The second build's parts by the beginning of their titles, and about how long each takes on two cores."""
_LEFT = re.compile(r"; about [\d:]+ left$")
_MOVED = re.compile(rf": \d+\.\d s$|{_LEFT.pattern}")
"""How lines of progress end, without a terminal."""
_ENDED = re.compile(r"\d+\.\d s")
_PERCENT = re.compile(r"(\d+) % of ")
_SKIPPED = {".git", "__pycache__", ".mypy_cache", ".ruff_cache", ".pytest_cache"}


@dataclass(frozen=True)
class _Circumstances:
    """Those of the second build."""

    directory: str
    """Where its files are now: checkout, keys, build directory."""
    place: str
    """The directory that is another one in its mount namespace, and has its files below."""
    robot: int
    user: int
    """An ordinary user's number, or 0: root."""
    locale: str
    python: str
    """Where the first build's Python is installed."""
    packages: str
    """The site-packages of the first build's Python environment."""

    @property
    def elsewhere(self) -> Path:
        """The directory as the second build sees it."""
        return Path(self.place, "somebody", "elsewhere")


def verify(fleet: Fleet, robot: Robot, apps: Sequence[BuiltApp] = (), *, plant: bool = False) -> str:
    """Build `robot`'s image twice and say what was varied; UserError with what differs.

    `apps`: the robot's, built for its board; the second build compiles them again.
    `plant` writes the time of day into the second checkout, to show that a difference is found and named; only the
    tools are taken from the first build's cache then.
    """
    started = time.monotonic()
    board = fleet.boards[robot.board]
    with cache.locked(paths.BUILD / ".verify.lock"), _directory() as directory:
        (first,) = build.build(fleet, [robot], apps={robot.name: apps})
        circumstances, notes = _prepare(directory, board, robot, plant=plant)
        kept = directory / "first.img"
        kept.hardlink_to(first)  # a build meanwhile puts another in its place
        before = datetime.now(UTC)
        log = paths.BUILD / "verify.log"
        log.unlink(missing_ok=True)  # an earlier one's
        own_kernel = board.kernel == "lean"
        progress.say(
            "the second image starts from an empty cache: about four minutes on two cores"
            + (f", and {kernel.MINUTES} for its kernel" if own_kernel else "")
        )
        with progress.step(f"second image of {robot.name}, elsewhere", lambda: far(progress.text(log), own_kernel)):
            _run(circumstances, log)
        check_clock(directory / "build" / f"rootfs-{board.name}.log", before)
        second = directory / "build" / "images" / first.name
        with progress.step("comparison"):
            toolset = tools.Tools(tools.tree(read_lock("tools")), read_lock(board.name).epoch)
            found = compare.images(kept, second, toolset, directory)
        saved = paths.BUILD / f"verify-{robot.name}.img"
        saved.unlink(missing_ok=True)  # of an earlier run
        if found:
            saved.touch(0o600)  # it holds a private key
            shutil.copyfile(second, saved)
            raise UserError(
                "\n  ".join([f"{robot.name}: the image built elsewhere differs from {paths.shown(first)}:", *found])
                + f"\n  it is kept as {paths.shown(saved)}"
            )
    return f"{robot.name}: identical; varied: {', '.join(notes)}; {time.monotonic() - started:.0f} s"


def far(log: str, own_kernel: bool) -> progress.Far:
    """How far the second build is, which writes lines of progress itself; the last is shown."""
    seconds = dict(_SECONDS) | ({"kernel": 60.0 * kernel.MINUTES} if own_kernel else {})
    lines = [line for line in log.splitlines() if _MOVED.search(line)]
    done = dict.fromkeys(seconds, 0.0)
    for line in lines:
        title, _, rest = line.partition(": ")
        name = next((each for each in seconds if title.startswith(f"{each} ")), None)
        if name and _ENDED.fullmatch(rest):
            done[name] = 1.0
        elif name and (percent := _PERCENT.match(rest)):
            done[name] = int(percent[1]) / 100
    last = _LEFT.sub("", lines[-1]) if lines else ""
    return progress.Far(sum(seconds[name] * share for name, share in done.items()), sum(seconds.values()), line=last)


@contextmanager
def _directory() -> Iterator[Path]:
    """An empty directory for the second build, removed afterwards; so is what a killed run left."""
    directory = paths.BUILD / "verify"
    _discard(directory)
    directory.mkdir()
    try:
        yield directory
    finally:
        with progress.step("remove the second build's files"):
            _discard(directory)


def _discard(directory: Path) -> None:
    try:
        cache.discard(directory)
    except PermissionError:  # root built there for an ordinary user
        subprocess.run(["sudo", "-n", "rm", "-rf", "--", str(directory)], check=True)


# The second build's files.


def _prepare(directory: Path, board: Board, robot: Robot, *, plant: bool) -> tuple[_Circumstances, list[str]]:
    """Lay out the second build's directory; its circumstances, and in words what they vary."""
    user, user_note = _other_user()
    locale = _other_locale()
    circumstances = _Circumstances(
        directory=str(directory),
        place=place_for([paths.PROJECT, paths.BUILD, paths.KEYS, Path(sys.base_prefix), Path(sys.prefix)]),
        robot=robot.number,
        user=user,
        locale=locale,
        python=sys.base_prefix,
        packages=sysconfig.get_path("purelib"),
    )
    copy_checkout(directory / "checkout")
    if paths.OWN_HOME:
        _copy(paths.HOME, directory / "fleet")
    elif paths.APPS != paths.PROJECT / "apps" and paths.APPS.exists():
        shutil.copytree(paths.APPS, directory / "checkout/apps", symlinks=True, copy_function=_copy_as_cloned)
    if plant:
        overlay = directory / "checkout" / paths.OVERLAY.relative_to(paths.IMPORTS)
        (overlay / _PLANTED).write_text(f"{datetime.now(UTC)}\n")
    keys.copy_for_image(robot, directory / "keys")
    lock, tools_lock = board_lock(board), read_lock("tools")
    (directory / "build/pool").mkdir(parents=True)
    (directory / "build/cache").mkdir()
    for package in {*lock.packages, *tools_lock.packages}:
        shutil.copyfile(pool.file(package), directory / "build/pool" / pool.file(package).name)
    if plant:
        subprocess.run(["cp", "-a", "--reflink=auto", tools.tree(tools_lock), directory / "build/cache"], check=True)
    _clock_libraries(directory / "faketime", lock, tools_lock)
    _python(directory, circumstances)
    (directory / "home").mkdir()
    if user:
        subprocess.run(["chown", "-R", f"{user}:{user}", directory], check=True)
    notes = [
        "path",
        user_note,
        f"umask {_UMASK:03o}",
        f"locale {locale}",
        f"time zone {_ZONE}",
        f"host name {_HOST}",
        f"clock {_DAYS} days ahead",
        "tools of the first build" if plant else "empty cache",
    ]
    return circumstances, notes


def copy_checkout(copy: Path) -> None:
    """The checkout without outputs, keys and history, and with the modes that a clone under the other umask has. Of a
    tool that was installed: the package."""
    _copy(paths.PACKAGE if paths.INSTALLED else paths.PROJECT, copy / "flotilla" if paths.INSTALLED else copy)


def _copy(directory: Path, copy: Path) -> None:
    def skipped(parent: str, names: list[str]) -> set[str]:
        kept_out = {paths.BUILD, paths.KEYS}
        if paths.OWN_HOME:
            kept_out |= {paths.PROJECT / "build", paths.PROJECT / "ansible/keys"}
        if paths.APPS != paths.PROJECT / "apps":
            kept_out.add(paths.PROJECT / "apps")
        return {name for name in names if name in _SKIPPED or Path(parent, name).resolve() in kept_out}

    shutil.copytree(directory, copy, symlinks=True, ignore=skipped, copy_function=_copy_as_cloned)
    for parent, _, _ in os.walk(copy):
        Path(parent).chmod(0o777 & ~_UMASK)


def _copy_as_cloned(source: str, target: str) -> None:
    shutil.copyfile(source, target)
    Path(target).chmod((0o777 if os.access(source, os.X_OK) else 0o666) & ~_UMASK)


def _other_user() -> tuple[int, str]:
    """Number of the second build's user, and in words what that varies."""
    if os.geteuid() == 0:
        taken = {account.pw_uid for account in pwd.getpwall()}
        return next(number for number in range(_FIRST_USER, 65000) if number not in taken), "an ordinary user, not root"
    if _sudo():
        return 0, "root, not an ordinary user"
    return 0, "root of a user namespace (root itself not varied: `sudo -n` is refused), not an ordinary user"


def _sudo() -> list[str]:
    """How to become root without being asked; nothing where that is not allowed."""
    sudo = ["sudo", "-n"]
    try:
        allowed = subprocess.run([*sudo, "true"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return []
    return sudo if allowed else []


def _other_locale() -> str:
    """One that this computer has, other than the present one; "C", which every computer has, at worst."""
    known = subprocess.run(["locale", "-a"], capture_output=True, text=True, check=False).stdout.split()
    present = os.environ.get("LC_ALL") or os.environ.get("LANG")
    return next((name for name in known if name.lower() not in ("c", "c.utf8", "c.utf-8", "posix", present)), "C")


def place_for(kept: list[Path]) -> str:
    """A directory that may become another one for the second build: nothing that it needs lies there."""
    for place in map(Path, _PLACES):
        if place.is_dir() and not any(path.resolve().is_relative_to(place) for path in kept):
            return str(place)
    raise UserError(
        f"the checkout, build directory, keys and Python occupy all of {', '.join(_PLACES)}; move one of them"
    )


def _clock_libraries(directory: Path, lock: Lock, tools_lock: Lock) -> None:
    """libfaketime for the tools and for the board, each where the dynamic linker's $LIB points."""
    locks = {
        "amd64": tools_lock,
        lock.architecture: tools_lock if lock.architecture == "amd64" else read_lock("verify"),
    }
    for architecture, source in locks.items():
        (package,) = (package for package in source.packages if package.name == "libfaketime")
        pool.fill([source])
        triplet = _TRIPLETS[architecture]
        member = f"usr/lib/{triplet}/faketime/libfaketime.so.1"
        with tempfile.TemporaryDirectory() as unpacked:
            subprocess.run(["dpkg-deb", "--extract", pool.file(package), unpacked], check=True)
            target = directory / "lib" / triplet / "libfaketime.so.1"
            target.parent.mkdir(parents=True)
            shutil.copyfile(Path(unpacked, member), target)
            target.chmod(0o755)


def _python(directory: Path, circumstances: _Circumstances) -> None:
    """The first build's Python environment, elsewhere: its programs name their interpreter by its path."""
    environment = directory / "build/venv"
    (environment / "bin").mkdir(parents=True)
    for program in Path(sys.prefix, "bin").iterdir():
        if program.is_symlink() or not program.is_file():
            continue
        content = program.read_bytes()
        if content.startswith(b"#!"):
            content = content.replace(os.fsencode(sys.prefix), os.fsencode(circumstances.elsewhere / "build/venv"))
            (environment / "bin" / program.name).write_bytes(content)
            (environment / "bin" / program.name).chmod(0o755)
    home = Path(circumstances.python, "bin")
    for name in ("python", "python3"):
        (environment / "bin" / name).symlink_to(home / Path(sys.executable).resolve().name)
    (environment / "pyvenv.cfg").write_text(f"home = {home}\ninclude-system-site-packages = false\n")
    (environment / Path(circumstances.packages).relative_to(sys.prefix)).mkdir(parents=True)
    (directory / "python").mkdir()


# The second build itself.


def _run(circumstances: _Circumstances, log: Path) -> None:
    description = Path(circumstances.directory, "circumstances.json")
    description.write_text(json.dumps(asdict(circumstances)))
    sudo = _sudo() if os.geteuid() != 0 else []
    prefix = namespace.prefix("--uts", "--mount-proc", root=os.geteuid() == 0 or bool(sudo))
    argv = [*sudo, *prefix, "env", f"PYTHONPATH={paths.IMPORTS}", sys.executable, "-m", __name__, str(description)]
    namespace.run_logged("the second build", argv, log)


def main(description_file: str) -> int:
    """In namespaces of its own, as root: make this computer another one, and build there."""
    circumstances = _Circumstances(**json.loads(Path(description_file).read_text()))
    elsewhere = circumstances.elsewhere
    _mount("-t", "tmpfs", "-o", "mode=755", "elsewhere", circumstances.place)
    elsewhere.mkdir(parents=True)
    _mount("--rbind", circumstances.directory, elsewhere)
    packages = elsewhere / "build/venv" / Path(circumstances.packages).relative_to(sys.prefix)
    _mount("--rbind", circumstances.packages, packages)
    _mount("-t", "tmpfs", "-o", "mode=1777", "elsewhere", "/dev/shm")  # libfaketime's, named by process numbers
    owner = []
    if circumstances.user:
        _add_account(circumstances)
        _uncover_python(elsewhere / "python", Path(circumstances.python))
        owner = ["setpriv", f"--reuid={circumstances.user}", f"--regid={circumstances.user}", "--clear-groups"]
    socket.sethostname(_HOST)
    os.umask(_UMASK)
    environment = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": str(elsewhere / "home"),
        "USER": _USER if circumstances.user else "root",
        "LC_ALL": circumstances.locale,
        "LANG": circumstances.locale,
        "TZ": _ZONE,
        "BUILD": str(elsewhere / "build"),
        "KEYS": str(elsewhere / "keys"),
        **({"FLEET": str(elsewhere / "fleet")} if (elsewhere / "fleet").exists() else {}),
        "FAKETIME": f"+{_DAYS}d",
        "FAKETIME_LIBRARIES": str(elsewhere / "faketime"),
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",  # how long something takes is not the clock's business
        "NO_FAKE_STAT": "1",  # files keep the times they have
        "LD_PRELOAD": f"{elsewhere}/faketime/$LIB/libfaketime.so.1",
    }
    argv = [
        *owner,
        *("env", "--ignore-environment", *(f"{name}={value}" for name, value in environment.items())),
        *(str(elsewhere / "build/venv/bin/python"), "-m", "flotilla", "image"),
        str(circumstances.robot),
    ]
    return subprocess.run(argv, cwd=elsewhere / "checkout", check=False).returncode


def _mount(*arguments: str | Path) -> None:
    subprocess.run(["mount", *arguments], check=True)


def _add_account(circumstances: _Circumstances) -> None:
    """An ordinary user whom only this mount namespace knows."""
    number = circumstances.user
    lines = {
        "passwd": f"{_USER}:x:{number}:{number}::{circumstances.elsewhere}/home:/bin/sh\n",
        "group": f"{_USER}:x:{number}:\n",
        "subuid": f"{_USER}:{_SUBORDINATE}:65536\n",
        "subgid": f"{_USER}:{_SUBORDINATE}:65536\n",
    }
    for name, line in lines.items():
        place = Path("/etc", name)
        if not place.exists():
            place.touch()
        copy = Path(circumstances.place, name)
        copy.write_text(place.read_text() + line)
        copy.chmod(0o644)
        _mount("--bind", copy, place)


def _uncover_python(staging: Path, python: Path) -> None:
    """Make an interpreter reachable that lies in somebody's closed home: with nothing but itself in that home."""
    closed = next((parent for parent in reversed(python.parents) if not parent.stat().st_mode & 0o001), None)
    if closed:
        _mount("--rbind", python, staging)
        _mount("-t", "tmpfs", "-o", "mode=755", "uncovered", closed)
        python.mkdir(parents=True)
        _mount("--move", staging, python)


_CLOCKS = {"stage", "tools", "target"}


def check_clock(log: Path, before: datetime) -> None:
    """Fail unless the second build's programs of every kind saw the moved clock."""
    seen = clocks(log.read_text(errors="replace"))
    moved = {f"{moment + timedelta(days=_DAYS):%F}" for moment in (before, datetime.now(UTC))}
    for clock in sorted(_CLOCKS):
        if seen.get(clock) not in moved:
            raise UserError(
                f"the second build's clock did not move: {clock} saw {seen.get(clock, 'none')}, "
                f"not {' or '.join(sorted(moved))}; libfaketime does not work here"
            )


def clocks(log: str) -> dict[str, str]:
    """The dates that a stage's programs saw, by kind of program."""
    return dict(re.findall(r"^clock of the (\w+): (\S+)$", log, re.MULTILINE))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
