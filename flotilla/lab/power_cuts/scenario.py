"""What happens to robots, and what of it is a mistake: recordings that are replayed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from flotilla.debian.tools import Tools
from flotilla.fleet.model import Board
from flotilla.lab.power_cuts import layout_1, releases
from flotilla.lab.power_cuts.layout_2 import STATE_COPIES, Blob, Robot, blob, new_card
from flotilla.lab.power_cuts.replay import Recording
from flotilla.lab.power_cuts.write_log import Entry, LogWriter, WriteLog
from flotilla.lab.qemu.timing import LabError
from flotilla.updates import bundle

_PART = 64 << 10
"""Bytes of the kernel and of the initramfs of a small release."""


def update(board: Board, tools: Tools, directory: Path, flotilla_slot: Path, *, mib: int) -> Recording:
    """An update that is interrupted and resumed, its trial, its confirmation, and a start after that.

    `flotilla_slot`: the program, built for this computer; `mib`: size of the releases, whose content is random.
    """
    return _Life(board, tools, directory, flotilla_slot, mib).update()


def life(board: Board, tools: Tools, directory: Path, flotilla_slot: Path, *, mib: int) -> Recording:
    """The same, then a second update that fails its trial, is tried again and confirmed."""
    robot = _Life(board, tools, directory, flotilla_slot, mib)
    robot.update()
    return robot.second_update()


class _Life:
    def __init__(self, board: Board, tools: Tools, directory: Path, flotilla_slot: Path, mib: int) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._old, self._new, self._newer = (
            _blob(name, number, directory, mib, board) for number, name in enumerate(("old", "new", "newer"), 1)
        )
        self._robot = Robot(board, new_card(board, tools, directory, self._old), directory / "robot", flotilla_slot)

    def update(self) -> Recording:
        robot, new = self._robot, self._new
        robot.may_start("old")
        self._start("old")
        robot.update(new, upto=len(new.content) // bundle.CHUNK_BYTES // 2)
        self._start("old")
        robot.update(new)
        self._try("B", "old", "new")
        self._confirm("new")
        return robot.recording([("A", self._old), ("B", new)])

    def second_update(self) -> Recording:
        robot = self._robot
        robot.update(self._newer)
        self._try("A", "new", "newer")
        self._start("new")  # nobody has confirmed the other
        robot.may_start("new")
        self._start("new")
        self._try("A", "new", "newer")
        self._confirm("newer")
        return robot.recording([("A", self._old), ("B", self._new), ("A", self._newer)])

    def _try(self, slot: str, before: str, after: str) -> None:
        self._robot.may_start(before, after)
        self._robot.slot("trial", slot)
        self._start(after)

    def _confirm(self, release: str) -> None:
        self._robot.slot("confirm")
        self._robot.may_start(release)
        self._start(release)

    def _start(self, release: str) -> None:
        """Power on, and do what every start does when the robot is up."""
        started = self._robot.power_on()
        if started.release != release or not started.whole:
            raise LabError(f"{started} where release {release} should have been started")
        self._robot.slot("started")


def earlier(board: Board, tools: Tools, directory: Path, mistake: layout_1.Mistake) -> Recording:
    """An update on a card of the first layout, with a mistake."""
    directory.mkdir(parents=True, exist_ok=True)
    old, new = (
        releases.make(name, directory, root=4 * _PART, kernel=_PART, initramfs=_PART) for name in ("old", "new")
    )
    return layout_1.Card(board, tools, directory / "card", old).update(new, directory / "writes.log", mistake)


def without_flushes(recording: Recording) -> Recording:
    """As if programs waited for the card nowhere."""

    def change(log: WriteLog, entry: Entry, out: LogWriter) -> None:
        if entry.flush and not entry.count:
            out.mark("no flush")
        else:
            out.copy(log, replace(entry, flush=False, fua=False))

    return _changed(recording, change)


def with_one_copy(recording: Recording) -> Recording:
    """As if there were one copy of the boot state, written in its place."""

    def change(log: WriteLog, entry: Entry, out: LogWriter) -> None:
        first, second = (each.start for each in STATE_COPIES)
        out.copy(log, entry, sector=first if entry.sector == second and entry.count else None)

    return _changed(recording, change)


MISTAKES: Mapping[str, Callable[[Recording], Recording]] = {
    "no flush": without_flushes,
    "one copy": with_one_copy,
}
"""Variations of a recording that the replay must find out."""


def _changed(recording: Recording, change: Callable[[WriteLog, Entry, LogWriter], None]) -> Recording:
    """A recording with other entries in the same places."""
    out = recording.log.with_suffix(".changed")
    with WriteLog(recording.log) as log, LogWriter(out) as written:
        for entry in log.entries:
            change(log, entry, written)
    return replace(recording, log=out)


def _blob(name: str, number: int, directory: Path, mib: int, board: Board) -> Blob:
    root = (mib << 20) - 2 * _PART
    return blob(releases.make(name, directory, root=root, kernel=_PART, initramfs=_PART), number, board)
