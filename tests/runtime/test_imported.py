"""`make import-model`: archives of MATLAB's packNGo as apps, and what is no such archive.

Headers are read by this computer's compiler in place of the locked one.
"""

from __future__ import annotations

import io
import stat
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.apps import app, ert, imported, scaffold
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian.lock import HOST
from tests.fixtures import ert_rates
from tests.fixtures.ert_shapes import SHAPES, write


@pytest.fixture
def archive(local_compiler: None, tmp_path: Path) -> Path:
    """Of the model `three`, with what else packNGo packs."""
    ert_rates.write(tmp_path / "code")
    packed = tmp_path / "three.zip"
    with zipfile.ZipFile(packed, "w") as out:
        for file in sorted((tmp_path / "code").iterdir()):
            out.write(file, file.name)
        out.writestr("buildInfo.mat", b"MATLAB 5.0 MAT-file")
        out.writestr("three.mk", "all:\n")
        out.writestr("defines.txt", "MODEL=three\nMT=1\n")
    return packed


def create(archive: Path, name: str = "three", **more: object) -> Path:
    parent = archive.parent / "apps"
    imported.create(archive, name, [HOST], parent=parent, **more)  # type: ignore[arg-type]
    return parent / name


def test_an_archive_becomes_an_app_that_runs(archive: Path, flotilla_run: Path) -> None:
    made = create(archive)
    assert sorted(file.name for file in (made / ert.GENERATED).iterdir()) == [
        "defines.txt", "rtwtypes.h", "three.c", "three.h"
    ]  # fmt: skip
    assert (made / app.FILE).read_text() == "kind: ert\nmodel: three\n"
    ert.block(made, "three", "three", [], source := archive.parent / "source", HOST)
    (blocks := archive.parent / "blocks").mkdir()
    argv = ["cc", "-shared", "-fPIC", f"-I{paths.PROJECT / 'runtime' / 'include'}", "-o", blocks / "three.so"]
    subprocess.run([*map(str, argv), *map(str, source.glob("*.c"))], check=True)
    run = [flotilla_run, "--blocks", blocks, "--no-wait", "--steps", "3", made / app.TASK]
    done = subprocess.run(list(map(str, run)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in made.parent.iterdir()) == ["three"], "something is left beside it"


def test_vectors_are_wired_too(local_compiler: None, tmp_path: Path) -> None:
    write(SHAPES["r2025b-rates"], tmp_path / "code")
    with zipfile.ZipFile(tmp_path / "plant.zip", "w") as out:
        for file in (tmp_path / "code").iterdir():
            out.write(file, file.name)
    text = (create(tmp_path / "plant.zip", "my-plant") / app.TASK).read_text()
    assert 'my-plant: {type: my-plant, in: {"error": 0, "rates": [0, 0], "enable": 0}}' in text
    assert "period: 10 ms\n" in text


def test_an_archive_of_archives(archive: Path) -> None:
    """As packNGo makes it with packType hierarchical."""
    with zipfile.ZipFile(whole := archive.parent / "whole.zip", "w") as out:
        out.write(archive, "sDirFiles.zip")
        inner = io.BytesIO()
        with zipfile.ZipFile(inner, "w") as other:
            other.writestr("R2024b/simulink/include/simstruc_types.h", "")
        out.writestr("mlrFiles.zip", inner.getvalue())
    made = create(whole)
    assert (made / ert.GENERATED / "R2024b/simulink/include/simstruc_types.h").is_file()
    assert (made / ert.GENERATED / "three.c").is_file()


def test_new_code_replaces_the_old_and_nothing_else(archive: Path) -> None:
    made = create(archive)
    (made / app.TASK).write_text("mine")
    (made / ert.GENERATED / "old.c").write_text("")
    create(archive)
    assert (made / app.TASK).read_text() == "mine"
    assert not (made / ert.GENERATED / "old.c").exists()
    assert (made / ert.GENERATED / "three.c").is_file()


def test_a_period_that_the_code_does_not_say(archive: Path) -> None:
    text = ert_rates.SOURCE.replace("BUSY", "0").replace("Sample time", "Time")
    packed = rewritten(archive, {"three.c": text})
    with pytest.raises(
        UserError, match=r"has 3 step functions, and 0 sample times are known; say sample_times: \[0\.01"
    ):
        create(packed)
    assert not list((archive.parent / "apps").iterdir())
    made = create(packed, sample_times_s=[0.01, 0.02, 0.06])
    assert app.load(made).description == app.Ert(kind="ert", model="three", sample_times=[0.01, 0.02, 0.06])


def rewritten(archive: Path, files: dict[str, str]) -> Path:
    """The archive with other files, or further ones."""
    with zipfile.ZipFile(archive) as old:
        kept = {name: old.read(name).decode() for name in old.namelist() if name.endswith((".c", ".h"))}
    with zipfile.ZipFile(place := archive.with_name("rewritten.zip"), "w") as out:
        for name, text in (kept | files).items():
            out.writestr(name, text)
    return place


def upwards_within(archive: Path) -> Path:
    with zipfile.ZipFile(archive, "a") as out:
        out.writestr("sub/../three.c", "")
    return archive


def linked(archive: Path) -> Path:
    with zipfile.ZipFile(archive, "a") as out:
        member = zipfile.ZipInfo("link.c")
        member.external_attr = (stat.S_IFLNK | 0o777) << 16
        out.writestr(member, "/etc/passwd")
    return archive


def text(archive: Path) -> Path:
    archive.write_text("no archive")
    return archive


def only(archive: Path, name: str) -> Path:
    with zipfile.ZipFile(archive, "w") as out:
        out.writestr(name, "")
    return archive


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "upwards": (lambda a: rewritten(a, {"../evil.c": ""}), r"\.\./evil\.c: is no file inside the archive; pack it"),
    "upwards within": (upwards_within, r"sub/\.\./three\.c: is no file inside"),
    "absolute": (lambda a: rewritten(a, {"/tmp/evil.c": ""}), r"/tmp/evil\.c: is no file inside"),
    "of Windows": (lambda a: rewritten(a, {"..\\evil.c": ""}), r"evil\.c: is no file inside"),
    "a drive": (lambda a: rewritten(a, {"C:\\evil.c": ""}), r"evil\.c: is no file inside"),
    "a link": (linked, r"link\.c: is no file inside"),
    "a file as a folder": (lambda a: rewritten(a, {"three.c/x.c": ""}), "is no archive of packNGo"),
    "large": (lambda a: rewritten(a, {"large.c": "x" * 200_000}), r"has more than \d+ files and 0 MiB of sources"),
    "no archive": (text, "is no archive of packNGo: File is not a zip file; pack it anew"),
    "no code": (lambda a: only(a, "three.mat"), "has no C file; pack it with packNGo"),
    "no model": (lambda a: only(a, "three.c"), "has no model; say MODEL=NAME"),
    "missing": (lambda a: a.with_name("other.zip"), r"ZIP=.*other\.zip: is missing; packNGo\(buildInfo\) in MATLAB"),
    "two models": (
        lambda a: rewritten(a, {"other.h": "void other_initialize(void);"}), r"has 2 models \(other, three\); say MOD"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_refused_leaves_nothing(
    archive: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Path], Path], said: str
) -> None:
    """Archives are not trusted. Seen to fail without the checks of paths, size and code."""
    monkeypatch.setattr(imported, "BYTES", 100_000)
    spoilt = spoil(archive)
    with pytest.raises(UserError, match=said):
        create(spoilt)
    assert not list((archive.parent / "apps").iterdir())
    assert not (archive.parent / "evil.c").exists()


def test_what_is_there_already_is_left(archive: Path) -> None:
    apps = archive.parent / "apps"
    scaffold.create("block", "three", apps)
    with pytest.raises(UserError, match="is an app of another kind; take another NAME="):
        create(archive)
    scaffold.create("ert", "four", apps)
    with pytest.raises(UserError, match=r"app\.yml: model: four: the archive is of three; take another NAME="):
        create(archive, "four", model="three")
    (apps / "five").mkdir()
    with pytest.raises(UserError, match=r"five: is there, without app\.yml; take another NAME=, or remove it"):
        create(archive, "five")
    assert sorted(path.name for path in apps.iterdir()) == ["five", "four", "three"]
