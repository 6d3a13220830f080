"""The process between the builder and a sandbox. It gives the sandbox memory to write to, and ends it at its limits.

Runs as process 1 of a process namespace, with mounts of its own and a new /proc, so that it sees every process of the
sandbox, and the sandbox sees nothing of it. It has no import but the standard library's: each check starts one.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import select
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

PLACE = Path("/sys")
"""Where the memory is mounted: a directory that every computer has, and nobody's files lie in."""
LIMIT = "sandbox: ended at its limit of "
"""How the line begins that names a limit."""
STATUS = 125
"""Exit status at a limit."""
_PERIOD_S = 0.05
_NICE = 5
"""Of the sandbox: this process comes first, among however many others."""
_FILES = 200_000
"""Of files and directories that a sandbox makes: each takes memory of the kernel."""
_RESERVE = 32
"""The part of this computer's memory that a sandbox leaves: one of so many."""
_KEYCTL, _JOIN_SESSION_KEYRING = 250, 1
"""Of x86-64 (asm/unistd_64.h, linux/keyctl.h)."""
_MIB = 1 << 20


def main(settings: str) -> int:
    """Run `argv` of the settings (JSON), with the keys of sandbox.Limits and `writable`; its exit status."""
    given = json.loads(settings)
    writable = [(Path(path), PLACE / name) for name, path in given["writable"].items()]
    options = f"size={given['disk_bytes']},nr_inodes={_FILES},mode=755,nosuid,nodev"
    if status := subprocess.run(["mount", "-t", "tmpfs", "-o", options, "flotilla", PLACE], check=False).returncode:
        return status
    if not shutil.which(given["argv"][0]):
        print(f"{given['argv'][0]}: is missing", file=sys.stderr)
        return 1
    for name in ("tmp", "shm"):
        (PLACE / name).mkdir()
    for path, inside in writable:
        inside.mkdir()
        if not _copied(path, inside):
            _end(f"{given['disk_bytes'] // _MIB} MiB for files, by the files that it begins with")
    status = _watched(given)
    if status == 0:
        for path, inside in writable:
            _hand_over(inside, path, given["disk_bytes"])
    return status


def _watched(given: dict[str, int]) -> int:
    """Run it until it ends or is at a limit; nothing of it runs afterwards."""

    def confine() -> None:
        os.nice(_NICE)
        Path("/proc/self/oom_score_adj").write_text("1000")  # where memory is short, this ends and nothing else
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (given["file_bytes"],) * 2)
        # Where the watch is late; the kernel exempts root.
        resource.setrlimit(resource.RLIMIT_NPROC, (2 * given["processes"],) * 2)
        # A session's keyring may hold keys of the user, and every process below has it.
        ctypes.CDLL(None).syscall(_KEYCTL, _JOIN_SESSION_KEYRING, None)

    with contextlib.suppress(OSError):  # root of a container may not
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    # Bubblewrap's own environment can be read by the sandbox, as that of its process 1.
    environment = {"PATH": os.environ.get("PATH", os.defpath)}
    # Pipes, because the owner of a file may change its mode by a descriptor: to set-user-ID.
    error = subprocess.STDOUT if os.path.sameopenfile(1, 2) else subprocess.PIPE
    process = subprocess.Popen(
        given["argv"],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=error,
        preexec_fn=confine,
    )  # type: ignore[call-overload]
    outputs = {pipe.fileno(): to for pipe, to in ((process.stdout, 1), (process.stderr, 2)) if pipe}
    handle, left = os.pidfd_open(process.pid), given["output_bytes"]
    deadline = time.monotonic() + given["seconds"]
    looked, reached, ended = 0.0, "", False
    while not reached and not ended:
        ready = select.select([handle, *outputs], [], [], _PERIOD_S)[0]
        ended = handle in ready
        left -= sum(_passed_on(pipe, outputs) for pipe in ready if pipe in outputs)
        now = time.monotonic()
        if now - looked > _PERIOD_S or ended:
            looked, reached = now, _reached(given)
        if left < 0:
            reached = f"{given['output_bytes'] // _MIB} MiB of messages"
        if now > deadline:
            reached = f"{given['seconds']} s"
    os.kill(-1, signal.SIGKILL)  # all of this namespace but this process
    status: int = process.wait()
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    while left > 0 and outputs:
        left -= sum(_passed_on(pipe, outputs) for pipe in list(outputs))
    if reached:
        _end(reached)
    return status


