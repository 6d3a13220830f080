"""How the station reaches a robot by ssh, or its guest when one runs on this computer."""

from __future__ import annotations

import fcntl
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.common.processes import bounded
from flotilla.common.text import shown
from flotilla.fleet import keys
from flotilla.fleet.model import Robot

FAILED = 255
"""Status of `ssh` when there is no connection; every other one is the command's."""
PATIENCE_S = 120
"""A service that stops may take 90 s, systemd's own limit."""
RUN = paths.BUILD / "run"
"""What `make boot` and `make fleet` tell `make ssh`: the port, in a file that means something only while locked."""


def shell(robot: Robot, words: Sequence[str] = ()) -> None:
    """Become `ssh` to the robot's guest when one runs, else to the robot."""
    port = forwarded_port(robot)
    argv = [*command(robot), *words]
    progress.command(argv)
    sys.stderr.write(f"{robot.name}: {f'guest on port {port}' if port else f'robot at {robot.address}'}\n")
    sys.stderr.flush()
    try:
        os.execvp("ssh", argv)
    except FileNotFoundError as error:
        raise UserError("ssh is missing on this computer; install it: sudo apt-get install openssh-client") from error


def command(robot: Robot, *, former: bool = True) -> list[str]:
    """`ssh` to the robot's guest when one runs, else to the robot. `former`: as of `options`."""
    port = forwarded_port(robot)
    return [
        "ssh",
        "-F",
        "none",
        *options(robot, former=former),
        *(["-p", str(port), "127.0.0.1"] if port else [str(robot.address)]),
    ]


def output(robot: Robot, words: Sequence[str], by: Sequence[str] | None = None) -> str:
    """What a command on the robot prints, without the last line's end, fit for a terminal; what it says on stderr, as
    UserError, when it fails, or when it lasts longer than PATIENCE_S. A program's name before its message is left out.
    `by`: another way there than `command`'s."""
    argv = [*(by or command(robot)), shlex.join(words)]
    try:
        done = bounded(argv, timeout_s=PATIENCE_S)
    except UserError as error:
        raise UserError(f"{robot.name}: {error}: look at the robot") from None
    except subprocess.TimeoutExpired:
        raise no_answer(robot, f"nothing within {PATIENCE_S} s") from None
    if done.returncode == FAILED:
        raise no_answer(robot, shown(done.stderr.strip()))
    if done.returncode:
        raise UserError(f"{robot.name}: {shown(done.stderr.strip()).removeprefix(f'{words[0]}: ')}")
    return shown(done.stdout.rstrip("\n"))


def options(robot: Robot, *, former: bool = True) -> list[str]:
    """How every `ssh` to a robot proves who is who: the operator's key, the robot's pinned host key, nothing asked.
    `former`: while the operator's key is rotated, the one before will do, too."""
    key, known_hosts = paths.KEYS / "operator_ed25519", paths.KEYS / "known_hosts"
    for file, kept in ((key, (key, key.with_name(f"{key.name}.pub"))), (known_hosts, (known_hosts,))):
        if not any(each.exists() for each in kept):
            raise UserError(f"{paths.shown(file)} is missing; `make image ROBOT={robot.number}` makes the keys")
    key = keys.usable(key)
    settings = {
        "User": "robot",
        "IdentityFile": str(key),
        "IdentitiesOnly": "yes",
        "BatchMode": "yes",
        "StrictHostKeyChecking": "yes",
        "HostKeyAlias": robot.name,
        "UserKnownHostsFile": str(known_hosts),
        "GlobalKnownHostsFile": "none",
        # An agent, a display or a port that is lent to a robot is lent to whoever has taken it over.
        "ForwardAgent": "no",
        "ForwardX11": "no",
        "ClearAllForwardings": "yes",
        # s: where nothing answers, not even a refusal, TCP alone would try for minutes.
        "ConnectTimeout": "20",
    }
    pairs = list(settings.items())
    if former and (before := keys.former_operator()):
        pairs.append(("IdentityFile", str(before)))
    # Quoted, because ssh splits the values of file options at blanks.
    return [word for name, value in pairs for word in ("-o", f'{name}="{value}"')]


def no_answer(robot: Robot, reason: str) -> UserError:
    """That a command by `command` did not reach the robot, or broke off; `reason`: in the words of whoever found it."""
    return UserError(f"{robot.name} did not answer: {reason}; is it on and reachable? `make ssh ROBOT={robot.number}`")


def forwarded_port(robot: Robot) -> int | None:
    """The loopback port of the robot's guest, or None when none runs."""
    try:
        record = _record(robot).open()
    except FileNotFoundError:
        return None
    with record:
        try:
            fcntl.flock(record, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return int(record.read())
    return None  # nobody holds the lock: left behind by a guest that ended


@contextmanager
def announced(robot: Robot, port: int) -> Iterator[None]:
    """Record for `make ssh` that the robot's guest listens on a loopback port, while the body runs.

    The file is never removed, since only its lock means something, and that ends with this process in whatever way.
    """
    RUN.mkdir(parents=True, exist_ok=True)
    with _record(robot).open("a") as record:
        try:
            fcntl.flock(record, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            remedy = f"leave it with Ctrl-A X or make fleet-down, or use make ssh ROBOT={robot.number}"
            raise UserError(f"{robot.name} runs already as a guest; {remedy}") from None
        record.truncate(0)
        record.write(str(port))
        record.flush()
        yield


def _record(robot: Robot) -> Path:
    return RUN / f"{robot.name}.port"
