"""What a word of the command line is: `flotilla WORD …`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

HostList = Literal["build", "lab", "runtime"]


def no_arguments(_: argparse.ArgumentParser) -> None:
    """Of a command that takes none."""


@dataclass(frozen=True)
class Target:
    """A target of make: a command with some variables already given."""

    name: str
    help: str = ""
    """The command's, where it is empty."""
    example: str = ""
    """Variables for an example, as a shell reads them."""
    given: Mapping[str, str] = field(default_factory=dict)
    takes: tuple[str, ...] | None = None
    """Variables that may be given; by default all that the command has."""
    needs: tuple[str, ...] = ()
    """Variables without which the target has no meaning, although the command's arguments are optional."""


@dataclass(frozen=True)
class Command:
    """A command. Both functions import what they need when they are called, so that help and errors come at once."""

    group: str
    """Heading in the help."""
    name: str
    help: str
    run: Callable[[argparse.Namespace], None]
    """Does it; prints the result on standard output, raises UserError where the user can help."""
    arguments: Callable[[argparse.ArgumentParser], None] = no_arguments
    host: tuple[HostList, ...] = ("build",)
    """Lists of the Debian packages that it needs on this computer, see `flotilla.cli.host_packages`."""
    packages: Literal["build", "station"] = "build"
    """The group of requirements/ that has the Python packages which both functions import."""
    root: bool = False
    """Whether it needs root, so that it may run through sudo; the Makefile names the same commands."""
    example: str = ""
    """Variables of make for an example: `ROBOT=3 DEV=/dev/sdX`."""
    targets: tuple[Target, ...] | None = None
    """Targets of make that run it; by default one of its name."""

    def of_make(self) -> tuple[Target, ...]:
        """Its targets of make."""
        return (Target(self.name, example=self.example),) if self.targets is None else self.targets


def robot_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robot", type=int, help="number in the inventory")
