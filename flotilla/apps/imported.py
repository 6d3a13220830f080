"""`make import-model`: generated code that MATLAB's packNGo packed becomes an app, or replaces the code of one."""

from __future__ import annotations

import io
import json
import re
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import yaml

from flotilla.apps import app, ert
from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import System

FILES = 5000
"""At most, in an archive. MATLAB's own headers are some hundreds."""
BYTES = 256 << 20
"""At most, unpacked: of all files together."""
_KEPT = {".c", ".h", ".cpp", ".cxx", ".hpp"}
"""Suffixes of what is unpacked. C++ is kept because the build says what to do about it."""
_NESTED = {"mlrFiles.zip", "sDirFiles.zip", "otherFiles.zip"}
"""What packNGo puts into the archive where the option packType is hierarchical."""


def create(
    archive: Path,
    name: str,
    systems: Sequence[System],
    model: str | None = None,
    sample_times_s: Sequence[float] = (),
    parent: Path | None = None,
) -> str:
    """Lay out the code of `archive` as the app `name` in `parent`, by default the project's `apps/`.

    Replaces the generated code of an app that is there, and nothing else of it. For a new one it writes app.yml, and a
    task.yml in which the model's inputs are zero; for this it reads the code as one of `systems` has it. Nothing
    changes after UserError. Returns what to do with it.
    """
    directory = (parent or paths.APPS) / app.check_name(name)
    known = app.load(directory) if (directory / app.FILE).exists() else None
    if known and not isinstance(known.description, app.Ert):
        raise UserError(f"{paths.shown(directory)}: is an app of another kind; take another NAME=, or remove it")
    if not known and directory.exists():
        raise UserError(f"{paths.shown(directory)}: is there, without {app.FILE}; take another NAME=, or remove it")
    paths.BUILD.mkdir(parents=True, exist_ok=True)
    directory.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=directory.parent, prefix=f".{name}-") as beside:
        work = Path(beside) / name
        _unpack(archive, work / ert.GENERATED)
        if known and isinstance(known.description, app.Ert):
            model = model or known.description.model
        model = model or _model(archive, work / ert.GENERATED)
        if known:
            assert isinstance(known.description, app.Ert)
            if model != known.description.model:
                where = paths.shown(directory / app.FILE)
                raise UserError(
                    f"{where}: model: {known.description.model}: the archive is of {model}; take another NAME="
                )
            _replace(work / ert.GENERATED, directory / ert.GENERATED)
            return f"{paths.shown(directory)} has the new code; bring it to a robot: {_deploy(directory)}"
        description = {"kind": "ert", "model": model}
        if sample_times_s:
            description["sample_times"] = list(sample_times_s)  # type: ignore[assignment]
        (work / app.FILE).write_text(yaml.safe_dump(description, sort_keys=False))
        (work / app.TASK).write_text(_task(work, name, model, sample_times_s, systems))
        durable.rename(work, directory)
    inputs = f"wire the model's inputs in {paths.shown(directory / app.TASK)}, which are zero"
    return f"{paths.shown(directory)} is ready; {inputs}, and bring it to a robot: {_deploy(directory)}"


def _deploy(directory: Path) -> str:
    return f"make deploy ROBOT=… APP={paths.shown(directory)}"


def _replace(new: Path, place: Path) -> None:
    """Put a directory in the place of another."""
    old = new.with_name("old")
    if place.exists():
        place.rename(old)
    durable.rename(new, place)


