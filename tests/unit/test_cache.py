"""Results of build steps: made once, whole or not at all."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections import namedtuple
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from flotilla.common import cache, host, paths, progress
from flotilla.common.errors import UserError

PATIENCE_S = 60


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")


def test_a_result_is_made_once() -> None:
    calls: list[Path] = []

    def make(out: Path) -> None:
        calls.append(out)
        (out / "file").touch()

    for _ in range(2):
        made = cache.result("kind", "0123456789abcdef", make)
    assert len(calls) == 1
    assert (made / "file").exists()


def test_a_failed_step_leaves_nothing_that_could_be_taken_for_a_result(capsys: pytest.CaptureFixture[str]) -> None:
    def fail(out: Path) -> None:
        (out / "half").touch()
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        cache.result("kind", "0123456789abcdef", fail)
    assert list(paths.CACHE.glob("[!.]*")) == []
    assert "kind-0123456789abcdef.part, which is not complete: 0." in capsys.readouterr().err


def test_work_that_a_full_disk_made_fail_says_so_when_other_work_has_made_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a compiler that is unpacked beside a root file system. With `free` asked at the end alone, this failed."""
    usage = namedtuple("usage", "free")
    free = [0]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(free[0]))
    monkeypatch.setattr(host, "_was_full", threading.Event())
    removed = threading.Event()

    def fail(_: Path) -> None:
        raise UserError("tar failed")

    def unpack() -> None:
        try:
            cache.result("tools", "0" * 64, fail)
        finally:
            free[0] = 1 << 30
            removed.set()

    def install() -> None:
        assert removed.wait(10)
        raise UserError("debootstrap failed")

    with pytest.raises(UserError, match=r"no space left on its disk.*BUILD=directory \(debootstrap failed\)"):
        cache.result("rootfs", "1" * 64, lambda _: _both(unpack, install))


def _both(unpack: Callable[[], None], install: Callable[[], None]) -> None:
    """Whichever ended first, the failure of `install` is raised."""
    with ThreadPoolExecutor(2) as threads:
        threads.submit(unpack)
        threads.submit(install).result()


def test_what_a_killed_build_left_is_removed_by_the_next() -> None:
    left = paths.CACHE / "kind-0123456789abcdef.part"
    left.mkdir(parents=True)
    (left / "half").touch()
    made = cache.result("kind", "0123456789abcdef", lambda out: (out / "whole").touch())
    assert sorted(path.name for path in made.iterdir()) == [".complete", "whole"]
    assert not left.exists()


