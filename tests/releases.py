"""Releases that tests bring to robots: what a board ships, with /new besides: some bytes, and what makes releases bad.

A release that is to go wrong differs from one that does well by its header alone, in a boot argument. So all of them
have one content, which a robot is sent once, by a delta from what it runs.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from flotilla.debian import runtime
from flotilla.fleet import release_keys
from flotilla.fleet.model import Releases
from flotilla.images import slot
from flotilla.images.build import BoardBuild
from flotilla.lab.staging.virtual import OVERRUN
from flotilla.updates import bundle

SEED, NEW_BYTES = 1, 2 << 20
"""What a delta cannot take from what a robot has: about as much as when a library of many programs is replaced."""
PREINIT = "init=/usr/lib/flotilla/preinit"
ARGUMENTS: Mapping[str, tuple[str, str]] = {
    "panic": (PREINIT, "init=/nonexistent"),
    # Waits for input, and leaves the watchdog as the boot loader started it.
    "hang before systemd": (PREINIT, "init=/bin/cat"),
    "no network": ("quiet", "quiet module_blacklist=e100"),
    # The eight-port board's ports have no driver.
    "dead sensor": ("8250.nr_uarts=16", "8250.nr_uarts=4"),
    "overruns": ("quiet", "quiet systemd.setenv=LD_PRELOAD=/new/overrun.so"),
    "service manager hangs": (PREINIT, "init=/new/freeze"),
}
"""How bad releases go wrong: a boot argument, and what stands in its place."""
FREEZE = """#!/bin/busybox sh
# The shipped first program, and a fault that the service manager does not survive: it freezes then, and serves nothing.
(
    until busybox pidof sshd >/dev/null; do busybox sleep 1; done
    busybox sleep 5
    kill -SEGV 1
) &
exec /usr/lib/flotilla/preinit "$@"
"""


@dataclass(frozen=True)
class Content:
    """What a slot holds, and its header."""

    directory: Path
    """With `slot.img` and `header.json`."""

    @property
    def header(self) -> dict[str, str]:
        header: dict[str, str] = json.loads((self.directory / "header.json").read_text())
        return header

    def release(self, number: int, directory: Path, fault: str = "", more: str = "") -> Content:
        """The same content as another release: with boot arguments that lead to a fault, and `more` of them."""
        words = self.header["ARGUMENTS"].split()
        if fault:
            replaced, by = ARGUMENTS[fault]
            words[words.index(replaced)] = by
        header = self.header | {"RELEASE": str(number), "ARGUMENTS": " ".join([*words, *more.split()])}
        (directory / "slot.img").hardlink_to(self.directory / "slot.img")
        (directory / "header.json").write_text(json.dumps(header))
        return Content(directory)

    def bundle(self, releases: Releases) -> Path:
        """Beside it, signed."""
        file = self.directory / "release.bundle"
        bundle.pack(file, self.directory, releases, {}, 0, expires=date(2099, 12, 31))
        return file


def successor(made: BoardBuild, releases: Releases, directory: Path) -> Content:
    """What the board ships, with /new; what is shipped lies where it did."""
    root, new, out = directory / "root", directory / "new", directory / "slot"
    for each in (root, new, out):
        each.mkdir()
    (new / "bytes").write_bytes(random.Random(SEED).randbytes(NEW_BYTES))
    (new / "overrun.so").write_bytes(runtime.compile_plugin(OVERRUN, made.board.system))
    (new / "freeze").write_text(FREEZE)
    for program in ("overrun.so", "freeze"):
        (new / program).chmod(0o755)
    for file in made.root.iterdir():
        shutil.copyfile(file, root / file.name)
    squashfs = root / "root.squashfs"
    made.tools.run(
        "usr/bin/mksquashfs",
        new,
        squashfs,
        "-keep-as-directory",
        "-all-root",
        "-root-mode",
        "0755",
        "-no-recovery",
        "-quiet",
    )
    slot.write(made.board, root, release_keys.document(releases), slot.release(), out)
    shutil.rmtree(root)
    return Content(out)
