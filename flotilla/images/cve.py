"""Known vulnerabilities (CVEs) of what the locks name, by the data of Debian's security tracker.

The tracker knows source packages and releases, so each locked package is traced to its sources first, by what it says
of itself. Nothing here enters an image; unlike a build, the command may ask what day it is.

`debsbom sec-scan` judges a bill of materials by the same data. It says neither why there is no fix nor what is
embedded, takes signed kernels for sources of their own, and ends with a traceback at an urgency that it does not know.
A test compares its verdicts with ours.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
import lzma
import re
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Literal

import pydantic
from debian.debian_support import NativeVersion

from flotilla.common import paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import download, kernel, mirror, pool
from flotilla.debian.lock import Lock, Package, board_lock, lock_file, read_lock
from flotilla.fleet.model import Fleet
from flotilla.images import build, manifest

OLD_DAYS = 30
"""Age of a lock above which nobody has looked for updates for too long."""
_ADDRESS = "https://security-tracker.debian.org/tracker/data/json"
_SCHEMES = ("http://", "https://", "file:/")
_UNIMPORTANT = "unimportant"
_BUILT_USING = re.compile(r"(\S+) \(= (\S+)\)")
_COLUMNS = ("CVE", "source", "installed", "fixed version", "urgency", "locks", "packages", "remark")


class Entry(pydantic.BaseModel):
    """What the tracker says of one CVE in one source package of one release. Other keys are ignored."""

    model_config = pydantic.ConfigDict(frozen=True)
    status: Literal["open", "resolved", "undetermined"]
    """`resolved`: what the release has by now is not vulnerable, or never was."""
    fixed_version: str = ""
    """Of the source; `0`: it was never vulnerable. Only where it is resolved."""
    urgency: str = "not yet assigned"
    """`unimportant`: of no effect as Debian builds the package."""
    nodsa: str = ""
    """Why there is no advisory."""
    nodsa_reason: str = ""
    """`ignored` or `postponed`, where that was decided."""
    repositories: dict[str, str] = {}
    """Version of the source by suite."""


@dataclass(frozen=True)
class Installed:
    """A source package that locks hold something of."""

    source: str
    version: str
    """Of the source."""
    packages: tuple[str, ...]
    """Binary packages of it, by name."""
    locks: tuple[str, ...]
    embedded: bool = False
    """Whether the packages only contain code of it, as statically linked programs do: a fix of the source reaches them
    when Debian builds them again."""


@dataclass(frozen=True)
class Finding:
    """A CVE that is open in what the locks name."""

    cve: str
    installed: Installed
    fixed_version: str | None
    """None: there is no fix yet."""
    undetermined: bool
    """Debian has not yet looked whether its package is vulnerable."""
    urgency: str
    remark: str

    @property
    def fixable(self) -> bool:
        """Whether a new lock would close it."""
        return self.fixed_version is not None and not self.installed.embedded

    @property
    def kind(self) -> str:
        """Its column of the summary."""
        if self.fixable:
            return "fix"
        if self.urgency == _UNIMPORTANT:
            return _UNIMPORTANT
        return "undetermined" if self.undetermined else "open"


@dataclass(frozen=True)
class Report:
    findings: tuple[Finding, ...]
    locks: tuple[Lock, ...]
    sources: int
    """How many were looked up."""
    failures: tuple[str, ...]
    """Why the command fails, in words with the remedy; none: it does not."""


def check(fleet: Fleet, tracker: str | None, today: date | None = None) -> Report:
    """Judge the locks of all boards, and our own kernel's source. `tracker`: file or address of the tracker's data."""
    data = read_tracker(tracker)
    locks = [
        lock.without("kernel") if board.kernel == "lean" else lock
        for board in fleet.boards.values()
        for lock in [board_lock(board)]
    ]
    toolchain = read_lock("toolchain")
    own_kernel = dataclasses.replace(toolchain, packages=(kernel.source(toolchain.packages),))
    return judge([*locks, own_kernel], data, today or datetime.now(UTC).date())


def judge(locks: Sequence[Lock], data: Mapping[str, Any], today: date) -> Report:
    """Hold what the locks name against the tracker's data."""
    pool.fill(locks)
    with progress.step("sources of the locked packages"):
        installed = sources(locks)
    releases = {lock.release for lock in locks}
    for release in releases - _releases(data):
        raise UserError(
            f"TRACKER: no entry about {release}: the data are of other releases, or no tracker's; get them anew from "
            f"{_ADDRESS}, or lock a release that Debian still looks after (images/packages/locks.yml: suite)"
        )
    release_of = {lock.name: lock.release for lock in locks}
    found = [
        finding
        for each in installed
        for finding in _findings(each, data.get(each.source, {}), release_of[each.locks[0]])
    ]
    found.sort(key=_order)
    unknown = [
        f"{each.source}: the tracker's data know nothing of our own kernel's source; get newer data from {_ADDRESS}"
        for each in installed
        if each.source not in data and any(name.startswith("linux-source-") for name in each.packages)
    ]
    failures = [*_outdated(locks, today), *unknown, *_fixable(found)]
    return Report(tuple(found), tuple(locks), len({each.source for each in installed}), tuple(failures))


