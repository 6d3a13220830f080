"""Hold a published bundle against this checkout: what it holds is what is built here, and who vouched for it."""

from __future__ import annotations

import hashlib
import json
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from itertools import zip_longest
from pathlib import Path
from typing import IO, Annotated, Any

import pydantic

from flotilla.common import cache, host, namespace, paths, progress
from flotilla.common.errors import UserError
from flotilla.common.text import day
from flotilla.fleet import release_keys
from flotilla.fleet.model import Fleet
from flotilla.images import card
from flotilla.images.build import board_build
from flotilla.updates import bundle

_PARTS = {"KERNEL": "kernel", "INITRD": "initramfs", "KEYS": "release keys"}
"""Parts of a slot behind its root, by their names in the header."""
_KEYS_REMEDY = (
    "write the publisher's public keys under releases: keys: in group_vars/all.yml, as lines of "
    "`ssh-ed25519 AAAA… NAME`"
)


class Manifest(pydantic.BaseModel):
    """What `bundle.manifest_of` writes."""

    format: int
    header: dict[str, str]
    chunk_bytes: int
    chunks: list[str]
    """SHA-256 of each chunk of slot.img."""
    bills: dict[str, str] = {}
    """SHA-256 of the bills of materials, by their names in the bundle."""
    expires: Annotated[date | None, pydantic.BeforeValidator(day)] = None
    """Last day, which the publisher chose; nothing to compare with. None: the bundle does not expire."""


@dataclass(frozen=True)
class Published:
    """A bundle that is what its manifest says; who signed that is judged by nobody yet."""

    text: bytes
    """The manifest to the byte, as it is signed."""
    manifest: Manifest
    signatures: list[bytes]


def verify(fleet: Fleet, file: Path) -> str:
    """Build what the bundle says it is, and compare all but who signed it. UserError with what differs, or why it is
    nothing to go by."""
    published = _read(file)
    header = published.manifest.header
    board = fleet.board(header.get("BOARD", ""))
    host.check()
    namespace.check()
    signed = _signed(published, json.loads(release_keys.document(fleet.releases)), file)
    with cache.exclusive():
        made = board_build(board, fleet.releases)
        here = Manifest.model_validate_json(bundle.manifest_of(made.slot, bundle.bills_of(made)))
    if found := list(_differences(published.manifest, here)):
        raise UserError("\n  ".join([f"{paths.shown(file)}: is not what this checkout builds:", *found]))
    return (
        f"{paths.shown(file)}: release {header['RELEASE']} of {board.name} is what this checkout builds: slot.img, "
        f"{progress.size(int(header['BYTES']))}, and {', '.join(sorted(here.bills))}; "
        + (f"expires on {published.manifest.expires}; " if published.manifest.expires else "")
        + f"signed by {', '.join(signed)}"
    )


def _read(file: Path) -> Published:
    """UserError where the bundle is none, or contradicts itself."""
    texts: dict[str, bytes] = {}
    chunks: list[str] = []
    try:
        with tarfile.open(file, "r:") as archive:
            for member in archive:
                content = archive.extractfile(member)
                if content is None:
                    raise ValueError(f"{member.name} is no file")
                if member.name == "slot.img":
                    chunks = list(_hashes(content))
                else:
                    texts[member.name] = content.read()
        text = texts.pop("manifest.json")
        manifest = Manifest.model_validate_json(text)
    except FileNotFoundError:
        raise UserError(f"{paths.shown(file)}: no such file; give the bundle that somebody published") from None
    except (tarfile.TarError, ValueError, KeyError) as error:
        raise UserError(f"{paths.shown(file)}: is no bundle: {error}") from error
    if (manifest.format, manifest.chunk_bytes) != (bundle.FORMAT, bundle.CHUNK_BYTES):
        raise UserError(
            f"{paths.shown(file)}: has format {manifest.format} and chunks of {manifest.chunk_bytes} bytes, this "
            f"checkout makes {bundle.FORMAT} and {bundle.CHUNK_BYTES}; take the checkout that made it"
        )
    signatures = [texts.pop(name) for name in sorted(texts) if name.endswith(".sig")]
    bills = {name: hashlib.sha256(content).hexdigest() for name, content in texts.items()}
    if (manifest.chunks, manifest.bills) != (chunks, bills):
        raise UserError(f"{paths.shown(file)}: does not match its manifest; get it again")
    return Published(text, manifest, signatures)


def _hashes(content: IO[bytes]) -> Iterator[str]:
    while chunk := content.read(bundle.CHUNK_BYTES):
        yield hashlib.sha256(chunk).hexdigest()


def _signed(published: Published, trusted: Mapping[str, Any], file: Path) -> list[str]:
    """Who of those that this checkout trusts has signed it: as many as a robot would want."""
    with tempfile.TemporaryDirectory() as scratch:
        text, signature = Path(scratch, "manifest.json"), Path(scratch, "signature")
        text.write_bytes(published.text)
        signed = set()
        for content in published.signatures:
            signature.write_bytes(content)
            signed |= {key["name"] for key in trusted["keys"] if bundle.signed_by(text, signature, key)}
    if len(signed) < trusted["signatures"]:
        names = ", ".join(key["name"] for key in trusted["keys"])
        raise UserError(
            f"{paths.shown(file)}: {len(signed)} of {trusted['signatures']} signatures by {names}; {_KEYS_REMEDY}"
        )
    return sorted(signed)


def _differences(published: Manifest, here: Manifest) -> Iterator[str]:
    theirs, ours = published.header, here.header
    # The hash of slot.img follows from its chunks: where those differ, they say more.
    told = {"BLOB"} if published.chunks != here.chunks else set()
    for key in sorted((theirs.keys() | ours.keys()) - told):
        if theirs.get(key) != ours.get(key):
            yield f"{key}: {theirs.get(key)}, here {ours.get(key)}"
    pairs = enumerate(zip_longest(published.chunks, here.chunks))
    starts = [number * here.chunk_bytes for number, (one, another) in pairs if one != another]
    if parts := {name for start in starts for name in _parts(ours, start, here.chunk_bytes)}:
        yield f"slot.img: differs in {', '.join(sorted(parts))}"
    elif starts:
        yield f"slot.img: is {len(published.chunks)} chunks long, here {len(here.chunks)}"
    if parts == {_PARTS["KEYS"]}:
        yield _KEYS_REMEDY
    for name in sorted(published.bills.keys() | here.bills.keys()):
        if published.bills.get(name) != here.bills.get(name):
            yield f"{name}: differs"


def _parts(header: Mapping[str, str], start: int, length: int) -> Iterator[str]:
    """What lies in a piece of the slot."""
    places = {_PARTS[key]: [int(n) * card.SECTOR for n in header[key].split("+")] for key in _PARTS if header.get(key)}
    behind = min(first for first, _ in places.values())
    for name, (first, size) in {"root": [0, behind], **places}.items():
        if start < first + size and first < start + length:
            yield name
