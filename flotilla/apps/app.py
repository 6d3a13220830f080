"""An app: code that is brought to a robot. What its directory says about it, read and checked (docs/how-to/apps.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from flotilla.common import paths
from flotilla.common.errors import Problem, ProblemsError, UserError
from flotilla.fleet import apps
from flotilla.fleet.model import Board, Robot, matching

FILE = apps.FILE
TASK = "task.yml"
"""The control task of an app of blocks."""
SAFE = "safe.yml"
"""A task of actuators alone: what a program's outputs are, so that they are reset when it has ended."""
_NAME = re.compile(r"[a-z][a-z0-9-]{0,31}")
Inside = Annotated[
    str,
    matching(
        r"[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_][A-Za-z0-9_.-]*)*",
        "is not a file inside the app",
        "such as hover or build/hover",
    ),
]
Identifier = Annotated[
    str,
    matching(r"[A-Za-z_][A-Za-z0-9_]*", "is not an identifier", "letters, digits and underscores, such as hover_ctrl"),
]


class _Description(BaseModel):
    """`app.yml`."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, use_attribute_docstrings=True)

    board: str | None = None
    """Board that the app is for. Any, when left out."""


class Block(_Description):
    """C files with blocks, and the task that uses them."""

    kind: Literal["block"]
    """Kind of the app."""


class Make(_Description):
    """A Makefile that makes one program."""

    kind: Literal["make"]
    """Kind of the app."""
    program: Inside
    """The program that `make` builds, relative to the app."""
    arguments: list[str] = []
    """Arguments of the program."""
    files: list[Inside] | None = None
    """Further files and directories of the app that go to the robot, to the same places. `make` may build them."""
    notify: bool = False
    """`true`: the program uses sd_notify(3). It sends READY=1 when it is ready, and systemd ends it after a second
    without WATCHDOG=1."""
    io_ports: bool = False
    """`true`: the program drives I/O ports (ioperm(2)). Not needed if `safe.yml` has a block that drives them."""


class Ert(_Description):
    """A model's code by Embedded Coder, and the task that uses it."""

    kind: Literal["ert"]
    """Kind of the app."""
    model: Identifier
    """Name of the model."""
    sample_times: list[float] = []
    """Sample times of the model's step functions in seconds, fastest first. Needed if comments in the code do not
    contain them."""
    tasking: Literal["threads", "single"] | None = None
    """How a model with several rates runs. `threads`: each slower rate in a thread of lower priority, which it may
    need all of its period for. `single`: all in one thread, within the fastest period. When left out: threads where
    the code has a function for each rate and calls no block of the runtime."""


class Fmu(_Description):
    """A co-simulation unit by the Functional Mock-up Interface, and the task that uses it."""

    kind: Literal["fmu"]
    """Kind of the app."""
    unit: Inside | None = None
    """The unit: an FMU file, or a directory with its content. When left out: the only one in the app."""


Description = Block | Make | Ert | Fmu
MODELS: dict[str, type[_Description]] = {"block": Block, "make": Make, "ert": Ert, "fmu": Fmu}
KINDS = tuple(MODELS)
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
    return apps.PLACE / name


def _problem(file: Path, raw: dict[str, Any], detail: Any) -> Problem:
    """What pydantic found, as every finding in a file is said."""
    model = MODELS.get(str(raw.get("kind")), _Description)
    loc = [step for step in detail["loc"] if step not in KINDS] or ["kind"]
    key = ".".join(map(str, loc))
    keys = ", ".join(model.model_fields)
    messages = {
        "extra_forbidden": ("is no key of this kind of app", f"there are {keys}"),
        "missing": ("is missing", f"an app of kind {raw.get('kind')} needs it"),
        "union_tag_not_found": ("is missing", f"one of {', '.join(KINDS)}"),
        "union_tag_invalid": ("is no kind of app", f"one of {', '.join(KINDS)}"),
    }
    context = detail.get("ctx", {})
    checked = (context["message"], context["remedy"]) if detail["type"] == "flotilla" else ("is wrong", detail["msg"])
    message, remedy = messages.get(detail["type"], checked)
    value = raw.get(str(loc[0]), "(nothing)") if len(loc) == 1 else detail["input"]
    return Problem(paths.shown(file), key, str(value), message, remedy)
