"""`make new-app`: a working start of an app, from the templates in images/apps/KIND."""

from __future__ import annotations

import shutil
from pathlib import Path

import jinja2

from images.builder import app, paths
from images.builder.errors import UserError

TEMPLATES = paths.PROJECT / "images" / "apps"
APPS = paths.PROJECT / "apps"


def create(kind: str, name: str, parent: Path = APPS) -> str:
    """Make the app `name` in `parent`; what to do with it."""
    if kind not in app.KINDS:
        raise UserError(f"KIND={kind}: is no kind of app; one of {', '.join(app.KINDS)}")
    final = parent / app.check_name(name)
    if final.exists():
        raise UserError(f"{paths.shown(final)} is there already; take another NAME=, or remove it")
    beside = parent / f".{name}.new"
    shutil.rmtree(beside, ignore_errors=True)
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True, autoescape=False
    )
    variables = {"name": name, "identifier": name.replace("-", "_")}
    for template in sorted((TEMPLATES / kind).rglob("*.j2")):
        relative = str(template.relative_to(TEMPLATES / kind)).removesuffix(".j2")
        place = beside / relative.replace("NAME", variables["identifier"])
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(environment.from_string(template.read_text()).render(variables))
    beside.rename(final)
    return f"{paths.shown(final)} is ready; bring it to a robot: make deploy ROBOT=… APP={paths.shown(final)}"
