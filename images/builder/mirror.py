"""Where Debian packages come from: the environment, else this computer's own apt configuration.

No file of the project names a mirror, so a lock never sends anyone to a server that somebody else chose.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from flotilla.common.errors import UserError

DEBIAN = "debian"
SECURITY = "debian-security"
ARCHIVES = (DEBIAN, SECURITY)
"""Identifiers of the archives, which are also their names below a snapshot archive's base."""

_VARIABLES = {DEBIAN: "MIRROR", SECURITY: "SECURITY_MIRROR"}
_EXAMPLES = {DEBIAN: "http://MIRROR/debian", SECURITY: "http://MIRROR/debian-security"}
_ALWAYS = r"sid|(old)*stable|testing|unstable"
"""What Debian calls suites besides the names of releases. Those are data: this computer's says os-release."""
_SCHEMES = ("http://", "https://", "file:/")
_MIRROR_LIST = "mirror+file:"
_FIELD = re.compile(r"^([!-9;-~]+):[ \t]*(.*(?:\n[ \t].*)*)", re.MULTILINE)
_ONE_LINE = re.compile(r"deb\s+(?:\[.*?\]\s+)?(\S+)\s+(\S+)\s+(.+)")


@dataclass(frozen=True)
class Mirrors:
    """Base addresses, without a slash at the end."""

    archives: Mapping[str, str] = field(default_factory=dict)
    """By archive identifier."""
    snapshot: str | None = None
    """Base of a snapshot archive: `BASE/debian/20260102T030405Z/pool/…`."""

    def of(self, archive: str) -> str:
        """Base address of an archive; an error that says how to set it when there is none."""
        try:
            return self.archives[archive]
        except KeyError:
            raise UserError(_advice(archive)) from None


def resolve(
    environment: Mapping[str, str] = os.environ,
    apt: Path = Path("/etc/apt"),
    os_release: Path = Path("/etc/os-release"),
) -> Mirrors:
    """The mirrors to use. One that is missing is an error only when it is needed: see `Mirrors.of`."""
    names = _suites(os_release)
    found = dict(_configured(apt, names)) if names else {}
    for archive, variable in _VARIABLES.items():
        if address := environment.get(variable):
            if not address.startswith(_SCHEMES):
                raise UserError(f"{variable}={address}: no address; write it like {variable}={_EXAMPLES[archive]}")
            found[archive] = address
    snapshot = environment.get("SNAPSHOT") or None
    return Mirrors(
        {archive: address.rstrip("/") for archive, address in found.items()},
        snapshot.rstrip("/") if snapshot else None,
    )


def stanzas(text: str) -> Iterator[dict[str, str]]:
    """The stanzas of a file in Debian's control format."""
    for stanza in text.split("\n\n"):
        if fields := dict(_FIELD.findall(stanza)):
            yield fields


def _advice(archive: str) -> str:
    return (
        f"no mirror known for the Debian archive '{archive}', and this computer's apt configuration names none; "
        f"set {_VARIABLES[archive]}, for example:\n"
        f"  make lock {' '.join(f'{_VARIABLES[each]}={_EXAMPLES[each]}' for each in ARCHIVES)}\n"
        "where MIRROR is a Debian mirror near you. SNAPSHOT=http://SNAPSHOT/archive is where older versions come from."
    )


def _suites(os_release: Path) -> str:
    """A pattern of the names that suites of this computer's Debian have; none elsewhere, where sources are others'."""
    text = os_release.read_text() if os_release.is_file() else ""
    values = dict(re.findall(r"""^(\w+)=["']?(.*?)["']?$""", text, re.MULTILINE))
    if values.get("ID") != "debian":
        return ""
    own = values.get("VERSION_CODENAME")
    return f"{_ALWAYS}|{re.escape(own)}" if own else _ALWAYS


def _configured(apt: Path, names: str) -> Iterator[tuple[str, str]]:
    """Archive and address of every source of Debian's that apt knows, the most preferred last.

    An archive's suites share one pool, so any of them will do.
    """
    patterns = {DEBIAN: re.compile(f"({names})(-updates)?"), SECURITY: re.compile(f"({names})-security")}
    for address, suites, components in reversed(list(_sources(apt))):
        for archive, pattern in patterns.items():
            if "main" in components and any(pattern.fullmatch(suite) for suite in suites):
                for usable in _usable(address, apt):
                    yield archive, usable


def _sources(apt: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Address, suites and components of every enabled binary source, in apt's order."""
    for path in [apt / "sources.list", *sorted((apt / "sources.list.d").glob("*"))]:
        if not path.is_file():
            continue
        lines = [line.rstrip() for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
        if path.suffix == ".list":
            for line in lines:
                if match := _ONE_LINE.match(line.partition("#")[0].strip()):
                    yield match[1], [match[2]], match[3].split()
        elif path.suffix == ".sources":
            for fields in stanzas("\n".join(lines)):
                entry = {key.lower(): value.split() for key, value in fields.items()}
                if "deb" in entry.get("types", []) and entry.get("enabled", ["yes"])[0].lower() != "no":
                    for address in entry.get("uris", []):
                        yield address, entry.get("suites", []), entry.get("components", [])


def _usable(address: str, apt: Path) -> Iterable[str]:
    """The address itself, or what a list of mirrors on this computer names first (Debian's cloud images have one)."""
    if address.startswith(_MIRROR_LIST):
        path = Path(address.removeprefix(_MIRROR_LIST).replace("///", "/"))
        lines = path.read_text().split() if path.is_file() else []
        return [line for line in lines if line.startswith(_SCHEMES)][:1]
    return [address] if address.startswith(_SCHEMES) else []
