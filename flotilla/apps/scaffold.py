"""`make new-app`: a working start of an app, which is an example of `examples/` under another name."""

from __future__ import annotations

import shutil
from pathlib import Path

from flotilla.apps import app
from flotilla.common import durable, paths, sources
from flotilla.common.errors import UserError

EXAMPLES = paths.PROJECT / "examples"
OF_KIND = {
    "block": "saw-tooth", "device": "range-finder", "make": "own-loop", "ert": "two-rates", "fmu": "first-lag"
}  # fmt: skip
"""The example of each kind of app, and of `device`: an app of kind `block` with a driver, its emulator and its test.
An example's name appears in it only where the app's has to: as it is, or as an identifier in C."""


def create(kind: str, name: str, parent: Path | None = None) -> str:
    """Make the app `name` in `parent`, by default the project's `apps/`; what to do with it."""
    if kind not in OF_KIND:
        raise UserError(f"KIND={kind}: is no kind of app; one of {', '.join(OF_KIND)}")
    parent = parent or paths.APPS
    final = parent / app.check_name(name)
    if final.exists():
        raise UserError(f"{paths.shown(final)} is there already; take another NAME=, or remove it")
    beside = parent / f".{name}.new"
    shutil.rmtree(beside, ignore_errors=True)
    example = EXAMPLES / OF_KIND[kind]
    for file in sources.files(example):
        if file.name.startswith("."):
            continue
        place = beside / _renamed(str(file.relative_to(example)), example.name, name)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(_renamed(file.read_text(encoding="utf-8"), example.name, name), encoding="utf-8")
    durable.rename(beside, final)
    return f"{paths.shown(final)} is ready; bring it to a robot: make deploy ROBOT=… APP={paths.shown(final)}"


def _renamed(text: str, old: str, new: str) -> str:
    identifier, other = old.replace("-", "_"), new.replace("-", "_")
    return text.replace(old, new).replace(identifier, other).replace(identifier.upper(), other.upper())
