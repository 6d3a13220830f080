"""Operators besides the one whose key every robot has: each by an SSH certificate that ends, and that can be revoked.

The fleet's authority signs a person's public key. Its key is the file `operator_authority` in `paths.KEYS`, made when
first needed, which no robot has. A robot admits as its user `robot` who has such a certificate, unless the certificate
has ended or its key is in the robot's list of revoked keys. Two more files lie in `paths.KEYS`:

| file | what |
|---|---|
| `operators` | JSON: who was admitted, a certificate each, with serial number, public key and end |
| `revoked_operators` | public keys that robots refuse, a line each with the operator's name |
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import re
import subprocess
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Network
from pathlib import Path

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet import keys
from flotilla.fleet.model import Fleet

CERTIFICATE = "operator_ed25519-cert.pub"
DAYS = 30
"""How long a certificate lasts, unless somebody says otherwise."""
_MOST_DAYS = 365
_PRINCIPAL = "robot"
"""The user of robots that a certificate is for."""
_NAME = re.compile(r"[a-z][a-z0-9-]*")
_KEY = re.compile(r"(ssh-ed25519|ssh-rsa|ecdsa-sha2-nistp(?:256|384|521)) ([A-Za-z0-9+/]+=*)(?: .*)?")
_TIME = "%Y-%m-%dT%H:%M:%SZ"


@dataclass(frozen=True)
class Admission:
    """A certificate that the authority signed."""

    name: str
    serial: int
    key: str
    """The person's public key, without comment."""
    until: datetime
    sources: tuple[str, ...] = ()
    """Networks from which robots take it; empty: from anywhere."""


def authority() -> Path:
    """The authority's private key, made if there is none."""
    return keys.make("operator_authority", "authority of operators")


def admit(
    fleet: Fleet, name: str, key_file: Path, days: int, out: Path | None, sources: str = ""
) -> tuple[Path, Admission]:
    """Sign a certificate for the public key in a file, and write it beside the `known_hosts` that pins all robots.

    `sources`: addresses and networks, with commas between, from which alone robots take it; empty: from anywhere.
    Returns their folder. The list of admissions has the certificate before anybody can use it, so that whatever was
    handed out can be revoked.
    """
    if not _NAME.fullmatch(name):
        raise UserError(f"NAME={name}: is no name; take small letters, digits and hyphens, a letter first")
    if not 1 <= days <= _MOST_DAYS:
        raise UserError(f"DAYS={days}: take 1 to {_MOST_DAYS}; a certificate is renewed by the same command")
    networks = _networks(fleet, sources)
    key, now = _public_key(key_file), _now()
    folder = out or paths.OPERATORS / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{paths.shown(folder)}: {error.strerror}; OUT= is the folder for the certificate") from error
    authority()
    keys.host_keys(fleet)  # with what pins them
    with keys.alone():
        before = _admissions()
        _check(before, name, key_file, key, now)
        serial = 1 + max((each.serial for each in before), default=0)
        admission = Admission(name, serial, key, now + timedelta(days=days), networks)
        certificate = _certificate(key_file, admission)
        _record([*before, admission])
    durable.write(folder / "known_hosts", (paths.KEYS / "known_hosts").read_text())
    durable.write(folder / CERTIFICATE, certificate)
    return folder, admission


def revoke(name: str) -> None:
    """Refuse every key that was admitted by a name. Robots do so once they have the list."""
    with keys.alone():
        admissions = _admissions()
        if not (theirs := [each.key for each in admissions if each.name == name]):
            names = ", ".join(sorted({each.name for each in admissions}))
            remedy = f"take one of: {names}" if names else "nobody was, so nobody has a certificate"
            raise UserError(f"NAME={name}: no operator of that name was admitted; {remedy}")
        before = _revoked().read_text() if _revoked().exists() else ""
        new = [key for key in dict.fromkeys(theirs) if key not in revoked()]
        durable.write(_revoked(), before + "".join(f"{key} {name}\n" for key in new))


def revoked() -> list[str]:
    """Public keys that robots refuse, whatever certificate there is for them."""
    return keys.listed(_revoked())


def table() -> str:
    """Who was admitted, until when, and whether that has ended: a line for each operator's key."""
    last: dict[tuple[str, str], Admission] = {}
    for each in sorted(_admissions(), key=lambda each: each.until):
        last[each.name, each.key] = each
    refused, now = revoked(), _now()
    width = max((len(name) for name, _ in last), default=0)
    lines = []
    for (name, key), each in sorted(last.items()):
        state = ["revoked"] if key in refused else ["expired"] if each.until <= now else []
        where = [f"from {', '.join(each.sources)}"] if each.sources else []
        lines.append("  ".join([f"{name:{width}}", f"until {shown(each.until)}", *where, *state]))
    return "\n".join(lines) or "no operator was admitted by a certificate; `make admit-operator` does so"


