"""Cards as they are built, with small releases, and what really writes them while software is updated.

The boot loader's writes are GRUB's, those of the boot state are flotilla-slot's, on this computer: QEMU's storage
daemon gives it the card as a file, and logs what arrives, as QEMU does when the boot loader runs.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.processes import DIE_WITH_PARENT
from flotilla.debian.tools import Tools
from flotilla.fleet.model import Board
from flotilla.images import card, environment_block
from flotilla.lab.power_cuts.releases import Release
from flotilla.lab.power_cuts.replay import Recording
from flotilla.lab.power_cuts.starter import Started, Starter
from flotilla.lab.power_cuts.timeline import Read
from flotilla.lab.power_cuts.write_log import SECTOR, count_entries
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.timing import LabError
from flotilla.updates import bundle

_PARTS = ("KERNEL", "INITRD", "KEYS")
_UPDATE = paths.PROJECT / "rootfs_overlay" / "usr" / "lib" / "flotilla" / "update.py"
_ON_THIS_COMPUTER = """
import importlib.util, sys
_, source, disk, known, *sys.argv[1:] = sys.argv
spec = importlib.util.spec_from_file_location("update", source)
update = importlib.util.module_from_spec(spec)
spec.loader.exec_module(update)
update.disk = lambda: disk
update.KNOWN = known
update.verify = update.yield_to_tasks = lambda *_: None
sys.exit(update.main())
"""
"""Runs the robot's update.py with another card, other places, signatures as they are and at its usual priority."""


_BATCH = 32
"""Chunks that a station sends at a time."""


