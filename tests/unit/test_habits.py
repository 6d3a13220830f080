"""The hooks of .pre-commit-config.yaml pass what is right and refuse what is wrong, by the locked tools."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from flotilla.common import paths

CONFIGURATION = ".pre-commit-config.yaml"
RIGHT = {
    "right.py": "value = 1\n",
    "right.c": "int value = 1;\n",
    "right.sh": "#!/bin/sh\necho right\n",
}
WRONG = {
    "wrong.py": "import  os\n",
    "wrong.c": "int   value=1;\n",
    "wrong.sh": "#!/bin/sh\ncd $1\n",
}


def run(checkout: Path, *argv: str) -> subprocess.CompletedProcess[str]:
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    environment = own | {"PRE_COMMIT_HOME": str(checkout / "build" / "pre-commit")}
    return subprocess.run(argv, cwd=checkout, env=environment, capture_output=True, text=True, check=False)


def git(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run(checkout, "git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments)


def pre_commit(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run(checkout, str(Path(sys.executable).with_name("pre-commit")), *arguments)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new repository with the project's hooks installed."""
    checkout = tmp_path_factory.mktemp("checkout")
    (checkout / "build").mkdir()
    (checkout / "build" / "venv").symlink_to(Path(sys.executable).parents[1])
    (checkout / ".gitignore").write_text("build\n")
    for file in (CONFIGURATION, ".clang-format", "pyproject.toml"):
        shutil.copy(paths.PROJECT / file, checkout)
    git(checkout, "init", "-q")
    done = pre_commit(checkout, "install")
    assert done.returncode == 0, done.stdout + done.stderr
    return checkout


def commit(checkout: Path, files: Mapping[str, str], message: str) -> subprocess.CompletedProcess[str]:
    for name, text in files.items():
        (checkout / name).write_text(text)
    git(checkout, "add", "-A")
    return git(checkout, "commit", "-m", message)


def test_what_is_right_is_committed_and_nothing_else(checkout: Path) -> None:
    done = commit(checkout, RIGHT, "tests: commit what is right\n\nA body.\n")
    assert done.returncode == 0, done.stdout + done.stderr
    done = commit(checkout, WRONG, "tests: commit what is wrong")
    refused = re.findall("hook id: (.*)", done.stdout + done.stderr)
    assert (done.returncode, refused) == (1, ["ruff-format", "ruff-check", "clang-format", "shellcheck"])


@pytest.mark.parametrize(
    ("subject", "status"),
    {
        "tests: " + "x" * 65: 0,
        "tests: " + "x" * 66: 1,
        "Say what it does": 1,
        "tests:no blank": 1,
        "an area: of two words": 1,
        "\ntests: in the second line": 1,
    }.items(),
)
def test_subjects(checkout: Path, subject: str, status: int) -> None:
    file = checkout / "build" / "message"
    file.write_text(f"{subject}\n\ntests: a body\n")
    done = pre_commit(checkout, "run", "--hook-stage", "commit-msg", "--commit-msg-filename", str(file))
    assert done.returncode == status, done.stdout + done.stderr
