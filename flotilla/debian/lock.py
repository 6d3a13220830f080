"""Locks: exactly which Debian packages an image is made of, resolved by apt, signatures verified."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import re
import shlex
import subprocess
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import unquote

import pydantic

from flotilla.common import durable, paths, progress, sources, yaml_file
from flotilla.common.errors import UserError
from flotilla.debian import mirror
from flotilla.debian.mirror import DEBIAN, SECURITY, Mirrors
from flotilla.fleet.model import Architecture, Board, System, Word

_COMPONENTS = "main non-free-firmware"
_KEYRINGS = tuple(Path("/usr/share/keyrings", f"debian-archive-keyring.{suffix}") for suffix in ("gpg", "pgp"))
_DATE = "%Y-%m-%dT%H:%M:%SZ"

FLEET = "fleet"
"""The list of a fleet's home whose packages all its robots have besides."""
HOST = System("amd64", "trixie")
"""What programs of the runtime are compiled for that this computer runs, where no board says otherwise."""

Role = Literal["required", "userland", "kernel"]
"""`required`: Essential, or of that priority in the archive's index; `kernel`: not installed with its dependencies."""


class _Asked(pydantic.BaseModel):
    """A lock in locks.yml."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    architecture: Architecture
    """Debian's name of the processor architecture."""
    list: str = ""
    """Name of its package list. The lock's own name, when left out."""


class File(pydantic.BaseModel):
    """What locks.yml says."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    suite: Word
    """Debian's name of the release of all packages except those of boards."""
    locks: dict[str, _Asked]
    """Locks of other things than boards, by name."""


@dataclass(frozen=True)
class Recipe:
    """How a lock comes about."""

    suite: str
    architecture: str
    lists: tuple[str, ...]
    system: bool = True
    """Whether it is a system to bootstrap, which needs what is essential or required, apt, and a kernel."""


def recipes(boards: Iterable[Board]) -> dict[str, Recipe]:
    """Of all locks by name: the boards', those of their runtimes and of this computer's, and those of locks.yml."""
    boards = list(boards)
    path = sources.find(paths.PACKAGES, "locks.yml")
    file = yaml_file.read(path, File)
    found: dict[str, Recipe] = {}
    for board in boards:
        found[board.name] = _of_board(board)
    for name, asked in file.locks.items():
        if name in found:
            raise UserError(f"{paths.shown(path)}: locks.{name}: is a board's name, too; give one of them another")
        found[name] = Recipe(file.suite, asked.architecture, (asked.list or name,), system=False)
    for system in sorted({HOST, *(board.system for board in boards)}):
        found[runtime_lock(system)] = Recipe(system.suite, system.architecture, ("runtime",), system=False)
    return found


def _of_board(board: Board) -> Recipe:
    of_fleet = [FLEET] if sources.find(paths.PACKAGES, f"{FLEET}.list").is_file() else []
    return Recipe(board.suite, board.architecture, ("robot", f"robot-{board.suite}", *of_fleet, board.name))


def runtime_lock(system: System) -> str:
    """Name of the lock of the runtime's compiler and libraries."""
    return f"runtime-{system.suite}-{system.architecture}"


def suites(release: str) -> tuple[tuple[str, str], ...]:
    """Archive and name of a release and of what belongs to it."""
    return (DEBIAN, release), (DEBIAN, f"{release}-updates"), (SECURITY, f"{release}-security")


@dataclass(frozen=True, order=True)
class Package:
    """One package at one version: a line of a lock."""

    name: str
    version: str
    architecture: str
    role: Role
    archive: str
    size: int
    sha256: str
    path: str
    """Below the archive's base: `pool/main/…`."""

    def __str__(self) -> str:
        return f"{self.name} {self.version} ({self.architecture})"


@dataclass(frozen=True, order=True)
class Suite:
    """A suite as it was when the lock was made."""

    archive: str
    name: str
    date: datetime
    """Of its Release file, UTC."""


