"""The package pool: every locked Debian package as `SHA256.deb`. Once it is filled, building needs no network."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from urllib.parse import quote

from flotilla.common import cache, durable, paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import deb, download, mirror
from flotilla.debian.download import Failure, Kind
from flotilla.debian.lock import Lock, Package
from flotilla.debian.mirror import Mirrors

_SNAPSHOT_DELAYS = (timedelta(0), timedelta(days=1))
"""A snapshot archive answers with its last copy before a time, older perhaps than the release of that very time."""
_Wanted = Mapping[str, tuple[Lock, Package]]
"""Packages by their hashes, and a lock that names each."""


def file(package: Package) -> Path:
    """Where the pool keeps a package."""
    return paths.POOL / f"{package.sha256}.deb"


def fill(locks: Iterable[Lock], mirrors: Mirrors | None = None) -> None:
    """Download the packages that the pool does not have, or has at another size. See also `verify_hashes`."""
    wanted = {package.sha256: (lock, package) for lock in locks for package in lock.packages}
    if not _missing(wanted):
        return
    mirrors = mirrors or mirror.resolve()
    with cache.locked(paths.POOL / ".lock"):  # of two builds at once, the second finds the first one's packages
        _remove_damaged(package for _, package in wanted.values() if _size(package) not in (None, package.size))
        missing = _missing(wanted)
        if not missing:
            return
        if not mirrors.snapshot:
            for archive in {package.archive for _, package in missing.values()}:
                mirrors.of(archive)
        total = sum(package.size for _, package in missing.values())
        with progress.step(f"downloading {len(missing)} packages, {progress.size(total)}") as step:
            _download(missing, mirrors, lambda done: step.at(done >> 20, total >> 20, "MiB"))


def verify_hashes(lock: Lock) -> None:
    """Compare the content of every package of a lock in the pool with the lock. A damaged one is downloaded anew."""
    absent = [package for package in lock.packages if not file(package).is_file()]
    if absent:
        raise UserError("\n".join(f"package {package}: missing in {paths.shown(paths.POOL)}" for package in absent))
    if _damaged(lock.packages):
        with cache.locked(paths.POOL / ".lock"):
            _remove_damaged(_damaged(lock.packages))
        fill([lock])


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


def _size(package: Package) -> int | None:
    """In the pool; None: it is not there."""
    try:
        return file(package).stat().st_size
    except FileNotFoundError:
        return None


def _missing(wanted: _Wanted) -> dict[str, tuple[Lock, Package]]:
    return {sha256: each for sha256, each in wanted.items() if _size(each[1]) != each[1].size}


def _damaged(packages: Iterable[Package]) -> list[Package]:
    """Those that the pool has with other content."""
    there = [package for package in packages if file(package).is_file()]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        found = threads.map(_hash, [file(package) for package in there])
    return [package for package, sha256 in zip(there, found, strict=True) if sha256 != package.sha256]


def _remove_damaged(packages: Iterable[Package]) -> None:
    for package in packages:
        progress.say(f"package {package}: {paths.shown(file(package))} is damaged; it is removed and downloaded anew")
        file(package).unlink()


def _hash(path: Path) -> str:
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


# --- download ---


def _download(missing: _Wanted, mirrors: Mirrors, report: Callable[[int], None]) -> None:
    """Download; every package that could not be had is in the one error at the end."""
    incoming = paths.POOL / ".incoming"
    incoming.mkdir(parents=True, exist_ok=True)
    packages = [package for _, package in missing.values()]
    _take(packages, incoming)  # that a build which was killed has left
    wanted = {
        download.File(f"{sha256}.deb", tuple(_addresses(lock, package, mirrors)), sha256, package.size): package
        for sha256, (lock, package) in _missing(missing).items()
    }
    try:
        failed = download.fetch(wanted, incoming, report)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise UserError(
            f"no space left for {paths.shown(paths.POOL)}; make room, or set BUILD= to another disk"
        ) from None
    finally:
        _take(packages, incoming)
    if failed:
        raise UserError("\n".join(_reasons({wanted[each]: failure for each, failure in failed.items()}, mirrors)))


def _take(packages: Iterable[Package], incoming: Path) -> None:
    """Move to the pool what has come as the lock says."""
    came = {package: incoming / file(package).name for package in packages}
    whole = [
        path
        for package, path in came.items()
        if path.is_file() and path.stat().st_size == package.size and _hash(path) == package.sha256
    ]
    durable.rename_files(whole, paths.POOL)


def _addresses(lock: Lock, package: Package, mirrors: Mirrors) -> Iterator[str]:
    """Where a package may be, the likeliest place first."""
    path = quote(package.path, safe="/+~")
    if package.archive in mirrors.archives:
        yield f"{mirrors.archives[package.archive]}/{path}"
    if mirrors.snapshot:
        for delay in _SNAPSHOT_DELAYS:
            time = lock.date(package.archive) + delay
            yield f"{mirrors.snapshot}/{package.archive}/{time:%Y%m%dT%H%M%SZ}/{path}"


def _reasons(failed: Mapping[Package, Failure], mirrors: Mirrors) -> Iterator[str]:
    """Why packages did not come: a line for each that the archive no longer has, one for all that share a reason."""
    alike: dict[tuple[str, Kind], list[Package]] = defaultdict(list)
    for package in sorted(failed):
        failure = failed[package]
        if failure.kind is download.GONE:
            yield f"package {package}: not at {' nor '.join(failure.tried)} any more; {_remedy_of_gone(mirrors)}"
        else:
            alike[failure.host, failure.kind].append(package)
    for packages in alike.values():
        failure = failed[packages[0]]
        others = f" and {len(packages) - 1} more" if packages[1:] else ""
        yield f"package {packages[0]}{others}: {failure.address}: {failure.reason}; {failure.kind.remedy}"


def _remedy_of_gone(mirrors: Mirrors) -> str:
    snapshot = "" if mirrors.snapshot else ", or set SNAPSHOT= to a snapshot archive (http://SNAPSHOT/archive)"
    return f"lock the version of today with `make lock`{snapshot}"


# --- repository ---


def control(package: Package) -> str:
    """The package's own description of itself. UserError where the pool's file is damaged, which is then removed."""
    try:
        return deb.control(file(package))
    except ValueError as error:
        if not _damaged([package]):
            raise UserError(
                f"package {package}: {error}; but its checksum is that of the lock: run `make lock`"
            ) from error
        file(package).unlink()
        raise UserError(
            f"package {package}: {error}; {paths.shown(file(package))} was damaged and is removed: run again"
        ) from error


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
