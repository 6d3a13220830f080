"""One QEMU process and its control channel (QMP)."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shlex
import socket
import subprocess
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

from qemu.qmp import EventListener, ExecuteError, Message, QMPClient, QMPError, Runstate

from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.timing import Deadline, Expired, LabError

T = TypeVar("T")

REPLY_SECONDS = 120
"""QEMU answers at once; a busy host may take a while to let it."""


class Exited(LabError):
    """QEMU is gone; the message has its status and its last words."""


class _Client(QMPClient):
    """Writes down every message."""

    def __init__(self, log: Path) -> None:
        super().__init__("lab")
        self._log = log.open("a", buffering=1)

    def _cb_outbound(self, msg: Message) -> Message:
        self._log.write(f"-> {bytes(msg).decode().strip()}\n")
        return msg

    def _cb_inbound(self, msg: Message) -> Message:
        self._log.write(f"<- {bytes(msg).decode().strip()}\n")
        return msg

    def close(self) -> None:
        self._log.close()


class Emulator:
    """A running QEMU. It dies with the thread that made it, so make it in one that stays."""

    def __init__(self, argv: Callable[[str], Sequence[str]], directory: Path, inherited: Sequence[int] = ()) -> None:
        """Start QEMU. `argv` gets the chardev backend of the control channel; `inherited`: descriptors QEMU keeps."""
        self._errors = directory / "qemu.stderr"
        ours, theirs = socket.socketpair()
        # A pair of connected sockets rather than a path: nothing to wait for, and no limit of 107 characters.
        with theirs, self._errors.open("ab") as errors:
            command = [*DIE_WITH_PARENT, *argv(qemu.inherited_socket(theirs.fileno()))]
            (directory / "qemu.command").write_text(shlex.join(command) + "\n")
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                pass_fds=[theirs.fileno(), *inherited],
            )
        self._runner = asyncio.Runner()
        self._client = _Client(directory / "qmp.log")
        self._events = EventListener()
        self._ended = False
        self._client.register_listener(self._events)
        try:
            self._await(self._client.connect(ours), REPLY_SECONDS)
        except BaseException:
            self.kill()
            raise

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def processor_s(self) -> float:
        """Seconds of a processor of the host that it has taken so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")  # utime, stime: proc(5)

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def execute(self, command: str, **arguments: object) -> Any:
        """Result of a QMP command; underscores in names of arguments stand for hyphens."""
        named = {name.replace("_", "-"): value for name, value in arguments.items()}
        return self._await(self._client.execute(command, named or None), REPLY_SECONDS)

    def wait_event(self, name: str, timeout: float) -> dict[str, Any]:
        """The next QMP event of that name that nobody has waited for yet; earlier others are passed over."""

        async def next_event() -> dict[str, Any]:
            gone = asyncio.ensure_future(self._client.runstate_changed())
            try:
                while not self._events.empty() or self._client.runstate == Runstate.RUNNING:
                    event = asyncio.ensure_future(self._events.get())
                    await asyncio.wait({event, gone}, return_when=asyncio.FIRST_COMPLETED)
                    if not event.done():
                        event.cancel()
                    elif event.result()["event"] == name:
                        return dict(event.result())
                raise EOFError
            finally:
                gone.cancel()

        return self._await(next_event(), timeout)

    def wait(self, timeout: float) -> int:
        """Wait until QEMU ends by itself: its exit status."""
        try:
            status = self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise Expired(f"QEMU still runs after {timeout:g} s") from None
        self.kill()
        return status

    def kill(self) -> None:
        """End QEMU without a word of warning; may be repeated."""
        self._process.kill()
        self._process.wait()
        if self._ended:
            return
        self._ended = True
        with contextlib.suppress(QMPError, EOFError, OSError):
            self._runner.run(self._client.disconnect())
        self._runner.close()
        self._client.close()

    def explain(self) -> str:
        """Why QEMU is no longer there."""
        try:
            status = self._process.wait(REPLY_SECONDS)
        except subprocess.TimeoutExpired:
            return "QEMU runs, but closed its channels"
        return f"QEMU ended with status {status}: {self._errors.read_text(errors='replace').strip() or '(no message)'}"

    def forwards(self) -> dict[str, int]:
        """Loopback ports that lead into the user-mode network, by address there."""
        shown = self.execute("human-monitor-command", command_line="info usernet")
        found = re.findall(r"HOST_FORWARD\]\s+\d+\s+127\.0\.0\.1\s+(\d+)\s+(\S+)\s+22\s", shown)
        return {address: int(port) for port, address in found}

    def sockets(self) -> dict[str, int]:
        """Loopback ports of serial ports, by chardev."""
        found = {
            chardev["label"]: re.search(r"tcp:127\.0\.0\.1:(\d+)", chardev["filename"])
            for chardev in self.execute("query-chardev")
        }
        return {label: int(match[1]) for label, match in found.items() if match}

    def _await(self, work: Coroutine[Any, Any, T], timeout: float) -> T:
        deadline = Deadline(timeout)
        try:
            return self._runner.run(asyncio.wait_for(work, deadline.left))
        except TimeoutError:
            raise Expired(f"QEMU did not answer within {timeout:g} s") from None
        except ExecuteError:
            raise  # QEMU's own answer: no
        except (EOFError, OSError, QMPError) as error:
            raise Exited(self.explain()) from error
