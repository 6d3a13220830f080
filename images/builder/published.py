"""Hold a published bundle against this checkout: what it holds is what is built here, and who vouched for it."""

from __future__ import annotations

import hashlib
import json
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from flotilla.common import cache, host, namespace, paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet import release_keys
from flotilla.fleet.model import Fleet
from images.builder import bundle, card
from images.builder.build import board_build

_PARTS = {"KERNEL": "kernel", "INITRD": "initramfs", "KEYS": "release keys"}
"""Parts of a slot behind its root, by their names in the header."""
_KEYS_REMEDY = (
    "write the publisher's public keys under releases: keys: in group_vars/all.yml, as lines of "
    "`ssh-ed25519 AAAA… NAME`"
)


@dataclass(frozen=True)
class Published:
    """A bundle as it is read, judged by nobody yet."""

    text: bytes
    """Its manifest."""
    signatures: Mapping[str, bytes]
    """By their names in it."""
    members: Mapping[str, str]
    """SHA-256 of the others, but of slot.img."""
    chunks: list[str]
    """SHA-256 of each chunk of slot.img."""

    @property
    def manifest(self) -> dict[str, Any]:
        manifest: dict[str, Any] = json.loads(self.text)
        return manifest


def verify(fleet: Fleet, file: Path) -> str:
    """Build what the bundle says it is, and compare all but who signed it. UserError with what differs, or why it is
    nothing to go by."""
    published = _read(file)
    header = published.manifest["header"]
    board = fleet.board(header["BOARD"])
    host.check()
    namespace.check()
    signed = _signed(published, json.loads(release_keys.document(fleet.releases)), file)
    with cache.exclusive():
        made = board_build(board, fleet.releases)
        here = json.loads(bundle.manifest_of(made.slot, bundle.bills_of(made)))
    if found := list(_differences(published.manifest, here)):
        raise UserError("\n  ".join([f"{paths.shown(file)}: is not what this checkout builds:", *found]))
    return (
        f"{paths.shown(file)}: release {header['RELEASE']} of {board.name} is what this checkout builds: slot.img, "
        f"{progress.size(int(header['BYTES']))}, and {', '.join(sorted(here['bills']))}; signed by {', '.join(signed)}"
    )


def _read(file: Path) -> Published:
    """UserError where the bundle contradicts itself."""
    texts: dict[str, bytes] = {}
    try:
        with tarfile.open(file, "r:") as archive:
            for member in archive:
                content = archive.extractfile(member)
                if content is None:
                    raise UserError(f"{paths.shown(file)}: {member.name}: is no file; it is no bundle")
                if member.name == "slot.img":
                    chunks = list(_hashes(content))
                else:
                    texts[member.name] = content.read()
        text = texts.pop("manifest.json")
        signatures = {name: content for name, content in texts.items() if name.endswith(".sig")}
        members = {
            name: hashlib.sha256(content).hexdigest() for name, content in texts.items() if name not in signatures
        }
        published = Published(text, signatures, members, chunks)
        described = published.manifest
        intact = described["chunks"] == chunks and described.get("bills", {}) == members
        header_board = described["header"]["BOARD"]
    except FileNotFoundError:
        raise UserError(f"{paths.shown(file)}: no such file; give the bundle that somebody published") from None
    except (tarfile.TarError, ValueError, KeyError, UnboundLocalError) as error:
        raise UserError(f"{paths.shown(file)}: is no bundle: {error}") from error
    if described["format"] != bundle.FORMAT:
        raise UserError(
            f"{paths.shown(file)}: has format {described['format']}, this checkout makes {bundle.FORMAT}; take the "
            "checkout that made it"
        )
    if not intact:
        raise UserError(f"{paths.shown(file)}: holds something else than its manifest says; get it again")
    assert isinstance(header_board, str), "or fleet.board() says that there is none"
    return published


def _hashes(content: IO[bytes]) -> Iterator[str]:
    while chunk := content.read(bundle.CHUNK_BYTES):
        yield hashlib.sha256(chunk).hexdigest()


def _signed(published: Published, trusted: Mapping[str, Any], file: Path) -> list[str]:
    """Who of those that this checkout trusts has signed it: as many as a robot would want."""
    with tempfile.TemporaryDirectory() as scratch:
        text, signature = Path(scratch, "manifest.json"), Path(scratch, "signature")
        text.write_bytes(published.text)
        signed = set()
        for content in published.signatures.values():
            signature.write_bytes(content)
            signed |= {key["name"] for key in trusted["keys"] if bundle.signed_by(text, signature, key)}
    if len(signed) < trusted["signatures"]:
        names = ", ".join(key["name"] for key in trusted["keys"])
        raise UserError(
            f"{paths.shown(file)}: {len(signed)} of {trusted['signatures']} signatures by {names}; {_KEYS_REMEDY}"
        )
    return sorted(signed)


def _differences(published: Mapping[str, Any], here: Mapping[str, Any]) -> Iterator[str]:
    theirs, ours = published["header"], here["header"]
    for key in sorted(theirs.keys() | ours.keys()):
        if theirs.get(key) != ours.get(key) and key != "BLOB":
            yield f"{key}: {theirs.get(key)}, here {ours.get(key)}"
    if published["chunk_bytes"] != here["chunk_bytes"]:
        yield f"chunk_bytes: {published['chunk_bytes']}, here {here['chunk_bytes']}"
        return
    pairs = zip(published["chunks"], here["chunks"], strict=False)
    other = [number for number, (one, another) in enumerate(pairs) if one != another]
    parts = {name for number in other for name in _parts(theirs, number * here["chunk_bytes"], here["chunk_bytes"])}
    if parts:
        yield f"slot.img: differs in {', '.join(sorted(parts))}"
    if parts == {_PARTS["KEYS"]}:
        yield _KEYS_REMEDY
    for name in sorted(published["bills"].keys() | here["bills"].keys()):
        if published["bills"].get(name) != here["bills"].get(name):
            yield f"{name}: differs"


def _parts(header: Mapping[str, str], start: int, length: int) -> Iterator[str]:
    """What lies in a piece of the slot."""
    places = {_PARTS[key]: [int(n) * card.SECTOR for n in header[key].split("+")] for key in _PARTS if header.get(key)}
    behind = min(first for first, _ in places.values())
    for name, (first, size) in {"root": [0, behind], **places}.items():
        if start < first + size and first < start + length:
            yield name