def _unpack(archive: Path, out: Path) -> None:
    """Source files of an archive, and of those within it, which is not trusted."""
    out.mkdir(parents=True)
    left, files = BYTES, 0
    try:
        with zipfile.ZipFile(archive) as opened:
            for name, source, member in _members(opened):
                path = PurePosixPath(name.replace("\\", "/"))
                link = stat.S_ISLNK(member.external_attr >> 16)
                if not path.parts or path.is_absolute() or ".." in path.parts or ":" in path.parts[0] or link:
                    raise UserError(
                        f"{archive}: {name}: is no file inside the archive; pack it with packNGo(buildInfo)"
                    )
                if path.suffix.lower() not in _KEPT and path.name != ert.DEFINES:
                    continue
                files += path.name != ert.DEFINES
                place = out / path
                if place.exists():
                    raise UserError(f"{archive}: {name}: is in it twice; pack it with packNGo(buildInfo)")
                place.parent.mkdir(parents=True, exist_ok=True)
                with source.open(member) as content:
                    data = content.read(left + 1)  # whatever the archive says about its size
                left -= len(data)
                if left < 0 or files > FILES:
                    limits = f"{FILES} files and {BYTES >> 20} MiB"
                    raise UserError(f"{archive}: has more than {limits} of sources; is it packNGo's?")
                place.write_bytes(data)
    except FileNotFoundError:
        raise UserError(f"ZIP={archive}: is missing; packNGo(buildInfo) in MATLAB makes it") from None
    except (
        zipfile.BadZipFile,
        NotADirectoryError,
        FileExistsError,
        IsADirectoryError,
        RuntimeError,
        EOFError,
    ) as error:
        raise UserError(f"{archive}: is no archive of packNGo: {error}; pack it anew") from None
    if not files:
        raise UserError(f"{archive}: has no C file; pack it with packNGo(buildInfo)")


def _members(archive: zipfile.ZipFile) -> Iterator[tuple[str, zipfile.ZipFile, zipfile.ZipInfo]]:
    """Files of an archive, and of packNGo's archives within it."""
    for member in archive.infolist():
        if member.is_dir():
            continue
        if member.filename not in _NESTED:
            yield member.filename, archive, member
            continue
        with archive.open(member) as content:
            data = content.read(BYTES + 1)
        if len(data) > BYTES:
            raise UserError(f"{archive.filename}: {member.filename}: has more than {BYTES >> 20} MiB; is it packNGo's?")
        with zipfile.ZipFile(io.BytesIO(data)) as inner:
            for each in inner.infolist():
                if not each.is_dir():
                    yield each.filename, inner, each


def _model(archive: Path, generated: Path) -> str:
    """The model's name, where the code has one model."""
    found = {
        header.stem
        for header in generated.rglob("*.h")
        if re.search(rf"\b{re.escape(header.stem)}_initialize\s*\(", header.read_text(errors="replace"))
    }
    if len(found) != 1:
        has = f"{len(found)} models ({', '.join(sorted(found))})" if found else "no model"
        raise UserError(f"{archive}: has {has}; say MODEL=NAME, as in NAME.h")
    return found.pop()


def _task(work: Path, name: str, model: str, sample_times_s: Sequence[float], systems: Sequence[System]) -> str:
    """A task of the model alone."""
    errors: list[UserError] = []
    for number, system in enumerate(systems):
        try:
            out = work.parent / f"read-{number}"
            code = ert.collect(work / ert.GENERATED, model, out)
            found = ert.read(model, ert.preprocess(out, model, code, system), code, list(sample_times_s))
        except UserError as error:
            errors.append(error)
            continue
        if found.period_s is None:
            raise UserError(
                f"{model}.h: its code contains no period; give SAMPLE_TIMES=0.01, in seconds, fastest first"
            )
        zeros = {port.name: _zeros(port.width) for port in found.inputs}
        wired = f", in: {json.dumps(zeros)}" if zeros else ""
        return (
            f"# The model alone. `{name}.PORT` reads an output; docs/how-to/control-tasks.md describes the rest.\n"
            f"period: {found.period_s * 1000:g} ms\npriority: 64\nblocks:\n  {name}: {{type: {name}{wired}}}\n"
        )
    raise errors[0]


def _zeros(width: int) -> int | list[int]:
    return 0 if width == 1 else [0] * width
