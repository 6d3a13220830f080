"""Many robots on one channel: who they are, and the page about them. Flying them takes a guest."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from flotilla.common.errors import UserError
from flotilla.lab.latency.results import Latency
from flotilla.lab.scenarios import command, crowd, report, virtual


@pytest.mark.parametrize("size", crowd.SIZES)
def test_each_loop_is_its_own(size: int, tmp_path: Path) -> None:
    """Seen to fail with relay boards at one address, and with stations that shared one."""
    files = crowd.files(size, tmp_path)
    session = json.loads(files[f"{virtual.DIRECTORY}/session.json"])
    loops = -(-size // crowd.PER_LOOP)
    addresses = {computer["address"].partition("/")[0] for computer in session["computers"]}
    assert len({computer["name"] for computer in session["computers"]}) == len(addresses) == size + loops
    (flight,) = session["flights"]
    assert len(flight["tasks"]) == 6 * loops
    assert {task["computer"] for task in flight["tasks"]} == {computer["name"] for computer in session["computers"]}
    said = {
        loop: "".join(files[task["file"]].decode() for task in flight["tasks"] if task["name"].startswith(f"{loop}-"))
        for loop in range(loops)
    }
    for pattern in (r"170\.160\.1\.\d+", r"/force\d", r"base: '0x\w+'"):
        found = [set(re.findall(pattern, text)) for text in said.values()]
        assert all(found)
        assert sum(map(len, found)) == len(set.union(*found)), f"{pattern}: of two loops"
    assert set(re.findall(r"170\.160\.1\.\d+", "".join(said.values()))) == addresses


def test_a_size_that_is_none_is_refused() -> None:
    with pytest.raises(UserError, match=r"1 robots: give 2, 4, 8, 16, and all up to that"):
        command.crowds(1, virtual.fleet("udp").board())


def test_the_page_has_each_size(tmp_path: Path) -> None:
    crowds = [crowd.Crowd(n, n // 2, 100, n - 2, Latency.of({1000 * n: 90, 4000 * n: 10})) for n in (2, 4)]
    page = report.write_crowds(crowds, tmp_path).read_text()
    assert "<td>4</td><td>2</td><td>100</td><td>2</td>\n<td>4000</td><td>16000</td>\n<td>16000</td>" in page
    assert page.count("<svg") == 1
    assert [found["lost"] for found in json.loads((tmp_path / "robots.json").read_text())] == [0, 2]
