"""Parts of the station's page that need neither network nor browser."""

from __future__ import annotations

import hashlib
import json
import math
import re
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.lab.wheeled import by_wires
from flotilla.station import page_requests, watching
from flotilla.station.access import Access, RefusedError
from flotilla.station.page_requests import NoRequestError
from flotilla.station.receiver import Receiver
from flotilla.station.replay import Replay
from flotilla.station.telemetry import streams
from flotilla.station.view import View
from flotilla.station.web import PAGE

DRIVE = {"do": "drive", "robot": "rover", "v": 0.5, "omega": 0, "boom": 0.1, "enable": True}


def test_what_others_made_is_as_they_published_it() -> None:
    table = (PAGE / "vendor" / "README.md").read_text()
    listed = dict(re.findall(r"^\| `(\S+)` \|.* `([0-9a-f]{64})` \|$", table, re.M))
    assert set(listed) == {"uPlot.esm.js", "uPlot.min.css"}
    for name, checksum in listed.items():
        assert hashlib.sha256((PAGE / "vendor" / name).read_bytes()).hexdigest() == checksum, name


def test_the_page_needs_nothing_from_elsewhere() -> None:
    """No address of another computer stands in it, and nothing that the policy would refuse."""
    for file in PAGE.glob("*.*"):
        text = file.read_text()
        assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)|//cdn", text), file
        assert "innerHTML" not in text, file
    assert not re.findall(r"<script(?![^>]*src=)|<style|\sstyle=|\son\w+=", (PAGE / "index.html").read_text())


def test_a_request_that_is_one() -> None:
    request = page_requests.read(json.dumps(DRIVE))
    assert isinstance(request, page_requests.Drive)
    assert request.model_dump() == DRIVE


@pytest.mark.parametrize(
    "wrong",
    [
        {"v": math.nan}, {"v": math.inf}, {"v": "0.5"}, {"v": 11}, {"v": None}, {"enable": 1}, {"boom": -0.1},
        {"robot": "../rover"}, {"robot": ""}, {"more": 1}, {"do": "fly"}, {"do": ["drive"]},
        {"do": "set", "id": 1, "task": "drive", "parameter": "-x", "value": "1"},
        {"do": "watch", "id": 1, "task": "drive", "signals": ["a.out;b"]},
        {"do": "watch", "id": 1, "task": "drive", "signals": ["a.out"] * 17},
        {"do": "watch", "id": 1, "task": "drive", "signals": ["a.out"], "trigger": "a.out>1 b.out"},
        {"do": "watch", "id": -1, "task": "drive", "signals": ["a.out"]},
    ],
)  # fmt: skip
def test_a_request_that_is_none(wrong: dict[str, object]) -> None:
    kept = DRIVE if wrong.get("do", "drive") not in ("set", "watch") else {"robot": "rover"}
    with pytest.raises(NoRequestError):
        page_requests.read(json.dumps(kept | wrong))


@pytest.mark.parametrize("text", ["", "null", "[]", "[" * 4000, '{"do":"drive"', b"\xff\xfe"])
def test_no_json_of_a_request(text: str | bytes) -> None:
    with pytest.raises(NoRequestError) as refused:
        page_requests.read(text)
    assert refused.value.number is None


def test_who_waits_for_an_answer_to_what_is_no_request_is_known() -> None:
    """Seen to fail: a plot with a wrong trigger waited for ever."""
    watch = {"do": "watch", "id": 7, "robot": "robot1", "task": "drive", "signals": ["a.out"], "trigger": "a.out=3"}
    with pytest.raises(NoRequestError, match="trigger") as refused:
        page_requests.read(json.dumps(watch))
    assert refused.value.number == 7


@pytest.mark.parametrize(
    ("address", "host", "good"),
    [
        ("127.0.0.1", "127.0.0.1", True), ("127.0.0.1", "localhost", True), ("127.0.0.1", "10.0.0.1", False),
        ("127.0.0.1", "127.0.0.1.attacker.example", False), ("0.0.0.0", "192.168.1.7", True),
        ("0.0.0.0", "attacker.example", False), ("10.42.0.254", "10.42.0.254", True), ("::1", "[::1]", True),
        ("10.42.0.254", "10.42.0.253", False), ("127.0.0.1", "", False),
    ],
)  # fmt: skip
def test_addresses_that_are_this_page(address: str, host: str, good: bool) -> None:
    """A name that somebody makes lead here is none."""
    access = Access(address, 8080)
    token = access.url.rpartition("=")[2]
    headers = {"Host": f"{host}:8080", "Origin": f"http://{host}:8080"}
    if good:
        access.check(headers, "", token, socket=True)
    else:
        with pytest.raises(RefusedError, match="Host"):
            access.check(headers, "", token, socket=True)


def test_a_cookie_that_is_no_text_is_no_token() -> None:
    """Seen to fail: it ended in a traceback, for each request."""
    access = Access("127.0.0.1", 8080)
    headers = {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}
    with pytest.raises(RefusedError, match="no token"):
        access.check(headers, "\udcff", "", socket=True)


def test_rows_come_no_faster_than_a_screen_shows() -> None:
    assert [watching.every(period_s) for period_s in (None, 0.001, 0.01, 0.1, 0.004)] == [10, 10, 1, 1, 3]
    for period_s in (0.0003, 0.002, 0.003, 0.007):
        assert 1 / (period_s * watching.every(period_s)) <= watching.ROWS_HZ * 1.001


def test_a_pose_a_path_and_a_scan() -> None:
    """Points are in the robot's axes: straight ahead, 1 m before a scanner that is 0.15 m ahead."""
    known = {stream.task: stream for stream in streams(by_wires.fleet())}
    receiver = Receiver(known.values())
    view = View(receiver, lambda: 10**9)
    receiver.sinks.append(view)
    rows: list[list[object]] = []
    view.follow("/rover/drive/report", ["pose[1]", "alive"], rows.append)
    drive = {field.name: (0.0,) * field.width if field.width > 1 else 0 for field in known["drive"].fields}
    for x in (0.0, 0.01, 0.5, math.nan):
        receiver.hand(known["drive"], drive | {"pose": (x, 0.25, 1.0), "alive": True}, 10**9)
    ranges = [math.nan] * 171
    ranges[84], ranges[85] = -math.inf, 1.0  # the former is too near
    receiver.hand(known["perceive"], {"step": 1, "age": 0.0, "ranges": tuple(ranges), "good": True}, 10**9)
    state = view.state()
    assert state["poses"] == {"rover": (0.5, 0.25, 1.0)}
    assert view.paths() == {"rover": [(0.0, 0.25), (0.5, 0.25)]}
    (points,) = [scan["points"] for scan in view.scans().values()]
    assert points == pytest.approx([1150, 9], abs=2)
    assert view.scans() == {}
    assert rows == [[1.0, 0.25, True]], "a hundred a second are the most"
    with pytest.raises(KeyError):
        view.follow("/rover/drive/report", ["pose[3]"], rows.append)
    json.dumps(state, allow_nan=False)


def test_what_cannot_be_replayed(tmp_path: Path) -> None:
    file = tmp_path / "no.mcap"
    with pytest.raises(UserError, match=r"no\.mcap: No such file"):
        Replay(file, [])
    file.write_bytes(b"nothing of the kind")
    with pytest.raises(UserError, match="is no MCAP file"):
        Replay(file, [])


def test_the_pages_files_are_found_from_the_checkout() -> None:
    assert (paths.PROJECT / "flotilla" / "station" / "page" / "index.html").is_file()
