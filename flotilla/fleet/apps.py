"""Apps that the inventory gives to robots: which there are, and what one is on a robot.

`flotilla.apps` builds them, which takes compilers. Who puts an app on a card, or compares it with what a robot has,
needs its files alone: here they are data.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import yaml

from flotilla.common import cache, paths, sources
from flotilla.common.errors import UserError

FILE = "app.yml"
"""An app's description in its directory."""
PLACE = PurePosixPath("/data/apps")
"""Where apps lie on a robot: `NAME` is a link to the version beside it. So an app changes at once or not at all."""
LISTINGS = PurePosixPath("/etc/flotilla/apps")
"""A file for each app that the inventory gave to a robot. What lies in `PLACE` besides was brought there by hand."""
SYSTEM = PurePosixPath("/etc/systemd/system")
"""Units and drop-ins that a robot has of its own."""
_SERVICE = "/usr/lib/systemd/system/flotilla-app@.service"


@dataclass(frozen=True)
class BuiltApp:
    """An app as it lies on robots of a board."""

    name: str
    version: str
    """Hash of its files, as `make deploy` computes it."""
    files: Mapping[PurePosixPath, tuple[bytes, int]]
    """Content and mode by path inside the app."""
    directories: tuple[PurePosixPath, ...]
    """Inside the app, parents first."""
    program: str = ""
    """What of it is linked with the robot's libraries; empty where nothing is."""

    @property
    def listing(self) -> bytes:
        """What the robot keeps in `LISTINGS`: version, and mode, SHA-256 and path of each file."""
        lines = [f"version {self.version}"]
        lines += [f"{mode:o} {sha256} {path}" for path, (sha256, mode) in self.hashes.items()]
        return "".join(f"{line}\n" for line in lines).encode()

    @property
    def hashes(self) -> dict[str, tuple[str, int]]:
        """SHA-256 and mode of each file by path inside the app."""
        files = sorted(self.files.items())
        return {str(path): (hashlib.sha256(content).hexdigest(), mode) for path, (content, mode) in files}

    @property
    def sha256(self) -> str:
        """One hash for all of it: its listing's."""
        return hashlib.sha256(self.listing).hexdigest()

    @property
    def bytes(self) -> int:
        """Of its files."""
        return sum(len(content) for content, _ in self.files.values())

    @property
    def place(self) -> PurePosixPath:
        """Where this version of it lies on a robot."""
        return PLACE / f".{self.name}@{self.version}"

    @property
    def links(self) -> dict[PurePosixPath, str]:
        """Links on the robot, and where they lead: to the version, to what its service has of its own, and what starts
        it with the robot."""
        unit = f"flotilla-app@{self.name}.service"
        return {
            PLACE / self.name: self.place.name,
            SYSTEM / f"{unit}.d": str(PLACE / self.name / "unit.d"),
            SYSTEM / "multi-user.target.wants" / unit: _SERVICE,
        }


def read(name: str, directory: Path, program: str = "") -> BuiltApp:
    """The app that a build has put into `directory`. Modes are the two that are sent to robots."""
    check_names(directory)
    files = {
        PurePosixPath(path.relative_to(directory)): (path.read_bytes(), 0o755 if sources.executable(path) else 0o644)
        for path in sources.files(directory)
    }
    directories = tuple(PurePosixPath(path.relative_to(directory)) for path in _directories(directory))
    return BuiltApp(name, version(directory), files, directories, program)


def check_names(directory: Path) -> None:
    """UserError with the files of an app whose names no robot can have."""
    faults = [(path, fault) for path in sorted(directory.rglob("*")) if (fault := paths.name_fault(path.name))]
    if faults:
        raise UserError("\n".join(f"{str(path.relative_to(directory))!a}: {fault}" for path, fault in faults))


def _directories(directory: Path) -> list[Path]:
    found = (path for path in directory.rglob("*") if path.is_dir())
    return sorted(path for path in found if not any(map(sources.left_behind, path.relative_to(directory).parts)))


def version(directory: Path) -> str:
    """The version of the app that a build has put into `directory`: of all that robots get of it."""
    directories = (str(path.relative_to(directory)) for path in _directories(directory))
    return cache.digest(cache.digest_of(directory, sources.files(directory)), *directories)[:16]


def names() -> list[str]:
    """The apps of this checkout."""
    return sorted(path.parent.name for path in paths.APPS.glob(f"*/{FILE}"))


def board(name: str) -> str | None:
    """The only board that an app of this checkout is for, as its description says. What is wrong with a description is
    said when it is built."""
    try:
        described = yaml.safe_load((paths.APPS / name / FILE).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        return None
    found = described.get("board") if isinstance(described, dict) else None
    return found if isinstance(found, str) else None


def listings(apps: Iterable[BuiltApp]) -> dict[PurePosixPath, tuple[bytes, int]]:
    """What robots keep of the apps that they have from the inventory, as `identity.render` returns files."""
    return {LISTINGS / app.name: (app.listing, 0o644) for app in apps}
