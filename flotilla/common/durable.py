"""Outputs that survive a power cut: under a name is the whole new content, or still the whole old one.

File systems write names and contents in the order that suits them. After a rename without a sync before it, a power cut
leaves the new name with an empty or a short file for up to half a minute. Here the content comes first.
"""

from __future__ import annotations

import ctypes
import errno
import os
import threading
from collections.abc import Sequence
from pathlib import Path

_libc = ctypes.CDLL(None, use_errno=True)


def rename(new: Path, final: Path) -> Path:
    """Give a complete file or directory tree its name, in the place of what had that name; the place."""
    _sync(new)
    new.replace(final)
    sync_names(final.parent)
    return final


def rename_files(files: Sequence[Path], place: Path) -> None:
    """Move complete files of one directory into another one."""
    if files:
        _sync(files[0].parent)
    for new in files:
        new.replace(place / new.name)
    sync_names(place)


def write(file: Path, content: str | bytes, *, private: bool = False) -> Path:
    """Write a small file in one go, in the place of the one that is there; the file. `private`: for its owner alone."""
    beside = file.with_name(f".{file.name}.{os.getpid()}-{threading.get_ident()}")  # others may write the same now
    try:
        beside.touch(0o600 if private else 0o666)
        beside.write_bytes(content.encode() if isinstance(content, str) else content)
        return rename(beside, file)
    finally:
        beside.unlink(missing_ok=True)


def sync_names(directory: Path) -> None:
    """Wait until names that were given or removed in the directory are on its device."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # of file systems that cannot sync a directory, as of shared folders
            raise
    finally:
        os.close(descriptor)


def _sync(path: Path) -> None:
    """Wait until a file is on its device. For a tree this is one call for its whole file system: a call for each of
    thousands of small files would take a commit of the journal each."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        if not path.is_dir():
            os.fsync(descriptor)
        elif _libc.syncfs(descriptor):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))
    finally:
        os.close(descriptor)
