"""What a cold build does at the same time, with stand-ins for what takes long."""

from __future__ import annotations

import json
import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from flotilla.common import cache, namespace, paths
from flotilla.common.errors import UserError
from flotilla.debian import pool, runtime, tools
from flotilla.debian.lock import read_lock
from flotilla.fleet.model import Fleet, System
from flotilla.images import build, rootfs

PC104 = System("i386", "bookworm")


@pytest.fixture
def own_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A build directory, and a pool that needs nothing."""
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(pool, "fill", lambda _: None)
    return tmp_path


def test_a_wrong_task_ends_the_root_that_is_being_made(
    fleet: Fleet, own_build: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(own_build / "fifo")
    asked = []

    def board_build(*_: object) -> None:
        argv = ["sh", "-c", f"echo $$ >{own_build}/fifo; exec sleep 1000"]
        namespace.run_logged("root", argv, own_build / "log")

    def check_task(path: Path, _: bytes, system: System) -> None:
        (own_build / "fifo").read_text()
        asked.append(system.architecture)
        raise UserError(f"{path.name}: wrong")

    monkeypatch.setattr("flotilla.images.build.host.check", lambda: None)
    monkeypatch.setattr("flotilla.images.build.namespace.check", lambda: None)
    monkeypatch.setattr("flotilla.images.build.cache.exclusive", nullcontext)
    monkeypatch.setattr(build, "board_build", board_build)
    monkeypatch.setattr(runtime, "check_task", check_task)
    monkeypatch.setattr(build, "_robot_images", lambda *_: pytest.fail("images are made"))
    with pytest.raises(UserError, match=r"^robot1: heading.yml: wrong$"):
        build.build(fleet, [fleet.robots[1]])
    assert asked == ["i386"]  # no second runtime is compiled for it


@pytest.mark.parametrize("wrong", [False, True], ids=["compiled", "does not compile"])
def test_the_root_is_begun_before_the_runtime_is_compiled(
    fleet: Fleet, own_build: Path, monkeypatch: pytest.MonkeyPatch, *, wrong: bool
) -> None:
    os.mkfifo(own_build / "fifo")
    board = fleet.boards["smartcoret3"]
    package = own_build / "flotilla-runtime_1_i386.deb"
    package.write_text("package")

    def compile_runtime(system: System) -> SimpleNamespace:
        assert system.architecture == "i386"
        (own_build / "fifo").read_text()  # the stage has begun
        if wrong:
            raise UserError("a.c:1: error")
        return SimpleNamespace(package=package)

    def stage(_: str, arguments: list[str], log: Path) -> None:
        """What rootfs.main does with the pipe, as a process."""
        description = json.loads(Path(arguments[0]).read_text())
        script = f"echo >{own_build}/fifo; read name <runtime; cp $name ../vmlinuz; touch ../root.squashfs"
        argv = ["env", "-C", description["repository"], "sh", "-e", "-c", script]
        namespace.run_logged("stage", argv, log)

    monkeypatch.setattr(runtime, "build", compile_runtime)
    monkeypatch.setattr(tools, "tree", lambda _: own_build / "tools")
    monkeypatch.setattr(pool, "repository", lambda *_, compressed: None)
    monkeypatch.setattr(namespace, "run_stage", stage)
    locks = read_lock("smartcoret3"), read_lock("tools")
    if wrong:
        with pytest.raises(UserError, match=r"^a.c:1: error$"):
            rootfs.build(board, *locks)
        assert not list(paths.CACHE.glob("rootfs-*"))
    else:
        made = rootfs.build(board, *locks)
        assert sorted(path.name for path in made.glob("[!.]*")) == ["root.squashfs", "vmlinuz"]
        assert (made / "vmlinuz").read_text() == "package"


def test_a_runtime_that_is_compiled_needs_no_packages(own_build: Path) -> None:
    assert [lock.name for lock in runtime.wanted(PC104)] == ["runtime-bookworm-i386"]
    made = own_build / "cache" / runtime.name(PC104)
    made.mkdir(parents=True)
    (made / cache._LIST).write_text("{}")
    assert runtime.wanted(PC104) == []
