"""Parsers of strangers' bytes that are written in Python, as functions of any bytes: each may only raise what it
documents. `python -m tests.fuzz` runs libFuzzer on them, and tests/unit/test_fuzz_targets.py their seeds.

Seeds lie in the folder `corpus`, by target: what robots, stations and browsers really send.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import tempfile
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from ipaddress import IPv4Address
from pathlib import Path
from types import ModuleType

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet.model import Robot
from flotilla.robot import answers
from flotilla.station import mcap_reader, page_requests, recording, services

CORPUS = Path(__file__).with_name("corpus")
UPDATE = paths.OVERLAY / "usr/lib/flotilla/update.py"
ROBOT = Robot(
    name="robot3", number=3, board="smartcoret3", address=IPv4Address("10.0.0.3"), control_tasks=["valves", "sensors"]
)
HEADER = {
    "RELEASE": "5", "FLOOR": "3", "BOARD": "smartcoret3", "LAYOUT": "2", "VERSION": "6.1", "BYTES": "8192",
    "BLOB": "0" * 64, "KERNEL": "0+8", "INITRD": "", "KEYS": "8+8", "ARGUMENTS": "ro",
}  # fmt: skip
"""Of the release that runs."""
_SLOT_BYTES = 1 << 20


class UnfitError(Exception):
    """A parser accepted an input that it must reject."""


def page(data: bytes) -> None:
    """A browser's request to the station."""
    page_requests.read(data)


def status(data: bytes) -> None:
    """Two rounds of a robot's report of its control tasks: the second is compared with the first."""
    lines = data.decode(errors="replace").splitlines(keepends=True)
    before: Mapping[str, services.State] = {}
    for each in (lines, lines):
        answer = services.read_round(ROBOT, each, before)
        before = answer.tasks
        for text in (*answer.notes, *(state.words for state in answer.tasks.values())):
            _check_printable(text)


def state(data: bytes) -> None:
    """A robot's answer to provisioning, which Ansible has read as JSON."""
    with contextlib.suppress(RecursionError):  # Ansible's own error
        answer = answers.judged(ROBOT.name, json.loads(data), answers.State)
        text = json.dumps(answer, allow_nan=False, ensure_ascii=False)
        _check_printable(text)


def manifest(data: bytes) -> None:
    """A release's manifest on a robot, after its signatures were verified: nothing of the slot changes by it."""
    update = _update()
    slot = _Slot.written = bytearray(_SLOT_BYTES)
    release = update.Release(data.decode(errors="replace"), [])
    release.missing()
    release.said([])
    if any(slot):
        raise UnfitError("the manifest alone changed the slot")


def chunks(data: bytes) -> None:
    """Chunks of a release, as a station sends them to a robot."""
    for number, content in _update().frames(io.BytesIO(data)):
        if not 0 <= number < 1 << 32 or len(content) > 1 << 18:
            raise UnfitError(f"chunk {number} of {len(content)} bytes")


def record(data: bytes) -> None:
    """A recording of a robot's; both readers find the same records."""
    whole = recording.parse(data)
    with _file(data) as file:
        found = recording.Found()
        counted = sum(len(chunk) for chunk in recording.chunks(file, found))
        recording.ends(file)
    if not counted == found.records == len(whole.records) or found.damaged != whole.damaged:
        raise UnfitError(f"{counted} and {len(whole.records)} records")


def mcap(data: bytes) -> None:
    """A recording of a station's."""
    with _file(data) as file:
        mcap_reader.read(file, mcap_reader.Damage())


Target = Callable[[bytes], None]
TARGETS: dict[str, tuple[Target, tuple[type[Exception], ...]]] = {
    "chunks": (chunks, ()),
    "manifest": (manifest, ()),
    "mcap": (mcap, (UserError,)),
    "page": (page, (page_requests.NoRequestError,)),
    "record": (record, (recording.RecordingError,)),
    "state": (state, (UserError, ValueError)),
    "status": (status, (UserError,)),
}
"""By name: the parser, and what it raises where the bytes are none of its own. Those of update.py: its own too."""


def accepts(name: str, data: bytes) -> bool:
    """Whether the parser takes it; raises what the parser must not raise."""
    target, documented = TARGETS[name]
    if name in ("chunks", "manifest"):
        documented = _update().INVALID
    try:
        target(data)
    except documented:
        return False
    return True


def _check_printable(text: str) -> None:
    """For a terminal: by Unicode's own categories, tabs alone excepted."""
    for each in text.replace("\t", ""):
        if unicodedata.category(each) in ("Cc", "Cs", "Zl", "Zp") or unicodedata.bidirectional(each) in _DIRECTIONS:
            raise UnfitError(f"{text!r} would control a terminal")


_DIRECTIONS = {"LRE", "RLE", "PDF", "LRO", "RLO", "LRI", "RLI", "FSI", "PDI"}
"""Of characters that turn the text around them."""


@contextlib.contextmanager
def _file(data: bytes) -> Iterator[Path]:
    with tempfile.NamedTemporaryFile(dir="/dev/shm") as file:
        file.write(data)
        file.flush()
        yield Path(file.name)


class _Slot:
    """In memory."""

    written = bytearray()
    name, size = "A", _SLOT_BYTES

    def __init__(self, name: str, slots: object, *, writable: bool = False) -> None:
        self.name = name

    def header(self) -> dict[str, str]:
        return HEADER

    def read(self, offset: int, length: int) -> bytes:
        return bytes(length)

    def write(self, offset: int, content: bytes) -> None:
        self.written[offset : offset + len(content)] = content


def _update() -> ModuleType:
    """The robot's program, whose card is in memory and whose signatures are good."""
    if not _loaded:
        specification = importlib.util.spec_from_file_location("update", UPDATE)
        assert specification
        assert specification.loader
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
        replaced = {
            "slots": lambda: {"running": "A", "trial": ""},
            "Slot": _Slot,
            "keys_of": lambda *_: {},
            "verify": lambda *_: None,
        }
        vars(module).update(replaced)
        _loaded.append(module)
    return _loaded[0]


_loaded: list[ModuleType] = []
