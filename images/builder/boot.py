"""`make boot`: a robot's card image in QEMU on this terminal. `make ssh`: a shell on that guest, or on the robot."""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ipaddress import IPv4Address
from pathlib import Path

from images.builder import paths, progress, qemu
from images.builder.errors import UserError
from images.builder.fleet import Board, Network, Robot

RUN = paths.BUILD / "run"
"""What `make boot` and `make fleet` tell `make ssh`: the port, in a file that means something only while locked."""


def boot(robot: Robot, board: Board, network: Network, image: Path, station: IPv4Address | None = None) -> None:
    """Boot the image on this terminal until QEMU ends. The image does not change.

    `station`: the address under which the host appears to the guest; by default one that is free.
    """
    if not image.exists():
        raise UserError(f"{paths.shown(image)} is missing; build it: make image ROBOT={robot.number}")
    qemu.program(board)  # complain about a missing QEMU before anything is left behind
    port = _free_port()
    with announced(robot, port):
        overlay = RUN / f"{robot.name}.qcow2"
        qemu.make_overlay(image, overlay, qemu.CARD_BYTES)
        link = qemu.UserLink(
            subnet=network.subnet,
            guest=robot.address,
            station=station or qemu.station_address(network, robot.address),
            port=port,
        )
        options = qemu.Options(
            name=robot.name,
            console=qemu.STDIO,
            monitor=True,
            link=link,
            mac=qemu.robot_mac(robot.number),
        )
        argv = [*DIE_WITH_PARENT, *qemu.command_line(board, overlay, options)]
        progress.command(argv)
        sys.stderr.write(
            f"{robot.name}: booting {paths.shown(image)} ({board.description}); what it writes is thrown away\n"
            f"leave: Ctrl-A X    QEMU's monitor and back: Ctrl-A C    shell: make ssh ROBOT={robot.number}\n"
        )
        sys.stderr.flush()
        try:
            status = subprocess.run(argv, check=False).returncode
        finally:
            overlay.unlink(missing_ok=True)
    if status:
        raise UserError(f"{robot.name}: QEMU ended with status {status}; its message is above")


def ssh(robot: Robot, command: Sequence[str] = ()) -> None:
    """Become `ssh` to the robot's guest when one runs, else to the robot."""
    port = forwarded_port(robot)
    argv = [*ssh_command(robot), *command]
    progress.command(argv)
    sys.stderr.write(f"{robot.name}: {f'guest on port {port}' if port else f'robot at {robot.address}'}\n")
    sys.stderr.flush()
    try:
        os.execvp("ssh", argv)
    except FileNotFoundError as error:
        raise UserError("ssh is missing on this computer; install it: sudo apt-get install openssh-client") from error


def ssh_command(robot: Robot) -> list[str]:
    """`ssh` to the robot's guest when one runs, else to the robot."""
    port = forwarded_port(robot)
    return ["ssh", *ssh_options(robot), *(["-p", str(port), "127.0.0.1"] if port else [str(robot.address)])]


def ssh_options(robot: Robot) -> list[str]:
    """How every `ssh` to a robot proves who is who: the operator's key, the robot's pinned host key, nothing asked."""
    key, known_hosts = paths.KEYS / "operator_ed25519", paths.KEYS / "known_hosts"
    for file in (key, known_hosts):
        if not file.exists():
            raise UserError(f"{paths.shown(file)} is missing; `make image ROBOT={robot.number}` makes the keys")
    settings = {
        "User": "robot",
        "IdentityFile": str(key),
        "IdentitiesOnly": "yes",
        "BatchMode": "yes",
        "StrictHostKeyChecking": "yes",
        "HostKeyAlias": robot.name,
        "UserKnownHostsFile": str(known_hosts),
        "GlobalKnownHostsFile": "none",
        # s: where nothing answers, not even a refusal, TCP alone would try for minutes.
        "ConnectTimeout": "20",
    }
    # Quoted, because ssh splits the values of file options at blanks.
    return [word for name, value in settings.items() for word in ("-o", f'{name}="{value}"')]


def no_answer(robot: Robot, said: str) -> UserError:
    """That a command by `ssh_command` did not reach the robot, or broke off; `said`: what there is to say about it."""
    return UserError(f"{robot.name} did not answer: {said}; is it on and reachable? `make ssh ROBOT={robot.number}`")


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


DIE_WITH_PARENT = ["setpriv", "--pdeathsig", "KILL"]
"""Prefix of a command that must not outlive the thread that starts it, however that ends."""


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


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