def _passed_on(pipe: int, outputs: dict[int, int]) -> int:
    """Bytes of the sandbox's messages that were there; a pipe that has ended is left out from then on."""
    data = os.read(pipe, 1 << 16)
    if not data:
        del outputs[pipe]
        return 0
    rest = data
    while rest:
        rest = rest[os.write(outputs[pipe], rest) :]
    return len(data)


def _reached(given: dict[str, int]) -> str:
    """The limit that the sandbox is at, if any."""
    processes = [each.name for each in Path("/proc").iterdir() if each.name.isdigit() and each.name != "1"]
    threads = memory = 0
    if len(processes) <= given["processes"]:
        for each_threads, each_memory in map(_use, processes):
            threads += each_threads
            memory += each_memory
    if max(len(processes), threads) > given["processes"]:
        return f"{given['processes']} processes and threads"
    if memory > given["memory_bytes"]:
        return f"{given['memory_bytes'] // _MIB} MiB of memory"
    use = os.statvfs(PLACE)
    if use.f_bavail * use.f_bsize < 1 << 16:
        return f"{given['disk_bytes'] // _MIB} MiB for files"
    if use.f_favail == 0:
        return f"{_FILES} files"
    total, left = _memory()
    if left < total // _RESERVE:
        return f"memory: {left // _MIB} MiB of this computer's {total // _MIB} MiB are left"
    return ""


def _use(process: str) -> tuple[int, int]:
    """Threads of a process, and the bytes that it alone has, or shares with others of the sandbox."""
    try:
        lines = Path("/proc", process, "status").read_text(errors="replace").splitlines()
    except OSError:  # it has ended
        return 0, 0
    values = dict(line.split(":", 1) for line in lines)
    kib = sum(int(values.get(key, "0").split()[0]) for key in ("RssAnon", "RssShmem"))
    return int(values["Threads"]), kib << 10


def _memory() -> tuple[int, int]:
    """Of this computer, and what of it is available, in bytes."""
    values = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
    return int(values["MemTotal"].split()[0]) << 10, int(values["MemAvailable"].split()[0]) << 10


def _hand_over(made: Path, to: Path, most_bytes: int) -> None:
    """Replace the files that it began with by the ones that it left."""
    size = 0
    for path in _below(made):
        found = path.lstat()
        if stat.S_ISREG(found.st_mode):
            size += found.st_size  # holes, too: they take no memory here, and whoever reads them sees zeros
        if not stat.S_ISLNK(found.st_mode):  # readable, and never set-user-ID
            path.chmod(found.st_mode & 0o777 | (0o700 if stat.S_ISDIR(found.st_mode) else 0o600))
    if size > most_bytes:
        _end(f"{most_bytes // _MIB} MiB for files")
    for old in to.iterdir():
        shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
    if not _copied(made, to):
        sys.exit(1)


def _below(directory: Path) -> Iterator[Path]:
    """All that is in a directory, each directory after it was yielded, so that it may be made readable first."""
    for path in directory.iterdir():
        yield path
        if path.is_dir() and not path.is_symlink():
            yield from _below(path)


def _copied(source: Path, to: Path) -> bool:
    """Whether all was copied, links as links."""
    argv = ["cp", "-dR", "--preserve=mode,timestamps,links", f"{source}/.", str(to)]
    return subprocess.run(argv, check=False).returncode == 0


def _end(limit: str) -> NoReturn:
    print(f"\n{LIMIT}{limit}", file=sys.stderr, flush=True)
    sys.exit(STATUS)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
