"""What provisioning asks the builder: a robot's files as its card image has them, and which role looks after which."""

from __future__ import annotations

import fnmatch
import functools
from collections.abc import Sequence
from pathlib import Path

import yaml

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import identity, inventory
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Fleet, Robot

ROLES = paths.PROJECT / "ansible" / "files.yml"

fleet = functools.cache(inventory.load_fleet)
"""The fleet of an inventory's directory; read once, and before Ansible makes a process for each robot."""


def robot(directory: Path, name: str) -> tuple[Fleet, Robot]:
    """The fleet of an inventory's directory and its robot `name`."""
    described = fleet(directory)
    for each in described.robots.values():
        if each.name == name:
            return described, each
    raise UserError(f"{name} is not a robot of {paths.shown(directory)}")


def files(directory: Path, name: str, built: Sequence[BuiltApp] = ()) -> dict[str, tuple[bytes, int]]:
    """Content and mode of the robot's own files, by path on the robot: those that its card image brings.

    `built`: its apps.
    """
    return {str(path): file for path, file in identity.render(*robot(directory, name), built).items()}


@functools.cache
def _table() -> list[tuple[str, str]]:
    """Paths and their roles, the longest path first."""
    roles: dict[str, list[str]] = yaml.safe_load(ROLES.read_text(encoding="utf-8"))
    return sorted(((path, role) for role, paths in roles.items() for path in paths), key=lambda row: -len(row[0]))


def role_of(path: str) -> str:
    """The role that looks after a file of a robot."""
    for place, role in _table():
        if fnmatch.fnmatchcase(path, f"{place}*" if place.endswith("/") else place):
            return role
    raise UserError(f"{path}: no role looks after it; add it to {paths.shown(ROLES)}")
