"""Recorder files as MCAP, CSV and MAT: judged by programs that share nothing with what wrote them."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymatio
import pytest

from flotilla.common.errors import UserError
from flotilla.station import convert, recording, segments
from tests.recorder_files import MS_NS, SIGNALS, content, ring
from tests.running import PATIENCE
from tests.station import decoded, pymcap

BEGIN_NS = 1_767_225_605_000_000_000
"""Of a ring's first record, by the wall clock: 2026-01-01 00:00:05."""


def mat(file: Path) -> dict[str, Any]:
    """By libmatio."""
    found: dict[str, Any] = pymatio.loadmat(str(file))
    return found


def test_mcap_has_every_record_in_order(tmp_path: Path) -> None:
    """Files are named in a wrong order. Seen to fail without the sort."""
    made = ring(tmp_path / "robot" / "heading")
    out = tmp_path / "run.mcap"
    said = convert.convert(made[::-1], out)
    assert said[1:] == ["/log: 300 records of 3 files from 2026-01-01T00:00:05 UTC on"]
    messages = decoded(out)
    assert [topic for topic, _ in messages] == ["/log"] * 300
    assert [message.step for _, message in messages] == list(range(300))
    assert [list(message.position) for _, message in messages][-1] == [299, -299]
    assert [message.good for _, message in messages][:3] == [True, False, True]
    assert messages[0][1].count == -1000


def test_several_recordings_are_topics_of_one_file_by_time(tmp_path: Path) -> None:
    """Two robots' of one name have their folders before it. Seen to fail with one recording after the other, and
    with times of the monotonic clock."""
    ring(tmp_path / "robot1" / "heading")
    ring(tmp_path / "robot3" / "heading")
    ring(tmp_path / "robot3" / "valves", name="steps")
    convert.convert([tmp_path], tmp_path / "run.mcap")
    messages = decoded(tmp_path / "run.mcap", whole=False)  # in the order of the file
    topics = ["/robot1/heading/log", "/robot3/heading/log", "/robot3/valves/steps"]
    assert [topic for topic, _ in messages] == topics * 300
    doctor = pymcap("doctor", tmp_path / "run.mcap")
    assert doctor.returncode == 0, doctor.stdout
    told = json.loads(pymcap("info-json", tmp_path / "run.mcap").stdout)
    assert told["statistics"]["message_start_time"] == BEGIN_NS
    assert told["statistics"]["message_end_time"] == BEGIN_NS + 299 * 10 * MS_NS
    assert {channel["topic"]: channel["message_count"] for channel in told["channels"]} == dict.fromkeys(topics, 300)