# --- the tracker's data ---


def read_tracker(tracker: str | None) -> dict[str, Any]:
    """The tracker's data by source and CVE, from a file or an address, packed by gzip or xz or not at all."""
    if not tracker:
        raise UserError(
            "give the security tracker's data: `make cve TRACKER=FILE`, with the file that Debian publishes at\n"
            f"  {_ADDRESS}\n"
            "(some 80 MB; packed as FILE.gz or FILE.xz it may stay so), or TRACKER=ADDRESS, that one or a mirror's"
        )
    with progress.step(f"read {tracker}"):
        content = _download(tracker) if tracker.startswith(_SCHEMES) else _read(Path(tracker))
        try:
            data = json.loads(_unpacked(content))
        except (ValueError, OSError, EOFError, lzma.LZMAError) as error:
            remedy = download.PAGE.remedy if content.lstrip().startswith(b"<") else f"get it anew from {_ADDRESS}"
            raise UserError(f"TRACKER={tracker}: is not JSON ({error}); {remedy}") from None
    if not isinstance(data, dict) or not all(isinstance(issues, dict) for issues in data.values()):
        raise UserError(f"TRACKER={tracker}: is JSON, but not the tracker's; get it from {_ADDRESS}")
    return data


def _download(address: str) -> bytes:
    wanted = download.File("tracker", (address,))
    with tempfile.TemporaryDirectory() as directory:
        for failure in download.fetch([wanted], Path(directory)).values():
            remedies = "; ".join(each for each in (failure.kind.remedy, "or give a file: TRACKER=FILE") if each)
            raise UserError(f"TRACKER={address}: {failure.reason}; {remedies}")
        return Path(directory, wanted.name).read_bytes()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"TRACKER={path}: {error.strerror}; get the file from {_ADDRESS}") from None


def _unpacked(content: bytes) -> bytes:
    if content.startswith(b"\x1f\x8b"):
        return gzip.decompress(content)
    if content.startswith(b"\xfd7zXZ\x00"):
        return lzma.decompress(content)
    return content


def _releases(data: Mapping[str, Any]) -> set[str]:
    """Of which the tracker says anything."""
    return {
        release
        for issues in data.values()
        for issue in issues.values()
        if isinstance(issue, dict)
        for release in issue.get("releases", ())
    }


# --- sources ---


def sources(locks: Iterable[Lock]) -> list[Installed]:
    """The source packages of what the locks name, from the packages' own descriptions in the pool."""
    found: dict[tuple[str, str, bool], tuple[set[str], set[str]]] = {}
    with ThreadPoolExecutor() as threads:
        for lock in locks:
            for package, control in zip(lock.packages, threads.map(pool.control, lock.packages), strict=True):
                for key in _sources(package, control):
                    names, of = found.setdefault(key, (set(), set()))
                    names.add(package.name)
                    of.add(lock.name)
    return [
        Installed(source, version, tuple(sorted(names)), tuple(sorted(of)), embedded)
        for (source, version, embedded), (names, of) in sorted(found.items())
    ]


def _sources(package: Package, control: str) -> Iterator[tuple[str, str, bool]]:
    """Name and version of a package's source, and of those that it contains code of (True).

    A signed package, such as Debian's kernels, is built from a source of its own that only holds the signatures. It has
    the version of what was signed, and this is what the tracker knows.
    """
    (described,) = manifest.packages(control)
    (fields,) = mirror.stanzas(control)
    used = [
        (name, version)
        for field in ("Built-Using", "Static-Built-Using")
        for name, version in _BUILT_USING.findall(fields.get(field, ""))
    ]
    signed = [(name, version) for name, version in used if version == package.version]
    yield from ((*each, False) for each in signed or [(described.source, described.source_version)])
    yield from ((*each, True) for each in used if each not in signed)


# --- judgement ---


