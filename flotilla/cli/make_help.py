"""The texts of `make help`: for people who look up a target, at most `WIDTH` columns wide."""

from __future__ import annotations

import argparse
import os
import textwrap
from collections.abc import Iterable, Sequence
from itertools import groupby

from flotilla.cli import make
from flotilla.cli.command import Command, Target
from flotilla.common import paths
from flotilla.common.errors import UserError

WIDTH = 80
"""Columns of a terminal."""
ALL = "all"
"""TARGET= of the list of all targets."""
USUAL = {
    "Describe a fleet": ("init", "check-fleet"),
    "Make cards": ("image", "images", "flash", "verify"),
    "Run robots": ("provision", "bundle", "update", "releases", "ssh", "hwcheck"),
    "Run control code": ("new-app", "deploy", "param", "scope", "fetch"),
    "See and drive robots": ("station",),
    "Simulate": ("boot", "wheeled"),
}
"""The targets that people use, by task."""
_MORE = """\
make help TARGET=flash shows the variables of a target and an example,
make help TARGET=all every target."""


def text(known: Sequence[Command], about: str = "") -> str:
    """The help about a target, about `ALL`, or the usual targets. UserError for another word."""
    listed = make.targets(known)
    if not about:
        return f"{_sections({task: _summaries(listed, names) for task, names in USUAL.items()})}\n{_MORE}\n"
    if about == ALL:
        return every(known)
    if about not in listed:
        raise UserError(f"TARGET={about}: no such target; see make help TARGET={ALL}")
    return of_target(*listed[about])


def every(known: Sequence[Command], more: dict[str, dict[str, str]] | None = None) -> str:
    """All targets by group, with `more` groups of summaries by name, and the variables of all targets."""
    listed = make.targets(known)
    by_group = groupby(sorted(listed, key=lambda name: listed[name][0].group), lambda name: listed[name][0].group)
    groups = {group: _summaries(listed, names) for group, names in by_group} | (more or {})
    return _sections(groups | {"Variables of all targets": {f"{name}=": of for name, of in make.GLOBAL.items()}})


def summary(command: Command, target: Target) -> str:
    """Of a target, in a line."""
    return target.help or command.help


def _summaries(listed: dict[str, tuple[Command, Target]], names: Iterable[str]) -> dict[str, str]:
    return {name: summary(*listed[name]) for name in names}


def _sections(groups: dict[str, dict[str, str]]) -> str:
    width = max(len(name) for group in groups.values() for name in group)
    return "\n".join(f"{title}\n{_table(rows, width)}" for title, rows in groups.items())


def _table(rows: dict[str, str], width: int = 0) -> str:
    width = width or max(map(len, rows), default=0)
    indent = " " * (width + 4)
    return "".join(
        textwrap.fill(each, WIDTH, initial_indent=f"  {name:{width}}  ", subsequent_indent=indent,
                      break_on_hyphens=False) + "\n"
        for name, each in rows.items()
    )  # fmt: skip


def of_target(command: Command, target: Target) -> str:
    """Summary, variables with their meanings, and an example."""
    own = make.own_parser(command)
    rows: dict[str, str] = {}
    for each in make.arguments(own, target):
        for name in each.variable.names:
            if name in make.variables(own, target):
                meanings = [rows.get(f"{name}=", ""), f"{_values(each)}{meaning_of(own, each.action)}"]
                rows[f"{name}="] = "; ".join(filter(None, meanings))
    for names in make.needed(own, target):
        for name in names:
            rows[f"{name}="] += f"; needed: {' or '.join(names)}" if len(names) > 1 else "; needed"
    listed = f"\n{_table(rows)}" if rows else ""
    return f"make {target.name}: {summary(command, target)}\n{listed}\nexample: {example(target)}\n"


def example(target: Target) -> str:
    """A line for a shell."""
    return f"make {target.name} {target.example}".rstrip()


def _values(argument: make.Argument) -> str:
    if argument.action.nargs == 0:
        return f"{argument.variable.value or 1}: "
    return f"{'|'.join(map(str, argument.action.choices))}: " if argument.action.choices else ""


def meaning_of(own: argparse.ArgumentParser, action: argparse.Action) -> str:
    """With the default where the text asks for it, and no path of this computer."""
    return own._get_formatter()._expand_help(action).replace(f"{paths.PROJECT}{os.sep}", "")
