"""The command line as a whole; what each command does is tested with what does it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from flotilla.cli import main as command_line
from flotilla.common import paths

COMMANDS = {command.name: command for command in command_line.commands()}


def flotilla(*words: str) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, "-m", "flotilla", *words]
    return subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, check=False)


def test_help_has_every_command_once() -> None:
    lines = [line.split() for line in flotilla("--help").stdout.splitlines() if line.startswith("  ")]
    words = [line[0] for line in lines]
    assert {name: words.count(name) for name in COMMANDS} == dict.fromkeys(COMMANDS, 1)
    assert {"boot", "deploy", "image", "top"} <= set(words)  # of the lab as well as of the package


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_explains_each_of_its_words(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seen to fail with an option that has no help."""
    monkeypatch.setattr(sys, "argv", ["flotilla", name, "--help"])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    said = capsys.readouterr().out
    assert ended.value.code == 0
    assert said.startswith(f"usage: flotilla {name} ")
    parser = command_line.parser([COMMANDS[name]], lambda _: True)
    (words,) = (action for action in parser._actions if isinstance(action.choices, dict))
    assert isinstance(words.choices, dict)
    assert not [action.dest for action in words.choices[name]._actions if not action.help]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["imgae"], "invalid choice: 'imgae'"),
        (["image"], "error: say which: a robot's number, or --all"),
        (["image", "3", "--all"], "error: say which: a robot's number, or --all"),
        (["flash", "3"], "error: say where to: the card's device, /dev/sdX, or --file FILE"),
        (["fleet", "up"], "error: say how many guests: flotilla fleet up 4"),
        (["provision", "--playbook", "flet"], "error: flet: ansible/ has no such playbook; there are collect, fleet,"),
    ],
)
def test_what_is_wrong_is_said(words: list[str], said: str) -> None:
    done = flotilla(*words)
    assert done.returncode != 0
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_shells_complete_commands_and_options() -> None:
    script = flotilla("completion", "bash").stdout
    assert all(name in script for name in COMMANDS)
    assert "--on-robot" in script
    done = subprocess.run(["bash", "-n"], input=script, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
