"""Releases, from the station's side: what a bundle holds, which chunks a robot lacks, and what a robot should run.

A bundle is made by `flotilla/updates/bundle.py`. The robot's side is `/usr/lib/flotilla/update.py`.
"""

from __future__ import annotations

import json
import struct
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.text import day
from flotilla.fleet.model import Robot


@dataclass(frozen=True)
class Bundle:
    """An update bundle, opened."""

    path: Path
    manifest: str
    """The text that is signed."""
    signatures: tuple[str, ...]
    start: int
    """Where the slot's content lies in the file."""

    @property
    def header(self) -> dict[str, str]:
        """What the slot's header will say."""
        header: dict[str, str] = json.loads(self.manifest)["header"]
        return header

    @property
    def expires(self) -> str:
        """Last day on which robots accept it, such as 2027-01-31, in UTC; empty if the bundle does not expire."""
        return str(json.loads(self.manifest).get("expires", ""))

    def expired(self, today: date) -> str:
        """The message that robots may reject it from now on; empty before its last day is over."""
        if not self.expires or today.isoformat() <= self.expires:
            return ""
        return (
            f"{paths.shown(self.path)}: release {self.header['RELEASE']} expired on {self.expires}, so robots with the "
            f"time of a station reject it; make it again: make bundle BOARD={self.header['BOARD']}"
        )

    def offer(self, accept_old: int | None = None) -> bytes:
        """The input of the robot's `begin`. `accept_old`: number of a release that it accepts although it is old."""
        offered = {"manifest": self.manifest, "signatures": self.signatures}
        return json.dumps(offered if accept_old is None else offered | {"accept_old": accept_old}).encode()

    def extract(self, to: Path) -> None:
        """Write the slot's content to a file."""
        with self.path.open("rb") as file, to.open("wb") as out:
            file.seek(self.start)
            left = int(self.header["BYTES"])
            while left:
                left -= out.write(file.read(min(left, 1 << 20)))

    def length(self, numbers: Sequence[int]) -> int:
        """Bytes of these chunks."""
        described = json.loads(self.manifest)
        length, size = int(described["chunk_bytes"]), int(described["header"]["BYTES"])
        return sum(min(length, size - number * length) for number in numbers)

    def has(self, numbers: Sequence[int]) -> bool:
        """Whether there are chunks of these numbers, none twice."""
        described = json.loads(self.manifest)
        count = -(-int(described["header"]["BYTES"]) // int(described["chunk_bytes"]))
        return all(0 <= number < count for number in numbers) and len(set(numbers)) == len(numbers)

    def delta(self, told: Mapping[str, Any]) -> Path | None:
        """The delta for a robot that said `told`; None where there is none, or what it lacks is less."""
        file = delta_of(told["base"], self.header["BLOB"])
        return file if file.exists() and file.stat().st_size < self.length(told["missing"]) else None

    def chunks(self, numbers: Sequence[int], batch_bytes: int) -> Iterator[bytes]:
        """These chunks as the robot's `write` reads them, about `batch_bytes` at a time."""
        described = json.loads(self.manifest)
        length = described["chunk_bytes"]
        size = int(described["header"]["BYTES"])
        batch = b""
        with self.path.open("rb") as file:
            for number in numbers:
                file.seek(self.start + number * length)
                content = file.read(min(length, size - number * length))
                batch += struct.pack("<II", number, len(content)) + content
                if len(batch) >= batch_bytes:
                    yield batch
                    batch = b""
        if batch:
            yield batch


def read(path: Path) -> Bundle:
    """The bundle in a file. Who signed it, robots find out."""
    try:
        with tarfile.open(path, "r:") as archive:
            members = {member.name: member for member in archive}
            content = members["slot.img"]
            texts = {
                name: (archive.extractfile(member) or archive).read().decode()  # type: ignore[union-attr]
                for name, member in members.items()
                if name.startswith("manifest.json")
            }
        manifest = json.loads(texts["manifest.json"])
        size = int(manifest["header"]["BYTES"])
    except FileNotFoundError:
        raise UserError(f"{paths.shown(path)} is missing; make it: `make bundle BOARD={path.stem}`") from None
    except (KeyError, TypeError, ValueError, RecursionError, tarfile.TarError) as error:
        raise UserError(f"{paths.shown(path)} is no bundle: {error!r}; make it again: `make bundle`") from error
    signatures = tuple(each for name, each in sorted(texts.items()) if name.endswith(".sig"))
    if content.size != size:
        raise UserError(f"{paths.shown(path)} is cut off; make it again: `make bundle BOARD={path.stem}`")
    try:
        if "expires" in manifest:
            day(manifest["expires"])
    except ValueError as error:
        raise UserError(
            f"{paths.shown(path)}: manifest.json: expires={manifest['expires']}: {error}; make the bundle again: `make "
            f"bundle BOARD={path.stem}`"
        ) from None
    return Bundle(path, texts["manifest.json"], signatures, content.offset_data)


def same_number(before: Bundle, after: Bundle) -> str:
    """The message that robots take two releases for equally new; empty if they differ in nothing or in their number."""
    number = after.header["RELEASE"]
    if before.header["RELEASE"] != number or before.header == after.header:
        return ""
    return (
        f"{paths.shown(after.path)}: note: the bundle before it has other content and the same number, {number}; raise "
        "`release:` in images/release.yml, so that robots reject the earlier one"
    )


def delta_of(base: str, content: str) -> Path:
    """Where the delta lies that makes one slot's content of another; both by their SHA-256."""
    return paths.BUNDLES / "deltas" / f"{base[:16]}-{content[:16]}"


def wanted(robot: Robot) -> str | None:
    """SHA-256 of what the running slot of a robot holds if its release is that of its image here; None without one."""
    try:
        told: dict[str, Any] = json.loads((paths.IMAGES / f"{robot.name}.manifest.json").read_bytes())
        return next((part["sha256"] for part in told["parts"] if part["name"] == "slot.img"), None)
    except FileNotFoundError:
        return None
