"""What a robot takes as a release and what it refuses: its own program, on a card that is a file."""

from __future__ import annotations

import hashlib
import importlib.util
import io
import json
import os
import random
import subprocess
import tarfile
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.robot import release
from flotilla.updates import delta
from images.builder import card, environment_block
from tests.runtime.test_slot import gpt, partition_table

PROGRAM = paths.OVERLAY / "usr/lib/flotilla/update.py"
CHUNK = 4096
SEED = 18
B = card.SLOTS[1]
EMPTY = environment_block.make({}, card.HEADER_BYTES)
"""The header of a slot that holds nothing."""


def header_of(blob: bytes, **changed: str) -> dict[str, str]:
    """A slot's header, in the order of `slot.build`; keys lie in the last 4 KiB of the content."""
    keys = len(blob) // card.SECTOR - 8
    return {
        "RELEASE": "5", "FLOOR": "3", "BOARD": "smartcoret3", "LAYOUT": "2", "VERSION": "6.1", "BYTES": str(len(blob)),
        "BLOB": hashlib.sha256(blob).hexdigest(), "KERNEL": "0+8", "INITRD": "", "KEYS": f"{keys}+8", "ARGUMENTS": "ro",
    } | changed  # fmt: skip


def manifest_of(blob: bytes, header: dict[str, str], **changed: Any) -> str:
    chunks = [hashlib.sha256(blob[start : start + CHUNK]).hexdigest() for start in range(0, len(blob), CHUNK)]
    return json.dumps({"format": 1, "header": header, "chunk_bytes": CHUNK, "chunks": chunks} | changed)


@dataclass
class Robot:
    """A robot that runs release 5 from slot A, and what it is offered."""

    module: ModuleType
    card: Path
    keys: Path
    blob: bytes
    """The new release's content."""
    said: dict[str, Any] = field(default_factory=dict)

    def sign(self, text: str, *names: str, namespace: str = "flotilla-release") -> list[str]:
        argv = ["ssh-keygen", "-q", "-Y", "sign", "-n", namespace, "-f"]
        return [
            subprocess.run(
                [*argv, str(self.keys / name)], input=text, capture_output=True, text=True, check=True
            ).stdout
            for name in names
        ]

    def run(self, command: str, content: bytes = b"") -> dict[str, Any]:
        vars(self.module)["sys"] = SimpleNamespace(stdin=io.TextIOWrapper(io.BytesIO(content)))
        said: dict[str, Any] = getattr(self.module, command)()
        return said

    def begin(self, text: str, signatures: list[str]) -> dict[str, Any]:
        return self.run("begin", json.dumps({"manifest": text, "signatures": signatures}).encode())

    def apply(self, delta: bytes, file: Path) -> dict[str, Any]:
        """`delta`, whose standard input is a file's."""
        file.write_bytes(delta)
        kept = os.dup(0)
        with file.open() as opened:
            os.dup2(opened.fileno(), 0)
        try:
            return self.run("delta")
        finally:
            os.dup2(kept, 0)
            os.close(kept)

    def take(self, text: str, *names: str) -> None:
        """The whole way of a release onto the card."""
        told = self.begin(text, self.sign(text, *names))
        told = self.run("copy")
        frames = b"".join(
            number.to_bytes(4, "little") + len(content).to_bytes(4, "little") + content
            for number in told["missing"]
            for content in (self.blob[number * CHUNK : (number + 1) * CHUNK],)
        )
        self.run("write", frames)
        assert self.run("finish")["staged"]

    def digest(self) -> str:
        with self.card.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def read(self, place: int, length: int) -> bytes:
        with self.card.open("rb") as file:
            file.seek(place)
            return file.read(length)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("keys")
    for name in ("alice", "bob", "carol", "mallory"):
        argv = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", name, "-f", str(directory / name)]
        subprocess.run(argv, check=True)
    return directory


