"""Brings a release to robots, by the robot's `/usr/lib/flotilla/update.py`; to several at once by multicast."""

from __future__ import annotations

import json
import os
import secrets
import shlex
import time
from datetime import UTC, datetime
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from ansible.errors import AnsibleActionFail

from ansible.plugins.action import ActionBase
from flotilla.common import paths, progress, text
from flotilla.common.errors import UserError
from flotilla.robot import answers, provision, release
from flotilla.updates import multicast, staging

BATCH_BYTES = 8 << 20
"""Sent at a time: what is cut off begins anew there."""
UPDATE = "/usr/lib/flotilla/update.py"
RECEIVE = "/usr/lib/flotilla/receive"
TOLD_S = 10.0
"""Between two lines about a transfer."""


class ActionModule(ActionBase):  # type: ignore[misc]  # Ansible has no types
    """A release, of the board's bundle or `bundle`, comes to the card in steps. Each is a call; `do` says which:

    | do | for | arguments | result |
    |---|---|---|---|
    | ask | a robot | `accept_old`: number | `told`: what the robot says it lacks |
    | share | all | `asked`: results of `ask` by robot; `by` | `shipments` for several robots each, `station` |
    | listen | a robot | `shared`: result of `share` | `listens`: whether it receives its shipment |
    | send | all | `shared`; `listening`: results of `listen` by robot; `kbit_s` | `reports`, one for each shipment |
    | stage | a robot | `asked`, `shared`, `listening`: its own | `told`; `sent_bytes` by SSH |

    `stage` takes what was received, sends what is still missing, and ends with all of it on the card.

    `do: activate`: the next start tries it. `do: confirm`: the running slot stays. `do: back`: the next start tries the
    other slot. Result `told`: what the robot said.
    """

    _supports_check_mode = True
    _requires_connection = True

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> dict[str, Any]:
        super().run(tmp, task_vars)
        self._vars = task_vars or {}
        steps = {
            "ask": self._ask, "share": self._share, "listen": self._listen, "send": self._send, "stage": self._stage,
            "activate": self._activate, "confirm": self._confirm, "back": self._back,
        }  # fmt: skip
        do = self._task.args["do"]
        if do not in steps:
            raise AnsibleActionFail(f"do={do}: one of {', '.join(steps)}")
        if self._task.check_mode and do != "ask":
            return {"changed": do in ("activate", "confirm", "back") or (do == "stage" and not self._lack().staged)}
        try:
            return steps[do]()
        except UserError as error:
            raise AnsibleActionFail(str(error)) from None

    # --- a release comes to the card ---

    def _ask(self) -> dict[str, Any]:
        file = self._bundle_file()
        bundle = release.read(file)
        if warning := bundle.expired(datetime.now(UTC).date()):
            self._display.warning(warning)
        told = self._begin(bundle)
        if told.get("unchecked"):
            self._say(f"{self._name}: {told['unchecked']}")
        if staging.Lack(file, told).anything and not bundle.delta(told) and not self._task.check_mode:
            told = self._update("copy")
        if not bundle.has(told["missing"]):
            raise UserError(f"{self._name}: it asks for chunks that the release does not have; look at the robot")
        return {"told": told, "bundle": str(file)}

    def _share(self) -> dict[str, Any]:
        fleet, _ = self._robot()
        lacks = {
            name: staging.Lack(Path(asked["bundle"]), asked["told"])
            for name, asked in self._task.args["asked"].items()
            if "told" in asked
        }
        found = staging.shipments(lacks, self._task.args.get("by", ""))
        station = staging.station(fleet)
        if found and station is None:
            stations = staging.listed(str(each.address) for each in fleet.stations) or "(none)"
            self._say(
                f"no multicast: this computer has none of the addresses of stations in the inventory, {stations}; each "
                "robot gets its own copy"
            )
            found = []
        return {
            "station": str(station),
            "shipments": [
                {
                    "command": each.command,
                    "file": str(each.file),
                    "robots": each.robots,
                    "description": multicast.describe(each.file.read_bytes()),
                    "key": secrets.token_hex(multicast.KEY_BYTES),
                }
                for each in found
            ],
        }

    def _listen(self) -> dict[str, Any]:
        shared = self._task.args["shared"]
        shipment = self._shipment(shared)
        if shipment is None:
            return {"listens": False}
        argv = [RECEIVE, "begin", shared["station"], str(self._robot()[1].address)]
        try:
            order = multicast.order(bytes.fromhex(shipment["key"]), shipment["description"])
            self._run(shlex.join(argv), order.encode())
        except AnsibleActionFail as error:
            self._say(f"{self._name}: {error}; it gets its own copy")
            return {"listens": False}
        return {"listens": True}

    def _send(self) -> dict[str, Any]:
        fleet, _ = self._robot()
        shared, listening = self._task.args["shared"], self._task.args["listening"]
        names = {str(robot.address): robot.name for robot in fleet.robots.values()}
        rate = 1000 * _kbit_s(self._task.args.get("kbit_s") or fleet.network.update_kbit_s)
        reports = []
        for shipment in shared["shipments"]:
            robots = [
                robot.address
                for robot in fleet.robots.values()
                if robot.name in shipment["robots"] and listening.get(robot.name, {}).get("listens")
            ]
            if not robots:
                continue
            content = Path(shipment["file"]).read_bytes()
            size = progress.size(len(content))
            self._say(f"{size} to {len(robots)} robots at once, {rate // 1000} kbit/s: {shipment['command']}")
            try:
                key = bytes.fromhex(shipment["key"])
                sender = multicast.Sender(content, IPv4Address(shared["station"]), robots, key, rate=rate)
            except OSError as error:
                self._say(f"no multicast from {shared['station']}: {error.strerror}; each robot gets its own copy")
                continue
            report = sender.run(Watch(self._say, len(content)))
            lacking = staging.listed(names[address] for address in report.lacking)
            self._say(
                f"{size}: {len(report.whole)} of {len(robots)} robots have it, {progress.size(report.sent)} sent in "
                f"{progress.clock(report.seconds)}" + (f"; by SSH instead: {lacking}" if lacking else "")
            )
            if shipment["command"] == "write":  # of a delta there is only one
                Path(shipment["file"]).unlink()
            reports.append({"file": shipment["file"], "bytes": len(content)} | vars(report))
        return {"reports": reports}

    def _stage(self) -> dict[str, Any]:
        lack = self._lack()
        told: dict[str, Any] = dict(lack.told)
        if lack.staged:
            return {"told": told, "sent_bytes": 0}
        bundle = release.read(lack.bundle)
        if shipment := self._shipment(self._task.args.get("shared") or {}):
            told = self._take_received(shipment) or told
        sent = 0
        if told["missing"] and (delta := bundle.delta(told)):
            content = delta.read_bytes()
            self._say(f"{self._name}: a delta of {progress.size(len(content))} by SSH")
            told = self._update("delta", content)
            sent += len(content)
        whole = bundle.length(told["missing"])
        for batch in bundle.chunks(told["missing"], BATCH_BYTES):
            self._update("write", batch)
            sent += len(batch)
            self._say(f"{self._name}: {progress.size(sent)} of {progress.size(whole)} by SSH")
        told = self._update("finish")
        if told["missing"]:
            raise AnsibleActionFail(f"the card does not keep chunks {told['missing']}: it needs another one")
        return {"changed": True, "told": told, "sent_bytes": sent}

    def _take_received(self, shipment: dict[str, Any]) -> dict[str, Any] | None:
        """What the robot says after it took the file that it received; None where that is not whole.

        If the file does not match the release, SSH sends the missing chunks, and nothing of the file is kept.
        """
        if not (self._task.args.get("listening") or {}).get("listens"):
            return None
        if not (file := self._run(f"{RECEIVE} end").strip()):
            return None
        try:
            told = self._told(self._run(f"{UPDATE} {shipment['command']} <{shlex.quote(file)}"))
        except AnsibleActionFail as error:
            self._say(f"{self._name}: {error}; what is missing comes by SSH")
            self._run(f"{RECEIVE} discard")
            return self._begun()
        if told["missing"] and shipment["command"] == "delta":
            self._run(f"{RECEIVE} discard")
        return told

    def _begun(self) -> dict[str, Any]:
        return self._begin(release.read(self._lack().bundle))

    def _begin(self, bundle: release.Bundle) -> dict[str, Any]:
        return self._update("begin", bundle.offer(_accept_old(self._task.args.get("accept_old"))))

    def _lack(self) -> staging.Lack:
        asked = self._task.args["asked"]
        return staging.Lack(Path(asked["bundle"]), asked["told"])

    def _shipment(self, shared: dict[str, Any]) -> dict[str, Any] | None:
        """This robot's."""
        found: list[dict[str, Any]] = shared.get("shipments", [])
        return next((each for each in found if self._name in each["robots"]), None)

    # --- it is started ---

    def _activate(self) -> dict[str, Any]:
        return {"changed": True, "told": self._update("activate")}

    def _confirm(self) -> dict[str, Any]:
        return {"changed": True, "told": text.shown(self._run("flotilla-slot confirm"))}

    def _back(self) -> dict[str, Any]:
        state = answers.judged(self._name, _parsed(self._run("flotilla-slot show")), answers.Release)
        other = "B" if state["running"] == "A" else "A"
        if not state["slots"][other]["ok"]:
            raise AnsibleActionFail(f"slot {other} holds no release that worked: there is nothing to go back to")
        return {"changed": True, "told": text.shown(self._run(f"flotilla-slot trial {other}"))}

    # --- what they have in common ---

    @property
    def _name(self) -> str:
        return str(self._vars["inventory_hostname"])

    def _robot(self) -> Any:
        """Fleet and robot."""
        return provision.robot(Path(self._vars["inventory_dir"]), self._name)

    def _bundle_file(self) -> Path:
        return Path(self._task.args.get("bundle") or paths.BUNDLES / f"{self._robot()[1].board}.bundle")

    def _say(self, line: str) -> None:
        self._display.display(line)

    def _update(self, command: str, content: bytes | None = None) -> dict[str, Any]:
        return self._told(self._run(f"{UPDATE} {command}", content))

    def _told(self, said: str) -> dict[str, Any]:
        return answers.judged(self._name, _parsed(said), answers.Told)

    def _run(self, command: str, content: bytes | None = None) -> str:
        """What a command says on the robot."""
        done = self._low_level_execute_command(command, in_data=content)
        if done["rc"]:
            said = done["stderr"].strip().splitlines() or done["stdout"].strip().splitlines() or ["nothing"]
            raise AnsibleActionFail(f"{command}: {text.shown(said[-1])}")
        return str(done["stdout"])


