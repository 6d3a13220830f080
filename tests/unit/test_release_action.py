"""The station's half of an update: what it does where a robot received a file that is not the release's."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from flotilla.common import paths

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
