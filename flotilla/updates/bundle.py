"""The update bundle of a board, which brings its release to robots in service: a tar file.

The same release with the same day of expiry and the same signatures gives the same bytes. The day is in the manifest
alone, so slot.img and its header are the same whenever the bundle is made.

| member | what |
|---|---|
| manifest.json | format, header of the slot, day of expiry, SHA-256 of each chunk of slot.img and of the bills |
| manifest.json.NAME.sig | its signature by the key NAME (`ssh-keygen -Y sign`) |
| sbom.spdx.json, sbom.cdx.json | bills of materials |
| slot.img | root, kernel, initramfs and release keys: all that a slot holds but the header |
"""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

from flotilla.common import cache, durable, host, namespace, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.text import day
from flotilla.fleet import release_keys, ssh_signatures
from flotilla.fleet.model import Board, Fleet, Releases
from flotilla.images import manifest, slot
from flotilla.images.build import BoardBuild, board_build

FORMAT = 1
CHUNK_BYTES = 1 << 18
"""A robot reads, checks and writes so much at a time, and what was cut off begins anew there."""


def file_of(board: str) -> Path:
    """Where the bundle of a board lies."""
    return paths.BUNDLES / f"{board}.bundle"


def make(fleet: Fleet, board: Board, signatures: Sequence[Path], expires: date | None = None) -> Path:
    """Make the bundle of a board, signed by the keys here, by those in an agent, and by `signatures` made elsewhere.

    `expires`: its last day, in UTC. By default that of the manifest that was signed elsewhere, or the inventory's
    `lifetime_days` from today on. Raises UserError if that day is over.
    """
    host.check()
    namespace.check()
    started = time.monotonic()
    final = file_of(board.name)
    today = datetime.now(UTC).date()
    last_day = expiry(fleet.releases, today, expires, text_of(final) if signatures else None)
    with cache.exclusive():
        made = board_build(board, fleet.releases)
        bills = bills_of(made)
        signed = pack(final, made.slot, fleet.releases, bills, made.lock.epoch, signatures, last_day)
    print(
        f"{paths.shown(final)}: release {slot.release().release} of {board.name}, expires on {last_day}, "
        f"{progress.size(final.stat().st_size)}, signed by {', '.join(signed)}, {time.monotonic() - started:.1f} s"
    )
    return final


def text_of(final: Path) -> Path:
    """Where the manifest of a bundle lies for those who sign elsewhere."""
    return final.with_suffix(".manifest.json")


def expiry(releases: Releases, today: date, given: date | None, signed: Path | None) -> date:
    """Last day of a bundle: `given`, that of the manifest `signed` elsewhere, or as many days from `today` on as the
    inventory gives. UserError if it is over."""
    there = json.loads(signed.read_bytes()) if signed is not None and signed.exists() else {}
    try:
        chosen = day(there["expires"]) if "expires" in there else None
    except ValueError as error:
        raise UserError(
            f"{paths.shown(signed or Path())}: expires={there['expires']}: {error}, and have the manifest signed again"
        ) from None
    last_day = given or chosen or today + timedelta(days=releases.lifetime_days)
    if last_day < today:
        source = "EXPIRES" if given or not signed else f"{paths.shown(signed)}: expires"
        raise UserError(
            f"{source}={last_day}: that day is over, and robots would reject the bundle; give a later one: "
            f"EXPIRES={today + timedelta(days=releases.lifetime_days)}"
            + ("" if given else ", and have the manifest signed again")
        )
    return last_day


def bills_of(made: BoardBuild) -> dict[str, bytes]:
    """A board's bills of materials as members of its bundle."""
    return {f"sbom.{end}": (made.manifest / f"sbom.{end}").read_bytes() for end in manifest.SBOMS}


