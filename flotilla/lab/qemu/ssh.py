"""A robot's shell over SSH: implements `protocols.Command` and `protocols.FileTransfer`.

The same key, pinned host key and options as `make ssh`, and one connection that all commands share: on an emulated
Pentium III a handshake takes seconds.
"""

from __future__ import annotations

import os
import selectors
import shlex
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.fleet.model import Robot
from flotilla.lab.qemu.timing import Deadline, Expired, LabError
from flotilla.robot.ssh import options as ssh_options

CONNECT_SECONDS = 600
RETRY_SECONDS = 0.5
COMMAND_SECONDS = 600
"""Limit for what takes a few seconds on an idle host."""
HOPELESS = ("Permission denied", "Host key verification failed", "REMOTE HOST IDENTIFICATION HAS CHANGED", "Bad owner")
"""What no waiting repairs."""


class Ssh:
    """Commands on a robot. Connects when first used, and again after the robot was away."""

    def __init__(
        self, robot: Robot, host: str, port: Callable[[], int] = lambda: 22, within: Sequence[str] = ()
    ) -> None:
        """`port` is asked at each connection, because a guest's changes when it is powered on again. `within`: what
        goes before a command that is to run on the station's computer, where that is not this one."""
        self._robot = robot
        self._within = within
        self._scratch = tempfile.TemporaryDirectory(prefix="lab-")  # sockets' paths must be short
        self._options = ["-F", "none", *ssh_options(robot), "-o", f"ControlPath={self._scratch.name}/master"]
        self._host = host
        self._port = port
        self._master: subprocess.Popen[str] | None = None
        self._root: subprocess.Popen[str] | None = None
        self.first_connected: float | None = None
        """When (`time.monotonic()`) the first connection stood."""

    def __enter__(self) -> Ssh:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def connect(self, timeout: float = CONNECT_SECONDS) -> None:
        """Wait until the robot lets us in; a refused key or host key is reported at once."""
        deadline = Deadline(timeout)
        while not deadline.expired:
            reason = self._try_to_connect(deadline)
            if reason is None:
                self.first_connected = self.first_connected or time.monotonic()
                return
            if any(phrase in reason for phrase in HOPELESS):
                raise LabError(f"{self._robot.name}: SSH refused: {reason}")
            time.sleep(RETRY_SECONDS)  # nothing tells from outside when a robot starts to listen
        raise Expired(f"{self._robot.name}: no SSH within {timeout:g} s: {reason}")

    def run(
        self, argv: Sequence[str], *, timeout: float = COMMAND_SECONDS, check: bool = True, stdin: str = ""
    ) -> subprocess.CompletedProcess[str]:
        done = self._run(argv, timeout, stdin.encode())
        result = subprocess.CompletedProcess(list(argv), done.returncode, _text(done.stdout), _text(done.stderr))
        if check and result.returncode:
            raise LabError(
                f"{self._robot.name}: {shlex.join(argv)}: status {result.returncode}\n{result.stdout}{result.stderr}"
            )
        return result

    def script(
        self, text: str, *, timeout: float = COMMAND_SECONDS, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Run a shell script as root, by a shell that waits for the next one. Its errors lack the last line's end.

        Where `run` is asked for `sudo sh -c`, an emulated Pentium III takes 0.3 s for the channel and sudo.
        """
        deadline = Deadline(timeout)
        if self._root is None or self._root.poll() is not None:
            self._root = self.start(["sudo", "sh"])
        assert self._root.stdin
        mark = uuid.uuid4().hex
        # What the script says goes out as it comes, its errors behind it.
        one = f"{{ errors=$(sh -c {shlex.quote(text)} 2>&1 >&3 3>&- </dev/null); }} 3>&1"
        self._root.stdin.write(f"{one}; printf '\\n%s %d\\n%s\\n%s\\n' {mark} $? \"$errors\" {mark}\n")
        self._root.stdin.flush()
        answer = self._output_of_root(f"\n{mark}\n", text, deadline)
        output, _, rest = answer.partition(f"\n{mark} ")
        status, _, errors = rest.partition("\n")
        result = subprocess.CompletedProcess(["sh", "-c", text], int(status), output, errors)
        if check and result.returncode:
            raise LabError(f"{self._robot.name}: {text}: status {status}\n{output}{errors}")
        return result

    def _output_of_root(self, end: str, text: str, deadline: Deadline) -> str:
        """Output of root's shell, up to `end`."""
        assert self._root
        assert self._root.stdout
        output = b""
        with selectors.DefaultSelector() as selector:
            selector.register(self._root.stdout, selectors.EVENT_READ)
            while not output.endswith(end.encode()):
                ready = selector.select(deadline.left)
                more = os.read(self._root.stdout.fileno(), 1 << 16) if ready else b""
                if not more:
                    self._leave_root()
                    why = "the connection ended" if ready else f"no end within {deadline.seconds:g} s"
                    raise (LabError if ready else Expired)(f"{self._robot.name}: {text}: {why}\n{_text(output)}")
                output += more
        return _text(output).removesuffix(end)

    def _leave_root(self) -> None:
        if self._root:
            self._root.kill()
            self._root.wait()
            for end in (self._root.stdin, self._root.stdout):
                if end:
                    end.close()
            self._root = None

    def start(self, argv: Sequence[str]) -> subprocess.Popen[str]:
        """A command that goes on, with pipes to its input and from its output."""
        if self._master is None or self._master.poll() is not None:
            self.connect()
        return subprocess.Popen(self._command(argv), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    @property
    def command(self) -> list[str]:
        """What goes before a command of one's own, by the shared connection."""
        return [*self._within, "ssh", *self._options, self._host]

    def read(self, path: str) -> bytes:
        done = self._run(["cat", "--", path], COMMAND_SECONDS, b"")
        if done.returncode:
            raise LabError(f"{self._robot.name}: cannot read {path}: {_text(done.stderr)}")
        return done.stdout

    def write(self, path: str, contents: bytes) -> None:
        done = self._run(["dd", "status=none", f"of={path}"], COMMAND_SECONDS, contents)
        if done.returncode:
            raise LabError(f"{self._robot.name}: cannot write {path}: {_text(done.stderr)}")

    def close(self) -> None:
        self.hang_up()
        self._scratch.cleanup()

    def _run(self, argv: Sequence[str], timeout: float, stdin: bytes) -> subprocess.CompletedProcess[bytes]:
        deadline = Deadline(timeout)
        if self._master is None or self._master.poll() is not None:
            self.connect(min(CONNECT_SECONDS, timeout))
        try:
            return subprocess.run(
                self._command(argv), input=stdin, capture_output=True, timeout=deadline.left, check=False
            )
        except subprocess.TimeoutExpired as error:
            so_far = _text(error.stdout or b"") + _text(error.stderr or b"")
            raise Expired(f"{self._robot.name}: {shlex.join(argv)}: no end within {timeout:g} s\n{so_far}") from None

    def _command(self, argv: Sequence[str]) -> list[str]:
        return [*self.command, shlex.join(argv)]

    def _try_to_connect(self, deadline: Deadline) -> str | None:
        """Start the shared connection: None when it stands, else what ssh said."""
        self.hang_up()
        # `LocalCommand` runs once the connection stands, so its output is the event to wait for.
        ready = ["-o", "PermitLocalCommand=yes", "-o", "LocalCommand=echo ready"]
        alive = ["-o", "ConnectTimeout=20", "-o", "ServerAliveInterval=10", "-o", "ServerAliveCountMax=18"]
        argv = [*self._within, *DIE_WITH_PARENT, "ssh", "-M", "-N", *ready, *alive, *self._options]
        argv += ["-p", str(self._port()), self._host]
        self._master = subprocess.Popen(
            argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self._master.stdout
        assert self._master.stderr
        with selectors.DefaultSelector() as selector:
            selector.register(self._master.stdout, selectors.EVENT_READ)
            if selector.select(deadline.left) and self._master.stdout.readline():
                return None
        self._master.kill()
        return self._master.stderr.read().strip() or "no answer"

    def hang_up(self) -> None:
        """End the connection; the next command makes another."""
        self._leave_root()
        if self._master:
            self._master.kill()
            self._master.communicate()
            self._master = None
            Path(self._scratch.name, "master").unlink(missing_ok=True)


def _text(output: bytes) -> str:
    return output.decode(errors="replace")
