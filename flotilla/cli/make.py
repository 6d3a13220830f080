"""`flotilla make TARGET`: what a target of make runs, from make's variables in the environment.

Make exports its variables as they are: no shell reads their values. The arguments of each command declare its
variables, see `flotilla.common.variables`.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import NamedTuple

from flotilla.cli.command import Command, Target
from flotilla.common.errors import UserError
from flotilla.common.variables import Variable, variable_of

GLOBAL = {
    "MIRROR": "Debian mirror; default: the one in this computer's apt files",
    "SECURITY_MIRROR": "Debian mirror of security updates; default as above",
    "SNAPSHOT": "snapshot archive, for locked packages that left the mirror",
    "FLEET": "directory of your fleet; default: the example fleet",
    "BUILD": "directory of outputs; default: build/",
    "KEYS": "directory of keys; default: keys/ of FLEET, or ansible/keys/",
    "APPS": "directory of apps; default: apps/",
    "INVENTORY": "directory of the inventory; default: that of FLEET",
    "ANY_HOST": "1: also set up a computer that is not a supported host",
    "PYTHON3": "Python interpreter; default: python3",
    "V": "1: show the commands",
}
"""Variables of all targets, with their meanings."""

WORD, HELP = "make", "help"
"""The command's name, and the target that only shows."""
GOALS, NAMES = "MAKE_GOALS", "MAKE_NAMES"
"""In the environment: make's targets, and its variables of the command line, words each. Make sets them once: its own
calls of make pass variables on that others have checked."""


class Argument(NamedTuple):
    """An argument of a command, and its variable."""

    action: argparse.Action
    variable: Variable

    @property
    def name(self) -> str:
        return self.variable.names[0]


def targets(known: Iterable[Command]) -> dict[str, tuple[Command, Target]]:
    """All targets that run a command, by name."""
    return {target.name: (command, target) for command in known for target in command.of_make()}


def unknown_target(known: Iterable[Command], name: str) -> UserError:
    """The error about a target that does not exist."""
    near = "".join(f"; the nearest is {each}" for each in get_close_matches(name, [*targets(known), HELP], 1))
    return UserError(f"make {name}: there is no such target{near}; `make help TARGET=all` lists them")


def own_parser(command: Command) -> argparse.ArgumentParser:
    """The parser of the command's arguments alone."""
    own = argparse.ArgumentParser(prog=f"flotilla {command.name}")
    command.arguments(own)
    return own


def arguments(own: argparse.ArgumentParser, target: Target) -> list[Argument]:
    """Arguments that the target's variables set."""
    found = [Argument(action, variable_of(action)) for action in own._actions if action.dest != "help"]
    return [each for each in found if any(_taken(target, name) or name in target.given for name in each.variable.names)]


def _taken(target: Target, name: str) -> bool:
    return name not in target.given and (target.takes is None or name in target.takes)


def variables(own: argparse.ArgumentParser, target: Target) -> set[str]:
    """Names of the variables that the target has."""
    return {name for each in arguments(own, target) for name in each.variable.names if _taken(target, name)}


def words(known: Sequence[Command], name: str, environment: Mapping[str, str] = os.environ) -> list[str]:
    """Words of the command line that the target stands for. UserError for a variable that is unknown or missing."""
    command, target = targets(known)[name]
    own = own_parser(command)
    _check_names(known, name, environment)
    found = arguments(own, target)
    typed = environment.get(NAMES, "").split()
    given = {
        each: environment[each]
        for each in sorted(variables(own, target))
        if environment.get(each) and (each in typed or not _overruled(own, found, each, {*typed, *target.given}))
    } | dict(target.given)
    _check_needed(own, found, target, given, typed)
    options: list[str] = []
    positional: list[str] = []
    for each in found:
        (options if each.action.option_strings else positional).extend(_words(each, given))
    return [command.name, *options, *(["--", *positional] if positional else [])]


