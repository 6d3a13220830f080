"""The command line as a whole; what each command does is tested with what does it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
        (["make", "imgae"], "error: make imgae: there is no such target; the nearest is image; `make help TARGET=all`"),
        (["image"], "error: one of the arguments robot --all is required"),
        (["image", "3", "--all"], "error: argument --all: not allowed with argument robot"),
        (["flash", "3"], "error: one of the arguments device --file is required"),
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


LATIN_1 = """
import locale, sys
locale.getencoding = lambda: "iso8859-1"
import flotilla.__main__
def command():
    print("… ä", open({file!r}).read(), sys.flags.utf8_mode)
    print("… ä", file=sys.stderr)
    return 0
flotilla.__main__.main = command
sys.exit(flotilla.__main__.program())
"""
"""A program of this project in a locale that few computers have; `{file}` has been written in UTF-8."""


def test_files_are_utf_8_and_output_is_the_locales(tmp_path: Path) -> None:
    """Seen to fail: `'latin-1' codec can't encode character '\\u2026'`, after all was done."""
    file = tmp_path / "file"
    file.write_bytes("ü".encode())
    argv = [sys.executable, "-c", LATIN_1.format(file=str(file))]
    done = subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, check=False)
    assert (done.stdout, done.stderr) == ("? ä ü 1\n".encode("latin-1"), "? ä\n".encode("latin-1"))
    assert done.returncode == 0


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"LC_ALL": "C"}, "COMMAND …"),
        ({"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, "COMMAND ?"),
        ({"PYTHONIOENCODING": "iso8859-1"}, "COMMAND ?"),
        ({"LC_ALL": "nowhere"}, "COMMAND …"),
    ],
)
def test_every_locale_has_help(environment: dict[str, str], said: str) -> None:
    argv = [sys.executable, "-m", "flotilla", "--help"]
    done = subprocess.run(argv, cwd=paths.PROJECT, env=os.environ | environment, capture_output=True, check=False)
    assert done.stdout.decode().splitlines()[0] == f"usage: flotilla {said}"
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("words", [["check-fleet"], ["make", "imgae"]])
@pytest.mark.parametrize("gone", ["stdout", "stderr"])
def test_a_reader_that_left_ends_a_command_in_silence(words: list[str], gone: str) -> None:
    """Seen to fail with a traceback: `flotilla check-fleet | head -1`. The status is the one of SIGPIPE in a shell."""
    read, write = os.pipe()
    os.close(read)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | {gone: write}
    argv = [sys.executable, "-m", "flotilla", *words]
    done = subprocess.run(argv, cwd=paths.PROJECT, **streams, text=True, check=False)  # type: ignore[call-overload]
    os.close(write)
    speaks, status = ("stderr", 1) if "imgae" in words else ("stdout", 0)
    assert done.returncode == (141 if gone == speaks else status)
    assert "Traceback" not in (done.stderr or "")
    assert bool(done.stderr) == (gone != "stderr" and speaks == "stderr")


def test_a_broken_pipe_to_another_program_is_a_defect() -> None:
    """Of standard output's reader alone nothing is said."""
    script = (
        "import os, flotilla.__main__ as program\ndef broken():\n    raise BrokenPipeError\n"
        "program.main = broken\nprogram.program()"
    )
    argv = [sys.executable, "-c", script]
    done = subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.endswith("BrokenPipeError\n")
