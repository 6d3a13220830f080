"""A virtual fleet: guests of the shipped images on one segment, left running in the background, to try a fleet on.

`make fleet N=4` starts it, `make fleet-status` asks it, `make fleet-down` ends it. While it runs, `make ssh ROBOT=3`
leads to the guest, and `build/fleet/guests.yml` tells Ansible where the guests are. What guests write is thrown away.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO

import yaml

from flotilla.common import durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.variables import variable
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet, Health, Robot
from flotilla.images.build import build, image_of
from flotilla.lab.qemu import holder, saved
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.radio_segment import segment_of
from flotilla.lab.qemu.segment import Segment
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import LabError
from flotilla.robot import ssh

DIRECTORY = paths.BUILD / "fleet"
GUESTS = paths.GUESTS
"""An inventory to put behind the real one: where the guests are. There while the fleet is."""
INVENTORY = DIRECTORY / "inventory"
"""The fleet's description where `LINK=` is not the project's."""
_LOCK = DIRECTORY / "lock"
"""Locked by the process that holds the fleet, whose number stands in it: without the lock, all here is left behind."""
_LOG = DIRECTORY / "log"
DOWN_SECONDS = 300
_ANSWER_SECONDS = 300
"""Of one guest to `make fleet-status`."""
LET_IN_SECONDS = 900
"""What Ansible waits for a guest to let it in. Only finite: a host that is slow is no robot that is away, which ssh's
own questions (`ServerAliveInterval`) tell from it."""
STATUS = """
cut -d ' ' -f 1 /proc/uptime
sudo systemctl is-system-running
sudo systemctl list-units --plain --no-legend 'flotilla-task@*'
"""
"""What `make fleet-status` asks each robot."""


def guests_inventory(ports: Mapping[str, int]) -> str:
    """An Ansible inventory that says through which loopback ports the robots' guests are reached.

    A guest's host promises no time, and nothing is plugged into its ports: neither makes it unhealthy or unreachable.
    Ansible would prefer what `group_vars/all.yml` says to a group's variable.
    """
    lenient = Health(overruns_percent=100).model_dump()
    each = {"ansible_host": "127.0.0.1", "health": lenient, "ansible_ssh_timeout": LET_IN_SECONDS}
    return yaml.safe_dump({"guests": {"hosts": {name: {**each, "ansible_port": port} for name, port in ports.items()}}})


def with_link(link: str, directory: Path) -> Path:
    """The project's inventory as `directory`, but with another `network.link`, which check-fleet's rules accept."""
    shutil.copytree(paths.INVENTORY, directory)
    file = directory / "group_vars/all.yml"
    text, count = re.subn(r"(?m)^(  link: ).*$", rf"\g<1>{link}", file.read_text())
    assert count == 1, f"{file} has {count} lines with network.link"
    file.write_text(text)
    return directory


@contextmanager
def running(
    fleet: Fleet, robots: Sequence[Robot], directory: Path, ports: Mapping[str, Mapping[str, str]] | None = None,
    images: Path = paths.IMAGES,
) -> Iterator[tuple[dict[str, Guest], Segment]]:  # fmt: skip
    """The robots as guests on one segment with the station, started, by name; `saved.wait` waits for each.

    `ports`: by the robot's name, its `qemu.Options.ports`.
    """
    with ExitStack() as stack:
        segment = stack.enter_context(segment_of(fleet, robots, directory / "segment"))
        guests = {}
        for robot in robots:
            options = replace(segment.options(robot), ports=(ports or {}).get(robot.name, {}))
            guest = Guest(fleet.boards[robot.board], image_of(robot, images), directory / robot.name, options)
            guests[robot.name] = stack.enter_context(guest)
            saved.start(guest)
        yield guests, segment


def up(count: int, link: str | None = None) -> None:
    """Start the first `count` robots as guests in the background, and wait until each lets us in.

    `link`: instead of the inventory's `network.link`; then guests have cards of their own.
    """
    fleet = inventory.load_fleet()
    robots = list(fleet.robots.values())[:count]
    if not 1 <= count <= len(fleet.robots):
        where = paths.shown(paths.INVENTORY / "robots.yml")
        raise UserError(
            f"N={count}: {where} has {len(fleet.robots)} robots; give 1 to {len(fleet.robots)}, or add some"
        )
    for robot in robots if link is None else ():
        if not image_of(robot).exists():
            raise UserError(f"{paths.shown(image_of(robot))} is missing; build it: make image ROBOT={robot.number}")
    if ports := guest_ports():
        if len(ports) != count:
            raise UserError(f"a virtual fleet of {len(ports)} runs already; end it first: make fleet-down")
        _say(ports, "runs already")
        return
    DIRECTORY.mkdir(parents=True, exist_ok=True)
    argv = [sys.executable, "-m", "flotilla", "fleet", "hold", str(count), *([f"--link={link}"] if link else [])]
    progress.command(argv)
    with progress.step(f"boot {count} guests") as step, _LOG.open("w") as log:
        process = subprocess.Popen(
            argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True, cwd=paths.WORKPLACE,
            start_new_session=True,  # Ctrl-C here is not meant for it
        )  # fmt: skip
        try:
            assert process.stdout
            awaited = [robot.name for robot in robots]
            step.at(0, count, "guests", awaited[0])
            for number, _ in enumerate(process.stdout, 1):  # a line for each that has booted
                step.at(number, count, "guests", *awaited[number : number + 1])
            if process.poll() is not None or not guest_ports():
                raise UserError(f"the virtual fleet did not start; {paths.shown(_LOG)} contains:\n{_LOG.read_text()}")
        except BaseException:
            process.terminate()
            raise
    how = f" by {link}" if link else ""
    _say(guest_ports(), f"runs on {fleet.network.subnet}{how}")


def status() -> str:
    """A line for each guest: uptime, state, tasks."""
    ports = guest_ports()
    if not ports:
        return "no virtual fleet runs; start one: make fleet N=4"
    robots = [robot for robot in inventory.load_fleet().robots.values() if robot.name in ports]

    def ask(robot: Robot) -> str:
        try:
            done = subprocess.run(
                [*ssh.command(robot), STATUS], capture_output=True, text=True, timeout=_ANSWER_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            return f"{robot.name}  no answer"
        if len(lines := done.stdout.splitlines()) < 2:
            return f"{robot.name}  no answer: {done.stderr.strip()}"
        uptime, state, *tasks = lines
        shown = ", ".join(" ".join(task.split()[:4:3]) for task in tasks) or "no tasks"
        return f"{robot.name}  port {ports[robot.name]}  up {uptime} s  {state}  {shown}"

    with concurrent.futures.ThreadPoolExecutor(len(robots)) as pool:
        return "\n".join(pool.map(ask, robots))


def down() -> str:
    """End the virtual fleet, be it still starting, and remove what it left."""
    ports = _written_ports()
    lock, ran = holder.end(_LOCK, DOWN_SECONDS)
    if lock is None:
        raise UserError(f"the virtual fleet did not end within {DOWN_SECONDS} s; process {_LOCK.read_text()} holds it")
    ended = f"{len(ports)} guests ended" if ports else "the virtual fleet ended before it had started"
    with lock:
        GUESTS.unlink(missing_ok=True)
    return ended if ran else "no virtual fleet runs"


def hold(count: int, link: str | None = None) -> None:
    """Be the process in the background, until SIGTERM: a line on standard output for each robot that has booted."""
    signal.signal(signal.SIGTERM, _end)
    lock = _free_lock()
    if lock is None:
        raise UserError("a virtual fleet runs already; end it: make fleet-down")
    with lock, ExitStack() as stack:
        holder.sign(lock)
        GUESTS.unlink(missing_ok=True)
        for directory in filter(Path.is_dir, DIRECTORY.iterdir()):
            shutil.rmtree(directory)  # a killed fleet's: its guests' overlays may be of other images
        fleet = inventory.load_fleet(with_link(link, INVENTORY) if link else None)
        robots = list(fleet.robots.values())[:count]
        images = paths.IMAGES
        if link:
            images = DIRECTORY / "images"
            build(fleet, robots, images)
        guests, segment = stack.enter_context(running(fleet, robots, DIRECTORY, images=images))
        ports = {robot.name: segment.ssh_port(robot.address) for robot in robots}
        for robot in robots:
            with Ssh(robot, "127.0.0.1", functools.partial(ports.__getitem__, robot.name)) as shell:
                saved.wait(guests[robot.name], robot, shell)
            stack.enter_context(ssh.announced(robot, ports[robot.name]))
            print(robot.name, flush=True)
        stack.callback(GUESTS.unlink, missing_ok=True)
        durable.write(GUESTS, guests_inventory(ports))
        sys.stdout.close()
        os.close(1)
        # Not signal.pause(), which would miss a signal that comes just before it.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        signal.sigwait({signal.SIGTERM})


def _end(*_: object) -> None:
    """Handler of SIGTERM while the fleet starts."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one would interrupt the cleaning up
    raise SystemExit("it was ended before it had started")


