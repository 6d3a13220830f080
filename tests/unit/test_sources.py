"""What enters an image is what is counted: files planted in each place that images are made of."""

from __future__ import annotations

import ast
import os
import shutil
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from flotilla.apps import app, assigned, builder
from flotilla.common import cache, paths, sources
from flotilla.common.errors import UserError
from flotilla.debian import kernel, kernel_stage, runtime, runtime_stage
from flotilla.debian.lock import board_lock, read_lock
from flotilla.fleet import identity
from flotilla.fleet.inventory import load_fleet
from flotilla.images import initramfs, manifest, rootfs

FLEET = load_fleet()
BOARD = FLEET.boards["smartcoret3"].model_copy(update={"kernel": "lean"})
LOCKS = board_lock(BOARD).without("kernel"), read_lock("tools")
LEFT_BEHIND = (
    "__pycache__/a.cpython-311.pyc", "a.pyc", "a.conf~", ".#a.j2", "#a.conf#", ".a.conf.swp", "a.c.orig", "a.c.rej",
    ".DS_Store", "__pycache__/a.c", ".git/a.conf", ".pytest_cache/a.c", ".mypy_cache/a.conf", ".ruff_cache/a.list",
)  # fmt: skip
"""In no image, and not counted."""
UNTRACKED = ("a.conf", "a.c", "a.list", "a.config", "a.patch", "a.j2", ".a", "a b.conf", "new/a.conf")
"""In an image and counted, or neither, as the place has it."""


@dataclass(frozen=True)
class Place:
    """A directory of which files enter an image."""

    directory: Path
    """A copy, in which files are planted."""
    entering: Callable[[Path], set[str]]
    """What is copied of it to where the argument says, or read by name."""
    keys: Callable[[], Sequence[str]]
    """Of results that are made of it, and of the manifest."""
    gets: Sequence[str]
    """Those of UNTRACKED that enter."""


def below(directory: Path) -> set[str]:
    return {str(path.relative_to(directory)) for path in directory.rglob("*") if not path.is_dir() or path.is_symlink()}


def names(files: Sequence[Path], directory: Path) -> set[str]:
    return {str(path.relative_to(directory)) for path in files}


def of_board() -> list[str]:
    return [rootfs.key(BOARD, *LOCKS), manifest.inputs_of_board(BOARD, LOCKS)]


@pytest.fixture(params=["overlay", "lists", "runtime", "kernel", "own-loop", "saw-tooth"])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    copy = tmp_path / "copy"
    monkeypatch.setattr(paths, "BUILD", tmp_path / "build")
    monkeypatch.setattr(paths, "CACHE", tmp_path / "build/cache")
    if request.param == "overlay":
        shutil.copytree(paths.OVERLAY, copy, symlinks=True, ignore=sources.ignored)
        monkeypatch.setattr(paths, "OVERLAY", copy)

        def lay(to: Path) -> set[str]:
            rootfs.lay_overlay(to)
            return below(to) | names(list(identity.templates().values()), copy)

        def counted() -> list[str]:  # the manifest counts what templates render to
            return [cache.digest(key, cache.digest_of_named(identity.templates())) for key in of_board()]

        return Place(copy, lay, counted, UNTRACKED)
    if request.param == "lists":
        shutil.copytree(rootfs.DATA, copy, ignore=sources.ignored)
        monkeypatch.setattr(rootfs, "DATA", copy)
        return Place(copy, lambda _: names(rootfs.lists(), copy), of_board, ["a.list"])
    if request.param == "runtime":
        shutil.copytree(runtime.SOURCE, copy, ignore=sources.ignored)
        monkeypatch.setattr(runtime, "SOURCE", copy)

        def send(to: Path) -> set[str]:
            runtime.copy_sources(to)
            return below(to)

        return Place(copy, send, of_board, [name for name in UNTRACKED if name != ".a"])
    if request.param == "kernel":
        shutil.copytree(paths.KERNELS, copy, ignore=sources.ignored)
        monkeypatch.setattr(paths, "KERNELS", copy)
        made_of = kernel.recipe(BOARD.name)
        read = [copy / f"{BOARD.name}.yml", *(copy / "fragments" / f"{name}.config" for name in made_of.fragments)]
        return Place(copy, lambda _: names([*read, *kernel.patches(BOARD.name)], copy), of_board, [])
    shutil.copytree(paths.PROJECT / "examples" / request.param, copy, ignore=sources.ignored)

    def build(to: Path) -> set[str]:
        found: set[str] = set()

        def run(_: str, work: Path, *__: object) -> None:
            found.update(below(work / "source"))
            (work / "plugin.so").touch()
            raise UserError("it need not be built")

        subject = app.load(copy)
        try:
            builder.build(subject, BOARD, to / "out", run)
        except UserError:
            if not found:
                raise
        return found

    return Place(copy, build, lambda: [assigned.key_of(copy)], UNTRACKED)