@pytest.fixture
def robot(tmp_path: Path, keys: Path, flotilla_slot: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    """It trusts two of three keys."""
    chance = random.Random(SEED)
    trusted = [
        {"name": name, "key": (keys / f"{name}.pub").read_text()[:80].strip()} for name in ("alice", "bob", "carol")
    ]
    document = json.dumps({"signatures": 2, "keys": trusted}).encode().ljust(4096)
    present, new = (chance.randbytes(40 * CHUNK) + document for _ in range(2))
    new = present[: 10 * CHUNK] + new[10 * CHUNK :]  # a part is as it was
    file = tmp_path / "card"
    with file.open("wb") as written:
        written.truncate(card.SIZE)
        for place, content in (
            (0, partition_table()), (card.STATE.start, card.tries_block()),
            *((card.STATE.start + copy, card.state_copy()) for copy in card.COPIES),
            (card.SLOTS[0].start, present),
            (card.SLOTS[0].end - card.HEADER_ROOM, environment_block.make(header_of(present), card.HEADER_BYTES)),
        ):  # fmt: skip
            written.seek(place)
            written.write(content)
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "flotilla-slot").write_text(f'#!/bin/sh\nexec {flotilla_slot} --disk {file} --running A "$@"\n')
    (programs / "flotilla-slot").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    specification = importlib.util.spec_from_file_location("update", PROGRAM)
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    for name, value in (("KNOWN", tmp_path / "known"), ("RUN", tmp_path), ("LAYERS", tmp_path / "data")):
        monkeypatch.setattr(module, name, str(value))
    monkeypatch.setattr(module, "disk", lambda: str(file))

    class Slot(module.Slot):  # type: ignore[name-defined,misc]  # the program ends instead of closing the card
        def __del__(self) -> None:
            os.close(self._fd)

    monkeypatch.setattr(module, "Slot", Slot)
    return Robot(module, file, keys, new)


def refused(robot: Robot, text: str, signatures: list[str]) -> str:
    """Why, and that nothing has changed."""
    before = robot.digest()
    with pytest.raises(robot.module.Refused) as why:
        robot.begin(text, signatures)
    assert robot.digest() == before
    assert not Path(robot.module.KNOWN).exists()
    return str(why.value)


@pytest.mark.parametrize("table", ["", "GPT"])
def test_a_release_is_taken_and_tried(robot: Robot, table: str) -> None:
    """Seen to fail with a GPT, which is on the cards of computers with UEFI: `begin` ended with EINVAL."""
    if table:
        with robot.card.open("r+b") as file:
            file.write(gpt())
    text = manifest_of(robot.blob, header_of(robot.blob, RELEASE="6"))
    told = robot.begin(text, robot.sign(text, "alice", "carol"))
    assert (told["slot"], told["running"], told["staged"], len(told["missing"])) == ("B", False, False, 41)
    told = robot.run("copy")
    assert told["missing"] == list(range(10, 40)), "what the running release has in the same place is not sent"
    robot.take(text, "alice", "carol")
    assert robot.read(B.start, len(robot.blob)) == robot.blob
    header = environment_block.values(robot.read(B.end - card.HEADER_ROOM, card.HEADER_BYTES))
    assert header == header_of(robot.blob, RELEASE="6")
    robot.run("activate")
    assert robot.module.slots()["trial"] == "B"


def test_what_was_cut_off_goes_on(robot: Robot) -> None:
    """Seen to fail where the header is written first: a slot that is not whole is one to start."""
    text = manifest_of(robot.blob, header_of(robot.blob))
    robot.begin(text, robot.sign(text, "alice", "bob"))
    robot.run("copy")
    content = robot.blob[12 * CHUNK : 13 * CHUNK]
    frame = (12).to_bytes(4, "little") + CHUNK.to_bytes(4, "little") + content
    with pytest.raises(robot.module.Refused, match="ends within a chunk"):
        robot.run("write", frame + frame[:1000])
    told = robot.run("finish")
    assert (told["staged"], len(told["missing"])) == (False, 29)
    assert not any(robot.read(B.end - card.HEADER_ROOM, card.HEADER_BYTES))
    with pytest.raises(robot.module.Refused, match="does not hold release"):
        robot.run("activate")
    with pytest.raises(robot.module.Refused, match="not what the release says"):
        robot.run("write", (14).to_bytes(4, "little") + frame[4:])
    told = robot.begin(text, robot.sign(text, "alice", "bob"))
    assert 12 not in told["missing"]
    robot.take(text, "alice", "bob")


