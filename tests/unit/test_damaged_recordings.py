"""Recordings that were cut off or lie on bad sectors: what is whole is read, and what is not is named by its place.

500 damages by a fixed seed: half of them of a recording of `make record`, half of a recorder's three files. What is
whole is told by MCAP's own reader of the file as it was, and by the recorder's format.
"""

from __future__ import annotations

import random
import re
import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.station import convert, mcap_reader, replay, report
from flotilla.station.record import Recorder
from flotilla.station.telemetry import streams
from tests import recorder_files
from tests.station import FLEET

SECTOR = 512
STEPS = 1500
Damaged = tuple[bytes, int, int]
"""A file's content, and from where to where it is not what it was."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Of one stream, in 30 chunks."""
    file = tmp_path_factory.mktemp("whole") / "whole.mcap"
    (stream,) = (each for each in streams(inventory.load_fleet(FLEET)) if each.topic == "/robot1/valves/report")
    recorder = Recorder([stream], file)
    values: dict[str, Any] = {each.name: (0,) * each.width if each.width > 1 else 0 for each in stream.fields}
    for step in range(STEPS):
        recorder.take(stream, values | {"step": step}, 1_767_225_600_000_000_000 + step * 10_000_000)
        if step % 50 == 49:
            recorder.refresh()
    recorder.end()
    return file.read_bytes()


def damage(content: bytes, chance: random.Random, number: int) -> Damaged:
    """Cut off, a sector of zeros, of ones, of noise, or one bit."""
    if number % 2:
        cut = chance.randrange(len(content))
        return content[:cut], cut, len(content)
    if number % 8 == 0:
        at = chance.randrange(len(content))
        return content[:at] + bytes([content[at] ^ 1 << chance.randrange(8)]) + content[at + 1 :], at, at + 1
    begin = chance.randrange(len(content) // SECTOR + 1) * SECTOR
    end = min(begin + SECTOR, len(content))
    sector = [bytes(end - begin), b"\xff" * (end - begin), chance.randbytes(end - begin)][number // 2 % 3]
    return content[:begin] + sector + content[end:], begin, end


def test_what_is_whole_of_a_recording_is_read(recording: bytes, tmp_path: Path) -> None:
    """Seen to fail: struct.error, RuntimeError and more as tracebacks, and nothing was read behind the damage."""
    whole, chance = tmp_path / "whole.mcap", random.Random(23)
    whole.write_bytes(recording)
    with whole.open("rb") as opened:
        summary = make_reader(opened).get_summary()
    assert summary
    chunks = [(each.chunk_start_offset, each.chunk_start_offset + each.chunk_length) for each in summary.chunk_indexes]
    assert len(chunks) == STEPS // 50
    named = 0
    for number in range(250):
        content, begin, end = damage(recording, chance, number)
        file = tmp_path / "damaged.mcap"
        file.write_bytes(content)
        untouched = [at for at, (first, last) in enumerate(chunks) if last <= begin or first >= end]
        # The first chunk says what messages are; so does the end, which is gone where it was cut off.
        known = 0 in untouched or len(content) == len(recording)
        steps = [step for at in untouched if known for step in range(50 * at, 50 * at + 50)]
        found = mcap_reader.Damage()
        if not steps:
            with pytest.raises(UserError, match=r"damaged\.mcap: "):
                mcap_reader.read(file, found)
            continue
        (topic,) = mcap_reader.read(file, found)
        assert list(topic.signals["step"]) == steps, (number, begin, end)
        replay.Replay(file, [])
        lost = STEPS - len(steps)
        assert all(first <= end and last >= begin for first, last in found.bytes) or not lost, (number, begin, end)
        cut_between = end == len(recording) and begin in {last for _, last in chunks}
        assert found.bytes or not lost or cut_between or len(content) < len(recording), (number, begin, end)
        named += bool(found.notes(file))
        assert report.write([file], tmp_path / "page.html").stat().st_size
    assert named > 100


def converted(files: list[Path], out: Path) -> list[str]:
    """What is said of it; nothing where it is refused because the files differ."""
    try:
        return convert.convert(files, out)
    except UserError as error:
        if not re.search(r"other signals than|are \d recordings, and CSV holds one", str(error)):
            raise
        return []


def test_what_is_whole_of_a_recorders_files_is_read(tmp_path: Path) -> None:
    """Seen to fail: a file whose beginning is damaged kept the others from being read; so did OverflowError."""
    chance = random.Random(24)
    files = recorder_files.ring(tmp_path / "ring")
    whole = [file.read_bytes() for file in files]
    _, header, length = struct.unpack_from("<8sII", whole[0])
    assert len(whole[0]) == header + 100 * length
    for number in range(250):
        at = number % 3
        content, begin, end = damage(whole[at], chance, number)
        files[at].write_bytes(content)
        out = tmp_path / "out.csv"
        out.unlink(missing_ok=True)
        said = converted(files, out)
        if not said:  # a field's name or place is another now
            assert begin < header, (number, begin, end)
            files[at].write_bytes(whole[at])
            continue
        rows = [line.split(",") for line in out.read_text().splitlines()[1:]]
        good = [
            100 * each + record
            for each in range(3)
            for record in range(100)
            if each != at or header + (record + 1) * length <= begin or header + record * length >= end
        ]
        steps = [int(row[3]) for row in rows]
        if begin >= header:
            assert steps == good, (number, begin, end)
            if len(content) == len(whole[at]) or (len(content) - header) % length:
                assert any(files[at].name in line for line in said), said
        else:
            assert set(steps) >= {step for step in range(300) if step // 100 != at}, (number, begin, end)
        files[at].write_bytes(whole[at])
