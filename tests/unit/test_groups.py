"""The groups of Python packages in requirements/: what a command needs, and what its make target installs."""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import grimp
import pytest

from flotilla.cli import host_packages, make
from flotilla.cli.command import Command, HostList
from flotilla.cli.main import OURS, commands
from flotilla.common import paths

GROUPS = ("build", "station", "tests")
"""Each stands on those before it."""
ON_ROBOTS = {file.stem for file in (paths.PROJECT / "rootfs_overlay/usr/lib/flotilla").glob("*.py")}
"""Modules of the robots' root, which programs put on their path themselves."""
REQUIREMENTS = paths.PROJECT / "requirements"


def locked(group: str) -> set[str]:
    """Lines of versions, such as `pyyaml==6.0.3`."""
    return set(re.findall(r"^(\S+==\S+)", (REQUIREMENTS / f"{group}.lock").read_text(), re.MULTILINE))


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def modules(group: str) -> set[str]:
    """What a Python program can import once `group` is installed, by the first part of the name."""
    names = {line.split("==")[0] for each in GROUPS[: GROUPS.index(group) + 1] for line in locked(each)}
    return {module for module, of in packages_distributions().items() if names & {normal(each) for each in of}}


@pytest.fixture(scope="module")
def imports() -> grimp.ImportGraph:
    """Imports inside of functions count, those for type checks do not."""
    return grimp.build_graph(*OURS, include_external_packages=True, exclude_type_checking_imports=True, cache_dir=None)


def imported_by(source: str) -> Iterator[str]:
    """Modules that `source` imports; of `from a import b` both `a` and `a.b`, since `b` may be one."""
    for node in ast.walk(ast.parse(textwrap.dedent(source))):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module
            yield from (node.module, *(f"{node.module}.{each.name}" for each in node.names))


def functions_of(function: Callable[..., object]) -> dict[str, str]:
    """Sources of `function` and of the functions of its module that it names, by name."""
    module = sys.modules[function.__module__]
    found: dict[str, str] = {}
    left = [function.__name__]
    while left:
        name = left.pop()
        each = getattr(module, name, None)
        if name not in found and inspect.isfunction(each):
            found[name] = inspect.getsource(each)
            left += [
                node.id for node in ast.walk(ast.parse(textwrap.dedent(found[name]))) if isinstance(node, ast.Name)
            ]
    return found


def needed(graph: grimp.ImportGraph, starts: set[str]) -> dict[str, list[str]]:
    """Modules of others that `starts` reach, and through which modules of this project each is reached."""
    ours = {module for module in graph.modules if module.split(".")[0] in OURS}
    seen = {start: [start] for start in starts if start in ours}
    found = {start.split(".")[0]: [start] for start in starts if start.split(".")[0] not in OURS}
    left = list(seen)
    while left:
        module = left.pop()
        parents = {module.rsplit(".", 1)[0]} if "." in module else set()  # imported before it
        for each in graph.find_modules_directly_imported_by(module) | parents:
            if each in ours and each not in seen:
                seen[each] = [*seen[module], each]
                left.append(each)
            elif each not in ours:
                found.setdefault(each.split(".")[0], [*seen[module], each])
    return {module: way for module, way in found.items() if module not in sys.stdlib_module_names | ON_ROBOTS}


def of_command(command: Command) -> set[str]:
    sources = functions_of(command.run) | functions_of(command.arguments)
    return {module for source in sources.values() for module in imported_by(source)}


def too_much(graph: grimp.ImportGraph, starts: set[str], group: str) -> list[str]:
    """What `starts` need and `group` has not."""
    known = modules(group)
    return sorted(" -> ".join(way) for module, way in needed(graph, starts).items() if module not in known)


@pytest.mark.parametrize("command", commands(), ids=lambda command: command.name)
def test_a_command_imports_packages_of_its_group_alone(imports: grimp.ImportGraph, command: Command) -> None:
    assert not too_much(imports, of_command(command), command.packages)


@pytest.mark.parametrize(
    "command", [each for each in commands() if each.packages == "station"], ids=lambda each: each.name
)
def test_a_command_of_the_station_needs_it(imports: grimp.ImportGraph, command: Command) -> None:
    """Otherwise it works without, and nobody has to install 300 MB for it."""
    starts = of_command(command)
    if command.name in ("completion", "make"):
        starts |= {module for each in commands() for module in of_command(each)}
    assert too_much(imports, starts, "build")


def test_what_runs_beside_the_command_line_needs_the_build_group_alone(imports: grimp.ImportGraph) -> None:
    """The builder starts its stages as programs, Ansible its plug-ins."""
    starts = {module for module in imports.modules if module.startswith(("flotilla.images.", "flotilla.debian."))}
    plugins = [
        *(paths.PROJECT / "ansible" / "plugins").rglob("*.py"),
        *(paths.PROJECT / "ansible/library").glob("*.py"),
    ]
    assert starts
    assert plugins
    starts |= {module for file in plugins for module in imported_by(file.read_text())}
    assert not too_much(imports, starts, "build")