def plant(directory: Path, name: str) -> None:
    path = directory / name
    path.parent.mkdir(exist_ok=True)
    if name.startswith(".#"):  # Emacs' locks lead nowhere
        path.symlink_to("somebody@host.1")
    else:
        path.write_text("planted\n")


def test_what_programs_leave_behind_enters_nothing_and_is_not_counted(place: Place, tmp_path: Path) -> None:
    """Seen to fail: bytecode and backups were in the root and in apps, and the keys were those without."""
    entering, keys = place.entering(tmp_path / "before"), place.keys()
    for name in LEFT_BEHIND:
        plant(place.directory, name)
    (place.directory / "empty").mkdir()  # which git keeps neither
    assert place.entering(tmp_path / "after") == entering
    assert place.keys() == keys


def test_a_file_that_git_does_not_know_enters_and_is_counted_or_neither(place: Place, tmp_path: Path) -> None:
    entering, keys = place.entering(tmp_path / "before"), place.keys()
    for name in UNTRACKED:
        if name not in place.gets:
            plant(place.directory, name)
    assert place.entering(tmp_path / "neither") == entering
    assert place.keys() == keys
    for name in place.gets:
        plant(place.directory, name)
    assert place.entering(tmp_path / "both") == entering | set(place.gets)
    keys = place.keys()
    for name in place.gets:
        (place.directory / name).unlink()
        assert all(map(str.__ne__, place.keys(), keys)), name
        plant(place.directory, name)


def link(path: Path) -> None:
    path.unlink()
    path.symlink_to("somewhere")


def test_content_mode_and_folder_of_a_file_are_counted(place: Place) -> None:
    """Seen to fail: a folder of the overlay got another name, and the root's key stayed the same."""
    if not place.gets:
        return
    name = place.gets[-1].rpartition("/")[2]
    folder, other = place.directory / "a.d", place.directory / "b.d"
    folder.mkdir()
    (folder / name).write_text("one\n")
    seen = [place.keys()]
    changes: list[Callable[[], object]] = [
        lambda: (folder / name).write_text("two\n"),
        lambda: (folder / name).chmod(0o755),
        lambda: folder.rename(other),
        lambda: link(other / name),
    ]
    for change in changes:
        change()
        seen.append(place.keys())
    assert len({keys for each in seen for keys in each}) == len(seen) * len(seen[0])


def test_what_is_no_file_is_refused(place: Place, tmp_path: Path) -> None:
    if place.gets:
        with socket.socket(socket.AF_UNIX) as one:
            os.mkfifo(place.directory / "pipe.conf")
            one.bind(os.path.relpath(place.directory / "socket.conf"))
        with pytest.raises(UserError, match=r"pipe\.conf: is neither a file nor a link nor a directory; remove it"):
            place.keys()
        with pytest.raises(UserError, match=r"pipe\.conf: is neither"):
            place.entering(tmp_path / "to")


def test_modes_are_those_that_git_keeps(tmp_path: Path) -> None:
    """Not what this user may do: seen to differ on a file system without programs (`noexec`)."""
    file = tmp_path / "file"
    file.touch()
    for mode, program in ((0o744, True), (0o700, True), (0o654, False), (0o611, False)):
        file.chmod(mode)
        assert sources.executable(file) == program, oct(mode)


