"""The page of a recording: what it counts, and what it draws, by recordings whose content is known."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from flotilla.common.errors import UserError
from flotilla.fleet import inventory
from flotilla.station import convert, hops, mcap_reader, pictures, report
from flotilla.station.mcap_reader import Damage
from flotilla.station.record import Recorder
from flotilla.station.telemetry import streams
from flotilla.station.topic import Topic
from tests.station import FLEET

SECOND_NS = 1_000_000_000
BEGIN_NS = 1_767_225_600 * SECOND_NS
"""2026-01-01."""
STEPS = 500
LOST = {7, 8, 100}
HOPS_US = (400, 700, 1100, 1900)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Of a robot that flies a circle; three messages of its valves are lost."""
    file = tmp_path / "circle.mcap"
    known = {stream.topic: stream for stream in streams(inventory.load_fleet(FLEET))}
    valves, control = known["/robot1/valves/report"], known["/robot3/control/report"]
    recorder = Recorder(known.values(), file)
    for step in range(STEPS):
        now_ns = BEGIN_NS + step * SECOND_NS // 100
        moments = [now_ns + 1000 * sum(HOPS_US[:hop]) for hop in range(len(HOPS_US) + 1)]
        values: dict[str, Any] = {field.name: (0,) * field.width if field.width > 1 else 0 for field in valves.fields}
        values |= dict(zip([n for n in values if n.endswith("_ns")][:5], moments, strict=True))
        if step not in LOST:
            recorder.take(valves, values | {"step": step, "valves": (step % 2 == 0,) * 8}, now_ns)
        if step % 10 == 0:
            angle = math.tau * step / STEPS
            place = (math.cos(angle), math.sin(angle))
            values = {field.name: (0.0,) * field.width if field.width > 1 else 0 for field in control.fields}
            values |= {"step": step, "wanted": place, "estimated": (*place, 0, 0, 0, 0)}
            recorder.take(control, values, now_ns)
        if step % 100 == 0:
            recorder.refresh()
    recorder.end()
    return file


def test_messages_are_read_as_they_were_recorded(recording: Path) -> None:
    topics = {topic.name: topic for topic in mcap_reader.read(recording, Damage())}
    valves, control = topics["/robot1/valves/report"], topics["/robot3/control/report"]
    assert list(valves.signals["step"]) == [step for step in range(STEPS) if step not in LOST]
    assert valves.signals["valves"].shape == (STEPS - len(LOST), 8)
    assert valves.signals["valves"].dtype == np.bool_
    assert list(valves.signals["valves"][:3, 0]) == [True, False, True]
    assert control.times_ns[1] - control.times_ns[0] == SECOND_NS // 10
    assert np.hypot(*control.signals["wanted"].T) == pytest.approx(np.ones(STEPS // 10))


def test_loss_is_counted_and_hops_are_measured(recording: Path) -> None:
    """Seen to fail with the stamps sorted by name."""
    topics = {topic.name: topic for topic in mcap_reader.read(recording, Damage())}
    accounts = {name: report.account(topic) for name, topic in topics.items()}
    assert accounts["/robot1/valves/report"].lost == len(LOST)
    assert accounts["/robot1/valves/report"].longest_gap_s == pytest.approx(0.03)
    assert accounts["/robot3/control/report"].lost == 0
    assert accounts["/robot3/control/report"].rate_hz == pytest.approx(10)
    found = {hop.name: set(hop.us) for hop in hops.hops(topics["/robot1/valves/report"])}
    assert found == {
        "sensed → navigation": {400},
        "navigation → control": {700},
        "control → mapping": {1100},
        "mapping → valves": {1900},
        "all": {4100},
    }
    assert hops.hops(topics["/robot3/control/report"]) == []


def test_the_page_has_it_all_and_repeats_to_the_byte(recording: Path, tmp_path: Path) -> None:
    page = report.write([recording], tmp_path / "pages" / "one.html")
    text = page.read_text()
    assert "<td>/robot1/valves/report</td><td>497</td>" in text
    assert '<td class="missed">3</td>' in text
    assert re.search(r"<td>all</td>(<td>4100</td>){4}", text)
    titles = ("robot3: path", "/robot1/valves/report: latency", "/robot1/valves/report: valves")
    for title in titles:
        assert title in text, title
    assert "step</text>" not in text
    assert report.write([recording], tmp_path / "other.html").read_text() == text


def test_a_recording_that_was_cut_off_is_read_as_far_as_it_goes(recording: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    content = recording.read_bytes()
    cut.write_bytes(content[: len(content) * 2 // 3])
    topics = {topic.name: topic for topic in mcap_reader.read(cut, Damage())}
    steps = list(topics["/robot1/valves/report"].signals["step"])
    assert 100 < len(steps) < STEPS - len(LOST)
    assert steps == [step for step in range(STEPS) if step not in LOST][: len(steps)]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "none.mcap: No such file or directory; record one: make record OUT=FILE"),
        (b"", "none.mcap: holds no message"),
        (b"no recording, but long enough", "none.mcap: is no MCAP file of protobuf messages"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes | None, reason: str) -> None:
    file = tmp_path / "none.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UserError, match=re.escape(reason)):
        report.write([file], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_page_that_cannot_be_written_is_named(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"file/page\.html: .*; name another file: OUT="):
        report.write([recording], tmp_path / "file" / "page.html")


def test_a_recording_becomes_csv_and_mat(recording: Path, tmp_path: Path) -> None:
    """Seen to fail: `no recording: it does not begin as one`."""
    said = convert.convert([recording], tmp_path / "valves.csv", "/robot1/valves/report")
    assert any(line.startswith("/robot1/valves/report: 497 messages from 2026-01-01T00:00:00 UTC on") for line in said)
    with (tmp_path / "valves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [step for step in range(STEPS) if step not in LOST]
    assert [rows[3]["valves[0]"], rows[3]["valves[7]"], rows[3]["time_s"]] == ["0", "0", "0.03"]
    convert.convert([recording], tmp_path / "all.mat")
    control = scipy.io.loadmat(tmp_path / "all.mat", simplify_cells=True)["robot3_control_report"]
    assert control["wanted"].shape == (50, 2)
    assert control["wanted"][10] == pytest.approx([math.cos(math.tau / 5), math.sin(math.tau / 5)])
    for out, topic, reason in (
        ("a.mcap", None, "circle.mcap: is MCAP already; OUT=NAME.csv or NAME.mat"),
        ("a.csv", None, "recordings, and CSV holds one; say TOPIC=/robot1/valves/report"),
        ("a.csv", "/robot9/x/y", "TOPIC=/robot9/x/y: is not there; there are /robot1/valves/report"),
    ):
        with pytest.raises(UserError, match=re.escape(reason)):
            convert.convert([recording], tmp_path / out, topic)
        assert not (tmp_path / out).exists()


def test_a_scan_is_an_image_and_no_hundred_lines() -> None:
    """Seen to fail: 171 lines, whose legend alone was 43 rows."""
    seconds = np.arange(20)
    ranges = np.add.outer(seconds, np.linspace(1, 4, 171))
    ranges[3, 7] = np.nan
    topic = Topic("/robot1/perceive/scan", BEGIN_NS + SECOND_NS * seconds, {"ranges": ranges}, {"ranges": ("m",)})
    (picture,) = pictures.of_topic(topic, BEGIN_NS)
    assert "ranges[" not in picture
    assert picture.count("<image") >= 1
    assert "ranges, m" in picture
    assert picture == next(pictures.of_topic(topic, BEGIN_NS))