def guest_ports() -> dict[str, int]:
    """SSH ports of the running fleet's guests by robot; empty when none runs."""
    lock = _free_lock()
    if lock is not None:
        lock.close()
        return {}
    ports = _written_ports()
    if not ports:
        raise UserError("a virtual fleet is starting or ending; try again, or end it: make fleet-down")
    return ports


def _written_ports() -> dict[str, int]:
    """What GUESTS says; nothing while it is not there."""
    try:
        hosts = yaml.safe_load(GUESTS.read_text())["guests"]["hosts"]
    except FileNotFoundError:
        return {}
    return {name: values["ansible_port"] for name, values in hosts.items()}


def _free_lock() -> IO[str] | None:
    """The lock, empty and held until it is closed; None when a fleet runs."""
    return holder.free(_LOCK)


def _say(ports: Mapping[str, int], how: str) -> None:
    listed = ", ".join(f"{name} on port {port}" for name, port in ports.items())
    guests, described = (
        os.path.relpath(place, paths.PROJECT / "ansible")
        for place in (GUESTS, INVENTORY if INVENTORY.exists() else paths.INVENTORY)
    )
    command = f"cd ansible && ansible-playbook -i {described} -i {guests} -l guests fleet.yml"
    if paths.OWN_HOME:
        command = f"make provision ON=guests FLEET={paths.HOME}"
    sys.stderr.write(
        f"virtual fleet {how}: {listed}\n"
        f"provision it: {command}\n"
        "shell: make ssh ROBOT=1    state: make fleet-status    end: make fleet-down\n"
    )


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=("up", "status", "down", "hold"), help="hold: what `up` leaves running")
    variable(parser.add_argument("count", type=int, nargs="?", help="of guests, for up"), "N")
    parser.add_argument("--link", choices=("ethernet", "ibss"), help="of the guests, instead of the inventory's")


def run(arguments: argparse.Namespace) -> None:
    if arguments.what in ("up", "hold") and arguments.count is None:
        raise UserError(f"say how many guests: flotilla fleet {arguments.what} 4")
    try:
        match arguments.what:
            case "up":
                up(arguments.count, arguments.link)
            case "hold":
                hold(arguments.count, arguments.link)
            case "status":
                print(status())
            case "down":
                print(down())
    except LabError as error:
        raise UserError(str(error)) from error
