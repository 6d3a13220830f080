"""The commands about cards, robots, apps and the station; `flotilla/lab/commands.py` has those of the lab."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from flotilla.cli.command import Command, Target, robot_argument
from flotilla.common.variables import variable

if TYPE_CHECKING:
    from datetime import date

    from flotilla.fleet.model import Fleet, Robot


def _image(arguments: argparse.Namespace) -> None:
    from flotilla.apps import assigned
    from flotilla.fleet import inventory
    from flotilla.images import build

    fleet = inventory.load_fleet()
    robots = list(fleet.robots.values()) if arguments.all else [inventory.robot(fleet, arguments.robot)]
    build.build(fleet, robots, apps=assigned.built(fleet, robots))


def _image_arguments(parser: argparse.ArgumentParser) -> None:
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("robot", type=int, nargs="?", help="number in the inventory")
    which.add_argument("--all", action="store_true", help="every robot of the fleet")


def _flash(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory
    from flotilla.images import build, flash

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    flash.flash(
        build.image_of(robot), device=arguments.device, file=arguments.file, force=arguments.force, yes=arguments.yes,
        robot=str(robot.number),
    )  # fmt: skip


def _flash_arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    where = parser.add_mutually_exclusive_group(required=True)
    variable(where.add_argument("device", type=Path, nargs="?", help="the card: /dev/sdX"), "DEV")
    variable(where.add_argument("--file", type=Path, help="a file instead of a card"), "CARD")
    parser.add_argument("--force", help="the word that an earlier error named")
    variable(parser.add_argument("--yes", action="store_true", help="do not ask"))


def _kernel(arguments: argparse.Namespace) -> None:
    from flotilla.debian import kernel
    from flotilla.fleet import inventory

    print(kernel.report([arguments.board or inventory.load_fleet().board().name]))


def _kernel_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("board", nargs="?", help="a board, or another name in kernel/ (the first robot's board)")


def _verify(arguments: argparse.Namespace) -> None:
    from flotilla.apps import assigned
    from flotilla.fleet import inventory
    from flotilla.images import verify

    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    print(verify.verify(fleet, robot, assigned.built(fleet, [robot])[robot.name], plant=arguments.plant))


def _verify_arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    plant = parser.add_argument(
        "--plant", action="store_true", help="inject a difference, which the comparison must find"
    )
    variable(plant)


def _verify_bundle(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory
    from flotilla.updates import published

    print(published.verify(inventory.load_fleet(), arguments.bundle))


def _verify_bundle_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", type=Path, help="bundle file of the publisher")


def _size(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory
    from flotilla.images import build, size

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    print(size.report(build.image_of(robot), remedy=f"make image ROBOT={robot.number}"))


def _lock(arguments: argparse.Namespace) -> None:
    from flotilla.debian import lock
    from flotilla.fleet import inventory

    recipes = lock.recipes(inventory.load_fleet().boards.values())
    print(lock.update_locks(lock.chosen(recipes, arguments.only)))


def _lock_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="this lock (all)")


def _bundle(arguments: argparse.Namespace) -> None:
    from flotilla.common import paths, progress
    from flotilla.fleet import inventory
    from flotilla.robot import release
    from flotilla.updates import bundle, delta

    fleet = inventory.load_fleet()
    board = fleet.board(arguments.board)
    final = bundle.file_of(board.name)
    before = final.with_suffix(".before")
    if final.exists():
        final.replace(before)
    try:
        bundle.make(fleet, board, arguments.signature, arguments.expires)
    except BaseException:
        if before.exists():
            before.replace(final)
        raise
    if before.exists() and (warning := release.same_number(release.read(before), release.read(final))):
        print(warning)
    if before.exists() and (made := delta.between(release.read(before), release.read(final))):
        print(f"{paths.shown(made)}: {progress.size(made.stat().st_size)} for robots with the release before")


def _day(text: str) -> date:
    from flotilla.common.text import day

    return day(text)


_day.__name__ = "YYYY-MM-DD"  # in argparse's errors


def _bundle_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("board", nargs="?", help="a board (the first robot's)")
    signature = parser.add_argument(
        "--signature", type=Path, action="append", default=[], help="one that was made elsewhere"
    )
    variable(signature, "SIGNATURES", words=True)
    parser.add_argument(
        "--expires", type=_day, metavar="DATE",
        help="last day on which robots accept the bundle: 2027-01-31 (`releases.lifetime_days` from today on)",
    )  # fmt: skip


def _cve(arguments: argparse.Namespace) -> None:
    from flotilla.common.errors import UserError
    from flotilla.fleet import inventory
    from flotilla.images import cve

    report = cve.check(inventory.load_fleet(), arguments.tracker, arguments.today)
    print((cve.as_json if arguments.json else cve.table)(report, arguments.today))
    if report.failures:
        raise UserError("\n".join(report.failures))


def _cve_arguments(parser: argparse.ArgumentParser) -> None:
    from datetime import date

    parser.add_argument("--tracker", metavar="FILE", help="the security tracker's data, or their address")
    parser.add_argument(
        "--today", type=date.fromisoformat, metavar="DATE", help="compute ages as of this day: 2026-01-31"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def _check_fleet(_: argparse.Namespace) -> None:
    from flotilla.apps import assigned
    from flotilla.fleet import inventory

    fleet = inventory.load_fleet()
    assigned.check(fleet, fleet.robots.values())
    print(inventory.summary(fleet))


_OPERATOR = "operator"


def _whose(text: str) -> int | str:
    return text if text == _OPERATOR else int(text)


_whose.__name__ = f"robot's number or {_OPERATOR!r}"  # in argparse's errors


def _rotate_key(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory

    fleet = inventory.load_fleet()
    if arguments.whose == _OPERATOR:
        _rotate_operator_key(fleet, arguments)
    else:
        _rotate_host_key(fleet, inventory.robot(fleet, arguments.whose), arguments)


def _rotate_operator_key(fleet: Fleet, arguments: argparse.Namespace) -> None:
    from flotilla.fleet import keys
    from flotilla.robot import operator_key

    if arguments.retire:
        operator_key.retire(fleet, force=arguments.force)
        print("the former operator's key is gone; robots admit the new one alone")
    else:
        keys.rotate_operator_key()
        print(
            "there is a new operator's key; bring it to all robots with `make provision`, "
            "then `make rotate-key KEY=operator RETIRE=1`"
        )


def _rotate_host_key(fleet: Fleet, robot: Robot, arguments: argparse.Namespace) -> None:
    from flotilla.fleet import keys

    if arguments.retire:
        keys.retire_host_key(fleet, robot)
        print(f"{robot.name}: this computer accepts its old host key no more")
    else:
        keys.rotate_host_key(fleet, robot)
        print(
            f"{robot.name}: has a new host key; bring it there with `make provision ROBOT={robot.number}`, "
            f"then `make rotate-key ROBOT={robot.number} RETIRE=1`"
        )


def _rotate_key_arguments(parser: argparse.ArgumentParser) -> None:
    whose = parser.add_argument("whose", type=_whose, help=f"a robot's number in the inventory, or {_OPERATOR}")
    variable(whose, "ROBOT", "KEY")
    parser.add_argument(
        "--retire",
        action="store_true",
        help="accept the old key no more, once `make provision` has brought the new one",
    )
    parser.add_argument("--force", action="store_true", help="retire the operator's, whichever robots still want it")


def _revoke_key(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory, keys

    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    keys.revoke_host_key(fleet, robot)
    print(
        f"{robot.name}: this station rejects its host key; after `make provision` the other robots reject it. Its next "
        f"card, by `make image ROBOT={robot.number}`, has a new one"
    )


def _admit_operator(arguments: argparse.Namespace) -> None:
    from flotilla.common import paths
    from flotilla.fleet import inventory, operators

    fleet = inventory.load_fleet()
    given = (arguments.name, arguments.key_file, arguments.days, arguments.out, arguments.sources)
    folder, admission = operators.admit(fleet, *given)
    print(
        f"{paths.shown(folder)}: a certificate for {admission.name} until {operators.shown(admission.until)}, and "
        f"known_hosts; from that folder, with the key's private half: ssh -i KEY -o "
        f"CertificateFile={operators.CERTIFICATE} -o UserKnownHostsFile=known_hosts robot@ADDRESS"
    )


def _admit_operator_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.fleet import operators

    parser.add_argument("name", help="of the person: small letters, digits and hyphens")
    parser.add_argument("key_file", type=Path, help="the person's public key")
    parser.add_argument(
        "--days", type=int, default=operators.DAYS, help="days until the certificate expires (%(default)s)"
    )
    parser.add_argument(
        "--from",
        dest="sources",
        default="",
        metavar="ADDRESSES",
        help="addresses or networks, commas between, from which alone robots take it",
    )
    parser.add_argument("--out", type=Path, metavar="DIRECTORY", help="where to (build/operators/NAME)")


def _revoke_operator(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import operators

    operators.revoke(arguments.name)
    print(f"{arguments.name}: robots reject all certificates of that name once they have the list: `make provision`")


def _revoke_operator_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", help="of the person")


def _operators(_: argparse.Namespace) -> None:
    from flotilla.fleet import operators

    print(operators.table())


def _backup_keys(arguments: argparse.Namespace) -> None:
    from flotilla.common import paths
    from flotilla.fleet import key_backup

    files = key_backup.backup(arguments.file, arguments.password_file)
    print(f"{paths.shown(arguments.file)}: {files} files of {paths.shown(paths.KEYS)}, encrypted")


def _restore_keys(arguments: argparse.Namespace) -> None:
    from flotilla.common import paths
    from flotilla.fleet import key_backup

    files = key_backup.restore(arguments.file, arguments.password_file)
    print(f"{paths.shown(paths.KEYS)}: {files} files of {paths.shown(arguments.file)}")


def _backup_keys_arguments(parser: argparse.ArgumentParser) -> None:
    variable(parser.add_argument("file", type=Path, help="the encrypted file"), "OUT")
    _password_argument(parser)


def _restore_keys_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="the encrypted file")
    _password_argument(parser)


def _password_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--password-file", type=Path, metavar="FILE", help="has the passphrase; otherwise it is asked")


def _ssh(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory
    from flotilla.robot import ssh

    ssh.shell(inventory.robot(inventory.load_fleet(), arguments.robot))


def _releases(arguments: argparse.Namespace) -> None:
    from flotilla.common.errors import UserError
    from flotilla.fleet import inventory
    from flotilla.robot import releases

    fleet = inventory.load_fleet()
    robots = list(fleet.robots.values()) if arguments.robot is None else [inventory.robot(fleet, arguments.robot)]
    answers = releases.ask(robots)
    print((releases.as_json if arguments.json else releases.table)(answers))
    if silent := releases.problems(answers):
        raise UserError("\n".join(silent))


def _releases_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", type=int, nargs="?", help="number in the inventory (all)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def _hwcheck(arguments: argparse.Namespace) -> None:
    from flotilla.common.errors import UserError
    from flotilla.fleet import inventory
    from flotilla.robot import board_draft, hwcheck

    if (arguments.target is None) != (arguments.name is None):
        raise UserError("hwcheck: give ROBOT=3 for a robot, or TARGET=ssh:USER@HOST NAME=nuc7 for any Debian computer")
    if arguments.target:
        print(board_draft.draft(arguments.target, arguments.name))
    else:
        print(hwcheck.check(inventory.robot(inventory.load_fleet(), arguments.robot), arguments.seconds))


def _hwcheck_arguments(parser: argparse.ArgumentParser) -> None:
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("robot", type=int, nargs="?", help="number in the inventory")
    which.add_argument("--target", metavar="ssh:USER@HOST", help="any Debian computer: draft the board's file from it")
    parser.add_argument("--seconds", type=int, default=60, help="to look for hardware latency (%(default)s)")
    variable(parser.add_argument("--name", help="of the board to draft"), "NAME", only_with="TARGET")


def _param(arguments: argparse.Namespace) -> None:
    import sys

    from flotilla.common.errors import UserError
    from flotilla.fleet import inventory
    from flotilla.robot import parameters

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    given = robot, arguments.task, arguments.parameter, arguments.value
    try:
        print(parameters.param(*given, arguments.confirm))
    except UserError as error:
        old = parameters.questioned(error)
        if old is None or arguments.confirm is not None or not sys.stdin.isatty():
            raise
        if input(f"{error} [y/N] ").strip().lower() not in ("y", "yes"):
            raise UserError("nothing was changed") from None
        print(parameters.param(*given, old))


def _param_arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    parser.add_argument("task", help="which runs on the robot")
    variable(parser.add_argument("parameter", nargs="?", help="block.parameter; all by default"), "PARAM")
    parser.add_argument(
        "--confirm", metavar="OLD", help="present value of a safety limit; without it the command asks you"
    )
    value = parser.add_argument(
        "value", nargs="?", help="new value; on the command line, write a negative one after --"
    )
    variable(value, "VALUE", only_with="PARAM")


def _scope(arguments: argparse.Namespace) -> None:
    from flotilla.common import paths
    from flotilla.fleet import inventory
    from flotilla.robot import scope

    robot = inventory.robot(inventory.load_fleet(), arguments.robot)
    options = {name: getattr(arguments, name) for name in ("every", "rows", "trigger", "before")}
    command = scope.words(arguments.task, arguments.signal, csv=arguments.csv is not None, **options)
    if arguments.csv is None:
        scope.show(robot, command)
    else:
        rows = scope.record(robot, command, arguments.csv)
        print(f"{paths.shown(arguments.csv)}: {rows} rows")


def _scope_arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    parser.add_argument("task", help="or app, which runs on the robot")
    signal = parser.add_argument("signal", nargs="*", help="block.port or block.port[2]; without one, they are listed")
    variable(signal, "SIGNALS", words=True)
    parser.add_argument("--every", type=int, metavar="N", help="only steps whose number is a multiple of N")
    parser.add_argument("--rows", type=int, metavar="N", help="end after so many (when interrupted)")
    parser.add_argument("--trigger", help="wait until a signal crosses a value: 'a.out>3' upwards, 'a.out<3' downwards")
    parser.add_argument("--before", type=int, metavar="N", help="of the rows, so many are of the steps before that")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write a table there")


def _init(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import home

    print(home.make(arguments.directory.absolute()))


def _init_arguments(parser: argparse.ArgumentParser) -> None:
    variable(parser.add_argument("directory", type=Path, help="a new or empty one"), "FLEET")


def _new_app(arguments: argparse.Namespace) -> None:
    from flotilla.apps import scaffold

    print(scaffold.create(arguments.kind, arguments.name))


def _new_app_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", help="block, device, make, ert or fmu")
    parser.add_argument("name", help="of the app, and of its directory in apps/")


def _import_model(arguments: argparse.Namespace) -> None:
    from flotilla.apps import imported
    from flotilla.fleet import inventory

    systems = sorted({board.system for board in inventory.load_fleet().boards.values()})
    times_s = arguments.sample_times or []
    print(imported.create(arguments.archive, arguments.name, systems, arguments.model, times_s))


def _import_model_arguments(parser: argparse.ArgumentParser) -> None:
    archive = parser.add_argument("archive", type=Path, metavar="zip", help="archive of packNGo(buildInfo) in MATLAB")
    variable(archive, "ZIP")
    parser.add_argument("name", help="of the app, and of its directory in apps/")
    parser.add_argument("--model", help="its name, where the archive has several")
    parser.add_argument("--sample-times", type=_seconds, metavar="S,…", help="in seconds, fastest first, for a new app")


def _seconds(text: str) -> list[float]:
    return [float(each) for each in text.split(",")]


def _deploy(arguments: argparse.Namespace) -> None:
    import functools

    from flotilla.apps import app, deploy, remote
    from flotilla.fleet import inventory

    fleet = inventory.load_fleet()
    robot = inventory.robot(fleet, arguments.robot)
    with remote.connection(robot) as to:
        if arguments.run:
            print(deploy.command(to, app.name_of(arguments.app), arguments.run))
        else:
            board, show = fleet.boards[robot.board], functools.partial(print, flush=True)
            options = {"keep": arguments.keep, "on_robot": arguments.on_robot}
            print(deploy.deploy(to, arguments.app, board, show=show, **options))


def _deploy_arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    parser.add_argument("app", type=Path, help="the app's directory")
    parser.add_argument("--run", help="start, stop, status, log or remove: act on the app on the robot")
    parser.add_argument("--keep", action="store_true", help="start it with the robot")
    parser.add_argument("--on-robot", action="store_true", help="compile it on the robot")


def _station(arguments: argparse.Namespace) -> None:
    from flotilla.station import command

    command.run(arguments)


def _record_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import command

    command.record_arguments(parser)


def _station_join(arguments: argparse.Namespace) -> None:
    from flotilla.station import cell

    cell.join(arguments)


def _station_join_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import cell

    cell.join_arguments(parser)


def _station_time(arguments: argparse.Namespace) -> None:
    from flotilla.station import clock

    clock.run(arguments)


def _station_time_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import cell

    cell.station_arguments(parser)


def _station_leave(arguments: argparse.Namespace) -> None:
    from flotilla.station import cell

    cell.leave(arguments)


def _station_leave_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import cell

    cell.leave_arguments(parser)


def _live_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import command

    command.live_arguments(parser)


def _top_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import command

    command.top_arguments(parser)


def _drive(arguments: argparse.Namespace) -> None:
    from flotilla.station import drive

    drive.run(arguments)


def _drive_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import drive

    drive.drive_arguments(parser)


def _positions(arguments: argparse.Namespace) -> None:
    from flotilla.station import positions

    positions.run(arguments)


def _positions_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import positions

    positions.positions_arguments(parser)


def _page(arguments: argparse.Namespace) -> None:
    from flotilla.station import page_command

    page_command.run(arguments)


def _page_arguments(parser: argparse.ArgumentParser) -> None:
    from flotilla.station import page_command

    page_command.page_arguments(parser)


def _fetch(arguments: argparse.Namespace) -> None:
    from flotilla.fleet import inventory
    from flotilla.robot import fetch

    print(fetch.fetch(inventory.robot(inventory.load_fleet(), arguments.robot), arguments.task, arguments.out))


def _fetch_arguments(parser: argparse.ArgumentParser) -> None:
    robot_argument(parser)
    parser.add_argument("task", help="task or app with the block recorder")
    parser.add_argument("--out", type=Path, metavar="DIRECTORY", help="where to (build/recordings/ROBOT/TASK)")


def _convert(arguments: argparse.Namespace) -> None:
    from flotilla.station import convert

    print("\n".join(convert.convert(arguments.files, arguments.out, arguments.topic)))


def _convert_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, help="NAME.mcap, NAME.csv or NAME.mat; it must not be there")
    parser.add_argument("--topic", help="the only one of several; CSV holds one")
    files = parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE",
        help="of a recorder, NAME-000001.rec, or folders of such; or a recording of `make record`",
    )  # fmt: skip
    variable(files, "FILE", words=True)


def _report(arguments: argparse.Namespace) -> None:
    from flotilla.common import paths
    from flotilla.station import report

    page = report.write(arguments.files, arguments.out or report.page_of(arguments.files))
    print(f"{paths.shown(page)}: a page of {', '.join(paths.shown(file) for file in arguments.files)}")


def _report_arguments(parser: argparse.ArgumentParser) -> None:
    files = parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE",
        help="a recording of `make record`, or files of a recorder, *.rec",
    )  # fmt: skip
    variable(files, "FILE", words=True)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (build/reports/NAME.html)")


def _provision(arguments: argparse.Namespace) -> None:
    from flotilla.robot import playbook

    playbook.play(arguments.playbook, robot=arguments.robot, guests=arguments.guests, words=arguments.words)


def _provision_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", type=int, help="this one only")
    guests = parser.add_argument("--guests", action="store_true", help="the virtual fleet instead of the robots")
    variable(guests, "ON", value="guests")
    parser.add_argument(
        "--playbook",
        default="fleet",
        help="fleet, tasks, collect, reboot, replace or update: of ansible/ (%(default)s)",
    )
    words = parser.add_argument(
        "words", nargs="*", metavar="-- …", help="further arguments of ansible-playbook, such as --check --diff"
    )
    variable(words, "ARGS", words=True)


def _completion(arguments: argparse.Namespace) -> None:
    import shtab

    from flotilla.cli.main import commands, parser

    print(shtab.complete(parser(commands(), lambda _: True), shell=arguments.shell))


def _completion_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="name of the shell")


def _make(arguments: argparse.Namespace) -> None:
    """Of `help`; `flotilla.cli.main` takes the words of any other target instead."""
    import os

    from flotilla.cli import make, make_help
    from flotilla.cli.main import commands

    if arguments.target != make.HELP:
        raise make.unknown_target(commands(), arguments.target)
    print(make_help.text(commands(), os.environ.get("TARGET", "")), end="")


def _make_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("target", help="such as image; its variables come from the environment: ROBOT=3")


COMMANDS = (
    Command("Cards", "image", "build the card image of one robot, or of all", _image, _image_arguments, targets=(
        Target("image", "build the card image of one robot", "ROBOT=3", takes=("ROBOT",)),
        Target("images", "build the card images of all robots", given={"ALL": "1"}, takes=()),
    )),
    Command("Cards", "flash", "write a card and read it back", _flash, _flash_arguments,
            example="ROBOT=3 DEV=/dev/sdX"),
    Command("Cards", "kernel", "compile the lean PREEMPT_RT kernel as a Debian package", _kernel, _kernel_arguments,
            example="BOARD=smartcoret3"),
    Command("Cards", "verify", "build an image a second time and compare every byte", _verify,
            _verify_arguments, example="ROBOT=3"),
    Command("Cards", "verify-bundle", "rebuild a published bundle and compare it", _verify_bundle,
            _verify_bundle_arguments, example="BUNDLE=smartcoret3.bundle"),
    Command("Cards", "size", "list the largest packages and files of an image", _size, robot_argument,
            example="ROBOT=3"),
    Command("Cards", "bundle", "build the update bundle of a board", _bundle, _bundle_arguments,
            example="BOARD=smartcoret3 EXPIRES=2027-01-31"),
    Command("Inputs", "init", "make a directory for a fleet of your own", _init, _init_arguments, host=(),
            example="FLEET=../rovers"),
    Command("Inputs", "check-fleet", "validate the inventory", _check_fleet, host=()),
    Command("Inputs", "lock", "resolve package lists to exact versions and hashes", _lock, _lock_arguments,
            example="ONLY=smartcoret3"),
    Command("Inputs", "cve", "check the locks against Debian's security tracker", _cve, _cve_arguments,
            example="TRACKER=tracker.json"),
    Command("Keys", "rotate-key", "replace the key of a robot or of the operator", _rotate_key,
            _rotate_key_arguments, example="ROBOT=3"),
    Command("Keys", "revoke-key", "revoke the host key of a stolen robot", _revoke_key,
            robot_argument, example="ROBOT=3"),
    Command("Keys", "admit-operator", "issue a certificate that lets a person into all robots",
            _admit_operator, _admit_operator_arguments, example="NAME=alice KEY_FILE=alice.pub DAYS=30"),
    Command("Keys", "revoke-operator", "revoke a person's certificates", _revoke_operator, _revoke_operator_arguments,
            example="NAME=alice"),
    Command("Keys", "operators", "list the certificates: name, expiry, revocation", _operators, host=()),
    Command("Keys", "backup-keys", "write all keys to one encrypted file", _backup_keys, _backup_keys_arguments,
            example="OUT=keys.age"),
    Command("Keys", "restore-keys", "restore all keys from an encrypted file", _restore_keys, _restore_keys_arguments,
            example="FILE=keys.age"),
    Command("Robots", "ssh", "open a shell on a robot, or on its guest if one runs", _ssh, robot_argument,
            example="ROBOT=3"),
    Command("Robots", "param", "list or set the parameters of a running task or app", _param, _param_arguments,
            example="ROBOT=1 TASK=heading PARAM=attitude.kp VALUE=2.5"),
    Command("Robots", "scope", "show or record the signals of a running task", _scope, _scope_arguments,
            example="ROBOT=1 TASK=heading SIGNALS=gyro.rate ROWS=20 CSV=turn.csv"),
    Command("Robots", "releases", "list the release of each robot, and its trial state",
            _releases, _releases_arguments),
    Command("Robots", "hwcheck", "write a robot's hardware to a file, or draft a board's file",
            _hwcheck, _hwcheck_arguments, example="TARGET=ssh:debian@10.0.0.7 NAME=nuc7"),
    Command("Robots", "provision", "apply the inventory to the robots", _provision, _provision_arguments, targets=(
        Target("provision", example="ROBOT=3 ARGS='--check --diff'"),
        Target("update", "install the update bundle on the robots", "ROBOT=3", given={"PLAYBOOK": "update"}),
    )),
    Command("Robots", "station", "serve a page that shows, drives and tunes the fleet", _page, _page_arguments,
            packages="station", example="PORT=8080"),
    Command("Robots", "record", "record telemetry to an MCAP file", _station, _record_arguments,
            packages="station", example="OUT=run.mcap SECONDS=60"),
    Command("Robots", "live", "stream live telemetry to Foxglove", _station, _live_arguments, packages="station",
            example="PORT=8765 ORIGIN=http://localhost:8080"),
    Command("Robots", "top", "show a live telemetry table; start and stop tasks by key",
            _station, _top_arguments, packages="station", example="ASK=1"),
    Command("Robots", "station-join", "join the robots' ad hoc cell with this computer's radio", _station_join,
            _station_join_arguments, example="ADAPTER=wlan0"),
    Command("Robots", "station-leave", "leave the cell and restore the adapter's settings", _station_leave,
            _station_leave_arguments, example="ADAPTER=wlan0"),
    Command("Robots", "station-time", "write the chrony files that make this computer the clock", _station_time,
            _station_time_arguments, example="STATION=station"),
    Command("Robots", "drive", "drive a wheeled robot by keyboard or gamepad", _drive, _drive_arguments,
            packages="station", example="ROBOT=5 INPUT=gamepad"),
    Command("Robots", "positions", "forward indoor positions to a robot, authenticated", _positions,
            _positions_arguments, packages="station", example="ROBOT=3 INTERFACE=eth1"),
    Command("Robots", "fetch", "copy the recorder files of a robot's task", _fetch, _fetch_arguments,
            example="ROBOT=3 TASK=heading"),
    Command("Robots", "convert", "convert recordings to MCAP, CSV or MAT", _convert, _convert_arguments,
            packages="station", host=(), example="FILE='log-000001.rec log-000002.rec' OUT=run.mcap"),
    Command("Robots", "report", "write a page of plots from recordings", _report, _report_arguments,
            packages="station", host=(), example="FILE=run.mcap OUT=page.html"),
    Command("Apps", "new-app", "create a working example app in apps/NAME", _new_app, _new_app_arguments, host=(),
            example="KIND=block NAME=hover"),
    Command("Apps", "import-model", "import MATLAB's packNGo archive as apps/NAME", _import_model,
            _import_model_arguments, example="ZIP=hover.zip NAME=hover SAMPLE_TIMES=0.01,0.05"),
    Command("Apps", "deploy", "build an app, copy it to a robot and start it", _deploy, _deploy_arguments,
            example="ROBOT=3 APP=apps/hover KEEP=1"),
    Command("Shell", "completion", "print a completion script for a shell", _completion,
            _completion_arguments, packages="station", host=(), targets=()),
    Command("Shell", "make", "run a target of make with the variables of the environment", _make,
            _make_arguments, packages="station", host=(), targets=()),
)  # fmt: skip