def test_csv_has_a_row_a_record(tmp_path: Path) -> None:
    convert.convert(ring(tmp_path), tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 300
    assert rows[299] == {
        "time_s": "2.99", "wall_ns": str(BEGIN_NS + 2990 * MS_NS), "time_ns": str(5_000_000_000 + 2990 * MS_NS),
        "step": "299", "lost": "0", "position[0]": "299.0", "position[1]": "-299.0", "good": "0", "count": "-701",
    }  # fmt: skip


def test_mat_has_a_struct_a_recording_and_a_vector_a_signal(tmp_path: Path) -> None:
    ring(tmp_path)
    ring(tmp_path, name="other-one", count=30)
    said = convert.convert([tmp_path], tmp_path / "run.mat")
    assert "struct: other-one is other_one there" in said
    found = mat(tmp_path / "run.mat")
    assert set(found) == {"log", "other_one"}
    log = found["log"]
    assert list(log) == ["time_s", "wall_ns", "time_ns", "step", "lost", *SIGNALS]
    assert {name: (rows.dtype.name, rows.shape) for name, rows in log.items()} == {
        "time_s": ("float64", (300, 1)), "wall_ns": ("int64", (300, 1)), "time_ns": ("int64", (300, 1)),
        "step": ("uint64", (300, 1)), "lost": ("uint32", (300, 1)), "position": ("float64", (300, 2)),
        "good": ("bool", (300, 1)), "count": ("int32", (300, 1)),
    }  # fmt: skip
    assert log["position"].tolist() == [[step, -step] for step in range(300)]
    assert log["time_s"][:, 0] == pytest.approx(np.arange(300) / 100)
    assert log["wall_ns"][299, 0] == BEGIN_NS + 2990 * MS_NS
    assert found["other_one"]["step"].shape == (30, 1)


def test_names_become_identifiers_of_their_own_and_are_named(tmp_path: Path) -> None:
    """Of MATLAB and of protobuf. Seen to fail with - made _: one of the two is lost, or the schema is refused."""
    long = "a" * 70
    names = ["a-b", "a_b", "end", "time_s", long, f"{long}x"]
    file = tmp_path / "log-000001.rec"
    file.write_bytes(content([range(6), range(6, 12)], dict.fromkeys(names, ("double", 1))))
    said = convert.convert([file], tmp_path / "run.mat")
    log = mat(tmp_path / "run.mat")["log"]
    named = ["a_b", "a_b_2", "end_2", "time_s_", "a" * 63, f"{'a' * 61}_2"]
    assert [log[name][0, 0] for name in named] == list(range(6))
    for name, other in zip(names, named, strict=True):
        assert (f"/log: {name} is {other} there" in said) == (name != other)
    convert.convert([file], tmp_path / "run.mcap")
    ((_, first), _) = decoded(tmp_path / "run.mcap")
    assert (first.a_b, first.a_b_2, first.end) == (0, 1, 2)


def test_the_clock_that_was_set_after_the_first_file_holds_for_its_run(tmp_path: Path) -> None:
    """A robot without a battery begins in 1970. Another run keeps its own. Seen to fail with each file's own offset."""
    rows = [(step, 0, True, 0) for step in range(10)]
    old, first, second = (tmp_path / f"log-{number:06}.rec" for number in (1, 2, 3))
    old.write_bytes(content(rows, first=500, wall_ns=7_000_000_000))
    first.write_bytes(content(rows, wall_ns=0))
    second.write_bytes(content(rows, first=10))
    ((log,)) = segments.find([old, first, second])
    times_ns = log.whole().times_ns
    assert times_ns[0] == 17_000_000_000
    assert list(times_ns[10:]) == [BEGIN_NS + step * 10 * MS_NS for step in range(20)]


def test_what_is_damaged_is_left_out_and_told(tmp_path: Path) -> None:
    first, second, third = ring(tmp_path)
    damaged = bytearray(second.read_bytes())
    length = 20 + 16 + 1 + 4 + 4
    damaged[-length - 10] ^= 1
    second.write_bytes(damaged)
    third.write_bytes(third.read_bytes()[:-3])
    said = convert.convert([first, second, third], tmp_path / "run.mcap")
    assert [message.step for _, message in decoded(tmp_path / "run.mcap")] == [
        step for step in range(299) if step != 198
    ]
    assert said[2:] == [
        f"{second}: 1 damaged records left out, the first one at byte {len(damaged) - 2 * length}",
        f"{third}: half a record at its end left out, {length - 3} bytes",
    ]
    second.unlink()
    said = convert.convert([first, third], tmp_path / "without.mcap")
    assert f"{third}: the files between log-000001.rec and it are missing" in said


def _empty(file: Path) -> None:
    file.write_bytes(b"")


def _truncated(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:100])


def _foreign(file: Path) -> None:
    file.write_bytes(b"something else, and long enough for a header")


def _long_header(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:8] + b"\xff\xff\xff\x7f" + file.read_bytes()[12:])


def _other(file: Path) -> None:
    file.write_bytes(content([(1,)], {"position": ("double", 1)}))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (_other, "log-000002.rec: count, good, position: other signals than in log-000001.rec"),
        (Path.unlink, "log-000002.rec: No such file or directory; name files of a recorder"),
    ],
)
@pytest.mark.parametrize("form", ["mcap", "csv", "mat"])
def test_what_is_no_recording_is_named_and_nothing_is_written(
    tmp_path: Path, spoil: Callable[[Path], None], reason: str, form: str
) -> None:
    made = ring(tmp_path)
    spoil(made[1])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UserError, match=re.escape(reason)):
        convert.convert(made, tmp_path / f"run.{form}")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (_empty, "log-000002.rec: is empty, as after a loss of power; leave it out"),
        (_truncated, "log-000002.rec: no recording: it ends within its header; leave it out, or fetch it again"),
        (_foreign, "log-000002.rec: no recording: it does not begin as one; leave it out"),
        (_long_header, "log-000002.rec: no recording: it ends within its header; leave it out"),
    ],
)
def test_a_file_whose_beginning_is_damaged_is_left_out_beside_others(
    tmp_path: Path, spoil: Callable[[Path], None], reason: str
) -> None:
    """Seen to fail: it kept the whole files from being read."""
    made = ring(tmp_path)
    spoil(made[1])
    said = convert.convert(made, tmp_path / "run.csv")
    assert [line for line in said if line.startswith("left out: ") and reason in line]
    assert len((tmp_path / "run.csv").read_text().splitlines()) == 1 + 200
    with pytest.raises(UserError, match=re.escape(reason)):
        convert.convert(made[1:2], tmp_path / "alone.csv")