@dataclass(frozen=True)
class Lock:
    name: str
    architecture: str
    suites: tuple[Suite, ...]
    packages: tuple[Package, ...]
    checked: datetime | None = None
    """Release of the newest suite by which `make lock` last found the packages unchanged, UTC; None: it never did."""

    @property
    def current(self) -> datetime:
        """Release of the newest suite up to which the packages are known to be the archive's own."""
        return max([*(suite.date for suite in self.suites), *([self.checked] if self.checked else [])])

    @property
    def epoch(self) -> int:
        """SOURCE_DATE_EPOCH of everything made from this lock: when its newest suite was released."""
        return int(max(suite.date for suite in self.suites).timestamp())

    @functools.cached_property  # it is asked for again with each card
    def digest(self) -> str:
        """SHA-256 of the lock's text but for `checked`: names whatever is made from it."""
        return hashlib.sha256(format_lock(dataclasses.replace(self, checked=None)).encode()).hexdigest()

    def date(self, archive: str) -> datetime:
        """When an archive's newest suite was released."""
        return max(suite.date for suite in self.suites if suite.archive == archive)

    @property
    def missing_suites(self) -> tuple[str, ...]:
        """Suites that it was made without, as no signature covered what the mirror had of them."""
        there = {suite.name for suite in self.suites}
        return tuple(name for _, name in suites(self.release) if name not in there)

    @property
    def release(self) -> str:
        """Debian's name of the release that it is of."""
        return min((suite.name for suite in self.suites if suite.archive == DEBIAN), key=len)

    def without(self, role: Role) -> Lock:
        """The lock but for the packages of one role."""
        return dataclasses.replace(self, packages=tuple(each for each in self.packages if each.role != role))

    def having(self, *roles: Role) -> tuple[Package, ...]:
        """The packages of some roles."""
        return tuple(package for package in self.packages if package.role in roles)


@dataclass(frozen=True)
class PackageRequest:
    """One line of a package list."""

    package: str
    kernel: bool
    reason: str


# --- text ---

_HEADER = "# Made by `make lock`; the lists are in images/packages/."
_COLUMNS = [column.name for column in dataclasses.fields(Package)]
_VALID = {
    "name": r"[a-z0-9][a-z0-9+.-]+",
    "version": r"[0-9][A-Za-z0-9.+~:-]*",
    "architecture": r"i386|amd64|all",
    "role": "|".join(get_args(Role)),
    "archive": "|".join(map(re.escape, mirror.ARCHIVES)),
    "size": r"[1-9][0-9]*",
    "sha256": r"[0-9a-f]{64}",
    "path": r"pool/(?!.*\.\.)[A-Za-z0-9.+~_/-]+\.deb",  # `..` would leave the pool
}


def lock_file(name: str) -> Path:
    return sources.find(paths.LOCKS, f"{name}.lock")


def own_lock_file(name: str) -> Path:
    """Where the lock is written: a fleet with a home of its own has its own."""
    return sources.own(paths.LOCKS) / f"{name}.lock"


def read_lock(name: str) -> Lock:
    """The lock of a board, or of the build tools."""
    path = lock_file(name)
    if not path.is_file():
        raise UserError(f"{paths.shown(path)}: missing; `make lock ONLY={name}` writes it")
    return parse_lock(path.read_text(encoding="utf-8"), name, paths.shown(path))


def board_lock(board: Board) -> Lock:
    """The lock of a board."""
    lock = read_lock(board.name)
    if lock.architecture != board.architecture:
        raise UserError(
            f"{paths.shown(lock_file(board.name))}: architecture: {lock.architecture}: the board's is "
            f"{board.architecture}; run `make lock ONLY={board.name}`"
        )
    locked = {package.name for package in lock.packages}
    for each in _of_board(board).lists:  # the lock of a kernel has the package that this one depends on
        asked = [request.package for request in read_list(each) if not request.kernel]
        if missing := [package for package in asked if package not in locked]:
            raise UserError(
                f"{paths.shown(sources.find(paths.PACKAGES, f'{each}.list'))}: {', '.join(missing)}: not in "
                f"{paths.shown(lock_file(board.name))} yet; run `make lock ONLY={board.name}`"
            )
    return lock


def parse_lock(text: str, name: str, shown: str) -> Lock:
    """The lock that `text` describes; `shown` names the file in errors."""
    architecture = ""
    suites: list[Suite] = []
    checked: datetime | None = None
    packages: dict[str, Package] = {}
    for number, line in enumerate(text.splitlines(), 1):
        try:
            match line.split(" "):
                case [""] | ["#", *_]:
                    pass
                case ["architecture", value]:
                    architecture = _valid("architecture", value)
                case ["suite", archive, suite, date]:
                    suites.append(Suite(_valid("archive", archive), suite, _time(date)))
                case ["checked", date]:
                    checked = _time(date)
                case ["package", *values]:
                    package = _package(values)
                    if package.name in packages:
                        raise ValueError(f"package {package.name} is locked twice")
                    packages[package.name] = package
                case _:
                    raise ValueError(f"'{line}' is no architecture, suite or package")
        except ValueError as error:
            raise UserError(f"{shown}:{number}: {error}; repair the line or run `make lock`") from None
    of_debian = [suite for suite in suites if suite.archive == DEBIAN]
    for what, present in (("architecture", architecture), (f"suite {DEBIAN}", of_debian), ("package", packages)):
        if not present:
            raise UserError(f"{shown}: has no {what} line; restore it from git or run `make lock`")
    return Lock(name, architecture, tuple(sorted(suites)), tuple(sorted(packages.values())), checked)


