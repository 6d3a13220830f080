"""A hostile author: the attacks of tests/fixtures/hostile, their targets, and the evidence that an attack succeeded."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import subprocess
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import paths

SECRET = "the key of a release"
ATTACKS = (
    "key", "key by climbing", "key by processes", "key by alias", "environment", "shared memory", "keyring", "network",
    "datagram", "agent", "abstract", "file", "append", "removal", "mode", "users", "mounting", "root", "privileges",
    "killing", "tracing", "survivor",
)  # fmt: skip
"""Those that end by themselves; any of them would succeed for an ordinary user, too."""
ROOTS_ATTACKS = ("device", "core pattern", "capabilities")
"""Those that would succeed for root only."""
LIMITS = {
    "processes": "64 processes",
    "memory": "128 MiB of memory",
    "one file": "32 MiB for files",
    "holes": "64 MiB for a file",
    "messages": "1 MiB of messages",
    "waiting": "2 s",
}
"""Those that do not end by themselves, with the limit that ends them under the limits SMALL; see sandbox.Limits."""
SMALL = {
    "processes": 64, "memory_bytes": 128 << 20, "disk_bytes": 32 << 20, "file_bytes": 64 << 20,
    "output_bytes": 1 << 20,
}  # fmt: skip
_SOURCE = paths.PROJECT / "tests/fixtures/hostile/attack.c"
_LIBC = ctypes.CDLL(None, use_errno=True)
_ADD_KEY, _KEYCTL, _JOIN_SESSION_KEYRING, _SESSION_KEYRING = 248, 250, 1, -3
"""Of x86-64."""


@dataclass
class Target:
    """A computer with something to steal, and with the programs that try."""

    directory: Path
    program: Path
    plugins: Path
    named: Path
    alias: str
    victim: subprocess.Popen[bytes]
    sockets: list[socket.socket]
    before: dict[str, bytes]

    def evidence(self, output: str) -> list[str]:
        """The successes of an attack, by its own words and by its traces; the traces are removed."""
        found = [line for line in output.splitlines() if line.startswith("broke out: ")]
        found += ["the key came out"] * (SECRET in output)
        for ready in select.select(self.sockets, [], [], 0)[0]:
            found.append(f"something came to {ready.getsockname()}")
            ready.recv(100) if ready.type == socket.SOCK_DGRAM else ready.accept()[0].close()
        if (after := self._files()) != self.before:
            found.append(f"files changed: {sorted(set(after.items()) ^ set(self.before.items()))}")
            for name in after.keys() - self.before.keys():
                (self.directory / "keys" / name).unlink()
            for name, content in self.before.items():
                (self.directory / "keys" / name).write_bytes(content)
        for process in self._survivors():
            with suppress(ProcessLookupError):  # it was ending
                os.kill(process, signal.SIGKILL)
                found.append(f"process {process} is left")
        return found

    def _files(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (self.directory / "keys").iterdir() if path.is_file()}

    def _survivors(self) -> list[int]:
        """Processes by the name that survivors take, or that run the program."""
        return [
            int(process.name)
            for process in Path("/proc").iterdir()
            if process.name.isdigit() and self._is_ours(process)
        ]

    def _is_ours(self, process: Path) -> bool:
        try:
            name = (process / "comm").read_text().strip()
            return name == self.alias or (process / "exe").readlink().name == self.alias
        except OSError:
            return False

    def plainly(self, attack: str) -> list[str]:
        """The successes of an attack without a sandbox, in namespaces of its own where it might change the computer."""
        own = [] if os.geteuid() == 0 else ["unshare", "--user", "--map-current-user", "--keep-caps"]
        own = own if attack in ("mounting", "root") else []
        log_file = self.directory / "log"
        with log_file.open("wb") as log:
            process = subprocess.Popen(
                [*own, self.program, attack], stdin=subprocess.DEVNULL, stdout=log, stderr=log, process_group=0
            )
            if attack in LIMITS:
                self._until_broken()
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if attack == "survivor":
            self._until_survivor()
        with log_file.open("rb") as log:
            log.seek(-min(log_file.stat().st_size, 1 << 16), os.SEEK_END)
            return self.evidence(log.read().decode(errors="replace"))

    def _until_broken(self) -> None:
        argv = ["sh", "-c", f"tail -c +1 -f {self.directory}/log | grep -a -m 1 -q '^broke out'"]
        subprocess.run(argv, check=True, timeout=60)

    def _until_survivor(self) -> None:
        while not self._survivors():
            os.sched_yield()


@contextmanager
def target(directory: Path) -> Iterator[Target]:
    """Plant keys, sockets and a process in `directory`, and compile the attacks on them."""
    directory.chmod(0o755)
    (directory / "keys").mkdir()
    key = directory / "keys/release"
    key.write_text(SECRET)
    (directory / "blocks").mkdir()
    alias = uuid.uuid4().hex[:12]
    number = int(alias[:7], 16)
    with ExitStack() as stack:
        tcp = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        udp = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        udp.bind(tcp.getsockname())
        sockets = [tcp, udp]
        for address in (f"{directory}/agent", f"\0{alias}"):
            sockets.append(stack.enter_context(socket.socket(socket.AF_UNIX)))
            sockets[-1].bind(address)
            sockets[-1].listen()
        victim = stack.enter_context(subprocess.Popen(["sleep", "600"]))
        stack.callback(victim.kill)
        os.environ["PLANTED"] = SECRET
        stack.callback(os.environ.pop, "PLANTED")
        segment = _LIBC.shmget(number, 4096, 0o1600)  # IPC_CREAT
        stack.callback(_LIBC.shmctl, segment, 0, None)  # IPC_RMID
        _LIBC.shmat.restype = ctypes.c_void_p
        place = _LIBC.shmat(segment, None, 0)
        ctypes.memmove(place, SECRET.encode(), len(SECRET))
        _LIBC.shmdt(ctypes.c_void_p(place))
        _LIBC.syscall(_KEYCTL, _JOIN_SESSION_KEYRING, None)
        planted = _LIBC.syscall(_ADD_KEY, b"user", alias.encode(), SECRET.encode(), len(SECRET), _SESSION_KEYRING)
        assert planted > 0, os.strerror(ctypes.get_errno())
        words = {
            "KEY": f'"{key}"', "ALIAS": f'"{alias}"', "MARKER": f'"{directory}/keys/marker"',
            "NAMED": f'"{directory}/blocks/named"', "SOCKET": f'"{directory}/agent"', "ABSTRACT": f'"{alias}"',
            "PORT": tcp.getsockname()[1], "VICTIM": victim.pid, "SEGMENT": number,
        }  # fmt: skip
        command = ["cc", "-O1", *(f"-D{name}={value}" for name, value in words.items()), str(_SOURCE)]
        program, plugin = directory / alias, directory / "blocks/attack.so"
        subprocess.run([*command, "-static", "-o", program], check=True)
        subprocess.run([*command, "-DPLUGIN", "-shared", "-fPIC", "-o", plugin], check=True)
        found = Target(directory, program, plugin.parent, plugin.parent / "named", alias, victim, sockets, {})
        found.before = found._files()
        yield found
