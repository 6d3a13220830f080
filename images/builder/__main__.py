"""Command line of the builder; `make help` lists the targets that call it."""

from __future__ import annotations

import argparse
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

from images.builder.errors import UserError


def _image(arguments: argparse.Namespace) -> None:
    from images.builder import build, inventory

    fleet = inventory.load_fleet()
    robots = list(fleet.robots.values()) if arguments.all else [inventory.robot(fleet, arguments.robot)]
    build.build(fleet, robots)


def _flash(arguments: argparse.Namespace) -> None:
    from images.builder import build, flash, inventory

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    flash.flash(
        build.image_of(robot), device=arguments.device, file=arguments.file, force=arguments.force, yes=arguments.yes,
        robot=str(robot.number),
    )  # fmt: skip


def _boot(arguments: argparse.Namespace) -> None:
    from images.builder import boot, build, inventory

    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    station = fleet.stations[0].address if fleet.stations else None
    boot.boot(robot, fleet.boards[robot.board], fleet.network, build.image_of(robot), station=station)


def _ssh(arguments: argparse.Namespace) -> None:
    from images.builder import boot, inventory

    boot.ssh(inventory.robot(inventory.load_fleet(), arguments.robot))


def _deploy(arguments: argparse.Namespace) -> None:
    from images.builder import app, app_deploy, app_robot, inventory

    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    with app_robot.connection(robot) as to:
        if arguments.run:
            print(app_deploy.command(to, app.name_of(arguments.app), arguments.run))
        else:
            board, show = fleet.boards[robot.board], functools.partial(print, flush=True)
            options = {"keep": arguments.keep, "on_robot": arguments.on_robot}
            print(app_deploy.deploy(to, arguments.app, board, show=show, **options))


def _new_app(arguments: argparse.Namespace) -> None:
    from images.builder import app_new

    print(app_new.create(arguments.kind, arguments.name))


def _verify(arguments: argparse.Namespace) -> None:
    from images.builder import inventory, verify

    fleet = inventory.load_fleet()
    print(verify.verify(fleet, inventory.robot(fleet, arguments.robot), plant=arguments.plant))


def _size(arguments: argparse.Namespace) -> None:
    from images.builder import build, inventory, size

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    print(size.report(build.image_of(robot), remedy=f"make image ROBOT={robot.number}"))


def _hwcheck(arguments: argparse.Namespace) -> None:
    from images.builder import hwcheck, inventory

    print(hwcheck.check(inventory.robot(inventory.load_fleet(), arguments.robot), arguments.seconds))


def _param(arguments: argparse.Namespace) -> None:
    from images.builder import inventory, param

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    print(param.param(robot, arguments.task, arguments.parameter, arguments.value))


def _bench(arguments: argparse.Namespace) -> None:
    from images.builder import bench, inventory

    fleet = inventory.load_fleet()
    robot = next(iter(fleet.robots)) if arguments.robot is None else arguments.robot
    print(bench.bench(fleet, inventory.robot(fleet, robot)))


def _kernel(arguments: argparse.Namespace) -> None:
    from images.builder import kernel

    print(kernel.report([arguments.board]))


def _rotate_key(arguments: argparse.Namespace) -> None:
    from images.builder import identity, inventory

    fleet = inventory.load_fleet()
    (identity.retire_host_key if arguments.retire else identity.rotate_host_key)(
        fleet, inventory.robot(fleet, arguments.robot)
    )


def _lock(_: argparse.Namespace) -> None:
    from images.builder import lock

    print(lock.update_locks())


def _check_fleet(_: argparse.Namespace) -> None:
    from images.builder import inventory

    print(inventory.summary(inventory.load_fleet()))


_COMMANDS: dict[str, tuple[Callable[[argparse.Namespace], None], str]] = {
    "image": (_image, "make card images"),
    "flash": (_flash, "write a card and read it back"),
    "boot": (_boot, "boot an image in QEMU"),
    "ssh": (_ssh, "shell on a robot"),
    "deploy": (_deploy, "bring an app to a robot and run it"),
    "new-app": (_new_app, "make a working start of an app"),
    "size": (_size, "what takes the room of an image"),
    "verify": (_verify, "build a second time under other circumstances and compare"),
    "hwcheck": (_hwcheck, "what a robot's hardware is and does"),
    "param": (_param, "parameters of a control task that runs"),
    "bench": (_bench, "wall times and ratios against other builders"),
    "kernel": (_kernel, "build a kernel of our own as a Debian package"),
    "rotate-key": (_rotate_key, "give a robot a new host key"),
    "lock": (_lock, "resolve the package lists"),
    "check-fleet": (_check_fleet, "validate the inventory"),
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m images.builder", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    made = {name: commands.add_parser(name, help=text) for name, (_, text) in _COMMANDS.items()}
    for name in (
        "image",
        "flash",
        "boot",
        "ssh",
        "deploy",
        "size",
        "verify",
        "hwcheck",
        "param",
        "bench",
        "rotate-key",
    ):
        made[name].add_argument("--robot", type=int, help="number in the inventory")
    made["deploy"].add_argument("--app", type=Path, required=True, help="the app's directory")
    made["deploy"].add_argument("--run", help="start, stop, status, log or remove what is on the robot")
    made["deploy"].add_argument("--keep", action="store_true", help="start it with the robot")
    made["deploy"].add_argument("--on-robot", action="store_true", help="compile it on the robot")
    made["new-app"].add_argument("--kind", required=True)
    made["new-app"].add_argument("--name", required=True)
    made["kernel"].add_argument("--board", required=True, help="name in kernel/kernels.yml")
    made["image"].add_argument("--all", action="store_true", help="every robot of the fleet")
    made["hwcheck"].add_argument(
        "--seconds", type=int, default=60, help="of looking for hardware latency (%(default)s)"
    )
    made["param"].add_argument("task", help="which runs on the robot")
    made["param"].add_argument("parameter", nargs="?", help="block.parameter; all by default")
    made["param"].add_argument("value", nargs="?", help="what to set it to")
    made["verify"].add_argument("--plant", action="store_true", help="plant a difference, which must be found")
    made["rotate-key"].add_argument("--retire", action="store_true", help="accept the old one no more")
    target = made["flash"].add_mutually_exclusive_group(required=True)
    target.add_argument("--device", type=Path, help="the card: /dev/sdX")
    target.add_argument("--file", type=Path, help="a file instead of a card")
    made["flash"].add_argument("--force", help="the word that an earlier refusal named")
    made["flash"].add_argument("--yes", action="store_true", help="do not ask")
    return parser


def main() -> int:
    os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"  # there are none, and to look for them reads every package
    arguments = _parser().parse_args()
    try:
        _COMMANDS[arguments.command][0](arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"error: interrupted; {str(interrupt) or 'the last good outputs are untouched'}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