def format_lock(lock: Lock) -> str:
    """The text of a lock: one package a line, so that a change reads well in git."""
    lines = [_HEADER, f"architecture {lock.architecture}"]
    lines += [f"suite {suite.archive} {suite.name} {suite.date.strftime(_DATE)}" for suite in sorted(lock.suites)]
    lines += [f"checked {lock.checked.strftime(_DATE)}"] if lock.checked else []
    lines += ["", f"# package {' '.join(_COLUMNS)}"]
    lines += [f"package {' '.join(map(str, dataclasses.astuple(package)))}" for package in sorted(lock.packages)]
    return "\n".join(lines) + "\n"


def _time(text: str) -> datetime:
    return datetime.strptime(text, _DATE).replace(tzinfo=UTC)


def _valid(column: str, value: str) -> str:
    if not re.fullmatch(_VALID[column], value):
        raise ValueError(f"{column} '{value}' is malformed")
    return value


def _package(values: Sequence[str]) -> Package:
    if len(values) != len(_COLUMNS):
        raise ValueError(f"a package has {len(_COLUMNS)} values ({' '.join(_COLUMNS)}), not {len(values)}")
    name, version, architecture, role, archive, size, sha256, path = map(_valid, _COLUMNS, values)
    return Package(name, version, architecture, role, archive, int(size), sha256, path)  # type: ignore[arg-type]


def read_list(name: str) -> list[PackageRequest]:
    """A package list: `[kernel] PACKAGE # reason` a line."""
    path = sources.find(paths.PACKAGES, f"{name}.list")
    if not path.is_file():
        raise UserError(f"{paths.shown(path)}: is missing; write `PACKAGE # reason` lines, as in the other lists")
    requests = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        entry, _, reason = (part.strip() for part in line.partition("#"))
        if not entry:
            continue
        match = re.fullmatch(rf"(kernel )?({_VALID['name']})", entry)
        if not match or not reason:
            raise UserError(
                f"{paths.shown(path)}:{number}: '{line}': write `PACKAGE # reason` or `kernel PACKAGE # reason`"
            )
        requests.append(PackageRequest(match[2], bool(match[1]), reason))
    return requests


def requests(recipe: Recipe) -> list[PackageRequest]:
    """What the lists of a lock ask for."""
    asked = [request for each in recipe.lists for request in read_list(each)]
    if recipe.system and not any(request.kernel for request in asked):
        path = sources.find(paths.PACKAGES, f"{recipe.lists[-1]}.list")
        raise UserError(f"{paths.shown(path)}: names no kernel; add a line `kernel linux-image-… # reason`")
    return asked


# --- resolution ---


def chosen(recipes: Mapping[str, Recipe], names: Sequence[str]) -> dict[str, Recipe]:
    """Those of these names; all of them where none is given."""
    if unknown := [name for name in names if name not in recipes]:
        raise UserError(f"{', '.join(unknown)}: there is no such lock; there are {', '.join(recipes)}")
    return {name: recipe for name, recipe in recipes.items() if name in names or not names}


def update_locks(recipes: Mapping[str, Recipe], mirrors: Mirrors | None = None, without: Collection[str] = ()) -> str:
    """Resolve package lists against the mirrors, write the locks and say what changed, a line each.

    `without` names suites to leave out, for a mirror whose copy of one is broken: what a signature does not cover is
    never used, so the choice is between fewer packages and none. The lock says which suites it was made from.
    """
    mirrors = mirrors or mirror.resolve()
    changes = []
    for name, recipe in recipes.items():
        with progress.step(f"lock of {name}"):
            new = resolve(name, recipe, mirrors, without)
        path = own_lock_file(name)
        old = read_lock(name) if lock_file(name).is_file() else None
        if old and old.packages == new.packages and old.missing_suites == new.missing_suites:
            if new.current > old.current:
                _write(path, dataclasses.replace(old, checked=new.current))
            changes.append(f"{name}: unchanged")  # nor does its epoch change: the same packages, the same image
            continue
        _write(path, new)
        total = progress.size(sum(package.size for package in new.packages))
        changes.append(f"{name}: {len(new.packages)} packages, {total}")
        changes += [f"  {line}" for line in difference(old.packages if old else (), new.packages)]
    return "\n".join(changes)


