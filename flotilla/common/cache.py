"""Results of build steps, kept under the hash of everything that went into them.

A result is a directory. It is made beside its place and renamed when it is complete and on its device, so that neither
an interrupted build nor a power cut leaves anything that could be taken for a result; the next build removes the rest.
It has a list of its files with their sizes. A result that differs from its list, or has none, is made anew.

A build that succeeds removes old results: the newest of each kind stay, those that it used itself, and those that
another process may be using.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
import stat
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TypeVar

from flotilla.common import durable, host, paths, progress, sources

_Name = TypeVar("_Name", bound=PurePath)
_KEPT = 4
"""The newest results of a kind, which stay whoever used them: with two boards, the present one and the one before."""
_IN_USE_S = 3600
"""After its last use by any process."""
_RESULT = re.compile(r"(.+)-[0-9a-f]{16}(\.part)?")
_LIST = ".complete"
"""What a result has, JSON: sizes by path. It is written last."""
_used: set[Path] = set()
_whole: set[Path] = set()
"""Results that this process has compared with their lists."""
_making: dict[Path, threading.Lock] = {}


def digest(*parts: str | bytes | Path) -> str:
    """SHA-256 over texts, and over files and directory trees (`sources.files`) with their names and executable bits."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            for path in sources.files(part) if part.is_dir() else [part]:
                total.update(_entry(path, os.fsencode(path.relative_to(part.parent))))
        else:
            data = part.encode() if isinstance(part, str) else part
            total.update(f"text {len(data)}\n".encode() + data)
    return total.hexdigest()


def digest_of(directory: Path, files: Iterable[Path]) -> str:
    """SHA-256 over some of the files below a directory, with their paths from there and executable bits."""
    return digest_of_named({path.relative_to(directory): path for path in files})


def digest_of_named(files: Mapping[_Name, Path]) -> str:
    """The same over files of several directories, by the paths that count."""
    total = hashlib.sha256()
    for name, path in files.items():
        total.update(_entry(path, os.fsencode(name)))
    return total.hexdigest()


def _entry(path: Path, name: bytes) -> bytes:
    if path.is_symlink():
        content, kind = os.fsencode(path.readlink()), b"link"
    else:
        content, kind = path.read_bytes(), b"x" if sources.executable(path) else b"-"
    return b"%b %d %b %d\n" % (kind, len(os.fsdecode(name)), name, len(content)) + content


def result(kind: str, key: str, make: Callable[[Path], None]) -> Path:
    """The directory that `make` fills, made once per `kind` and `key`."""
    final = paths.CACHE / name(kind, key)
    _used.add(final)
    if not _is_whole(final):
        # A thread of our own that makes it is no other command to tell of.
        with _making.setdefault(final, threading.Lock()), locked(paths.CACHE / f".{final.name}.lock"):
            if not _is_whole(final):  # nobody else made it meanwhile
                _make(final, make)
    os.utime(final)  # it was of use just now: see `clean`
    return final


def has(kind: str, key: str) -> bool:
    """Whether `result` would have nothing to make."""
    return _is_whole(paths.CACHE / name(kind, key))


def name(kind: str, key: str) -> str:
    """Of a result's directory: other results may be made from it."""
    return f"{kind}-{key[:16]}"


def _make(final: Path, make: Callable[[Path], None]) -> None:
    beside = final.with_name(final.name + ".part")
    discard(beside)
    if final.exists():
        progress.say(f"{paths.shown(final)}: is not whole, so it is made anew")
        final.rename(beside)
        discard(beside)
    beside.mkdir(parents=True)
    try:
        with host.explaining_a_full_disk():
            make(beside)
            (beside / _LIST).write_text(json.dumps(_sizes(beside)))
            durable.rename(beside, final)
        _whole.add(final)
    finally:
        if beside.exists():  # a kernel's objects take seconds
            with progress.step(f"remove {paths.shown(beside)}, which is not complete"):
                discard(beside)


def _is_whole(final: Path) -> bool:
    """Whether the result is there as it was made. Files that its users have added since do not matter."""
    if not final.exists():
        return False
    if final not in _whole:
        try:
            listed: dict[str, int] = json.loads((final / _LIST).read_text())
            if any(_size(f"{final}/{path}") != size for path, size in listed.items()):
                return False
        except (OSError, ValueError):  # a file that is not there, or no list
            return False
        _whole.add(final)
    return True


def _sizes(directory: Path) -> dict[str, int]:
    """Of all files and links below a directory."""
    files = [f"{parent}/{name}" for parent, names, others in os.walk(directory) for name in names + others]
    return {os.path.relpath(file, directory): size for file in files if (size := _size(file)) >= 0}


def _size(path: str) -> int:
    """In bytes; -1 of a directory, whose size is the file system's own."""
    status = os.lstat(path)
    return -1 if stat.S_ISDIR(status.st_mode) else status.st_size


def discard(directory: Path) -> None:
    """Remove a directory tree, if it is there, read-only directories included."""
    if directory.exists():
        for parent, _, _ in os.walk(directory):
            Path(parent).chmod(0o755)
        shutil.rmtree(directory)


@contextmanager
def exclusive() -> Iterator[None]:
    """One build of images or apps at a time in a build directory: a second one waits for the first."""
    with locked(paths.CACHE / ".lock"):
        yield
        clean()


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold a lock for as long as the body runs: whoever else asks for it waits, and says so."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with progress.step(f"wait for another command that holds {paths.shown(file)}"):
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def clean() -> None:
    """Remove the results that nobody uses, but for the last used of each kind."""
    newest = time.time() - _IN_USE_S
    kinds: dict[str, list[Path]] = defaultdict(list)
    for path in paths.CACHE.iterdir():
        if match := _RESULT.fullmatch(path.name):
            kinds[match[1]].append(path)
    for results in kinds.values():
        results.sort(key=lambda path: path.stat().st_mtime, reverse=True)
        for old in set(results[_KEPT:]) - _used:
            if old.exists() and old.stat().st_mtime < newest:
                _remove(old)


def _remove(old: Path) -> None:
    """A result, or what is left of one, unless it is being made: its age says nothing while archives are unpacked."""
    name = old.name.removesuffix(".part")
    with (paths.CACHE / f".{name}.lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        leaving = old.with_name(f"{name}.part")  # which is no result's name, should this be interrupted
        if leaving != old:
            discard(leaving)
            old.rename(leaving)
        discard(leaving)