def _findings(installed: Installed, issues: Mapping[str, Any], release: str) -> Iterator[Finding]:
    for cve, issue in issues.items():
        try:
            entry = Entry.model_validate(issue["releases"][release])
        except (KeyError, TypeError):  # the release never had it; an issue of no release has a list in their place
            continue
        except pydantic.ValidationError as error:
            (first, *_) = error.errors()
            key = ".".join(map(str, (installed.source, cve, "releases", release, *first["loc"])))
            raise UserError(
                f"TRACKER: {key}: {first['input']}: {first['msg']}; the file is damaged, or the tracker's format has "
                f"changed: get it anew from {_ADDRESS}"
            ) from None
        fixed = _fixed_version(entry)
        if fixed is not None and NativeVersion(installed.version) >= NativeVersion(fixed):
            continue
        why = [entry.nodsa_reason, entry.nodsa] if fixed is None else []
        why += ["embedded: until Debian builds the package again"] if installed.embedded else []
        yield Finding(
            cve,
            installed,
            fixed,
            entry.status == "undetermined",
            entry.urgency,
            "; ".join(each for each in why if each),
        )


def _fixed_version(entry: Entry) -> str | None:
    """Of the source, from which on it is not vulnerable; `0`: it never was. None: there is none yet."""
    if entry.fixed_version:
        return entry.fixed_version
    if entry.status == "resolved":  # by what the release has now
        return str(max(map(NativeVersion, entry.repositories.values()), default="0"))
    return None


def _order(finding: Finding) -> tuple[Any, ...]:
    """What to act on comes first, what matters least last."""
    number = [int(part) for part in re.findall(r"\d+", finding.cve)]
    kinds = ("fix", "open", "undetermined", _UNIMPORTANT)
    return kinds.index(finding.kind), finding.installed.source, number, finding.cve, finding.installed.locks


def _outdated(locks: Iterable[Lock], today: date) -> Iterator[str]:
    for lock in locks:
        if lock.missing_suites:
            yield build.missing_suites(lock.name, lock.missing_suites)
        if (days := age(lock, today)) > OLD_DAYS:
            yield (
                f"{paths.shown(lock_file(lock.name))}: is {days} days old, more than {OLD_DAYS}; "
                f"run `make lock ONLY={lock.name}`"
            )


def age(lock: Lock, today: date) -> int:
    """Days since the release of the newest suite that it was made from, or found unchanged by."""
    return (today - lock.current.date()).days


def _fixable(findings: Iterable[Finding]) -> Iterator[str]:
    count = Counter(name for finding in findings if finding.fixable for name in finding.installed.locks)
    for name, number in sorted(count.items()):
        yield f"{name}: {number} open CVEs have a fix in the suite; `make lock ONLY={name}`, then build the images"


# --- words ---


def table(report: Report, today: date | None = None) -> str:
    """A line for each CVE, then one for each lock."""
    day = today or datetime.now(UTC).date()
    rows = [_COLUMNS, *(_row(finding) for finding in report.findings)] if report.findings else []
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))] if rows else []
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines += [""] if lines else []
    for lock in report.locks:
        kinds = Counter(finding.kind for finding in report.findings if lock.name in finding.installed.locks)
        lines.append(
            f"{lock.name}: {kinds['fix']} with a fix, {kinds['open']} without one yet, {kinds['undetermined']} "
            f"undetermined, {kinds[_UNIMPORTANT]} unimportant; lock {age(lock, day)} days old"
        )
    return "\n".join([*lines, f"{report.sources} source packages looked up"])


def _row(finding: Finding) -> tuple[str, ...]:
    names = finding.installed.packages
    shown = ", ".join(names[:2]) + (f" and {len(names) - 2} more" if len(names) > 2 else "")
    fixed = finding.fixed_version or ("undetermined" if finding.undetermined else "no fix yet")
    installed = finding.installed
    locks = " ".join(installed.locks)
    return finding.cve, installed.source, installed.version, fixed, finding.urgency, locks, shown, finding.remark


def as_json(report: Report, today: date | None = None) -> str:
    """The same for programs."""
    day = today or datetime.now(UTC).date()
    return json.dumps(
        {
            "findings": [
                {
                    "cve": finding.cve,
                    "kind": finding.kind,
                    **dataclasses.asdict(finding.installed),
                    "fixed_version": finding.fixed_version,
                    "undetermined": finding.undetermined,
                    "urgency": finding.urgency,
                    "remark": finding.remark,
                }
                for finding in report.findings
            ],
            "locks": {
                lock.name: {"age_days": age(lock, day), "missing_suites": list(lock.missing_suites)}
                for lock in report.locks
            },
            "sources": report.sources,
            "failures": list(report.failures),
        },
        indent=1,
    )
