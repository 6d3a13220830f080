"""How what robots tell the station comes, shown by the real program."""

from __future__ import annotations

from pathlib import Path

from tests.running import PATIENCE
from tests.station import Robots, on_loopback, station


def test_one_table_where_there_is_no_terminal(tmp_path: Path) -> None:
    """A tenth of the steps is left out. Seen to fail where all are sent, and where only a signal ends it."""
    fleet = on_loopback(tmp_path / "inventory")
    robots = Robots(fleet)

    def ended() -> bool:
        robots.sent["valves"] += robots.sent["valves"] % 10 == 9
        return process.poll() is not None

    with station(fleet, "--top") as process:
        robots.until(ended)
        said, complaints = process.communicate(timeout=PATIENCE)
    assert (process.returncode, complaints) == (0, "")
    title, valves, control = (line.split() for line in said.splitlines())
    assert title[:9] == ["robot", "task", "ms", "stream", "Hz", "of", "came", "refused", "lost"]
    came, refused, lost = (int(valves[title.index(what)]) for what in ("came", "refused", "lost"))
    assert [*valves[:4], valves[5]] == ["robot1", "valves", "10", "report", "100"]
    assert (came > 0, refused, abs(9 * lost - came) <= 9) == (True, 0, True)
    assert valves[-2:] == ["not", "good"]
    assert [*control[:4], control[5]] == ["robot3", "control", "10", "report", "10"]
    assert control[-4:] == ["not", "flying,", "not", "done"]
