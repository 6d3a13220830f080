"""The page of commands, and the text of `make help`.

Their sources are the commands' declarations, and the Makefile's comments on targets that run no command.
"""

from __future__ import annotations

import argparse
import re
from itertools import groupby

from flotilla.cli import make, make_help
from flotilla.cli.command import Command
from flotilla.cli.key_access import PRIVATE_KEYS
from flotilla.cli.main import commands
from flotilla.common import paths
from flotilla.common.variables import variable_of
from flotilla.reference.markdown import MADE, code, literal, table

HEAD = f"""{MADE}
# Commands

The program `build/venv/bin/flotilla` has every command, and make has a target for most of them. A target installs the
packages that its command needs, then calls the command with arguments from variables: `make fetch ROBOT=3 TASK=heading`
is `flotilla fetch 3 heading`. A flag is set by 1: `make releases JSON=1`. A variable that the target does not know is
an error. After an error, both end with a status other than 0 and a message on standard error.
"""


_KEYS = """## Private keys that commands read

`backup-keys` and `restore-keys` read all of them. Commands that are not in the table read none.

"""

MAKEFILES = ("Makefile", "tests/development.mk")


def page() -> str:
    """docs/reference/commands.md."""
    known = sorted(commands(), key=lambda command: command.group)
    sections = [
        f"\n## {group}\n{''.join(map(_command, members))}"
        for group, members in groupby(known, lambda command: command.group)
    ]
    rows = [(code(f"{name}="), literal(meaning)) for name, meaning in make.GLOBAL.items()]
    variables = f"\n## Variables of all targets\n\n{table(('variable', 'meaning'), rows)}"
    return f"{HEAD}{variables}{''.join(sections)}{_others()}\n{_KEYS}{_keys()}"


def targets() -> str:
    """docs/reference/targets.txt, which `make help` shows: for each value of TARGET= a part after a line `== VALUE`."""
    known, others = commands(), other_targets()
    summaries = {title: {name: line[0] for name, line in rows.items()} for title, rows in others.items()}
    parts = {"": make_help.text(known), make_help.ALL: make_help.every(known, summaries)}
    parts |= {name: make_help.text(known, name) for name in make.targets(known)}
    for rows in others.values():
        parts |= {name: f"make {name} {words}".rstrip() + f"\n    {text}\n" for name, (text, words) in rows.items()}
    return "".join(f"== {name}".rstrip() + f"\n{text}" for name, text in parts.items())


def other_targets() -> dict[str, dict[str, tuple[str, str]]]:
    """Targets that run no command, by heading and name: summary and variables."""
    found: dict[str, dict[str, tuple[str, str]]] = {}
    for file in MAKEFILES:
        title = ""
        for line in (paths.PROJECT / file).read_text(encoding="utf-8").splitlines():
            if line.startswith("##@ "):
                title = line[4:]
            elif match := re.match(r"([a-z-]+):.*## (.*)", line):
                text, _, words = match[2].partition(" | ")
                found.setdefault(title, {})[match[1]] = text, words
    return found


def _others() -> str:
    return "".join(
        f"\n## {title}\n\n"
        + table(("command", "meaning"), [
            (code(f"make {name} {words}".rstrip()), literal(text)) for name, (text, words) in rows.items()
        ])
        for title, rows in other_targets().items()
    )  # fmt: skip


def _keys() -> str:
    head = ("file in `ansible/keys/`", "use", "commands that read it", "an ssh-agent may have it")
    return table(head, [
        (code(key.name), key.use, ", ".join(map(code, sorted(key.commands))), "yes" if key.in_agent else "no")
        for key in PRIVATE_KEYS
    ])  # fmt: skip


def _command(command: Command) -> str:
    own = make.own_parser(command)
    head = f"\n### {command.name}\n\n{literal(command.help[0].upper() + command.help[1:])}.\n"
    targets = command.of_make()
    examples = [(code(make_help.example(each)), literal(make_help.summary(command, each))) for each in targets]
    listed = f"Example: {examples[0][0]}\n" if len(targets) == 1 else table(("target", "meaning"), examples)
    rows = [
        (_words(action), _variables(command, action), literal(make_help.meaning_of(own, action)))
        for action in own._actions
        if action.dest != "help"
    ]
    return (
        head
        + (f"\n{listed}" if targets else "")
        + (f"\n{table(('argument', 'variable', 'meaning'), rows)}" if rows else "")
    )


def _variables(command: Command, action: argparse.Action) -> str:
    """Of an argument, as a user gives it to make: `ON=guests`."""
    variable = variable_of(action)
    known = set[str]().union(*(make.variables(make.own_parser(command), target) for target in command.of_make()))
    value = (variable.value or "1") if action.nargs == 0 else ""
    return ", ".join(code(f"{name}={value}") for name in variable.names if name in known)


def _words(action: argparse.Action) -> str:
    """As a user gives it: `--seconds SECONDS`, `robot`, `{up,down}`."""
    if not action.option_strings:
        return code("{" + ",".join(action.choices) + "}" if action.choices else str(action.metavar or action.dest))
    value = "" if action.nargs == 0 else f" {action.metavar or action.dest.upper()}"
    return code(f"{action.option_strings[-1]}{value}")