def test_a_recording_without_records_is_no_error_beside_others(tmp_path: Path) -> None:
    (tmp_path / "none-000001.rec").write_bytes(content([], name="none"))
    with pytest.raises(UserError, match=r"none-000001\.rec: no record in it"):
        convert.convert([tmp_path], tmp_path / "run.csv")
    ring(tmp_path)
    (tmp_path / "log-000004.rec").write_bytes(content([]))
    for form in ("mcap", "csv", "mat"):
        assert "/log: 300 records of 4 files" in convert.convert([tmp_path], tmp_path / f"run.{form}")[1]


def test_what_is_there_stays(tmp_path: Path) -> None:
    made = ring(tmp_path)
    (tmp_path / "run.csv").write_text("precious")
    with pytest.raises(UserError, match=r"run\.csv is there already; give another name: OUT="):
        convert.convert(made, tmp_path / "run.csv")
    assert (tmp_path / "run.csv").read_text() == "precious"
    with pytest.raises(UserError, match=r"run\.txt: is no form that is known; let it end in \.mcap, \.csv, \.mat"):
        convert.convert(made, tmp_path / "run.txt")
    with pytest.raises(UserError, match=r"run\.csv/a\.mat: .*; make room, or name another place: OUT="):
        convert.convert(made, tmp_path / "run.csv" / "a.mat")
    ring(tmp_path, name="other")
    with pytest.raises(
        UserError, match=r"/log, /other: are 2 recordings, and CSV holds one; say TOPIC=/log, name the files"
    ):
        convert.convert([tmp_path], tmp_path / "two.csv")
    with pytest.raises(UserError, match=r"x-\*\.rec: matches no file"):
        convert.convert([tmp_path / "x-*.rec"], tmp_path / "two.csv")
    assert not list(tmp_path.glob("two*"))
    assert convert.convert([tmp_path / "log-*.rec", made[0]], tmp_path / "one.csv")[1].startswith("/log: 300 records")


@pytest.mark.parametrize("form", ["mcap", "csv", "mat"])
def test_a_full_disk_leaves_no_half(tmp_path: Path, form: str) -> None:
    """/dev/full stands in for the disk. Seen to fail with the name of what is written beside."""
    made = ring(tmp_path / "files")
    (tmp_path / f"run.{form}.part").symlink_to("/dev/full")
    with pytest.raises(UserError, match=rf"run\.{form}: No space left on device; make room"):
        convert.convert(made, tmp_path / f"run.{form}")
    assert list(tmp_path.iterdir()) == [tmp_path / "files"]


def test_the_command_line_says_what_came_of_it(tmp_path: Path) -> None:
    first, *_ = ring(tmp_path)
    for words, status, said in (
        (("convert", "run.mat", "log-*.rec"), 0, "/log: 300 records of 3 files from 2026-01-01T00:00:05 UTC on"),
        (
            ("report", "--out", "log.html", "log-000001.rec", "log-000002.rec"),
            0,
            "log.html: a page of log-000001.rec, ",
        ),
        (("convert", "run.mat", "log-*.rec"), 1, "error: run.mat is there already; give another name: OUT="),
    ):
        argv = [sys.executable, "-m", "flotilla", *words]
        done = subprocess.run(argv, cwd=first.parent, capture_output=True, text=True, check=False, timeout=PATIENCE)
        assert done.returncode == status, done.stderr
        assert said in done.stdout + done.stderr
    assert {file.name for file in tmp_path.iterdir()} >= {"run.mat", "log.html"}


def test_more_than_a_mat_file_holds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the limit made small."""
    made = ring(tmp_path / "files")
    monkeypatch.setattr(convert, "MOST_MAT_BYTES", 300 * 57 - 1)
    with pytest.raises(UserError, match=r"/log: takes 16\.7 KiB, and a MAT-file holds 16\.7 KiB of a recording"):
        convert.convert(made, tmp_path / "run.mat")
    assert list(tmp_path.iterdir()) == [tmp_path / "files"]
    monkeypatch.setattr(convert, "MOST_MAT_BYTES", 300 * 57)
    convert.convert(made, tmp_path / "run.mat")


@pytest.mark.parametrize("form", ["mcap", "mat"])
def test_a_long_recording_needs_little_memory(tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """4 MiB of records, read by smaller parts than usual. Seen to fail with usual ones, which are most of a file."""
    monkeypatch.setattr(recording, "CHUNK_BYTES", 2**16)
    first = tmp_path / "log-000001.rec"
    first.write_bytes(content([range(1024)] * 256, {f"wide{at}": ("double", 128) for at in range(8)}))
    made = [first, tmp_path / "log-000002.rec"]
    shutil.copy(*made)
    tracemalloc.start()
    try:
        convert.convert(made, tmp_path / f"run.{form}")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3.5 * 2**20
