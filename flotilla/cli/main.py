"""The command line: finds the commands, reads the words, says errors in one way."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from itertools import groupby

from flotilla.cli import host_packages, make
from flotilla.cli.command import Command
from flotilla.common import paths, sudo
from flotilla.common.errors import UserError
from flotilla.common.text import shown

GROUP = "flotilla.commands"
"""Entry points, each a tuple of `Command`, in pyproject.toml: so the lab has commands, and nothing here knows it."""

OURS = ("flotilla",)
"""Packages of this checkout, which no group of requirements/ brings."""


def commands() -> list[Command]:
    return [command for found in sorted(entry_points(group=GROUP), key=lambda e: e.name) for command in found.load()]


class _Help(argparse.RawDescriptionHelpFormatter):
    """Without argparse's own list of commands: that one knows no headings."""

    def _format_action(self, action: argparse.Action) -> str:
        return "" if isinstance(action, argparse._SubParsersAction) else super()._format_action(action)


def parser(known: Sequence[Command], detailed: Callable[[Command], bool]) -> argparse.ArgumentParser:
    """`detailed`: whose arguments are needed; to declare some imports a great deal."""
    from importlib.metadata import version

    width = max(len(command.name) for command in known)
    listed = "\n\n".join(
        "\n".join([group, *(f"  {command.name:{width}}  {command.help}" for command in members)])
        for group, members in groupby(sorted(known, key=lambda command: command.group), lambda command: command.group)
    )
    main = argparse.ArgumentParser(
        prog="flotilla",
        description="Real-time Linux card images for a fleet of robots, and what is done with them.",
        epilog=f"{listed}\n\n`flotilla COMMAND --help` shows the arguments of a command.",
        formatter_class=_Help,
        usage="flotilla COMMAND …",
    )
    main.add_argument("--version", action="version", version=f"flotilla {version('flotilla')}")
    words = main.add_subparsers(dest="command", required=True, prog="flotilla", metavar="COMMAND")
    for command in known:
        each = words.add_parser(
            command.name, help=command.help, description=f"{command.help[0].upper()}{command.help[1:]}."
        )
        if detailed(command):
            command.arguments(each)
    return main


def main() -> int:
    os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"  # there are none, and to look for them reads every package
    known = commands()
    words = sys.argv[1:]
    word = next((word for word in words if not word.startswith("-")), None)
    try:
        if word == make.WORD and (target := make.targets(known).get(words[-1])):
            word = target[0].name  # first: reading its arguments may import packages that are missing
            words = make.words(known, words[-1])
            make.show(words)
        arguments = parser(known, lambda command: word in (command.name, "completion")).parse_args(words)
        paths.check()
        command = next(command for command in known if command.name == arguments.command)
        caller = sudo.caller()
        if caller and not command.root:
            raise sudo.refusal(f"flotilla {command.name}")
        host_packages.install(command)
        try:
            command.run(arguments)
        finally:
            if caller:
                sudo.hand_back(caller)
    except UserError as error:
        print(f"error: {shown(str(error))}", file=sys.stderr)
        return 1
    except PermissionError as error:
        if not (explained := sudo.left_by_root(error)):
            raise
        print(f"error: {shown(str(explained))}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        group = next(command.packages for command in known if command.name == word)
        module = (error.name or "").split(".")[0]
        if group == "build" or module in OURS:
            raise
        remedy = f'pip install "flotilla[{group}]"' if paths.INSTALLED else f"make setup-{group}"
        print(
            f"error: flotilla {word}: the Python package {module} is not installed; `{remedy}` installs it",
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"error: interrupted; {shown(str(interrupt)) or 'the last good outputs are untouched'}", file=sys.stderr)
        return 130
    return 0