def _write(path: Path, lock: Lock) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    durable.write(path, format_lock(lock))


def difference(old: Iterable[Package], new: Iterable[Package]) -> list[str]:
    """What was added, removed or changed, a line each."""
    before = {package.name: package for package in old}
    after = {package.name: package for package in new}
    added = {name: f"+ {name} {after[name].version}" for name in after.keys() - before.keys()}
    removed = {name: f"- {name} {before[name].version}" for name in before.keys() - after.keys()}
    changed = {
        name: f"~ {name} {before[name].version} -> {after[name].version}"
        for name in before.keys() & after.keys()
        if before[name] != after[name]
    }
    return [line for _, line in sorted((added | removed | changed).items())]


def resolve(name: str, recipe: Recipe, mirrors: Mirrors, without: Collection[str] = ()) -> Lock:
    """Ask apt what the lists of a lock come to today."""
    asked = requests(recipe)
    apt = Apt(recipe.architecture, mirrors, [suite for suite in suites(recipe.suite) if suite[1] not in without])
    apt.update()
    index = apt.index()
    required = {
        fields["Package"]
        for _, fields in index.values()
        if fields.get("Essential") == "yes" or fields.get("Priority") == "required"
    }
    userland = {request.package for request in asked if not request.kernel}
    if recipe.system:
        userland |= required | {"apt"}  # debootstrap's smallest variant holds these
    selected: dict[str, Role] = {
        address: "required" if index[address][1]["Package"] in required else "userland"
        for address in apt.install(sorted(userland))
    }
    for request in asked:
        if request.kernel:
            selected[apt.address(apt.concrete(request.package))] = "kernel"
    packages = [
        Package(
            name=fields["Package"],
            version=fields["Version"],
            architecture=fields["Architecture"],
            role=role,
            archive=archive,
            size=int(fields["Size"]),
            sha256=fields["SHA256"],
            path=fields["Filename"],
        )
        for address, role in selected.items()
        for archive, fields in [index[address]]
    ]
    return Lock(name, recipe.architecture, apt.suites(), tuple(sorted(packages)))


