"""The commands of the lab: `flotilla boot`, `fleet`, `latency`, `scenarios` and others."""

from __future__ import annotations

import argparse

from flotilla.cli.command import Command, HostList, Target, robot_argument


def _boot(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory
    from flotilla.images import build
    from flotilla.lab.qemu import boot

    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    station = fleet.stations[0].address if fleet.stations else None
    boot.boot(robot, fleet.boards[robot.board], fleet.network, build.image_of(robot), station=station)


def _fleet(arguments: argparse.Namespace) -> None:
    from flotilla.lab.qemu import virtual_fleet

    virtual_fleet.run(arguments)


def _fleet_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.qemu import virtual_fleet

    virtual_fleet.arguments(parser)


def _fleet_scale(arguments: argparse.Namespace) -> None:
    from flotilla.lab.containers import scale

    scale.run(arguments)


def _fleet_scale_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.containers import scale

    scale.arguments(parser)


def _latency(arguments: argparse.Namespace) -> None:
    from flotilla.lab.latency import command

    command.latency(arguments)


def _latency_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.latency import command

    command.latency_arguments(parser)


def _latency_accept(arguments: argparse.Namespace) -> None:
    from flotilla.lab.latency import command

    command.accept(arguments)


def _latency_accept_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.latency import command

    command.accept_arguments(parser)


def _accept(arguments: argparse.Namespace) -> None:
    from flotilla.lab.acceptance import command

    command.run(arguments)


def _accept_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.acceptance import command

    command.arguments(parser)


def _boot_time(arguments: argparse.Namespace) -> None:
    from flotilla.lab.latency import command

    command.boot_time(arguments)


def _boot_time_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.latency import command

    command.system_arguments(parser)


def _scenarios(arguments: argparse.Namespace) -> None:
    from flotilla.lab.scenarios import command

    command.run(arguments)


def _scenarios_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.scenarios import command

    command.arguments(parser)


def _scenarios_accept(arguments: argparse.Namespace) -> None:
    from flotilla.lab.scenarios import command

    command.accept(arguments)


def _emulate(arguments: argparse.Namespace) -> None:
    from flotilla.lab.emulators import command

    command.run(arguments)


def _emulate_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.emulators import command

    command.arguments(parser)


def _power_cuts(arguments: argparse.Namespace) -> None:
    from flotilla.lab.power_cuts import command

    command.run(arguments)


def _power_cuts_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.power_cuts import command

    command.arguments(parser)


def _radio_capacity(arguments: argparse.Namespace) -> None:
    from flotilla.lab.radio import command

    command.run(arguments)


def _radio_capacity_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.radio import command

    command.arguments(parser)


def _wheeled(arguments: argparse.Namespace) -> None:
    from flotilla.lab.wheeled import command

    command.run(arguments)


def _wheeled_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.lab.wheeled import command

    command.arguments(parser)


def _wheeled_down(_: argparse.Namespace) -> None:
    from flotilla.lab.wheeled import command

    command.down()


_LAB: tuple[HostList, ...] = ("build", "lab")
_LAB_AND_RUNTIME: tuple[HostList, ...] = (*_LAB, "runtime")

COMMANDS = (
    Command("Lab", "boot", "boot a robot's image in QEMU on this terminal", _boot, robot_argument,
            host=_LAB, example="ROBOT=3"),
    Command("Lab", "fleet", "start, list or stop a virtual fleet of QEMU guests", _fleet, _fleet_arguments,
            packages="station", host=_LAB, targets=(
        Target("fleet", "start a virtual fleet of QEMU guests in the background", "N=4", given={"WHAT": "up"},
               needs=("N",)),
        Target("fleet-status", "list the guests of the virtual fleet and their state", given={"WHAT": "status"},
               takes=()),
        Target("fleet-down", "stop the virtual fleet", given={"WHAT": "down"}, takes=()),
    )),
    Command("Lab", "wheeled", "simulate wheeled robots to drive, until Ctrl-C", _wheeled,
            _wheeled_arguments, packages="station", host=_LAB_AND_RUNTIME, example="N=2 ROOM=corner"),
    Command("Lab", "wheeled-down", "stop the simulated wheeled robots", _wheeled_down, packages="station",
            host=_LAB_AND_RUNTIME),
    Command("Lab", "fleet-scale", "measure provisioning of N robots in containers (root)", _fleet_scale,
            _fleet_scale_arguments, packages="station", root=True, host=_LAB, example="N=32"),
    Command("Lab", "emulate", "emulate a serial device until interrupted", _emulate, _emulate_arguments, targets=()),
    Command("Lab", "latency", "measure latency in virtual time; compare with a baseline", _latency, _latency_arguments,
            host=_LAB_AND_RUNTIME, example="BOARD=x86_64 KERNEL=lean PLAN=standard"),
    Command("Lab", "latency-accept", "measure latency and store it as the new baseline", _latency_accept,
            _latency_accept_arguments, host=_LAB_AND_RUNTIME, example="BOARD=x86_64 KERNEL=lean"),
    Command("Lab", "accept", "test a robot's hardware and write a signed report", _accept, _accept_arguments,
            packages="station", host=_LAB_AND_RUNTIME, example="ROBOT=3 RELAYS=1"),
    Command("Lab", "boot-time", "measure the steps of a boot in virtual time", _boot_time, _boot_time_arguments,
            host=_LAB_AND_RUNTIME, example="BOARD=x86_64 KERNEL=lean"),
    Command("Lab", "scenarios", "simulate robots with packet loss and link failures", _scenarios,
            _scenarios_arguments, packages="station", host=_LAB_AND_RUNTIME, example="ON=lockstep LINK=ibss"),
    Command("Lab", "scenarios-accept", "run the scenarios and store them as the new baseline", _scenarios_accept,
            packages="station", host=_LAB_AND_RUNTIME),
    Command("Lab", "radio-capacity", "simulate how many robots one radio cell carries", _radio_capacity,
            _radio_capacity_arguments, packages="station", example="STANDARD=g RATE=11M PHASES=random"),
    Command("Lab", "power-cuts", "replay a power cut at every write of an update", _power_cuts,
            _power_cuts_arguments, packages="station", host=_LAB_AND_RUNTIME, example="BOARD=smartcoret3 MIB=16"),
)  # fmt: skip
