"""A third person builds what somebody published, and finds that it is the same, or what is not."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import tarfile
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import release_keys
from flotilla.fleet.model import Fleet
from flotilla.images.build import board_build
from flotilla.updates import bundle, published


@pytest.fixture(scope="module")
def releases(fleet: Fleet) -> Fleet:
    """The fleet as its publisher describes it to others: by public keys, which need no private ones here."""
    public = (paths.KEYS / "release_ed25519.pub").read_text().split()[:2]
    keys = [" ".join([*public, "release"])]
    return fleet.model_copy(update={"releases": fleet.releases.model_copy(update={"keys": keys})})


@pytest.fixture(scope="module")
def file(releases: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle that was published."""
    file = tmp_path_factory.mktemp("published") / "some.bundle"
    made = board_build(releases.board(), releases.releases)
    bundle.pack(file, made.slot, releases.releases, bundle.bills_of(made), made.lock.epoch, expires=date(2099, 12, 31))
    return file


def altered(file: Path, to: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    with tarfile.open(file) as archive:
        members = {member.name: archive.extractfile(member).read() for member in archive}  # type: ignore[union-attr]
    change(members)
    with tarfile.open(to, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return to


def resigned(file: Path, to: Path, fleet: Fleet, change: Callable[[dict[str, bytes]], None]) -> Path:
    """Altered by somebody who has the keys: the manifest fits, and is signed."""

    def all_of_it(members: dict[str, bytes]) -> None:
        change(members)
        (to.parent / "slot.img").write_bytes(members["slot.img"])
        (to.parent / "header.json").write_text(json.dumps(json.loads(members["manifest.json"])["header"]))
        bills = {name: content for name, content in members.items() if name.startswith("sbom.")}
        bundle.pack(to.with_suffix(".again"), to.parent, fleet.releases, bills, 0)

    altered(file, to, all_of_it)
    return to.with_suffix(".again")


def test_what_is_built_here_is_what_was_published(
    releases: Fleet, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = published.verify(releases, file)
    assert f"release 1 of {releases.board().name} is what this checkout builds" in said
    assert said.endswith("and sbom.cdx.json, sbom.spdx.json; expires on 2099-12-31; signed by release")


def test_another_description_is_named(releases: Fleet, file: Path) -> None:
    """Boot arguments that the publisher did not have."""
    board = releases.board()
    changed = board.model_copy(update={"kernel_arguments": [*board.kernel_arguments, "nosmt"]})
    other = releases.model_copy(update={"boards": releases.boards | {board.name: changed}})
    with pytest.raises(UserError, match=r"is not what this checkout builds:\n  ARGUMENTS: .*, here .* nosmt.*$"):
        published.verify(other, file)


@pytest.mark.parametrize("part", ["root", "kernel", "sbom.spdx.json"])
def test_what_somebody_put_in_is_named(part: str, releases: Fleet, file: Path, tmp_path: Path) -> None:
    """With the publisher's keys."""

    def change(members: dict[str, bytes]) -> None:
        name = "slot.img" if part in ("root", "kernel") else part
        header = json.loads(members["manifest.json"])["header"]
        at = int(header["KERNEL"].split("+")[0]) * 512 + 1_000_000 if part == "kernel" else 1000
        content = bytearray(members[name])
        content[at] ^= 1
        members[name] = bytes(content)

    wrong = resigned(file, tmp_path / "wrong.bundle", releases, change)
    expected = f"{part}: differs" if part.startswith("sbom") else f"slot.img: differs in {part}"
    with pytest.raises(UserError, match=rf"is not what this checkout builds:\n  {expected}$"):
        published.verify(releases, wrong)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda manifest: manifest["header"].update(BLOB="0" * 64), "BLOB: 0{64}, here [0-9a-f]{64}"),
        (lambda manifest: manifest["chunks"].pop(), r"slot\.img: differs in initramfs, release keys"),
        (lambda manifest: manifest["header"].update(SOME="1"), "SOME: 1, here None"),
    ],
    ids=["hash of the whole", "a chunk less", "one more entry"],
)
def test_a_manifest_that_says_something_else_is_named(
    change: Callable[[dict[str, Any]], object], said: str, releases: Fleet, file: Path, tmp_path: Path
) -> None:
    """With the publisher's keys, and a slot.img that fits it. Seen to fail, the first two, where the hash was not
    compared and the shorter list of chunks ended the comparison."""

    def lie(members: dict[str, bytes]) -> None:
        manifest = json.loads(members["manifest.json"])
        change(manifest)
        members["manifest.json"] = json.dumps(manifest).encode()
        members["slot.img"] = members["slot.img"][: len(manifest["chunks"]) * bundle.CHUNK_BYTES]
        (name,) = (name for name in members if name.endswith(".sig"))
        sign = ["ssh-keygen", "-Y", "sign", "-q", "-n", release_keys.NAMESPACE]
        sign += ["-f", str(paths.KEYS / "release_ed25519")]
        members[name] = subprocess.run(sign, input=members["manifest.json"], capture_output=True, check=True).stdout

    wrong = altered(file, tmp_path / "wrong.bundle", lie)
    with pytest.raises(UserError, match=rf"is not what this checkout builds:\n  {said}$"):
        published.verify(releases, wrong)


@pytest.mark.parametrize("member", ["slot.img", "sbom.cdx.json"])
def test_a_bundle_that_is_not_as_its_manifest_says_is_refused(
    member: str, releases: Fleet, file: Path, tmp_path: Path
) -> None:
    def change(members: dict[str, bytes]) -> None:
        members[member] = members[member][:-1] + b"!"

    wrong = altered(file, tmp_path / "wrong.bundle", change)
    with pytest.raises(UserError, match=r"wrong\.bundle: does not match its manifest; get it again"):
        published.verify(releases, wrong)


def test_nobodys_signature_is_none(
    releases: Fleet, fleet: Fleet, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of something else, and none at all; and a reader who does not know the publisher, whose own key is made."""

    def unsigned(members: dict[str, bytes]) -> None:
        (name,) = (name for name in members if name.endswith(".sig"))
        members[name] = b"nothing"

    wanted = r"0 of 1 signatures by release; write the publisher's public keys under releases: keys:"
    with pytest.raises(UserError, match=wanted):
        published.verify(releases, altered(file, tmp_path / "wrong.bundle", unsigned))
    shutil.copytree(paths.KEYS, tmp_path / "keys", ignore=shutil.ignore_patterns("release_*"))
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    with pytest.raises(UserError, match=wanted):
        published.verify(fleet, file)


@pytest.mark.parametrize(
    ("content", "words"), [(None, "no such file"), (b"no tar", "is no bundle"), (b"", "is no bundle")]
)
def test_what_is_no_bundle_is_said(content: bytes | None, words: str, fleet: Fleet, tmp_path: Path) -> None:
    file = tmp_path / "some.bundle"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UserError, match=rf"some\.bundle: {words}"):
        published.verify(fleet, file)
