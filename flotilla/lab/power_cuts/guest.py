"""A robot's whole system as a guest, of whose card every write is logged while it is updated.

What differs from `layout_2.py`: releases have their real size, Linux is what writes, and the data partition is part of
the recording.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flotilla.common import paths
from flotilla.debian.tools import Tools, command
from flotilla.fleet import keys, release_keys, ssh_signatures
from flotilla.images import card, environment_block
from flotilla.lab.power_cuts import releases
from flotilla.lab.power_cuts.crash_states import CrashState
from flotilla.lab.power_cuts.layout_2 import TRIES, Layout2, frame, header_sectors
from flotilla.lab.power_cuts.replay import Recording
from flotilla.lab.power_cuts.timeline import UNREADABLE, Timeline
from flotilla.lab.power_cuts.write_log import SECTOR, WriteLog, count_entries
from flotilla.lab.qemu import qemu
from flotilla.lab.qemu.guest import Guest
from flotilla.lab.qemu.ssh import Ssh
from flotilla.lab.qemu.timing import LabError
from flotilla.updates import bundle

_UPDATE = "/usr/lib/flotilla/update.py"
_INPUT = "/tmp/input"
_SECONDS = 1200
"""Limit for what takes a minute on an idle host."""


@dataclass(frozen=True)
class Held:
    """A release as a slot holds it."""

    header: Mapping[str, str]
    content: bytes

    def loaded(self) -> Iterator[range]:
        """Kernel and initramfs, in sectors of the slot."""
        for name in ("KERNEL", "INITRD"):
            if place := self.header[name]:
                start, count = map(int, place.split("+"))
                yield range(start, start + count)


def held(image: Path) -> Held:
    """What slot A of a card holds."""
    first = card.SLOTS[0]
    with image.open("rb") as file:
        file.seek(header_sectors(first).start * SECTOR)
        header = environment_block.values(file.read(card.HEADER_BYTES))
        file.seek(first.start)
        return Held(header, file.read(int(header["BYTES"])))


def successor(present: Held) -> Held:
    """The next release: the same system, and a page more, so that no two slots hold the same."""
    content = present.content + hashlib.sha512(b"successor").digest() * (4096 // 64)
    header = {
        **present.header,
        "RELEASE": str(int(present.header["RELEASE"]) + 1),
        "BYTES": str(len(content)),
        "BLOB": hashlib.sha256(content).hexdigest(),
    }
    return Held(header, content)


def flattened(machine: Guest, out: Path) -> Path:
    """The card of a guest that is off, as a file of its own."""
    overlay = machine.directory / "card.qcow2"
    subprocess.run([qemu.find_tool("qemu-img"), "convert", "-O", "raw", str(overlay), str(out)], check=True)
    return out


class Updated:
    """A guest whose card is logged, and what may be started on it."""

    def __init__(self, machine: Guest, shell: Ssh, wait_booted: Callable[[], None], base: Path, log: Path) -> None:
        """`machine`: off, made with `base` as its image and `log` as `Options.log_writes`. `wait_booted`: until SSH."""
        self._machine = machine
        self._shell = shell
        self._wait_booted = wait_booted
        self._base = base
        self._log = log
        self._phases: list[tuple[int, frozenset[str]]] = [(0, frozenset({"old"}))]

    def update(self, directory: Path) -> Recording:
        """An update that power cuts in its midst, its trial, its confirmation, and a start after that."""
        directory.mkdir(parents=True, exist_ok=True)
        old = held(self._base)
        new = successor(old)
        manifest = _manifest(new, directory)
        self._start()
        self._answer("begin", manifest)
        self._copy_until(len(old.content) // 2)
        self._machine.cut()
        self._start()
        self._answer("begin", manifest)
        missing = self._answer("copy")["missing"]
        chunks = [(number, new.content[number * bundle.CHUNK_BYTES :][: bundle.CHUNK_BYTES]) for number in missing]
        self._answer("write", b"".join(frame(*chunk) for chunk in chunks))
        if not self._answer("finish")["staged"]:
            raise LabError("update.py did not stage the release")
        self._may_start("old", "new")
        self._answer("activate")
        self._restart()
        self._shell.script("flotilla-slot confirm", timeout=_SECONDS)
        self._may_start("new")
        self._restart()
        self._machine.cut()
        return self._recording(old, new, directory)

    def _answer(self, what: str, content: bytes = b"") -> dict[str, Any]:
        """What update.py answers to a command with this input."""
        self._shell.write(_INPUT, content)
        output = self._shell.script(f"{_UPDATE} {what} <{_INPUT}", timeout=_SECONDS).stdout
        answer: dict[str, Any] = json.loads(output)
        return answer

    def _copy_until(self, size: int) -> None:
        """Let update.py copy what both releases have, until so many bytes are written."""
        # Sectors written: those of a partition miss what goes to the whole disk.
        seventh = "read -r _ _ _ _ _ _ n _ </sys/block/sda/stat"
        self._shell.script(
            f"{seventh}; before=$n; systemd-run --quiet --unit=copied {_UPDATE} copy; "
            f"until {seventh} && [ $((n - before)) -gt {size // SECTOR} ]; "
            "do systemctl is-active --quiet copied || exit 1; sleep 0.1; done",
            timeout=_SECONDS,
        )

    def _may_start(self, *names: str) -> None:
        self._phases.append((count_entries(self._log), frozenset(names)))

    def _start(self) -> None:
        self._machine.on()
        self._wait_booted()
        self._shell.script("systemctl is-system-running --wait", check=False, timeout=_SECONDS)

    def _restart(self) -> None:
        self._shell.run(["sudo", "systemctl", "--no-block", "reboot"])
        self._wait_booted()
        self._shell.script("systemctl is-system-running --wait", check=False, timeout=_SECONDS)

    def _recording(self, old: Held, new: Held, directory: Path) -> Recording:
        places = {"A": ("old", old), "B": ("new", new)}
        stand_ins: dict[int, dict[bytes, bytes]] = {}
        loaded: dict[str, list[range]] = {}
        for partition in card.SLOTS:
            name, release = places[partition.name]
            start = partition.start // SECTOR
            ranges = list(release.loaded())
            loaded[partition.name] = [range(start + each.start, start + each.stop) for each in ranges]
            parts = [release.content[each.start * SECTOR : each.stop * SECTOR] for each in ranges]
            for at, content in releases.stand_in(name, directory, *parts).items():
                part, number = at
                sector = start + ranges[part].start + number
                real = parts[part][number * SECTOR :][:SECTOR]
                stand_ins[sector] = {real: content}
        contents = {name: {each: release.content} for each, (name, release) in places.items()}
        return Recording(self._base, self._log, Layout2(loaded), contents, self._phases, [*TRIES], stand_ins)


def card_of(timeline: Timeline, state: CrashState, base: Path, out: Path) -> Path:
    """The card in a state, as a file; sectors that cannot be read are as before."""
    subprocess.run(["cp", "--sparse=always", str(base), str(out)], check=True)
    with out.open("r+b") as file:
        for sector, number in timeline.overlay(state).items():
            if number != UNREADABLE:
                file.seek(sector * SECTOR)
                file.write(timeline.content(number))
    return out


def states_of_data(log: WriteLog, states: Iterable[CrashState]) -> list[CrashState]:
    """Of these states, those in which writes of the data partition are lost, torn or the last that came."""
    first = card.DATA.start // SECTOR

    def is_data(index: int) -> bool:
        return index >= 0 and log.entries[index].count > 0 and log.entries[index].sector >= first

    return [
        state
        for state in states
        if is_data(state.upto if state.torn else state.upto - 1) or any(is_data(each) for each in state.lost)
    ]


def faults_of_data(
    tools: Tools, timeline: Timeline, states: Iterable[CrashState], base: Path, directory: Path
) -> Iterator[str]:
    """Of these states, those whose data partition is not sound once its journal is replayed, and what e2fsck finds.

    Linux replays the journal when it mounts the partition, by the same rules, and checks nothing.
    """
    directory.mkdir(parents=True, exist_ok=True)
    first = card.DATA.start // SECTOR
    plain, tried = directory / "data", directory / "tried"
    count = -(-(base.stat().st_size - card.DATA.start) // (1 << 20))
    copy = ["dd", f"if={base}", f"of={plain}", "bs=1M", f"skip={card.DATA.start >> 20}", f"count={count}"]
    subprocess.run([*copy, "conv=sparse", "status=none"], check=True)
    for state in states:
        subprocess.run(["cp", "--sparse=always", str(plain), str(tried)], check=True)
        with tried.open("r+b") as file:
            for sector, number in timeline.overlay(state).items():
                if sector >= first and number != UNREADABLE:
                    file.seek((sector - first) * SECTOR)
                    file.write(timeline.content(number))
        for options in (["-E", "journal_only", "-p"], ["-f", "-n"]):
            argv = [*command(tools.directory, "usr/sbin/e2fsck"), *options, str(tried)]
            done = subprocess.run(argv, capture_output=True, text=True, check=False)
            if done.returncode:
                what = f"e2fsck {' '.join(options)} ended with {done.returncode}"
                yield f"{state}: {what}: {done.stdout.strip()} {done.stderr.strip()}"
                break


def _manifest(release: Held, directory: Path) -> bytes:
    """What `update.py begin` reads, signed by the key that is here."""
    (directory / "slot.img").write_bytes(release.content)
    (directory / "header.json").write_text(json.dumps(dict(release.header)))
    text = bundle.manifest_of(directory, {})
    key = keys.usable(paths.KEYS / "release_ed25519")
    signature = ssh_signatures.sign(text, key, release_keys.NAMESPACE)
    return json.dumps({"manifest": text.decode(), "signatures": [signature.decode()]}).encode()