def test_a_wrong_chunk_spoils_no_other(robot: Robot) -> None:
    """Seen to fail: what came after it was thrown away, each time anew."""
    text = manifest_of(robot.blob, header_of(robot.blob))
    robot.begin(text, robot.sign(text, "alice", "bob"))
    robot.run("copy")
    contents = {number: robot.blob[number * CHUNK : (number + 1) * CHUNK] for number in (12, 13, 14)}
    contents[13] = bytes(CHUNK)
    frames = b"".join(
        number.to_bytes(4, "little") + CHUNK.to_bytes(4, "little") + content for number, content in contents.items()
    )
    with pytest.raises(robot.module.Refused, match="chunk 13 is not what the release says"):
        robot.run("write", frames)
    told = robot.begin(text, robot.sign(text, "alice", "bob"))
    assert {12, 13, 14} & {*told["missing"]} == {13}


def test_a_new_release_empties_the_slot_first(robot: Robot) -> None:
    text = manifest_of(robot.blob, header_of(robot.blob))
    robot.take(text, "alice", "bob")
    other = manifest_of(robot.blob, header_of(robot.blob, ARGUMENTS="ro other"))
    robot.begin(other, robot.sign(other, "alice", "bob"))
    assert robot.read(B.end - card.HEADER_ROOM, 8) == b"# GRUB E", "asking changes nothing"
    robot.run("copy")
    assert robot.read(B.end - card.HEADER_ROOM, card.HEADER_BYTES) == EMPTY


