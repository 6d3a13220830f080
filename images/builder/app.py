"""An app: code that is brought to a robot. What its directory says about it, read and checked (docs/apps.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

from images.builder import paths
from images.builder.errors import Problem, ProblemsError, UserError
from images.builder.fleet import Board, Robot

FILE = "app.yml"
TASK = "task.yml"
"""The control task of an app of blocks."""
SAFE = "safe.yml"
"""A task of actuators alone: what a program's outputs are, so that they are reset when it has ended."""
_NAME = re.compile(r"[a-z][a-z0-9-]{0,31}")
Inside = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_][A-Za-z0-9_.-]*)*$")]

Identifier = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]


class _Description(BaseModel):
    """`app.yml`."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    board: str | None = None
    """The only board that the app is for; without it, any."""


class Block(_Description):
    """C files with blocks, and the task that uses them."""

    kind: Literal["block"]


class Make(_Description):
    """A Makefile that makes one program."""

    kind: Literal["make"]
    program: Inside
    """What it makes, relative to the app."""
    arguments: list[str] = []
    """What the program is called with."""
    files: list[Inside] | None = None
    """What else goes to the robot, to the same places: files and directories of the app, made by make or not."""
    notify: bool = False
    """The program speaks sd_notify(3): it says when it is ready, and is ended when it has not said WATCHDOG=1 for a
    second."""


class Ert(_Description):
    """A model's code by Embedded Coder, and the task that uses it."""

    kind: Literal["ert"]
    model: Identifier
    """The model's name."""
    sample_times: list[float] = []
    """Of its step functions in seconds, fastest first, where comments in the code do not say."""


class Fmu(_Description):
    """A co-simulation unit by the Functional Mock-up Interface, and the task that uses it."""

    kind: Literal["fmu"]
    unit: Inside | None = None
    """The unit, a file or what was in it as a directory; without it, the app's only one."""


Description = Block | Make | Ert | Fmu
_MODELS: dict[str, type[_Description]] = {"block": Block, "make": Make, "ert": Ert, "fmu": Fmu}
KINDS = tuple(_MODELS)
_NEEDED = {"block": [TASK], "make": ["Makefile"], "ert": [TASK], "fmu": [TASK]}
_ADAPTER: TypeAdapter[Description] = TypeAdapter(Annotated[Description, Field(discriminator="kind")])


@dataclass(frozen=True)
class App:
    """A directory with an app."""

    directory: Path
    description: Description

    @property
    def name(self) -> str:
        """Its name on robots."""
        return name_of(self.directory)


def name_of(directory: Path) -> str:
    """The app's name: its directory's."""
    return check_name(directory.resolve().name)


def check_name(name: str) -> str:
    """The name, if an app may have it: it becomes a unit's and a directory's."""
    if not _NAME.fullmatch(name):
        remedy = "a small letter, then small letters, digits or hyphens, at most 32, such as hover"
        raise UserError(f"{name}: is not an app's name; {remedy}")
    return name


def load(directory: Path) -> App:
    """The app in `directory`, or UserError with all that is wrong in its description."""
    file = directory / FILE
    if not file.is_file():
        raise UserError(f"{paths.shown(file)} is missing; `make new-app KIND=block NAME=…` makes a working start")
    try:
        raw = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{paths.shown(file)}: {error}") from None
    if not isinstance(raw, dict):
        raise UserError(f"{paths.shown(file)}: has no keys; at least kind: {'|'.join(KINDS)}")
    try:
        description = _ADAPTER.validate_python(raw)
    except ValidationError as error:
        raise ProblemsError([_problem(file, raw, detail) for detail in error.errors()]) from None
    app = App(directory.resolve(), description)
    for needed in _NEEDED[description.kind]:
        if not (directory / needed).is_file():
            raise UserError(f"{paths.shown(directory / needed)} is missing; an app of kind {description.kind} has one")
    return app


def check_board(app: App, robot: Robot, board: Board) -> None:
    """Refuse an app that is for another board."""
    wanted = app.description.board
    if wanted not in (None, board.name):
        where = paths.shown(app.directory / FILE)
        raise UserError(f"{where}: board: {wanted}: {robot.name} is a {board.name}; choose a robot of that board")


def on_robot(name: str) -> PurePosixPath:
    """Where an app lies on its robot."""
    return PurePosixPath("/data/apps") / name


def _problem(file: Path, raw: dict[str, Any], detail: Any) -> Problem:
    """What pydantic found, as every finding in a file is said."""
    model = _MODELS.get(str(raw.get("kind")), _Description)
    loc = [step for step in detail["loc"] if step not in KINDS] or ["kind"]
    key = ".".join(map(str, loc))
    keys = ", ".join(model.model_fields)
    messages = {
        "extra_forbidden": ("is no key of this kind of app", f"there are {keys}"),
        "missing": ("is missing", f"an app of kind {raw.get('kind')} needs it"),
        "union_tag_not_found": ("is missing", f"one of {', '.join(KINDS)}"),
        "union_tag_invalid": ("is no kind of app", f"one of {', '.join(KINDS)}"),
        "string_pattern_mismatch": ("is not a file inside the app", "such as hover or build/hover"),
    }
    message, remedy = messages.get(detail["type"], ("is wrong", detail["msg"]))
    value = raw.get(str(loc[0]), "(nothing)") if len(loc) == 1 else detail["input"]
    return Problem(paths.shown(file), key, str(value), message, remedy)
