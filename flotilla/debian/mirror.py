"""Where Debian packages come from: the environment, else this computer's own apt configuration, else, on another
distribution, what its package python-apt-common says of Debian.

No file of the project names a mirror, so a lock never sends anyone to a server that somebody else chose.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections import defaultdict
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
_ALWAYS = r"sid|(?:old)*stable|testing|unstable"
"""What Debian calls suites besides the names of releases. Those are data: this computer's says os-release."""
_SCHEMES = ("http://", "https://", "file:/")
_MIRROR_LIST = "mirror+file:"
_LABELS = {"Debian": DEBIAN, "Debian-Security": SECURITY}
"""Of the archives' Release files, whose origin is `Debian`."""
_TEMPLATES = ("debian.info", "Debian.info")
"""The file that describes Debian's archives to programs which edit apt's sources; the package's newer name first."""
_TEMPLATE_SUITES = {"{series}": DEBIAN, "{series}-security": SECURITY}
"""There, by suite; the archive of all releases since Debian 11."""
_FIELD = re.compile(r"^([!-9;-~]+):[ \t]*(.*(?:\n[ \t].*)*)", re.MULTILINE)


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
    templates: Path = Path("/usr/share/python-apt/templates"),
) -> Mirrors:
    """The mirrors to use. One that is missing is an error only when it is needed: see `Mirrors.of`."""
    given = {archive: environment[variable] for archive, variable in _VARIABLES.items() if environment.get(variable)}
    for archive, address in given.items():
        if not address.startswith(_SCHEMES):
            variable = _VARIABLES[archive]
            raise UserError(f"{variable}={address}: no address; write it like {variable}={_EXAMPLES[archive]}")
    known: dict[str, str] = {}
    if given.keys() != set(ARCHIVES):
        names = _suites(os_release)
        known = dict(() if names else _described(templates)) | dict(_configured(apt, names))
    snapshot = environment.get("SNAPSHOT") or None
    return Mirrors(
        {archive: address.rstrip("/") for archive, address in (known | given).items()},
        snapshot.rstrip("/") if snapshot else None,
    )


def stanzas(text: str) -> Iterator[dict[str, str]]:
    """The stanzas of a file in Debian's control format."""
    for stanza in text.split("\n\n"):
        if fields := dict(_FIELD.findall(stanza)):
            yield fields


def _advice(archive: str) -> str:
    return (
        f"no mirror known for the Debian archive '{archive}': neither this computer's apt configuration nor its "
        f"package python-apt-common names one; give the same command {_VARIABLES[archive]}, for example:\n"
        f"  make image ROBOT=3 {' '.join(f'{_VARIABLES[each]}={_EXAMPLES[each]}' for each in ARCHIVES)}\n"
        "where MIRROR is a Debian mirror near you. SNAPSHOT=http://SNAPSHOT/archive is where older versions come from."
    )


def _suites(os_release: Path) -> str:
    """A pattern of the names that suites of this computer's Debian have; none elsewhere, where suites are others'."""
    text = os_release.read_text() if os_release.is_file() else ""
    values = dict(re.findall(r"""^(\w+)=["']?(.*?)["']?$""", text, re.MULTILINE))
    if values.get("ID") != "debian":
        return ""
    own = values.get("VERSION_CODENAME")
    return f"{_ALWAYS}|{re.escape(own)}" if own else _ALWAYS


def _configured(apt: Path, names: str) -> Iterator[tuple[str, str]]:
    """Archive and address of every source of Debian's that apt knows, the most preferred last.

    Who publishes a source is in its Release file, which apt has verified and kept. Where apt has none yet, the names of
    the suites and the address decide: others call their suites `stable` and their components `main`, too.
    An archive's suites share one pool, so any of them will do.
    """
    published: dict[str, set[str]] = defaultdict(set)
    for address, origin, label in _index_targets(apt, ["ORIGIN", "LABEL"]):
        published[address].add(_LABELS.get(label, "") if origin == "Debian" else "")
    suites: dict[str, set[str]] = defaultdict(set)
    for address, suite, component in _index_targets(apt, ["RELEASE", "COMPONENT"], "--no-release-info"):
        if component == "main" or address in published:
            suites[address].add(suite)
    sure = [
        address for address in suites if address in published or any("-updates" in each for each in suites[address])
    ]
    for address in reversed(sure + [each for each in suites if each not in sure]):
        for usable in _usable(address):
            for archive in published.get(address) or _guessed(usable, suites[address], names):
                if archive:
                    yield archive, usable


def _guessed(address: str, suites: Iterable[str], names: str) -> Iterator[str]:
    """The archive that an address is of, which apt has fetched nothing from."""
    pattern = re.compile(rf"(?:{names or '(?!)'})(?P<part>-updates|-security)?")
    found = {match["part"] for suite in suites if (match := pattern.fullmatch(suite))}
    if "-security" in found:
        yield SECURITY
    if "-updates" in found or (None in found and address.rstrip("/").endswith("/debian")):
        yield DEBIAN


def _described(templates: Path) -> Iterator[tuple[str, str]]:
    """Archive and address of Debian's own archives, on a distribution whose apt has sources of its own."""
    for file in (templates / name for name in _TEMPLATES):
        for fields in stanzas(file.read_text()) if file.is_file() else ():
            archive, address = _TEMPLATE_SUITES.get(fields.get("Suite", "")), fields.get("BaseURI", "")
            if archive and address.startswith(_SCHEMES):
                yield archive, address


def _index_targets(apt: Path, fields: Iterable[str], *options: str) -> list[list[str]]:
    """Address of every enabled source of binary packages, in apt's order, and these fields of it."""
    form = "\t".join(f"$({each})" for each in ("REPO_URI", *fields))
    argv = ["apt-get", "indextargets", f"-oDir::Etc={apt}", *options, "--format", form, "Created-By: Packages"]
    environment = os.environ | {"LC_ALL": "C.UTF-8"}
    try:
        done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=True)
    except FileNotFoundError:
        return []
    except subprocess.CalledProcessError as error:
        raise UserError(f"{apt}: apt cannot read its sources:\n{error.stderr.strip()}") from None
    return [line.split("\t") for line in done.stdout.splitlines()]


def _usable(address: str) -> Iterable[str]:
    """The address itself, or what a list of mirrors on this computer names first (Debian's cloud images have one)."""
    if address.startswith(_MIRROR_LIST):
        path = Path(address.removeprefix(_MIRROR_LIST).replace("///", "/").rstrip("/"))
        lines = path.read_text().split() if path.is_file() else []
        return [line for line in lines if line.startswith(_SCHEMES)][:1]
    return [address] if address.startswith(_SCHEMES) else []
