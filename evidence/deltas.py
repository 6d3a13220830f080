"""Ways to bring a release to robots that have the one before, measured: `python -m evidence.deltas OLD NEW`.

OLD and NEW are what a slot holds. Memory is the peak of the process that applies the delta on the robot. The record
docs/decisions/0051-vcdiff-deltas.md has the figures on which was decided.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.updates import delta

_PACKAGES = Path(__file__).with_name("deltas-packages.txt")
_PATCH = paths.BUILD / "runtime" / "flotilla-patch"


@dataclass(frozen=True)
class Way:
    """How a delta is made, and applied; in both commands OLD, NEW and DELTA stand for files."""

    name: str
    make: Sequence[str]
    """Writes DELTA."""
    apply: Sequence[str]
    """Writes the release to standard output, or into RESULT."""


def ways() -> list[Way]:
    """The ways that are compared; xdelta3 is the locked one."""
    xdelta = delta.command()
    source = (*xdelta, "-d", "-c", "-s", "OLD", "DELTA")
    encode = (*xdelta, "-e", "-f", "-9", "-n", "-A", "-S", "none", "-W", str(delta.WINDOW))
    return [
        Way("xdelta3, applied by flotilla-patch", (), (str(_PATCH), "OLD")),
        Way("the same, applied by xdelta3, source window 4 MiB", (), (*source[:-3], "-B", "4194304", *source[-3:])),
        *(
            Way(
                f"xdelta3, source window {size} MiB on both sides",
                (*encode, "-B", str(size << 20), "-s", "OLD", "NEW", "DELTA"),
                (*source[:-3], "-B", str(size << 20), *source[-3:]),
            )
            for size in (1, 8)
        ),
        Way(
            "zstd -19 --patch-from",
            ("zstd", "-q", "-f", "-19", "--long=27", "--patch-from=OLD", "NEW", "-o", "DELTA"),
            ("zstd", "-q", "-d", "-c", "--long=27", "--patch-from=OLD", "DELTA"),
        ),
        Way("bsdiff", ("bsdiff", "OLD", "NEW", "DELTA"), ("bspatch", "OLD", "RESULT", "DELTA")),
    ]


def chunks(old: Path, new: Path, size: int) -> int:
    """Bytes of the chunks of `new`, all of one size, that `old` lacks."""

    def pieces(path: Path) -> list[bytes]:
        content = path.read_bytes()
        return [content[at : at + size] for at in range(0, len(content), size)]

    known = {hashlib.sha256(piece).digest() for piece in pieces(old)}
    return sum(len(piece) for piece in pieces(new) if hashlib.sha256(piece).digest() not in known)


def _measure(way: Way, old: Path, new: Path, work: Path) -> str:
    files = {"OLD": old, "NEW": new, "DELTA": work / "delta", "RESULT": work / "result"}

    def named(command: Sequence[str]) -> list[str]:
        return [command[0], *(_replaced(word, files) for word in command[1:])]

    began = time.monotonic()
    if way.make:
        files["DELTA"].unlink(missing_ok=True)
        subprocess.run(named(way.make), check=True)
    else:
        delta.make(old, new, files["DELTA"])
    made = time.monotonic()
    argv = ["/usr/bin/time", "-f", "%M", "-o", str(work / "memory"), *named(way.apply)]
    with files["DELTA"].open("rb") as source, files["RESULT"].open("wb") as result:
        subprocess.run(argv, stdin=source, stdout=result, check=True)
    applied = time.monotonic()
    if files["RESULT"].read_bytes() != new.read_bytes():
        raise UserError(f"{way.name}: the result is not {new}")
    memory = int((work / "memory").read_text()) / 1024
    size = files["DELTA"].stat().st_size
    return f"{way.name:50} {size:>12,} B {made - began:8.1f} s {applied - made:8.1f} s {memory:8.1f} MiB"


def _replaced(word: str, files: dict[str, Path]) -> str:
    for name, path in files.items():
        word = str(path) if word == name else word.replace(f"={name}", f"={path}")
    return word


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    arguments = parser.parse_args()
    subprocess.run([paths.PROJECT / "images" / "install-host-packages", _PACKAGES], check=True)
    subprocess.run(["make", "-C", str(paths.PROJECT), "runtime"], check=True)
    print(f"{'':50} {'delta':>14} {'make':>10} {'apply':>10} {'memory':>12}")
    print(f"{'whole':50} {arguments.new.stat().st_size:>12,} B")
    for size in (1 << 20, 1 << 16, 1 << 12):
        print(f"{f'chunks of {size >> 10} KiB':50} {chunks(arguments.old, arguments.new, size):>12,} B")
    with tempfile.TemporaryDirectory(dir=paths.BUILD) as work:
        for way in ways():
            print(_measure(way, arguments.old.resolve(), arguments.new.resolve(), Path(work)), flush=True)


if __name__ == "__main__":
    main()