@pytest.mark.parametrize("damage", ["emptied", "gone", "no list", "short list"])
def test_a_result_that_is_not_whole_is_made_anew(
    damage: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a power cut leaves it that came before results were synced. Seen to fail: whatever was there was taken."""

    def make(out: Path) -> None:
        (out / "directory").mkdir()
        (out / "directory" / "file").write_text("content")
        (out / "link").symlink_to("directory/file")

    key = "0123456789abcdef"
    made = cache.result("kind", key, make)
    damages: dict[str, Callable[[], object]] = {
        "emptied": lambda: os.truncate(made / "directory" / "file", 0),
        "gone": lambda: (made / "link").unlink(),
        "no list": lambda: (made / ".complete").unlink(),
        "short list": lambda: os.truncate(made / ".complete", 5),
    }
    damages[damage]()
    monkeypatch.setattr(cache, "_whole", set())  # the next process
    assert not cache.has("kind", key)
    assert (cache.result("kind", key, make) / "link").read_text() == "content"
    assert cache.has("kind", key)
    assert "kind-0123456789abcdef: is not whole, so it is made anew" in capsys.readouterr().err
    assert not list(paths.CACHE.glob("*.part"))


def test_a_file_that_a_user_of_a_result_added_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    made = cache.result("kind", "0123456789abcdef", lambda out: (out / "file").touch())
    (made / "file.pyc").touch()
    monkeypatch.setattr(cache, "_whole", set())
    assert cache.has("kind", "0123456789abcdef")


@pytest.fixture
def _results(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of two kinds that earlier builds used, number 0 last."""
    for number in range(8):
        for kind in ("root", "root-lean"):
            os.utime(cache.result(kind, f"{number:016}", _nothing), (1000 - number, 1000 - number))
    monkeypatch.setattr(cache, "_used", set())


def _nothing(_: Path) -> None:
    pass


def _left(kind: str) -> list[int]:
    return sorted(int(path.name[-16:]) for path in paths.CACHE.glob(f"{kind}-0*"))


@pytest.mark.usefixtures("_results")
def test_a_build_leaves_the_last_used_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    (paths.CACHE / "root-no-result.json").touch()
    cache.result("root", f"{7:016}", _nothing)
    monkeypatch.setattr(cache, "_used", set())  # the next build
    with cache.exclusive():
        pass
    assert _left("root") == [0, 1, 2, 7]
    assert _left("root-lean") == [0, 1, 2, 3]
    assert (paths.CACHE / "root-no-result.json").exists()


@pytest.mark.usefixtures("_results")
def test_a_build_leaves_all_that_it_used() -> None:
    with cache.exclusive():
        for number in range(2, 8):
            cache.result("root", f"{number:016}", _nothing)
    assert _left("root") == [2, 3, 4, 5, 6, 7]


@pytest.mark.usefixtures("_results")
def test_a_failed_build_removes_nothing() -> None:
    with pytest.raises(RuntimeError), cache.exclusive():
        raise RuntimeError("no")
    assert _left("root") == list(range(8))


@pytest.mark.parametrize("change", ["content", "name", "executable", "new file", "link"])
def test_the_digest_sees_every_change_that_matters(tmp_path: Path, change: str) -> None:
    tree = tmp_path / "tree"
    tree.mkdir()
    file = tree / "a"
    file.write_text("one")
    before = cache.digest("text", tree)
    assert before == cache.digest("text", tree)
    changes: dict[str, Callable[[], object]] = {
        "content": lambda: file.write_text("two"),
        "name": lambda: file.rename(tree / "b"),
        "executable": lambda: file.chmod(0o755),
        "new file": lambda: (tree / "c").touch(),
        "link": lambda: (tree / "d").symlink_to("a"),
    }
    changes[change]()
    assert cache.digest("text", tree) != before


def test_the_digest_does_not_see_umask_and_times(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_text("one")
    file.chmod(0o644)
    before = cache.digest(file)
    file.chmod(0o600)
    file.touch()
    assert cache.digest(file) == before


@pytest.mark.usefixtures("_results")
def test_a_build_leaves_what_another_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """More results than are kept, all of them used just now. Seen to fail without the time limit."""
    for number in range(8):
        cache.result("root", f"{number:016}", _nothing)
    monkeypatch.setattr(cache, "_used", set())
    with cache.exclusive():
        pass
    assert _left("root") == list(range(8))


@pytest.mark.usefixtures("_results")
def test_a_removal_that_was_interrupted_leaves_no_half_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to fail when the directory keeps its name while it is emptied."""

    def interrupted(directory: Path) -> None:
        if directory.exists():
            raise KeyboardInterrupt

    monkeypatch.setattr(cache, "discard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cache.clean()
    kept = [path for path in paths.CACHE.iterdir() if path.name.startswith("root")]
    assert len([path for path in kept if path.suffix == ".part"]) == 1


def test_two_processes_make_a_result_once() -> None:
    """Seen to fail without a lock: the second one removes what the first has begun."""
    started, made = threading.Event(), []

    def slow(out: Path) -> None:
        (out / "begun").touch()
        started.set()
        other.join(0.2)  # would be done by then, if it did not wait
        made.append((out / "begun").exists())

    def same() -> None:
        started.wait(10)
        cache._making.clear()  # of which another process knows nothing
        cache.result("kind", "0123456789abcdef", lambda out: made.append(False))

    other = threading.Thread(target=same)
    other.start()
    cache.result("kind", "0123456789abcdef", slow)
    other.join(10)
    assert made == [True]


def test_two_threads_make_a_result_once_and_speak_of_no_other_command(capsys: pytest.CaptureFixture[str]) -> None:
    started = threading.Event()
    made: list[Path] = []

    def slow(out: Path) -> None:
        started.set()
        other.join(0.2)  # would be done by then, if it did not wait
        made.append(out)

    def same() -> None:
        started.wait(10)
        cache.result("kind", "0123456789abcdef", made.append)

    other = threading.Thread(target=same)
    other.start()
    cache.result("kind", "0123456789abcdef", slow)
    other.join(10)
    assert len(made) == 1
    assert "another command" not in capsys.readouterr().err


@pytest.mark.usefixtures("_results")
def test_what_is_being_made_is_left_alone() -> None:
    """However old an archive says that it is. Seen to fail when removing takes no lock."""
    left = []

    def unpack(out: Path) -> None:
        os.utime(out, (1, 1))
        cache.clean()
        left.append(out.exists())

    cache.result("root", f"{99:016}", unpack)
    assert left == [True]


def test_who_waits_says_for_what(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Seen to fail when a second build showed nothing until the first one ended."""
    lock = tmp_path / "lock"
    entered = threading.Event()

    def second() -> None:
        with cache.locked(lock):
            entered.set()

    waiting = threading.Thread(target=second)
    with cache.locked(lock):
        waiting.start()
        end = time.monotonic() + PATIENCE_S
        while not progress._running:
            assert waiting.is_alive()
            assert time.monotonic() < end, "it waits without a word"
        assert "wait for another command that holds" in progress._running[-1].title
        assert not entered.is_set()
    waiting.join()
    assert entered.is_set()
    assert "wait for another command that holds" in capfd.readouterr().err
