"""What a message between robots costs their processors, by each transport, without and with a proof: in virtual time,
on a processor of 125 million instructions a second, so that the figures repeat."""

from __future__ import annotations

from pathlib import Path

import pytest

from flotilla.lab.scenarios import exchange, message_cost, virtual

pytestmark = pytest.mark.nightly

PROOF_NS = 100_000
"""For both computers, at most, of a message by UDP: a hundredth of a period."""


def test_what_a_message_costs(artefacts: Path) -> None:
    """Seen to fail with keys left out of both variants: a proof cost nothing."""
    board = virtual.fleet("udp").board().model_copy(update={"kernel": "lean"})
    found = message_cost.measure(board, artefacts)
    for name, cost in found.items():
        print(
            f"{message_cost.VARIANTS[name].title}: sender {cost.sender_ns / 1000:.0f} µs, receiver "
            f"{cost.receiver_ns / 1000:.0f} µs, with the kernel's threads {cost.whole_ns / 1000:.0f} µs a message"
        )
    messages = exchange.SECONDS * 1_000_000_000 // message_cost.PERIOD_NS
    assert all(cost.taken >= messages for cost in found.values()), "messages were lost"
    assert 0 < found["udp-keys"].whole_ns - found["udp"].whole_ns < PROOF_NS
    assert found["dds"].whole_ns < found["dds-security"].whole_ns
