"""The page of recorder files: pictures are chosen by signals, and tell what was put into the recordings."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from flotilla.common.errors import UserError
from flotilla.station import figures, hops, pictures, report, segments
from flotilla.station.topic import Topic
from tests.recorder_files import MS_NS, content, ring

STEPS = 400
_MOMENTS = ("sensed_ns", "navigation_ns", "valves_ns")


@pytest.fixture
def flight(tmp_path: Path) -> list[Path]:
    """Of a robot that flies a circle of 1 m radius, everywhere 10 mm outside of it; as plant and station record it.

    The station's tasks begin 20 steps before the first message comes, and number 50 is lost.
    """
    angles = [math.tau * step / STEPS for step in range(STEPS)]
    flown = [
        (1.01 * math.cos(a), 1.01 * math.sin(a), a, *(step % 20 < at for at in range(8)))
        for step, a in enumerate(angles)
    ]
    steps: list[tuple[float, ...]] = []
    controls: list[tuple[float, ...]] = []
    for step, a in enumerate(angles):
        number = 0 if step < 20 else step - 19 - (step == 69)
        moments = [0, 0, 0] if number == 0 else [10**12 + step * 10 * MS_NS + at for at in (0, 2 * MS_NS, 5 * MS_NS)]
        steps.append((number, *moments, number > 0, *([step % 2 == 0] * 8)))
        place = (math.cos(a), math.sin(a)) if number else (0, 0)
        controls.append((number, *place, *place, 0, number > 0))
    signals = {
        "flown": {"pose": ("double", 3), "open": ("boolean", 8)},
        "steps": {"number": ("uint32", 1), **dict.fromkeys(_MOMENTS, ("int64", 1)), "good": ("boolean", 1),
                  "valves": ("boolean", 8)},
        "controls": {"number": ("uint32", 1), "wanted": ("double", 2), "estimated": ("double", 3),
                     "flying": ("boolean", 1)},
    }  # fmt: skip
    made = []
    for name, rows in (("flown", flown), ("steps", steps), ("controls", controls)):
        made.append(tmp_path / f"{name}-000001.rec")
        made[-1].write_bytes(content(rows, signals[name], name=name))
    return made


def topics(files: list[Path]) -> dict[str, Topic]:
    return {topic.name: topic for topic in report.read(files)[0]}


def test_a_flight_shows_paths_valves_latency_and_error(flight: list[Path], tmp_path: Path) -> None:
    """Rows before the first message are no places: the error would be a metre."""
    text = report.write(flight, tmp_path / "flight.html").read_text()
    for title in (
        "path", "distance from commanded", "/steps: latency", "/steps: latency of all hops", "/steps: valves",
        "/steps: flags", "/flown: pose", "/flown: open", "/controls: estimated",
    ):  # fmt: skip
        assert f"{title}</text>" in text, title
    for label in (
        "commanded: wanted, /controls", "pose, /flown", "estimated, /controls", "x, m", "y, m", "time, s",
        "latency, ms", "distance, mm", "pose, rad", "pose, /flown: rms 10.0 mm, max 10.0 mm",
        "estimated, /controls: rms 0.0 mm, max 0.0 mm",
    ):  # fmt: skip
        assert f"{label}</text>" in text, label
    assert re.search(r"<td>sensed → navigation</td>(<td>2000</td>){4}", text)
    assert re.search(r"<td>all</td>(<td>5000</td>){4}", text)
    assert re.search('<td>/steps</td><td>400</td><td>100.0</td>\n<td class="missed">1</td>', text)
    assert re.search(r"not good</td>\n<td>1</td><td>0\.20</td><td>0\.20</td>\n<td>0\.00</td>", text)


def test_a_message_that_was_recorded_twice_counts_once(flight: list[Path]) -> None:
    steps = topics(flight)["/steps"]
    assert list(np.flatnonzero(~steps.came)) == list(range(20))
    (found, *_) = hops.hops(steps)
    assert len(found.us) == STEPS - 20 - 1


def _drive(commanded: str) -> Topic:
    """A stream of a wheeled robot at 10 Hz: not alive from 2 s to 3 s, limited from 2.5 s to 4 s."""
    seconds = np.arange(100) / 10
    speeds = np.stack([np.full(100, 0.4), np.zeros(100)], axis=1)
    signals = {
        "step": np.arange(0, 1000, 10), "pose": np.stack([seconds * 0.4, 0 * seconds, 0 * seconds], axis=1),
        "motion": speeds * 0.9, commanded: speeds, "free": 4 - 0.4 * seconds,
        "alive": (seconds < 2) | (seconds >= 3), "limited": (seconds >= 2.5) & (seconds < 4),
        "left_error": np.zeros(100, np.uint16),
    }  # fmt: skip
    return Topic("/robot2/drive/report", (1e9 * seconds).astype(np.int64), signals, {"free": ("m",)})


def test_speeds_that_are_commanded_are_no_places() -> None:
    """With `wanted` a place, the map would show a robot that should be at 0.4 m."""
    drawn = [*pictures.of_robots([_drive("wanted")], 0), *pictures.of_topic(_drive("wanted"), 0)]
    titles = [re.search(r"<!-- ([^\n]*(?:path|speeds|distance|flags|pose|free)[^\n]*) -->", each) for each in drawn]
    text = "".join(drawn)
    assert len(titles) == len(drawn)
    assert "speeds, commanded and driven</text>" in text
    assert "distance from commanded" not in text
    assert "commanded: wanted" not in text
    for label in ("motion[0], m/s", "motion[1], rad/s", "commanded", "driven", "not alive", "limited", "free, m"):
        assert f">{label}</text>" in text, label
    other = "".join(pictures.of_topic(_drive("asked"), 0))
    assert "speeds, commanded and driven" not in other
    assert pictures.constants(_drive("wanted")) == {"left_error": "0", "motion": "0.36, 0", "wanted": "0.4, 0"}


def test_states_last_until_the_next_message() -> None:
    topic = _drive("wanted")
    alive, limited = pictures.states(topic, topic.times_ns / 1e9)
    assert (alive.name, alive.spans_s) == ("not alive", [(2.0, 3.0)])
    assert (limited.name, limited.spans_s) == ("limited", [(2.5, 4.0)])
    assert pictures.states(Topic("/a", topic.times_ns, {"alive": np.ones(100, bool)}), topic.times_ns / 1e9) == []


def test_long_recordings_make_no_long_page(tmp_path: Path) -> None:
    """An hour at 100 Hz with one peak, one flash, and a pause."""
    count = 360_000
    seconds = np.arange(count) / 100
    seconds[count // 2 :] += 1000
    values = np.sin(seconds / 100)
    values[123_456] = 55.5
    flags = np.zeros((count, 2), bool)
    flags[200_000, 1] = True
    alive = np.arange(count) % 2 == 0
    topic = Topic("/long", (1e9 * seconds).astype(np.int64), {"value": values, "flags": flags, "alive": alive})
    drawn = list(pictures.of_topic(topic, 0))
    assert len(drawn) == 3
    assert sum(map(len, drawn)) < 600_000
    _, axes = figures.new()
    figures.line(axes, seconds, values, color="black", label=None)
    (line,) = axes.lines
    shown = np.asarray(line.get_ydata(), float)
    assert np.nanmax(shown) == 55.5
    assert len(shown) <= 2001
    assert np.isnan(shown).sum() == 1
    _, shares = figures.shares(seconds, flags[:, 1])
    assert np.count_nonzero(shares) == 1
    assert figures.merged([(0, 1), (2, 3), (9, 10)], 2) == [(0, 3), (9, 10)]


def test_what_is_damaged_is_on_the_page_and_foreign_files_are_refused(tmp_path: Path) -> None:
    made = ring(tmp_path)
    made[1].unlink()
    made[2].write_bytes(made[2].read_bytes()[:-3])
    text = report.write([tmp_path], tmp_path / "page.html").read_text()
    assert "the files between log-000001.rec and it are missing" in text
    assert "half a record at its end left out, 42 bytes" in text
    (tmp_path / "a.mcap").touch()
    with pytest.raises(UserError, match=r"a\.mcap: is no file of a recorder, \*\.rec; name one MCAP file alone"):
        report.write([made[0], tmp_path / "a.mcap"], tmp_path / "other.html")
    made[0].write_bytes(b"")
    assert "left out: " in report.write([tmp_path], tmp_path / "page.html").read_text()
    with pytest.raises(UserError, match=r"log-000001\.rec: is empty"):
        report.write([made[0]], tmp_path / "other.html")
    assert not (tmp_path / "other.html").exists()


@pytest.mark.parametrize(
    ("given", "name"),
    [("a/log-000012.rec", "log"), ("run.mcap", "run"), ("a/heading", "heading"), ("a/log-*.rec", "log"),
     ("*.rec", "recording")],
)  # fmt: skip
def test_pages_are_called_as_their_recordings(given: str, name: str) -> None:
    assert report.page_of([Path(given)]).name == f"{name}.html"


def test_times_of_a_whole_recording_are_in_order(tmp_path: Path) -> None:
    (log,) = segments.find(ring(tmp_path)[::-1])
    assert list(log.whole().signals["step"]) == list(range(300))
    assert "lost" not in log.whole().signals
