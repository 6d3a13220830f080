"""The package pool: every locked Debian package as `SHA256.deb`. Once it is filled, building needs no network."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from datetime import timedelta
from pathlib import Path
from urllib.parse import quote

from flotilla.common import cache, durable, paths, progress
from flotilla.common.errors import UserError
from images.builder import deb, mirror
from images.builder.lock import Lock, Package
from images.builder.mirror import Mirrors

_CONNECTIONS = 8
_ATTEMPTS = 3
_TIMEOUT = 30.0
_CHUNK = 1 << 18
_GONE = (404, 410)
_SNAPSHOT_DELAYS = (timedelta(0), timedelta(days=1))
"""A snapshot archive answers with its last copy before a time, older perhaps than the release of that very time."""


class _GoneError(Exception):
    """The server no longer has the file."""


class _NoSpaceError(UserError):
    """The disk is full: no other download can do better."""


def file(package: Package) -> Path:
    """Where the pool keeps a package."""
    return paths.POOL / f"{package.sha256}.deb"


def fill(locks: Iterable[Lock], mirrors: Mirrors | None = None) -> None:
    """Download what the locks name and the pool lacks. Contents of what is there are the matter of `verify_hashes`."""
    wanted = {package.sha256: (lock, package) for lock in locks for package in lock.packages}
    if not _missing(wanted):
        return
    mirrors = mirrors or mirror.resolve()
    with cache.locked(paths.POOL / ".lock"):  # of two builds at once, the second finds the first one's packages
        missing = _missing(wanted)
        if not mirrors.snapshot:
            for archive in {package.archive for _, package in missing}:
                mirrors.of(archive)
        total = sum(package.size for _, package in missing)
        with progress.step(f"downloading {len(missing)} packages, {progress.size(total)}") as step:
            _download_all(missing, mirrors, lambda done: step.at(done >> 20, total >> 20, "MiB"))


def verify_hashes(lock: Lock) -> None:
    """Compare the content of every package of a lock in the pool with the lock."""
    absent = [package for package in lock.packages if not file(package).is_file()]
    if absent:
        raise UserError("\n".join(f"package {package}: missing in {paths.shown(paths.POOL)}" for package in absent))
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        found = threads.map(_hash, [file(package) for package in lock.packages])
    wrong = [
        _corrupt(package, sha256)
        for package, sha256 in zip(lock.packages, found, strict=True)
        if sha256 != package.sha256
    ]
    if wrong:
        raise UserError("\n".join(wrong))


def repository(lock: Lock, directory: Path, *, compressed: bool = True) -> None:
    """A package repository of just the lock's packages, which it verifies; no signature, so it is for

    `debootstrap --no-check-gpg --variant=minbase RELEASE TARGET file://DIRECTORY`.

    `compressed`: as Debian has them. debootstrap unpacks what is required twice, and dpkg one package after the other,
    so that without compression is sooner; the kernel, which neither touches at first, stays as it is.
    """
    verify_hashes(lock)
    index = directory / "dists" / lock.release / "main" / f"binary-{lock.architecture}"
    index.mkdir(parents=True)

    def add(package: Package) -> str:
        """Its stanza in the index."""
        place = directory / package.path
        place.parent.mkdir(parents=True, exist_ok=True)
        if compressed or package.role == "kernel":
            _link(file(package), place)
            return _stanza(package, package.size, package.sha256)
        deb.without_compression(file(package), place)
        return _stanza(package, place.stat().st_size, _hash(place))

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        content = "".join(threads.map(add, lock.packages)).encode()
    (index / "Packages").write_bytes(content)
    (index.parents[1] / "Release").write_text(
        f"Origin: Debian\nSuite: {lock.release}\nCodename: {lock.release}\n"
        f"Architectures: {lock.architecture}\nComponents: main\n"
        f"SHA256:\n {hashlib.sha256(content).hexdigest()} {len(content)} main/binary-{lock.architecture}/Packages\n",
        encoding="utf-8",
    )


# --- pool ---


def _missing(wanted: dict[str, tuple[Lock, Package]]) -> list[tuple[Lock, Package]]:
    """What the pool lacks; an error for what it holds at another size."""
    missing, wrong = [], []
    for lock, package in wanted.values():
        try:
            size = file(package).stat().st_size
        except FileNotFoundError:
            missing.append((lock, package))
            continue
        if size != package.size:
            wrong.append(_corrupt(package, _hash(file(package))))
    if wrong:
        raise UserError("\n".join(wrong))
    return missing


def _corrupt(package: Package, found: str) -> str:
    return (
        f"package {package}: {paths.shown(file(package))} has SHA-256 {found}, the lock says {package.sha256}; "
        "delete the file and run again"
    )


def _hash(path: Path) -> str:
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


# --- download ---


def _download_all(missing: list[tuple[Lock, Package]], mirrors: Mirrors, report: Callable[[int], None]) -> None:
    """Download in parallel; every package that could not be had is in the one error at the end."""
    done = 0
    mutex = threading.Lock()

    def count(size: int) -> None:
        nonlocal done
        with mutex:
            done += size
            report(done)

    failures: list[str] = []
    with ThreadPoolExecutor(_CONNECTIONS) as threads:
        running = [threads.submit(_download, lock, package, mirrors, count) for lock, package in missing]
        try:
            for future in as_completed(running):
                try:
                    future.result()
                except _NoSpaceError:
                    raise
                except UserError as error:
                    failures.append(str(error))
        except BaseException:
            threads.shutdown(cancel_futures=True)
            raise
    if failures:
        raise UserError("\n".join(sorted(failures)))


def _download(lock: Lock, package: Package, mirrors: Mirrors, count: Callable[[int], None]) -> None:
    tried = []
    for base in _bases(lock, package, mirrors):
        address = f"{base}/{quote(package.path, safe='/+~')}"
        tried.append(address)
        try:
            return _fetch(address, package, count)
        except _GoneError:
            continue
    places = " nor ".join(tried)
    remedy = (
        "lock the version of today with `make lock`"
        if mirrors.snapshot
        else "lock the version of today with `make lock`, or set SNAPSHOT= to a snapshot archive (http://SNAPSHOT/archive)"
    )
    raise UserError(f"package {package}: not at {places} any more; {remedy}")


def _bases(lock: Lock, package: Package, mirrors: Mirrors) -> Iterator[str]:
    """Where a package may be, the likeliest place first."""
    if package.archive in mirrors.archives:
        yield mirrors.archives[package.archive]
    if mirrors.snapshot:
        for delay in _SNAPSHOT_DELAYS:
            time = lock.date(package.archive) + delay
            yield f"{mirrors.snapshot}/{package.archive}/{time:%Y%m%dT%H%M%SZ}"


def _fetch(address: str, package: Package, count: Callable[[int], None]) -> None:
    """Download one package beside its place in the pool and move it there once size and hash are right."""
    import http.client  # here, because it takes a while, and a full pool needs no network
    import urllib.error

    beside = file(package).with_suffix(".part")
    try:
        for attempt in range(1, _ATTEMPTS + 1):  # networks fail in passing
            try:
                found, size = _receive(address, beside, count)
                break
            except urllib.error.HTTPError as error:
                if error.code in _GONE:
                    raise _GoneError from None
                reason = str(error)
            except (http.client.HTTPException, urllib.error.URLError, TimeoutError, ConnectionError) as error:
                reason = str(error)
            if attempt == _ATTEMPTS:
                raise UserError(f"package {package}: {address}: {reason}; run again, or set another mirror")
        if (found, size) != (package.sha256, package.size):
            raise UserError(
                f"package {package}: {address} has SHA-256 {found} and {size} bytes, the lock says "
                f"{package.sha256} and {package.size} bytes; try another mirror, or lock anew with `make lock`"
            )
        durable.rename(beside, file(package))
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise UserError(
            f"no space left for {paths.shown(paths.POOL)}; make room, or set BUILD= to another disk"
        ) from None
    finally:
        beside.unlink(missing_ok=True)


def _receive(address: str, beside: Path, count: Callable[[int], None]) -> tuple[str, int]:
    """Hash and size of what came."""
    import http.client
    import urllib.request

    digest, size = hashlib.sha256(), 0
    with urllib.request.urlopen(address, timeout=_TIMEOUT) as answer, beside.open("wb") as part:
        while chunk := answer.read(_CHUNK):
            part.write(chunk)
            digest.update(chunk)
            size += len(chunk)
            count(len(chunk))
        expected = answer.headers.get("Content-Length")
    if expected and size < int(expected):
        raise http.client.IncompleteRead(b"", int(expected) - size)
    return digest.hexdigest(), size


# --- repository ---


def control(package: Package) -> str:
    """The package's own description of itself. UserError where the pool's file is damaged."""
    try:
        return deb.control(file(package))
    except ValueError as error:
        raise UserError(f"package {package}: {error}; delete {paths.shown(file(package))} and run again") from error


def _stanza(package: Package, size: int, sha256: str) -> str:
    """Its stanza in the repository's index. The archive's word on what is required stands above the package's own.

    debootstrap misses a stanza that no empty line ends.
    """
    kept = re.sub(r"^Priority: .*\n", "", control(package), flags=re.MULTILINE)
    return (
        f"{kept.rstrip()}\nPriority: {'required' if package.role == 'required' else 'optional'}\n"
        f"Filename: {package.path}\nSize: {size}\nSHA256: {sha256}\n\n"
    )


def _link(source: Path, target: Path) -> None:
    try:
        target.hardlink_to(source)
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK):
            raise
        shutil.copyfile(source, target)