def sectors(start: int, size: int) -> range:
    """Of bytes of the card."""
    return range(start // SECTOR, -(-(start + size) // SECTOR))


def frame(number: int, content: bytes) -> bytes:
    """A chunk as update.py's `write` reads it."""
    return struct.pack("<II", number, len(content)) + content


def header_sectors(partition: card.Partition) -> range:
    return sectors(partition.end - card.HEADER_ROOM, card.HEADER_BYTES)


STATE_COPIES = [sectors(card.STATE.start + place, SECTOR) for place in card.COPIES]
TRIES = sectors(card.STATE.start, card.TRIES + SECTOR)


class Layout2:
    """What the boot chain reads of a card: MBR, GRUB, boot state, headers; of a slot with a header its kernel."""

    def __init__(self, loaded: Mapping[str, Sequence[range]]) -> None:
        """`loaded`: where kernels and initramfs lie in each slot, of all releases together."""
        self.loaded = loaded
        self.slots = {each.name: each.start // SECTOR for each in card.SLOTS}
        self.damaged = [range(card.DATA.start // SECTOR)]
        self.always = [range(card.STATE.start // SECTOR), TRIES, *STATE_COPIES, *map(header_sectors, card.SLOTS)]
        self._headers = {each.name: header_sectors(each) for each in card.SLOTS}

    def startable(self, slot: str, read: Read) -> bool:
        found = [read(sector) for sector in self._headers[slot]]
        header = b"".join(each for each in found if each is not None)
        return None not in found and bool(environment_block.values(header).get("KERNEL"))


@dataclass(frozen=True)
class Blob:
    """What a slot holds of a release."""

    name: str
    content: bytes
    header: Mapping[str, str]
    loaded: Sequence[range]
    """Kernel and initramfs, in sectors of the slot."""


def blob(release: Release, number: int, board: Board) -> Blob:
    """A release as a slot holds it, with the header that the builder writes."""
    keys = json.dumps({"signatures": 0, "keys": []}).encode().ljust(SECTOR)
    parts = [release.root, release.kernel, release.initramfs, keys]
    places = [range(0)]
    for part in parts:
        places.append(range(places[-1].stop, places[-1].stop + len(part) // SECTOR))
    _, _, kernel, initramfs, trusted = places
    content = b"".join(parts)
    header = {
        "RELEASE": str(number),
        "FLOOR": "1",
        "BOARD": board.name,
        "LAYOUT": str(card.LAYOUT.layout),
        "VERSION": "stub",
        "BYTES": str(len(content)),
        "BLOB": hashlib.sha256(content).hexdigest(),
        **{name: f"{each.start}+{len(each)}" for name, each in zip(_PARTS, (kernel, initramfs, trusted), strict=True)},
        "ARGUMENTS": "quiet",
    }
    return Blob(release.name, content, header, [kernel, initramfs])


def new_card(board: Board, tools: Tools, directory: Path, first: Blob) -> Path:
    """A card with this release in slot A; the builder's, all but the slot's content."""
    header = environment_block.make(first.header, card.HEADER_BYTES)
    digest = hashlib.sha256(first.content + header).hexdigest()
    content = directory / f"slot-{digest[:16]}"
    content.mkdir(parents=True, exist_ok=True)
    (content / "slot.img").write_bytes(first.content)
    (content / "header").write_bytes(header)
    return card.base(board, content, tools, 0) / "card.img"


class Robot:
    """A robot whose card is logged from its first start on. What runs on it, runs here."""

    def __init__(self, board: Board, image: Path, directory: Path, flotilla_slot: Path) -> None:
        """`image`: the card, which stays as it is; `flotilla_slot`: the program, built for this computer."""
        directory.mkdir(parents=True, exist_ok=True)
        self._board = board
        self._program = flotilla_slot
        self._directory = directory
        self.base = image
        self._card = directory / "card"
        self.log = directory / "writes.log"
        subprocess.run(["cp", "--sparse=always", str(image), str(self._card)], check=True)
        self.log.write_bytes(b"")
        self.running = "A"
        self.phases: list[tuple[int, frozenset[str]]] = []

    def may_start(self, *releases: str) -> None:
        """From this moment on, only these releases may be started."""
        self.phases.append((count_entries(self.log), frozenset(releases)))

    def power_on(self) -> Started:
        """Let the boot loader start a slot."""
        with Starter(self._board, self._card, self._directory / "boot", log_writes=self.log) as starter:
            started = starter.power_on()
        if started.slot is None:
            raise LabError(f"the boot loader started nothing; see {self._directory / 'boot'}")
        self.running = started.slot
        return started

    def slot(self, *arguments: str) -> str:
        """What flotilla-slot says."""
        with self._mounted() as file:
            return self._slot(file, *arguments)

    def update(self, brought: Blob, *, upto: int | None = None) -> None:
        """Bring a release to the slot that does not run, as a station does.

        `upto`: only so many of the chunks that the slot lacks, and no header: the power is cut then.
        """
        (self._directory / brought.name).mkdir(exist_ok=True)
        (self._directory / brought.name / "slot.img").write_bytes(brought.content)
        (self._directory / brought.name / "header.json").write_text(json.dumps(brought.header))
        manifest = bundle.manifest_of(self._directory / brought.name, {}).decode()
        with self._mounted() as file:
            answer = self._update(file, "begin", json.dumps({"manifest": manifest, "signatures": []}).encode())
            size = int(answer["chunk_bytes"])
            chunks = [(number, brought.content[number * size :][:size]) for number in answer["missing"][:upto]]
            for start in range(0, len(chunks), _BATCH):
                batch = chunks[start : start + _BATCH]
                self._update(file, "write", b"".join(frame(*chunk) for chunk in batch))
            if upto is None and not self._update(file, "finish")["staged"]:
                raise LabError(f"update.py did not stage {brought.name}")

    def recording(self, contents: Sequence[tuple[str, Blob]]) -> Recording:
        """`contents`: slots and what they held at any time."""
        starts = {each.name: each.start // SECTOR for each in card.SLOTS}
        loaded: dict[str, list[range]] = {name: [] for name in starts}
        releases: dict[str, dict[str, bytes]] = {}
        for name, held in contents:
            releases.setdefault(held.name, {})[name] = held.content
            loaded[name] += [range(starts[name] + each.start, starts[name] + each.stop) for each in held.loaded]
        return Recording(self.base, self.log, Layout2(loaded), releases, self.phases, [*TRIES])

    def _slot(self, file: Path, *arguments: str) -> str:
        return self._ran([str(self._program), "--disk", str(file), "--running", self.running, *arguments])

    def _update(self, file: Path, command: str, content: bytes = b"") -> dict[str, Any]:
        programs = self._directory / "programs"
        programs.mkdir(exist_ok=True)
        script = f"#!/bin/sh\nexec {shlex.quote(str(self._program))} --disk {shlex.quote(str(file))} "
        script += f'--running {self.running} "$@"\n'
        (programs / "flotilla-slot").write_text(script)
        (programs / "flotilla-slot").chmod(0o755)
        argv = [
            sys.executable,
            "-c",
            _ON_THIS_COMPUTER,
            str(_UPDATE),
            str(file),
            str(self._directory / "known"),
            command,
        ]
        answer: dict[str, Any] = json.loads(
            self._ran(argv, content, {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"})
        )
        return answer

    def _ran(self, argv: Sequence[str], content: bytes = b"", environment: Mapping[str, str] | None = None) -> str:
        done = subprocess.run(argv, input=content, capture_output=True, env=environment, check=False)
        if done.returncode:
            raise LabError(f"{' '.join(argv[-2:])}: {done.stderr.decode().strip()}")
        return done.stdout.decode()

    @contextmanager
    def _mounted(self) -> Iterator[Path]:
        """The card as a file, of which each write is logged."""
        if not Path("/dev/fuse").exists():
            raise UserError("/dev/fuse is missing on this computer; load the kernel's module: sudo modprobe fuse")
        if os.geteuid() != 0 and not shutil.which("fusermount3"):
            raise UserError("fusermount3 is missing on this computer; install it: sudo apt-get install fuse3")
        export = self._directory / "exported"
        export.touch()
        node = qemu.logged({"driver": "file", "filename": str(self._card), "cache": {"no-flush": True}}, self.log)
        errors = self._directory / "storage-daemon.stderr"
        ours, theirs = socket.socketpair()
        with ours, errors.open("wb") as stderr:
            with theirs:
                argv = [
                    *DIE_WITH_PARENT, qemu.find_tool("qemu-storage-daemon"),
                    "--blockdev", json.dumps(node | {"node-name": "card"}),
                    "--export", f"type=fuse,id=card,node-name=card,mountpoint={export},writable=on",
                    "--chardev", qemu.chardev("qmp", qemu.inherited_socket(theirs.fileno())),
                    "--monitor", "chardev=qmp",
                ]  # fmt: skip
                daemon = subprocess.Popen(argv, stderr=stderr, pass_fds=[theirs.fileno()])
            try:
                if not ours.recv(4096):  # its greeting comes when all is set up
                    raise LabError(f"qemu-storage-daemon ended: {errors.read_text().strip()}")
                yield export
            finally:
                daemon.terminate()
                status = daemon.wait()
        if status:
            raise LabError(f"qemu-storage-daemon ended with status {status}: {errors.read_text().strip()}")
