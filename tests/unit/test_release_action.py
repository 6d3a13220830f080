"""The station's half of an update: what it does where a robot received a file that is not the release's."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from tests.runtime.test_update import CHUNK, FUTURE, PAST, header_of, manifest_of, pack

FILE = "/data/update/spool/in/file"


@pytest.fixture
def action(monkeypatch: pytest.MonkeyPatch) -> Any:
    specification = importlib.util.spec_from_file_location(
        "release", paths.PROJECT / "ansible/plugins/action/release.py"
    )
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    made = object.__new__(module.ActionModule)
    made._vars = {"inventory_hostname": "robot1"}
    made._task = type("Task", (), {"args": {"listening": {"listens": True}}})
    made.ran = []
    made.failure = module.AnsibleActionFail
    monkeypatch.setattr(made, "_say", made.ran.append)
    monkeypatch.setattr(made, "_told", lambda said: {"missing": eval(said)})
    monkeypatch.setattr(made, "_begun", lambda: {"missing": [3]})
    return made


@pytest.mark.parametrize(
    ("command", "answer", "missing", "discarded"),
    [
        ("write", None, [3], True),  # a wrong chunk: what came before and after it is on the card
        ("delta", "[3, 4]", [3, 4], True),
        ("delta", "[]", [], False),
        ("write", "[7]", [7], False),  # of which the others had enough
    ],
)
def test_a_received_file_that_is_not_the_releases_is_discarded(
    action: Any, command: str, answer: str | None, missing: list[int], discarded: bool
) -> None:
    """And SSH brings what is missing. Seen to fail: the update ended there, and the next one, too, because the file
    stayed."""

    def run(line: str, content: bytes | None = None) -> str:
        action.ran.append(line)
        if line.endswith(f"<{FILE}") and answer is None:
            raise action.failure("update: chunk 3 is not what the release says")
        return {"/usr/lib/flotilla/receive end": f"{FILE}\n"}.get(line, answer or "")

    action._run = run
    assert action._take_received({"command": command}) == {"missing": missing}
    assert action.ran[:2] == ["/usr/lib/flotilla/receive end", f"/usr/lib/flotilla/update.py {command} <{FILE}"]
    assert ("/usr/lib/flotilla/receive discard" in action.ran) == discarded


@pytest.mark.parametrize(
    ("expires", "warnings"), [(PAST, [f"release 5 expired on {PAST}"]), (FUTURE, []), (None, [])], ids=str
)
def test_an_expired_bundle_is_named_before_it_is_sent(
    action: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, expires: str | None, warnings: list[str]
) -> None:
    """Whether the robot accepts it or not; the robot's reason why it did not check is shown, too. Seen to fail: the
    station sent it without a warning."""
    blob = bytes(8 * CHUNK)
    text = manifest_of(blob, header_of(blob), **({"expires": expires} if expires else {}))
    file = pack(tmp_path / "smartcoret3.bundle", text, [], blob)
    shown: list[str] = []
    action._display = type("Display", (), {"warning": staticmethod(shown.append)})
    action._task.args = {"bundle": str(file)}
    action._task.check_mode = True
    told = {"missing": [], "base": "", "running": False, "staged": True, "unchecked": "no station gives the time"}
    monkeypatch.setattr(action, "_update", lambda *_: told)
    assert action._ask()["told"] == told
    assert action.ran == ["robot1: no station gives the time"]
    assert len(shown) == len(warnings)
    for one, part in zip(shown, warnings, strict=True):
        assert part in one
        assert "make bundle BOARD=smartcoret3" in one


@pytest.mark.parametrize(("given", "sent"), [("", None), ("4", 4), (None, None), (4, 4)])
def test_the_operator_accepts_a_release_by_its_number(
    action: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: object, sent: int | None
) -> None:
    """A bundle contains no such permission: it comes from the command line."""
    blob = bytes(8 * CHUNK)
    file = pack(tmp_path / "some.bundle", manifest_of(blob, header_of(blob), accept_old=4), [], blob)
    action._task.args = {"bundle": str(file), "accept_old": given}
    action._task.check_mode = True
    offered: list[bytes] = []

    def update(_: str, content: bytes) -> dict[str, Any]:
        offered.append(content)
        return {"missing": [], "staged": True, "running": False}

    monkeypatch.setattr(action, "_update", update)
    action._ask()
    assert json.loads(offered[0]).get("accept_old") == sent
    action._task.args["accept_old"] = "four"
    with pytest.raises(UserError, match="accept_old=four: give the number of the release"):
        action._ask()
