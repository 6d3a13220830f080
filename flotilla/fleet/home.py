"""The home of a fleet: a directory outside of the tool, which its owner keeps in a repository of its own.

`flotilla.common.paths` has the layout.
"""

from __future__ import annotations

import functools
import re
import shutil
from importlib.metadata import version
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from flotilla.common import durable, paths, yaml_file
from flotilla.common.errors import UserError

_TEMPLATE = Path(__file__).parent / "new_home"
_EXAMPLE = {
    "inventory/group_vars/all.yml": paths.PROJECT / "ansible/inventory/group_vars/all.yml",
    "control_tasks/heartbeat.yml": paths.PROJECT / "ansible/control_tasks/heartbeat.yml",
}
"""Files that a new home gets from the example fleet."""
_NAME = re.compile(r"[a-z][a-z0-9-]{0,31}")


class _File(BaseModel):
    """`fleet.yml`."""

    model_config = ConfigDict(extra="forbid")
    flotilla: str = Field(pattern=r"^\d+\.\d+\.\d+$")
    """The version of the tool that the home was made for."""


@functools.cache
def check() -> None:
    """UserError where FLEET= is no home, or the home of a newer version of this tool."""
    if not paths.OWN_HOME:
        return
    file = paths.HOME / paths.HOME_FILE
    if not file.is_file():
        command = "flotilla init DIRECTORY" if paths.INSTALLED else f"make init FLEET={paths.HOME}"
        raise UserError(
            f"FLEET={paths.HOME}: has no {paths.HOME_FILE}; name a fleet's directory, or make one: {command}"
        )
    wanted, ours = yaml_file.read(file, _File).flotilla, version("flotilla")
    if _numbers(wanted) > _numbers(ours):
        raise UserError(f"{file}: flotilla: {wanted}: this is version {ours}; use version {wanted} or a newer one")


def make(directory: Path) -> str:
    """Make a home with one robot and one control task in a directory that is new or empty; what to do with it."""
    name = re.sub(r"[^a-z0-9]+", "-", directory.name.lower()).strip("-")
    if not _NAME.fullmatch(name):
        raise UserError(f"{directory}: its name becomes the fleet's, which begins with a letter; take another one")
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise UserError(f"{directory}: is there already, and is no empty directory; take another one")
    beside = directory.with_name(f".{directory.name}.new")
    shutil.rmtree(beside, ignore_errors=True)
    directory.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(_TEMPLATE, beside)
    for place, source in _EXAMPLE.items():
        (beside / place).parent.mkdir(exist_ok=True)
        shutil.copyfile(source, beside / place)
    _change(beside / "inventory/group_vars/all.yml", r"(?m)^fleet_name: \S+", f"fleet_name: {name}")
    _change(beside / "README.md", "FLEET_NAME", name)
    _change(beside / paths.HOME_FILE, "FLOTILLA_VERSION", version("flotilla"))
    if directory.exists():
        directory.rmdir()
    durable.rename(beside, directory)
    command = f"cd {directory} && flotilla image 1" if paths.INSTALLED else f"make image ROBOT=1 FLEET={directory}"
    return f"{directory} is the home of the fleet {name}; build its robot's card: {command}"


def _change(file: Path, old: str, new: str) -> None:
    text, count = re.subn(old, new, file.read_text(encoding="utf-8"))
    if not count:  # a defect: the home would have the example's value
        raise ValueError(f"{file}: has no {old}")
    file.write_text(text, encoding="utf-8")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))