def pack(
    final: Path,
    content: Path,
    releases: Releases,
    bills: Mapping[str, bytes],
    epoch: int,
    signatures: Sequence[Path] = (),
    expires: date | None = None,
) -> list[str]:
    """Write the bundle of what `slot.build` made in `content`; who has signed it. `bills`: further members.

    The manifest is left beside it, for those who sign elsewhere. `expires`: last day; None: it does not expire.
    """
    final.parent.mkdir(parents=True, exist_ok=True)
    described = manifest_of(content, bills, expires)
    text = text_of(final)
    text.write_bytes(described)
    signed = _signatures(text, releases, signatures)
    members = {"manifest.json": described}
    members |= {f"manifest.json.{name}.sig": signed[name] for name in sorted(signed)} | dict(bills)
    new = final.with_suffix(".new")
    with tarfile.open(new, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name, each in members.items():
            _add(archive, name, io.BytesIO(each), len(each), epoch)
        with (content / "slot.img").open("rb") as blob:
            _add(archive, "slot.img", blob, (content / "slot.img").stat().st_size, epoch)
    durable.rename(new, final)
    return sorted(signed)


def manifest_of(content: Path, bills: Mapping[str, bytes], expires: date | None = None) -> bytes:
    """The manifest of what `slot.build` made, and of its bills of materials. `expires`: last day; None: no expiry."""
    chunks = []
    with (content / "slot.img").open("rb") as blob:
        while chunk := blob.read(CHUNK_BYTES):
            chunks.append(hashlib.sha256(chunk).hexdigest())
    header = json.loads((content / "header.json").read_text())
    described = {"format": FORMAT, "header": header, "chunk_bytes": CHUNK_BYTES, "chunks": chunks}
    if bills:
        described["bills"] = {name: hashlib.sha256(bill).hexdigest() for name, bill in sorted(bills.items())}
    if expires:
        described["expires"] = expires.isoformat()
    return (json.dumps(described, indent=1) + "\n").encode()


def _signatures(text: Path, releases: Releases, elsewhere: Sequence[Path]) -> dict[str, bytes]:
    """Signatures of a manifest by name of the key: enough of them, each checked."""
    trusted = json.loads(release_keys.document(releases))
    signed: dict[str, bytes] = {}
    for key in trusted["keys"]:
        private = paths.KEYS / f"{key['name']}_ed25519"
        if private.exists():
            signed[key["name"]] = ssh_signatures.sign(text.read_bytes(), private, release_keys.NAMESPACE)
        elif ssh_signatures.is_in_agent(key["key"]):
            signed[key["name"]] = ssh_signatures.sign_by_agent(text.read_bytes(), key["key"], release_keys.NAMESPACE)
    for file in elsewhere:
        name = next((key["name"] for key in trusted["keys"] if signed_by(text, file, key)), None)
        if name is None:
            raise UserError(
                f"{file}: is no signature of {paths.shown(text)} by a key of releases in group_vars/all.yml; make it "
                f"by `ssh-keygen -Y sign -n {release_keys.NAMESPACE} -f KEY {text.name}`"
            )
        signed[name] = file.read_bytes()
    if len(signed) < trusted["signatures"]:
        names = ", ".join(key["name"] for key in trusted["keys"])
        raise UserError(
            f"{paths.shown(text)}: {len(signed)} of {trusted['signatures']} signatures, by keys of "
            f"{paths.shown(paths.KEYS)} and of the ssh-agent; load a key (`ssh-add`), or have more of {names} sign it: "
            f"`ssh-keygen -Y sign -n {release_keys.NAMESPACE} -f KEY {text.name}`, then give the signature files: "
            'SIGNATURES="FILE ..."'
        )
    return signed


def signed_by(text: Path, signature: Path, key: Mapping[str, str]) -> bool:
    """Whether a key of `release_keys.document` has made this signature of a file."""
    return ssh_signatures.is_signed(text.read_bytes(), signature, [key["key"]], release_keys.NAMESPACE)


def _add(archive: tarfile.TarFile, name: str, content: io.BufferedIOBase, size: int, epoch: int) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mtime = size, epoch
    archive.addfile(member, content)
