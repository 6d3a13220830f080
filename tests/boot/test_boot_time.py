"""How soon a robot controls. From a card, so a run does not repeat: while the guest waits, the host's clock goes on."""

from __future__ import annotations

from pathlib import Path

from flotilla.fleet.model import Fleet
from flotilla.lab.latency import boottime

FIRST_STEP_S = 4.0
"""A control task has its first period within this virtual time from the boot loader's end."""


def test_a_control_task_begins_soon_after_power_on(fleet: Fleet, artefacts: Path) -> None:
    """Booted from the card. Seen to fail when the task's unit waits for basic.target, as units do by default."""
    board = fleet.board().model_copy(update={"kernel": "lean"})
    boots = boottime.measure(board, artefacts)
    print(boottime.account(boots))
    assert boots.card["boot"]["failed_units"] == []
    assert boots.first_step_s <= FIRST_STEP_S