def test_a_delta_brings_the_rest(
    robot: Robot, flotilla_slot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Made by the station between two bundles; whatever it is worth, chunks bring what it does not. Seen to fail where
    what comes of a delta is written unseen."""
    (tmp_path / "bin" / "flotilla-patch").symlink_to(flotilla_slot.with_name("flotilla-patch"))
    present = robot.read(card.SLOTS[0].start, len(robot.blob))
    base = tmp_path / "base"
    base.write_bytes(present)
    monkeypatch.setattr(robot.module, "partition", lambda _: str(base))
    monkeypatch.setattr(paths, "BUNDLES", tmp_path / "bundles")
    text = manifest_of(robot.blob, header_of(robot.blob))
    signatures = robot.sign(text, "alice", "bob")
    old = pack(tmp_path / "old", manifest_of(present, header_of(present)), [], present)
    made = delta.between(release.read(old), release.read(pack(tmp_path / "new", text, signatures, robot.blob)))
    told = robot.begin(text, signatures)
    assert made == release.delta_of(told["base"], hashlib.sha256(robot.blob).hexdigest())
    content = made.read_bytes()
    for sent, missing in ((content[: len(content) // 2], True), (b"", True), (content, False)):
        told = robot.apply(sent, tmp_path / "sent")
        assert bool(told["missing"]) == missing
        assert not told["staged"]
    assert robot.run("finish")["staged"]
    assert robot.read(B.start, len(robot.blob)) == robot.blob


def test_who_signs(robot: Robot) -> None:
    """Seen to fail where signatures are counted rather than keys."""
    text = manifest_of(robot.blob, header_of(robot.blob))
    for signatures in (
        [], robot.sign(text, "alice"), robot.sign(text, "alice", "alice"), robot.sign(text, "alice", "mallory"),
        robot.sign(text, "alice", "bob", namespace="file"), robot.sign(text + " ", "alice", "bob"),
        [signature[:200] for signature in robot.sign(text, "alice", "bob")],
    ):  # fmt: skip
        assert "of the 2 signatures" in refused(robot, text, signatures)
    assert robot.begin(text, robot.sign(text, "mallory", "bob", "carol"))["slot"] == "B"


REFUSED = {
    "older": ({"RELEASE": "2"}, "release 2 is below 3"),
    "other board": ({"BOARD": "x86_64"}, "is for board x86_64, this robot has smartcoret3"),
    "other layout": ({"LAYOUT": "1"}, "is for layout of the card 1"),
    "too large": ({"BYTES": str(card.SLOTS[0].size)}, "does not fit"),
    "cut off": ({"BYTES": str(30 * CHUNK)}, "chunks are not what"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_for_this_robot(robot: Robot, name: str) -> None:
    changed, why = REFUSED[name]
    text = manifest_of(robot.blob, header_of(robot.blob, **changed))
    assert why in refused(robot, text, robot.sign(text, "alice", "bob"))


def test_a_release_on_trial_takes_no_other(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be written over the one to go back to."""
    text = manifest_of(robot.blob, header_of(robot.blob))
    on_trial = {"running": "A", "trial": "A"}
    monkeypatch.setattr(robot.module, "slots", lambda: on_trial)
    assert "is on trial" in refused(robot, text, robot.sign(text, "alice", "bob"))


@pytest.mark.parametrize("flips", [100, pytest.param(1000, marks=pytest.mark.nightly)])
def test_each_flipped_bit_is_refused(robot: Robot, flips: int) -> None:
    """In the manifest, in the signatures and in the content. Seen to fail where chunks are not compared."""
    chance = random.Random(SEED)
    text = manifest_of(robot.blob, header_of(robot.blob))
    signatures = robot.sign(text, "alice", "bob")
    before = robot.digest()

    def flip(what: str) -> str:
        content = bytearray(what.encode())
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(7)
        return content.decode("latin-1")

    for number in range(flips // 5):
        offer = (flip(text), signatures) if number % 2 else (text, [signatures[0], flip_inside(signatures[1], chance)])
        with pytest.raises((robot.module.Refused, ValueError)):
            robot.begin(*offer)
    assert robot.digest() == before
    robot.begin(text, signatures)
    robot.run("copy")
    before = robot.digest()
    for _ in range(flips - flips // 5):
        number = chance.randrange(10, 40)
        content = bytearray(robot.blob[number * CHUNK : (number + 1) * CHUNK])
        content[chance.randrange(CHUNK)] ^= 1 << chance.randrange(8)
        with pytest.raises(robot.module.Refused, match="not what the release says"):
            robot.run("write", number.to_bytes(4, "little") + CHUNK.to_bytes(4, "little") + content)
    assert robot.digest() == before


def flip_inside(signature: str, chance: random.Random) -> str:
    """Another letter somewhere in the armoured part."""
    lines = signature.splitlines()
    number = chance.randrange(1, len(lines) - 2)
    place = chance.randrange(len(lines[number]))
    letter = chance.choice([each for each in "ABCDabcd0123" if each != lines[number][place]])
    lines[number] = lines[number][:place] + letter + lines[number][place + 1 :]
    return "\n".join(lines) + "\n"


def pack(file: Path, text: str, signatures: list[str], content: bytes) -> Path:
    """A bundle, as bundle.py makes it."""
    signed = {f"manifest.json.{n}.sig": signature.encode() for n, signature in enumerate(signatures)}
    with tarfile.open(file, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name, each in ({"manifest.json": text.encode()} | signed | {"slot.img": content}).items():
            member = tarfile.TarInfo(name)
            member.size = len(each)
            archive.addfile(member, io.BytesIO(each))
    return file


def test_a_bundle_is_read_as_it_was_made(robot: Robot, tmp_path: Path) -> None:
    """The station's half: which chunks it sends."""
    text = manifest_of(robot.blob, header_of(robot.blob))
    file = pack(tmp_path / "smartcoret3.bundle", text, robot.sign(text, "alice", "bob"), robot.blob)
    bundle = release.read(file)
    told = robot.run("begin", bundle.offer)
    robot.run("copy")
    for batch in bundle.chunks(told["missing"], 5 * CHUNK):
        robot.run("write", batch)
    assert robot.run("finish")["staged"]
    with file.open("r+b") as cut:
        cut.truncate(file.stat().st_size // 2)
    with pytest.raises(UserError, match=r"is no bundle|is cut off"):
        release.read(file)