def test_links_of_the_overlay_are_links_of_the_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail: a link to a file that only robots have, and one to a folder, were counted and left out."""
    overlay, target = tmp_path / "overlay", tmp_path / "target"
    (overlay / "etc").mkdir(parents=True)
    (overlay / "etc/only-there").symlink_to("/usr/lib/flotilla/nowhere")
    (overlay / "etc/folder").symlink_to(tmp_path)
    monkeypatch.setattr(paths, "OVERLAY", overlay)
    rootfs.lay_overlay(target)
    assert (target / "etc/only-there").readlink() == Path("/usr/lib/flotilla/nowhere")
    assert (target / "etc/folder").readlink() == tmp_path


def test_the_overlay_is_not_laid_through_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail: the file that an absolute link of the root leads to on this computer was written."""
    overlay, target, host = tmp_path / "overlay", tmp_path / "target", tmp_path / "host"
    for directory in (overlay / "etc", target / "etc", host):
        directory.mkdir(parents=True)
    (overlay / "etc/localtime").write_text("overlay")
    (host / "UTC").write_text("this computer's")
    (target / "etc/localtime").symlink_to(host / "UTC")
    monkeypatch.setattr(paths, "OVERLAY", overlay)
    rootfs.lay_overlay(target)
    assert (host / "UTC").read_text() == "this computer's"
    assert (target / "etc/localtime").read_text() == "overlay"
    (overlay / "run").mkdir()
    (overlay / "run/file").touch()
    (target / "run").symlink_to(host)
    with pytest.raises(SystemExit, match=r"run/file: a folder of this path is a link to .*/host in the root"):
        rootfs.lay_overlay(target)
    assert not (host / "file").exists()


def test_a_file_behind_a_link_out_of_an_app_is_counted(tmp_path: Path) -> None:
    directory, shared = tmp_path / "app", tmp_path / "shared.c"
    directory.mkdir()
    shared.write_text("one")
    (directory / "shared.c").symlink_to(shared)
    before = assigned.key_of(directory)
    shared.write_text("two")
    assert assigned.key_of(directory) != before


# --- the code that makes an image ---

COUNTED: dict[str, Sequence[str]] = {
    rootfs.__file__: rootfs.MADE_BY,
    runtime_stage.__file__: runtime.MADE_BY,
    kernel_stage.__file__: kernel.MADE_BY,
}
"""What a key counts, by the module that is run in namespaces."""
NOT_COUNTED = {
    "flotilla.common.cache": "keeps results",
    "flotilla.common.paths": "where things lie",
    "flotilla.common.progress": "what is shown",
    "flotilla.common.sources": "the files that it finds are counted",
    "flotilla.common.together": "when things are done",
    "flotilla.common.errors": "messages",
    "flotilla.fleet.privileges": "its users are counted",
    "flotilla.fleet.model": "what of a board is used is counted",
    "flotilla.debian.lock": "the lock is counted",
    "flotilla.debian.kernel": "its result is counted by name",
    "flotilla.debian.runtime": "its result is counted by name",
    "flotilla.debian.tools": "its result is counted by name",
    "flotilla.debian.mirror": "how indexes of archives are read, for locks",
    "flotilla.debian.download": "how packages are downloaded, whose hashes are counted",
    "flotilla.common.durable": "when results are on the disk",
    "flotilla.common.processes": "how processes end",
    "flotilla.common.host": "what a computer must have",
}


def imported(file: Path) -> set[Path]:
    """The project's modules that a module imports."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    files = {name: paths.PROJECT / (name.replace(".", "/") + ".py") for name in found if name not in NOT_COUNTED}
    return {path for path in files.values() if path.is_file()}


@pytest.mark.parametrize("stage", COUNTED, ids=lambda file: Path(file).stem)
def test_all_code_of_a_stage_is_counted(stage: str) -> None:
    """What a stage imports is in the key of its result, or is named above with the reason. Seen to fail: namespace.py,
    which sets the environment of every program of a stage, was in none, and the way that tools are unpacked."""
    waiting, known = {Path(stage)}, set[Path]()
    while waiting:
        known |= waiting
        waiting = {module for file in waiting for module in imported(file)} - known
    assert {str(path) for path in known} <= set(COUNTED[stage])
    assert all((paths.PROJECT / (name.replace(".", "/") + ".py")).is_file() for name in NOT_COUNTED)
    assert str(Path(initramfs.__file__).with_name("init")) in COUNTED[rootfs.__file__]
