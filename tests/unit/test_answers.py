"""What robots answer: what has a type and bounds, and what is shown."""

from __future__ import annotations

from typing import Any

import pytest

from flotilla.common.errors import UserError
from flotilla.robot import answers, state

TOLD: dict[str, Any] = {"missing": [0, 1], "base": "0" * 64, "running": False, "staged": False, "release": "1"}


def test_what_a_robot_says_of_a_release_is_taken_with_all_that_it_has() -> None:
    assert answers.judged("robot1", TOLD, answers.Told) == TOLD


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"base": "../../../keys/release"}, "base"),
        ({"base": [1]}, "base"),
        ({"missing": "all"}, "missing"),
        ({"missing": [-1]}, "missing.0"),
        ({"missing": ["a"]}, "missing.0"),
        ({"missing": [10**30]}, "missing.0"),
        ({"missing": None}, "missing"),
        ({"staged": "yes"}, "staged"),
    ],
)
def test_another_answer_is_refused_by_robot_and_member(change: dict[str, Any], named: str) -> None:
    """Such a base would become part of a path of the station's."""
    with pytest.raises(UserError, match=rf"robot1: its answer is none of a robot's: {named}"):
        answers.judged("robot1", TOLD | change, answers.Told)


SLOT = {"ok": True, "blob": None, "release": "1", "kernel": None}
RELEASE: dict[str, Any] = {"running": "A", "trial": None, "slots": {"A": SLOT, "B": SLOT}}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"slots": {}}, "slots.A"),
        ({"slots": {"B": SLOT}}, "slots.A"),
        ({"slots": {"A": SLOT}}, "slots.B"),
        ({"trial": "C"}, "trial"),
        ({"trial": 1}, "trial"),
    ],
)
def test_boot_state_has_both_slots(change: dict[str, Any], named: str) -> None:
    """Seen to fail: it was accepted, and the first look at the slot that is missing was an error without the robot's
    name."""
    assert answers.judged("robot1", RELEASE, answers.Release) == RELEASE
    with pytest.raises(UserError, match=rf"robot1: its answer is none of a robot's: {named}:"):
        answers.judged("robot1", RELEASE | change, answers.Release)
    with pytest.raises(UserError, match=r"robot1: its answer is none of a robot's: trial: Field required"):
        answers.judged("robot1", {name: each for name, each in RELEASE.items() if name != "trial"}, answers.Release)


def test_a_running_slot_without_content_differs_from_the_image() -> None:
    """Seen to fail: `TypeError: 'NoneType' object is not subscriptable`."""
    shown = state.release_drift(answers.judged("robot1", RELEASE, answers.Release), "a" * 64)
    assert shown.startswith("runs release 1 with kernel None and content None, its image here is aaaaaaaaaaaaaaaa")


@pytest.mark.parametrize("answer", [None, [], "text", 1, {}])
def test_what_is_no_answer_at_all_is_refused(answer: object) -> None:
    with pytest.raises(UserError, match="robot1: its answer"):
        answers.judged("robot1", answer, answers.Told)


def test_control_characters_are_seen_and_numbers_finite() -> None:
    more = {
        "words": "\x1b[2J\u202eabc\x07",
        "rate": float("inf"),
        "lines": "a\n\tb",
        "none": float("nan"),
        "of": object(),
    }
    found = answers.judged("robot1", TOLD | more, answers.Told)
    assert found["words"] == "\\x1b[2J\\u202eabc\\x07"
    assert found["lines"] == "a\n\tb"
    assert (found["rate"], found["none"], found["of"]) == (None, None, None)


def test_what_is_nested_without_end_ends() -> None:
    deep: list[Any] = []
    for _ in range(900):
        deep = [deep]
    found = answers.judged("robot1", TOLD | {"deep": deep}, answers.Told)
    assert str(found["deep"]).count("[") < 20


def test_of_a_modules_outcome_only_that_is_left() -> None:
    said = {"failed": True, "msg": "\x1b[2Jno", "ansible_facts": {"keys": "x"}, "state": {}, "changed": "yes"}
    assert answers.outcome(said) == {"failed": True, "changed": True, "msg": "\\x1b[2Jno"}
    assert answers.outcome({"changed": False, "stdout": "x"}) == {"changed": False}