def test_an_import_of_another_group_is_found(imports: grimp.ImportGraph) -> None:
    assert too_much(imports, {"flotilla.station.report"}, "build")
    assert too_much(imports, {"pytest"}, "station")
    assert too_much(imports, {"flotilla.station.no_such", "mcap.writer"}, "build") == ["mcap.writer"]


def test_groups_agree_on_versions_and_name_the_direct_ones_once() -> None:
    every = {line for group in GROUPS for line in locked(group)}
    text = "".join((REQUIREMENTS / f"{group}.lock").read_text() for group in GROUPS)
    marked = set(re.findall(r"^(\S+)==\S+ ; python", text, re.MULTILINE))  # another version for another Python
    names = [line.split("==")[0] for line in every]
    assert {name for name in names if names.count(name) > 1} <= marked
    described = tomllib.loads((paths.PROJECT / "pyproject.toml").read_text())
    project, groups = described["project"], described["dependency-groups"]
    lists = [project["dependencies"], project["optional-dependencies"]["station"], groups["setup"], groups["tests"]]
    direct = [normal(re.split(r"[<=\[]", each)[0]) for names in lists for each in names]
    assert len(direct) > len(GROUPS)
    assert len(direct) == len(set(direct))


def make_targets() -> dict[str, tuple[set[str], str]]:
    """Prerequisites and recipe of the targets of the Makefile."""
    argv = ["make", "-pqrR", "-C", str(paths.PROJECT)]
    environment = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL")}
    listed = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False).stdout
    found: dict[str, tuple[set[str], str]] = {}
    for block in listed.split("\n\n"):
        if match := re.search(r"^([\w./-]+):([^=\n]*)$", block, re.MULTILINE):
            found[match[1]] = set(match[2].replace("|", " ").split()), block[match.end() :]
    return found


def all_of(targets: dict[str, tuple[set[str], str]], target: str) -> set[str]:
    direct = targets.get(target, (set(), ""))[0]
    return direct.union(*(all_of(targets, each) for each in direct))


def test_a_make_target_installs_the_group_of_its_command_and_no_more() -> None:
    listed = make_targets()
    for name, (command, _) in make.targets(commands()).items():
        installed = {each for each in GROUPS if f"build/venv/.{each}" in all_of(listed, name)}
        assert installed == set(GROUPS[: GROUPS.index(command.packages) + 1]), name


@pytest.mark.parametrize(
    ("installed", "host", "lists"),
    [
        (False, ("build", "lab"), ["flotilla/lab/host-packages.txt"]),
        (False, ("build",), []),
        (True, ("build", "lab"), ["images/host-packages.txt", "flotilla/lab/host-packages.txt"]),
        (True, (), []),
    ],
)
def test_a_command_installs_its_debian_packages(
    monkeypatch: pytest.MonkeyPatch, installed: bool, host: tuple[HostList, ...], lists: list[str]
) -> None:
    """In a checkout `make setup` has installed those of the list `build`."""
    called: list[list[str]] = []

    def run(argv: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        called.append(argv)
        return subprocess.CompletedProcess(argv, 0)

    monkeypatch.setattr(paths, "INSTALLED", installed)
    monkeypatch.setattr(subprocess, "run", run)
    host_packages.install(Command("Lab", "work", "does it", lambda _: None, host=host))
    scripts = ["check-host"] * installed + ["install-host-packages"] if lists else []
    assert [Path(argv[1]).name for argv in called] == scripts
    assert called[-1:] == ([["sh", *called[-1][1:2], *(str(paths.PROJECT / each) for each in lists)]] if lists else [])


def without(tmp_path: Path, module: str, *words: str) -> subprocess.CompletedProcess[str]:
    """`flotilla WORD…` where `module` is not installed."""
    refuse = tmp_path / "sitecustomize.py"
    refuse.write_text(f"import sys\nsys.modules[{module!r}] = None\n")
    argv = [sys.executable, "-m", "flotilla", *words]
    return subprocess.run(
        argv, cwd=paths.PROJECT, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def test_a_command_without_its_packages_says_what_installs_them(tmp_path: Path) -> None:
    """Seen to fail in an environment of the group `build`: tracebacks, of numpy for `top` and of rich for `drive`."""
    done = without(tmp_path, "rich", "top", "--help")
    assert (done.returncode, done.stderr) == (
        1, "error: flotilla top: the Python package rich is not installed; `make setup-station` installs it\n"
    )  # fmt: skip


def test_the_command_line_of_the_build_group_runs_without_the_other_groups(tmp_path: Path) -> None:
    """All modules of other groups are refused, and each of its commands says what it takes."""
    others = sorted(modules("tests") - modules("build"))
    assert {"numpy", "matplotlib", "pytest"} <= set(others)
    (tmp_path / "sitecustomize.py").write_text(f"import sys\nsys.modules.update(dict.fromkeys({others!r}))\n")
    words = [command.name for command in commands() if command.packages == "build"]
    program = (
        "import sys\nfrom flotilla.cli.main import commands, parser\n"
        f"taken = parser(commands(), lambda each: each.name in {words!r})\nprint(taken.prog)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=paths.PROJECT, env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "flotilla\n", "")
