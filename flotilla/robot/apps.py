"""A robot's apps beside what the inventory gives to it: what is wrong with them, and what puts it right.

The inventory's apps become what it says, whoever changed them. An app that was brought by hand and is not in the
inventory stays and is named: somebody tries something, and a roll-out to the fleet is no reason to end that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from flotilla.fleet.apps import BuiltApp


@dataclass
class Verdict:
    """What provisioning makes of a robot's apps."""

    faults: list[str] = field(default_factory=list)
    """What is wrong with the inventory's, in words."""
    notes: list[str] = field(default_factory=list)
    """What was brought by hand, and what to do with it."""
    actions: list[tuple[str, str]] = field(default_factory=list)
    """App and command of flotilla/apps/remote.sh, in order, that put it right."""


def judge(number: int, found: Mapping[str, Mapping[str, Any]], wanted: Sequence[BuiltApp]) -> Verdict:
    """Of robot `number`: `found` is what `ansible/library/robot_state.py` says of all its apps, by name."""
    verdict = Verdict()
    given = {app.name: app for app in wanted}
    for name, it in sorted(found.items()):
        if name not in given and it["listed"]:
            verdict.faults.append(f"app {name} is not the robot's any more")
            verdict.actions.append((name, "clear"))
        elif name not in given:
            verdict.notes.append(
                f"app {name} was deployed manually and is kept; give it to the robot (apps: in robots.yml), or remove "
                f"it: make deploy ROBOT={number} APP=apps/{name} RUN=remove"
            )
    for app in wanted:
        _judge_one(app, found.get(app.name), verdict)
    return verdict


def _judge_one(app: BuiltApp, it: Mapping[str, Any] | None, verdict: Verdict) -> None:
    """One that the robot should have."""
    name = app.name
    broken = ["is missing"] if it is None or not it["version"] else _wrong(app, it)
    verdict.faults += [f"app {name} {why}" for why in broken]
    if broken:
        verdict.actions += [(name, "receive"), (name, "keep"), (name, "start")]
        return
    assert it
    if not it["kept"]:
        verdict.faults.append(f"app {name} does not start with the robot")
        verdict.actions.append((name, "keep"))
    if not it["up"]:
        verdict.faults.append(f"app {name} does not run")
        verdict.actions.append((name, "start"))


def _wrong(app: BuiltApp, it: Mapping[str, Any]) -> list[str]:
    """What is wrong with its files."""
    if it["version"] != app.version:
        if it["version"] == it["listed"]:
            return [f"is version {it['version']}, and the inventory's is {app.version}"]
        return [
            f"is version {it['version']}, deployed manually, and the inventory's is {app.version}: to keep it, "
            f"take {app.name} out of the robot's apps, or change apps/{app.name}"
        ]
    return [f"is not as built: {line}" for line in it["files"]] + (
        [] if it["drop_in"] else ["does not have its unit.d"]
    )