def _overruled(own: argparse.ArgumentParser, found: list[Argument], name: str, stronger: set[str]) -> bool:
    """Whether a variable of the environment only stands against one of the command line."""
    groups = [{*group._group_actions} for group in own._mutually_exclusive_groups]
    same = [{each for found_ in found if found_.action in group for each in found_.variable.names} for group in groups]
    same += [{*each.variable.names} for each in found]
    return any(name in group and group & stronger for group in same)


def _words(argument: Argument, given: Mapping[str, str]) -> list[str]:
    """The argument as words of the command line; none where it is not given."""
    action, variable = argument
    value = next((given[name] for name in reversed(variable.names) if name in given), "")
    if not value or (variable.only_with and variable.only_with not in given):
        return []
    if action.nargs == 0:
        return [action.option_strings[-1]] if _is_set(value, variable) else []
    values = re.findall(r"[^ \t\n\r\f\v]+", value) if variable.words else [value]
    return [f"{action.option_strings[-1]}={each}" for each in values] if action.option_strings else values


def _is_set(value: str, variable: Variable) -> bool:
    return value == variable.value if variable.value else value.strip() not in ("", "0")


def _check_names(known: Sequence[Command], name: str, environment: Mapping[str, str]) -> None:
    """A variable of the command line has to be one of a target that was given with it."""
    listed = targets(known)
    goals = [goal for goal in environment.get(GOALS, "").split() if goal in listed] or [name]
    ours = set(GLOBAL)
    for goal in sorted(goals, key=lambda goal: goal != name):
        if ours.issuperset(environment.get(NAMES, "").split()):
            return
        with suppress(ModuleNotFoundError):  # of a later target, whose packages are installed before it runs
            ours |= variables(own_parser(listed[goal][0]), listed[goal][1])
    for unknown in environment.get(NAMES, "").split():
        if unknown not in ours:
            raise UserError(
                f"make {' '.join(goals)} {unknown}=…: there is no such variable; {_nearest(unknown, ours)}"
                f"`make help TARGET={goals[0]}` shows those of the target"
            )


def _nearest(name: str, known: Iterable[str]) -> str:
    near = get_close_matches(name, sorted(known), 1)
    return f"the nearest is {near[0]}, " if near else ""


def _check_needed(
    own: argparse.ArgumentParser, found: list[Argument], target: Target, given: Mapping[str, str], typed: list[str]
) -> None:
    for names in needed(own, target):
        if not given.keys() & {*names}:
            raise _missing(target, *names)
    for argument in found:
        values = {one.value: one for one in (each.variable for each in found) if one.names == argument.variable.names}
        value = given.get(argument.name, "")
        if argument.variable.value and value and value not in values:
            raise UserError(f"{argument.name}={value}: take {' or '.join(values)}")
        if (other := argument.variable.only_with) and argument.name in typed and other not in given:
            raise _missing(target, other)


def _missing(target: Target, *names: str) -> UserError:
    return UserError(f"say which: make {target.name} {' or '.join(f'{name}=…' for name in names)}")


def needed(own: argparse.ArgumentParser, target: Target) -> list[tuple[str, ...]]:
    """Variables without which the target cannot run: of each tuple one."""
    groups = [group._group_actions for group in own._mutually_exclusive_groups if group.required]
    alone = [[action] for action in own._actions if action.required and action.nargs != "*"]
    found = {actions[0].dest: [*map(id, actions)] for actions in groups + alone}
    listed = arguments(own, target)
    names = [
        tuple(name for each in listed if id(each.action) in found.get(action.dest, ()) for name in each.variable.names)
        for action in own._actions
    ]
    taken = [tuple(name for name in each if _taken(target, name)) for each in names]
    return [each for each in taken if each] + [(name,) for name in target.needs]


def show(command_words: Sequence[str], environment: Mapping[str, str] = os.environ) -> None:
    """Show the command on standard error where V=1 asks for it."""
    if environment.get("V", "").strip() not in ("", "0"):
        print(shlex.join(["flotilla", *command_words]), file=sys.stderr)
