"""Variables of make: which one sets an argument of a command. `flotilla.cli.make` reads them.

An argument's variable has the argument's name in capitals: `--sample-times` is SAMPLE_TIMES. `variable` declares
another.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

_ATTRIBUTE = "make_variable"


@dataclass(frozen=True)
class Variable:
    """How make sets an argument."""

    names: tuple[str, ...]
    """Of several that are given, the last one counts. Empty: make does not set this argument."""
    value: str = ""
    """Of a flag: the value that sets it, where that is not 1."""
    words: bool = False
    """Whether each word of the value is an argument of its own."""
    only_with: str = ""
    """A variable without which this one has no meaning."""


def variable(
    action: argparse.Action, *names: str, value: str = "", words: bool = False, only_with: str = ""
) -> argparse.Action:
    """Declare the variables that set an argument; the fields of `Variable` have the meaning of each option."""
    setattr(action, _ATTRIBUTE, Variable(names, value, words, only_with))
    return action


def variable_of(action: argparse.Action) -> Variable:
    """The declared variable, or the one of the argument's name."""
    usual = Variable((_name(action).lstrip("-").replace("-", "_").upper(),), words=action.nargs in ("*", "+"))
    declared: Variable = getattr(action, _ATTRIBUTE, usual)
    return declared


def _name(action: argparse.Action) -> str:
    return action.option_strings[-1] if action.option_strings else action.dest