def shown(until: datetime) -> str:
    return f"{until:%Y-%m-%d %H:%M} UTC"


def _check(admissions: list[Admission], name: str, file: Path, key: str, now: datetime) -> None:
    """UserError where a certificate for the key would be useless or dangerous."""
    shown_file, refused = paths.shown(file), revoked()
    if key in {keys.public(public.with_suffix("")) for public in paths.KEYS.glob("*.pub")}:
        # To revoke such a key, the operator's for one, would lock everybody out.
        raise UserError(f"{shown_file}: is a key of {paths.shown(paths.KEYS)}; take one of {name}'s own")
    if key in refused:
        raise UserError(f"{shown_file}: this key was revoked, and robots reject it; {name} needs a new one")
    for each in admissions:
        if each.key == key and each.name != name:
            raise UserError(f"{shown_file}: is the key of {each.name}, who was admitted; {name} needs one of their own")
        if each.name == name and each.key not in {key, *refused} and each.until > now:
            raise UserError(
                f"NAME={name}: is admitted with another key until {shown(each.until)}; "
                f"`make revoke-operator NAME={name}` first, or take another name"
            )


def _networks(fleet: Fleet, sources: str) -> tuple[str, ...]:
    """As written, each in its shortest form."""
    subnet = fleet.network.subnet
    found = []
    for source in filter(None, sources.split(",")):
        try:
            network = IPv4Network(source)
        except ValueError as error:
            raise UserError(
                f"FROM={sources}: {error}; take addresses, or networks as 10.0.0.0/24, commas between"
            ) from error
        if not network.overlaps(subnet):
            raise UserError(
                f"FROM={sources}: {source} is outside of {subnet}, and nobody reaches a robot from elsewhere"
            )
        found.append(str(network).removesuffix("/32"))
    return tuple(found)


def _public_key(file: Path) -> str:
    """Without comment, in the one form that compares."""
    wanted = "give a file with one public key, ssh-ed25519, ecdsa-sha2-… or ssh-rsa"
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{paths.shown(file)}: {error.strerror}; {wanted}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{paths.shown(file)}: is no text; {wanted}") from error
    if "PRIVATE KEY" in text:
        raise UserError(
            f"{paths.shown(file)}: is a private key, which stays with whom it belongs to; give the public half, "
            f"{file.name}.pub"
        )
    if not (found := _KEY.fullmatch(text.strip())):
        raise UserError(f"{paths.shown(file)}: is no public key; {wanted}")
    try:
        return f"{found[1]} {base64.b64encode(base64.b64decode(found[2], validate=True)).decode()}"
    except binascii.Error as error:
        raise UserError(f"{paths.shown(file)}: is no public key: {error}; {wanted}") from error


def _certificate(key_file: Path, admission: Admission) -> str:
    # Valid from `always`: a robot whose clock has lost its battery starts in the past.
    valid = f"always:{admission.until:%Y%m%d%H%M%S}"
    with tempfile.TemporaryDirectory(prefix="operator-") as directory:
        public = Path(directory) / "key.pub"
        public.write_text(f"{admission.key} {admission.name}\n")
        signer = keys.usable(authority())
        by_agent = ["-U"] if signer.suffix == ".pub" else []
        argv = ["ssh-keygen", "-q", *by_agent, "-s", str(signer), "-I", admission.name, "-n", _PRINCIPAL, "-V", valid]
        argv += ["-z", str(admission.serial), "-O", "clear", "-O", "permit-pty"]
        if admission.sources:
            argv += ["-O", f"source-address={','.join(admission.sources)}"]
        argv.append(str(public))
        # ssh-keygen reads times as local ones; only newer ones know the suffix for UTC.
        done = subprocess.run(
            argv, env=os.environ | {"TZ": "UTC"}, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise UserError(f"{paths.shown(key_file)}: cannot be signed: {done.stderr.strip()}")
        return public.with_name("key-cert.pub").read_text()


def _admissions() -> list[Admission]:
    """In the order in which they were signed."""
    file = _admitted()
    if not file.exists():
        return []
    try:
        return [
            Admission(
                each["name"],
                each["serial"],
                each["key"],
                datetime.strptime(each["until"], _TIME).replace(tzinfo=UTC),
                tuple(each["sources"]),
            )
            for each in json.loads(file.read_text())
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{paths.shown(file)}: is no list of operators: {error!r}; restore it by `make restore-keys`"
        ) from error


def _record(admissions: list[Admission]) -> None:
    described = [vars(each) | {"until": each.until.strftime(_TIME)} for each in admissions]
    durable.write(_admitted(), json.dumps(described, indent=1) + "\n")


def _admitted() -> Path:
    return paths.KEYS / "operators"


def _revoked() -> Path:
    return paths.KEYS / "revoked_operators"


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)
