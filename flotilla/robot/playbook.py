"""`make provision`: runs a playbook of `ansible/` on robots, or on the guests of the virtual fleet."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from flotilla.common import ansible, paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet import inventory, keys

ANSIBLE = paths.PROJECT / "ansible"


def play(playbook: str, *, robot: int | None, guests: bool, words: Sequence[str]) -> None:
    """Become `ansible-playbook`. Without `guests` the virtual fleet is out of reach, and with it the robots are."""
    file = ANSIBLE / f"{playbook}.yml"
    if not file.is_file():
        there = ", ".join(sorted(path.stem for path in ANSIBLE.glob("*.yml") if path.stem != "files"))
        raise UserError(f"{playbook}: ansible/ has no such playbook; there are {there}")
    if guests and not paths.GUESTS.exists():
        raise UserError(f"{paths.shown(paths.GUESTS)} is missing: no virtual fleet runs; start one: make fleet N=4")
    keys.usable(keys.operator())  # before Ansible, whose messages name no remedy
    programs = Path(sys.executable).parent
    argv = [str(programs / "ansible-playbook")]
    argv += [word for place in inventory.layers(paths.INVENTORY) for word in ("-i", str(place))]
    argv += ["-i", str(paths.GUESTS)] if guests else []
    if robot is not None:
        argv += ["-l", inventory.robot(inventory.load_fleet(), robot).name]
    elif guests:
        argv += ["-l", "guests"]
    argv += [*words, file.name]
    progress.command(argv)
    os.chdir(ANSIBLE)
    environment = ansible.environment() | {
        "PATH": f"{programs}:{os.environ['PATH']}",
        **({"FLEET": str(paths.HOME)} if paths.OWN_HOME else {}),
        "BUILD": str(paths.BUILD),
        "KEYS": str(paths.KEYS),
        "APPS": str(paths.APPS),
        "INVENTORY": str(paths.INVENTORY),
    }
    os.execve(argv[0], argv, environment)
