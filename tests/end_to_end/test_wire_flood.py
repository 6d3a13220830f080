"""A flood from the cable, in virtual time: forged datagrams at the port of a control task, from outside the guest."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.scenarios import flooded, virtual, wire_flood

pytestmark = pytest.mark.nightly

RATE_HZ = 5000
"""With 8,000 a processor of 125 million instructions a second is full: Linux takes 50 ms of each second from all
real-time threads then, for those that starve, so that control is late."""


def test_a_flood_from_the_cable(artefacts: Path) -> None:
    """None is taken, all are counted, no message is lost, and no task is late: neither the one that refuses, nor the
    sender, nor one without messages. Seen to fail with 8,000 a second: each task had some ten overruns."""
    board = virtual.fleet("udp").board().model_copy(update={"kernel": "lean"})
    found = wire_flood.measure(board, artefacts, RATE_HZ)
    for name, each in found.items():
        print(f"{name}: {each}")
    quiet, under = found["quiet"], found["flooded"]
    assert (quiet.frames, quiet.forged) == (0, 0)
    assert under.frames > 0.99 * RATE_HZ * flooded.SECONDS
    assert under.forged + under.dropped == under.frames
    assert under.dropped < 0.01 * under.frames
    for each in (quiet, under):
        assert abs(each.sent - each.messages) <= 2, "messages are lost"  # counted one after the other
        assert set(each.overruns.values()) == {0}
