"""`make boot`: a robot's card image in QEMU on this terminal."""

from __future__ import annotations

import socket
import subprocess
import sys
from ipaddress import IPv4Address
from pathlib import Path

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.fleet.model import Board, Network, Robot
from flotilla.lab.qemu import qemu
from flotilla.robot import ssh


def boot(robot: Robot, board: Board, network: Network, image: Path, station: IPv4Address | None = None) -> None:
    """Boot the image on this terminal until QEMU ends. The image does not change.

    `station`: the address under which the host appears to the guest; by default one that is free.
    """
    if not image.exists():
        raise UserError(f"{paths.shown(image)} is missing; build it: make image ROBOT={robot.number}")
    qemu.program(board)  # complain about a missing QEMU before anything is left behind
    port = _free_port()
    with ssh.announced(robot, port):
        overlay = ssh.RUN / f"{robot.name}.qcow2"
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
        if not board.console:
            sys.stderr.write(f"board {board.name} has no `console:`: the boot is not shown here; use `make ssh`\n")
        sys.stderr.flush()
        try:
            status = subprocess.run(argv, check=False).returncode
        finally:
            overlay.unlink(missing_ok=True)
    if status:
        raise UserError(f"{robot.name}: QEMU ended with status {status}; its message is above")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