def _parsed(said: str) -> object:
    """JSON; what is none is as wrong as another answer."""
    try:
        return json.loads(said)
    except (ValueError, RecursionError):
        return None


def _accept_old(value: object) -> int | None:
    """The number of a release, as the command line has it; None for none."""
    if value in (None, ""):
        return None
    if not str(value).isdecimal():
        raise UserError(f"accept_old={value}: give the number of the release, `release:` in images/release.yml")
    return int(str(value))


def _kbit_s(value: object) -> int:
    """A rate, as the command line or the inventory has it."""
    if not str(value).isdecimal() or not int(str(value)):
        raise UserError(f"kbit_s={value}: give kbit/s, a whole number from 1 on")
    return int(str(value))


class Watch:
    """Shows how far a transfer is, and ends it with the playbook, whatever ended that."""

    def __init__(self, say: Any, size: int) -> None:
        self._say = say
        self._size = size
        self._parent = os.getppid()
        self._told = time.monotonic()

    def __call__(self, report: multicast.Report) -> None:
        if os.getppid() != self._parent:
            raise SystemExit(1)
        if time.monotonic() - self._told < TOLD_S:
            return
        self._told = time.monotonic()
        there = len(report.whole)
        self._say(
            f"{progress.size(report.sent)} sent of {progress.size(self._size)} and repairs after "
            f"{progress.clock(report.seconds)}; {there} of {there + len(report.lacking)} robots have all of it"
        )