class Apt:
    """apt as resolver and verifier, in a directory of its own: no root, and nothing of this computer's configuration
    but what it needs to reach the network."""

    def __init__(self, architecture: str, mirrors: Mirrors, suites: Sequence[tuple[str, str]]) -> None:
        self.architecture = architecture
        self.sources = suites
        self.archives = {archive: mirrors.of(archive) for archive, _ in suites}
        self.directory = paths.BUILD / "apt" / architecture
        keyring = next((path for path in _KEYRINGS if path.is_file()), None)
        if not keyring:
            raise UserError("the Debian archive's keys are missing: apt-get install debian-archive-keyring")
        self._configure(keyring)

    def _configure(self, keyring: Path) -> None:
        for each in (
            "etc/apt/apt.conf.d",
            "etc/apt/preferences.d",
            "var/lib/dpkg",
            "var/lib/apt/lists/partial",
            "var/cache/apt/archives/partial",
        ):
            (self.directory / each).mkdir(parents=True, exist_ok=True)
        status = self.directory / "var/lib/dpkg/status"
        status.write_text("")
        sources = self.directory / "etc/apt/sources.list"
        sources.write_text(
            "".join(
                f"deb [arch={self.architecture} signed-by={keyring}] {self.archives[archive]} {suite} {_COMPONENTS}\n"
                for archive, suite in self.sources
            )
        )
        settings = {
            "Dir": f"{self.directory}/",
            "Dir::State::status": str(status),
            "APT::Architecture": self.architecture,
            "APT::Architectures": self.architecture,
            "APT::Install-Recommends": "false",
            "APT::Install-Suggests": "false",
            "APT::Sandbox::User": "root",  # there is no other user to drop to when it does not run as root
            "APT::Update::Error-Mode": "any",  # an archive that cannot be read is no reason for an older lock
            "Acquire::Languages": "none",
            "Acquire::ForceHash": "sha256",
            "Acquire::Retries": "3",
            "Acquire::http::Timeout": "15",
            "Acquire::https::Timeout": "15",
        } | _network()
        (self.directory / "apt.conf").write_text("".join(f'{key} "{value}";\n' for key, value in settings.items()))

    def _run(self, *arguments: str) -> str:
        progress.command(arguments)
        environment = os.environ | {"APT_CONFIG": str(self.directory / "apt.conf"), "LC_ALL": "C.UTF-8"}
        done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(f"{' '.join(arguments[:2])} failed:\n{(done.stderr or done.stdout).strip()}")
        return done.stdout

    def update(self) -> None:
        """Fetch the indexes; apt verifies their signatures."""
        try:
            self._run("apt-get", "update", "-q")
        except UserError as error:
            raise UserError(
                f"{error}\nA lock contains only packages that the archive's signatures cover: run again later, or with "
                "another MIRROR= and SECURITY_MIRROR="
            ) from None

    def index(self) -> dict[str, tuple[str, dict[str, str]]]:
        """Archive and index stanza of every package that the archives hold, by address."""
        return {
            unquote(base) + fields["Filename"]: (archive, fields)
            for archive, _, base, path in self._targets()
            for fields in mirror.stanzas(path.read_text(encoding="utf-8"))
        }

    def suites(self) -> tuple[Suite, ...]:
        """The suites with the dates of their Release files."""
        found = set()
        for archive, suite, _, path in self._targets():
            prefix = re.sub(rf"(_dists_{re.escape(suite)})_.*", r"\1", str(path))
            release = next(each for name in ("InRelease", "Release") if (each := Path(f"{prefix}_{name}")).is_file())
            date = next(line for line in release.read_text(encoding="utf-8").splitlines() if line.startswith("Date: "))
            found.add(Suite(archive, suite, parsedate_to_datetime(date.removeprefix("Date: ")).astimezone(UTC)))
        return tuple(sorted(found))

    def _targets(self) -> list[tuple[str, str, str, Path]]:
        """Archive, suite, base address and file of every package index that was fetched."""
        archives = {suite: archive for archive, suite in self.sources}
        form = "$(RELEASE)\t$(REPO_URI)\t$(FILENAME)"
        lines = self._run("apt-get", "indextargets", "--format", form, "Created-By: Packages").splitlines()
        return [
            (archives[suite], suite, base, Path(path)) for suite, base, path in (line.split("\t") for line in lines)
        ]

    def install(self, names: Sequence[str]) -> list[str]:
        """Addresses of these packages and of all they depend on."""
        return [_address(line) for line in self._run("apt-get", "install", "-qq", "--print-uris", *names).splitlines()]

    def address(self, name: str) -> str:
        """Address of this package alone."""
        return _address(self._run("apt-get", "download", "-qq", "--print-uris", name))

    def concrete(self, meta: str) -> str:
        """The package that a meta package stands for."""
        fields = next(mirror.stanzas(self._run("apt-cache", "show", "--no-all-versions", meta)))
        match = re.match(rf"({_VALID['name']}) \(= ", fields.get("Depends", ""))
        if not match:
            raise UserError(
                f"package {meta} is no meta package of a kernel: it depends on '{fields.get('Depends', '')}'"
            )
        return match[1]


def _address(line: str) -> str:
    """The address in a line of `--print-uris`."""
    return unquote(line.split("'")[1])


def _network() -> dict[str, str]:
    """This computer's settings of apt for the network: proxies, certificates, where its passwords are."""
    dump = subprocess.run(
        ["apt-config", "dump", "--format", "%f %v%n", "Acquire"], capture_output=True, text=True, check=True
    ).stdout
    pairs = (line.partition(" ") for line in dump.splitlines())
    found = {
        key: json.loads(f'"{value}"')
        for key, _, value in pairs
        if re.match(r"Acquire::https?::", key) and not key.endswith("::") and value
    }
    places = ["shell", "Dir::Etc::netrc", "Dir::Etc::netrc/f", "Dir::Etc::netrcparts", "Dir::Etc::netrcparts/d"]
    shell = subprocess.run(["apt-config", *places], capture_output=True, text=True, check=True).stdout
    for line in shell.splitlines():
        key, _, value = line.partition("=")
        found[key] = shlex.split(value)[0]
    if certificates := os.environ.get("SSL_CERT_FILE"):
        found.setdefault("Acquire::https::CAInfo", certificates)
    return found
