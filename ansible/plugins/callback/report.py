"""What a run did to the fleet, as `build/reports/fleet.json` for programs and `fleet.html` for people.

`robots`: by name, `outcome` (`up to date`, `changed`, `would change`, `failed`, `unreachable`), `repaired` (what
was, or would be, put right), `messages` (why it failed), `state`, `unhealthy` and `by_hand` (what
`robot_state` last found). Robots that a roll-out did not come to are not there.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import jinja2

from ansible.plugins.callback import CallbackBase
from flotilla.common import durable, paths

DOCUMENTATION = """
name: report
type: notification
short_description: a page and a JSON file about each run
description: Writes build/reports/fleet.json and fleet.html.
"""
TEMPLATE = Path(__file__).with_name("report.html.j2")


class CallbackModule(CallbackBase):  # type: ignore[misc]  # Ansible has no types
    CALLBACK_VERSION = 2.0
    CALLBACK_TYPE = "notification"
    CALLBACK_NAME = "report"

    def __init__(self) -> None:
        super().__init__()
        self._started = time.time()
        self._playbook = ""
        self._check = False
        self._robots: dict[str, dict[str, Any]] = {}

    def v2_playbook_on_start(self, playbook: Any) -> None:
        self._playbook = Path(playbook._file_name).stem

    def v2_playbook_on_play_start(self, play: Any) -> None:
        self._check = bool(play.get_variable_manager()._options_vars.get("ansible_check_mode"))

    def v2_runner_on_ok(self, result: Any) -> None:
        found = result._result
        robot = self._robot(result)
        if "state" in found and "faults" in found:
            robot |= {key: found[key] for key in ("state", "unhealthy", "by_hand")}
        if found.get("changed"):
            differences = found.get("diff") or []
            listed = [each for each in differences if isinstance(each, dict)] if isinstance(differences, list) else []
            robot["repaired"] += [_difference(each) for each in listed] or [result._task.get_name()]

    def v2_runner_on_failed(self, result: Any, ignore_errors: bool = False) -> None:
        robot = self._robot(result)
        robot["messages"].append(f"{result._task.get_name()}: {result._result.get('msg', '')}")

    def v2_runner_on_unreachable(self, result: Any) -> None:
        self._robot(result)["messages"].append(str(result._result.get("msg", "unreachable")))

    def v2_playbook_on_stats(self, stats: Any) -> None:
        for name, robot in self._robots.items():
            counts = stats.summarize(name)
            robot["outcome"] = (
                "unreachable" if counts["unreachable"]
                else "failed" if counts["failures"]
                else ("would change" if self._check else "changed") if counts["changed"]
                else "up to date"
            )  # fmt: skip
        document = {
            "playbook": self._playbook,
            "check": self._check,
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self._started)),
            "duration_s": round(time.time() - self._started, 1),
            "robots": dict(sorted(self._robots.items())),
        }
        directory = paths.BUILD / "reports"
        directory.mkdir(parents=True, exist_ok=True)
        page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
        html = page.from_string(TEMPLATE.read_text(encoding="utf-8")).render(document)
        for name, text in (("json", json.dumps(document, indent=1, sort_keys=True) + "\n"), ("html", html)):
            durable.write(directory / f"{self._playbook}.{name}", text)
        self._display.display(f"{paths.shown(directory / self._playbook)}.html")

    def _robot(self, result: Any) -> dict[str, Any]:
        empty: dict[str, Any] = {
            "outcome": "",
            "repaired": [],
            "messages": [],
            "state": None,
            "unhealthy": [],
            "by_hand": [],
        }
        return self._robots.setdefault(result._host.get_name(), empty)


def _difference(each: dict[str, Any]) -> str:
    """A line about a difference: the file and what was wrong with it, or the fault."""
    header = str(each.get("before_header", ""))
    return header if header.startswith("/") else str(each.get("before", "")).strip()
