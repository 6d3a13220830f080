"""The page of commands: `flotilla`'s from its parsers, make's targets and variables from the Makefile's comments."""

from __future__ import annotations

import argparse
import os
import re
from itertools import groupby

from flotilla.cli.command import Command
from flotilla.cli.key_access import PRIVATE_KEYS
from flotilla.cli.main import commands, parser
from flotilla.common import paths
from flotilla.reference.markdown import MADE, code, literal, table

HEAD = f"""{MADE}
# Commands

`build/venv/bin/flotilla` has every command. Make is its front door: a target installs what it lacks, then calls one.
Both end with a status other than 0 and a message on standard error where something is wrong.
"""


_KEYS = """## Private keys that commands read

`backup-keys` and `restore-keys` read all of them. Commands that are not in the table read none.

"""


def page() -> str:
    known = sorted(commands(), key=lambda command: command.group)
    sections = [
        f"\n### {group}\n{''.join(map(_command, members))}"
        for group, members in groupby(known, lambda command: command.group)
    ]
    return f"{HEAD}\n## Targets of make\n{_targets()}\n{_KEYS}{_keys()}\n## Commands of flotilla\n{''.join(sections)}"


def _keys() -> str:
    head = ("file in `ansible/keys/`", "use", "commands that read it", "an ssh-agent may have it")
    return table(head, [
        (code(key.name), key.use, ", ".join(map(code, sorted(key.commands))), "yes" if key.in_agent else "no")
        for key in PRIVATE_KEYS
    ])  # fmt: skip


def _command(command: Command) -> str:
    main = parser([command], lambda _: True)
    (choices,) = (action.choices for action in main._actions if isinstance(action.choices, dict))
    own = choices[command.name]
    rows = [(_words(action), literal(_help(own, action))) for action in own._actions if action.dest != "help"]
    return f"\n#### {command.name}\n\n{literal(command.help[0].upper() + command.help[1:])}.\n\n" + (
        table(("argument", "meaning"), rows) if rows else ""
    )


def _words(action: argparse.Action) -> str:
    """As a user gives it: `--seconds SECONDS`, `robot`, `{up,down}`."""
    if not action.option_strings:
        return code("{" + ",".join(action.choices) + "}" if action.choices else str(action.metavar or action.dest))
    value = "" if action.nargs == 0 else f" {action.metavar or action.dest.upper()}"
    return code(f"{action.option_strings[-1]}{value}")


def _help(own: argparse.ArgumentParser, action: argparse.Action) -> str:
    """With the default where the text asks for it, and no path of this computer."""
    text = own._get_formatter()._expand_help(action)
    return text.replace(f"{paths.PROJECT}{os.sep}", "")


def _targets() -> str:
    text = title = ""
    rows: list[tuple[str, str]] = []
    for line in [*(paths.PROJECT / "Makefile").read_text(encoding="utf-8").splitlines(), "##@ "]:
        if line.startswith("##@ "):
            text += table((title, "meaning"), rows) if rows else ""
            text += f"\n### {line[4:]}\n\n" if line[4:] else ""
            rows = []
        elif match := re.match(r"##= (\S+) +(.*)", line):
            title = "variable"
            rows.append((code(match[1]), literal(match[2])))
        elif match := re.match(r"([a-z-]+):.*## (.*)", line):
            title = "command"
            meaning, _, variables = match[2].partition(" | ")
            rows.append((code(f"make {match[1]} {variables}".rstrip()), literal(meaning)))
    return text
