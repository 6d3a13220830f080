"""The runtime's C modules depend on each other in one direction only.

A module is a .c file, its header of the same name, or both. It depends on the modules that it includes, and on those
that define the functions of the public interface (`fl_...`) which it calls.
"""

import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from flotilla.common import paths

RUNTIME = paths.PROJECT / "runtime"
MAY_INCLUDE = {
    "include": {"include"},
    "core": {"include", "core"},
    "blocks": {"include", "core", "."},
    "executive": {"include", "core", "executive"},
    "programs": {"include", "core", "executive", "programs"},
}
"""Of each folder: what its files may include, from the runtime's root. `.` is the file's own folder."""
GENERATED = {"flotilla.h", "ros.h"}
"""Headers that the build makes."""

_INCLUDE = re.compile(r'^#include (?:"([^"]+)"|<(flotilla/[^>]+)>)', re.MULTILINE)
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_DEFINED = re.compile(r"^(?!static )\w[\w *]*?\b(fl_\w+)\([^;{}]*\)\n\{", re.MULTILINE)
_CALLED = re.compile(r"\b(fl_\w+)\(")


def problems(root: Path) -> list[str]:
    """What the C files below `root` do that the rules forbid."""
    files = sorted(path for folder in MAY_INCLUDE for path in (root / folder).rglob("*.[ch]"))
    texts = {path: _COMMENT.sub("", path.read_text()) for path in files}
    defined = {name: module(root, path) for path, text in texts.items() for name in _DEFINED.findall(text)}
    found = []
    depends: dict[str, set[str]] = {}
    for path, text in texts.items():
        needs = depends.setdefault(module(root, path), set())
        for name, included in includes(root, path, text):
            if included is None:
                found.append(f"{path.relative_to(root)}: there is no {name}")
            elif not allowed(root, path, included):
                found.append(f"{path.relative_to(root)} must not include {included.relative_to(root)}")
            else:
                needs.add(module(root, included))
        if path.suffix == ".c":
            needs.update(defined[name] for name in _CALLED.findall(text) if name in defined)
    try:
        TopologicalSorter({name: needs - {name} for name, needs in depends.items()}).prepare()
    except CycleError as error:
        found.append(f"a cycle: {' -> '.join(reversed(error.args[1]))}")
    return found


def includes(root: Path, path: Path, text: str) -> Iterator[tuple[str, Path | None]]:
    """The runtime's files that a file includes, by the name it gives; None: not found."""
    for quoted, public in _INCLUDE.findall(text):
        places = [root / "include" / public] if public else [path.parent / quoted, root / quoted]
        there = [place for place in places if place.is_file()]
        if there or quoted not in GENERATED:
            yield quoted or public, there[0] if there else None


def allowed(root: Path, path: Path, included: Path) -> bool:
    rules = MAY_INCLUDE[path.relative_to(root).parts[0]]
    own = "." in rules and included.parent == path.parent
    return own or included.relative_to(root).parts[0] in rules


def module(root: Path, path: Path) -> str:
    return str(path.relative_to(root).with_suffix(""))


def test_modules_depend_in_one_direction() -> None:
    assert problems(RUNTIME) == []


def test_all_folders_have_rules() -> None:
    folders = {path.relative_to(RUNTIME).parts[0] for path in RUNTIME.rglob("*.[ch]")}
    assert folders - {"tests"} == set(MAY_INCLUDE)


GOOD = {
    "include/flotilla/block.h": "int fl_fail(int why);\n",
    "core/serial.h": "#include <flotilla/block.h>\n#include <stdio.h>\n",
    "core/service.c": "#include <flotilla/block.h>\nint fl_fail(int why)\n{\n}\n",
    "executive/task.h": "/* runs blocks */\n",
    "executive/task.c": '#include "task.h"\n#include "core/serial.h"\nvoid task(void)\n{\n    fl_fail(1);\n}\n',
    "programs/run.h": "",
    "programs/run.c": '#include "executive/task.h"\n#include "run.h"\n',
    "blocks/can/socket.h": "",
    "blocks/can/can.c": '#include "socket.h"\n#include "core/serial.h"\n',
    "blocks/io/io.c": "#include <flotilla/block.h>\n",
}
"""A tree that keeps the rules."""


def plant(root: Path, files: dict[str, str]) -> None:
    for file, text in {**GOOD, **files}.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(text)


@pytest.mark.parametrize(
    ("file", "header"),
    [
        ("include/flotilla/a.h", "core/serial.h"),
        ("core/a.c", "executive/task.h"),
        ("core/a.c", "blocks/can/socket.h"),
        ("core/a.c", "programs/run.h"),
        ("executive/a.c", "programs/run.h"),
        ("executive/a.c", "blocks/can/socket.h"),
        ("programs/a.c", "blocks/can/socket.h"),
        ("blocks/io/a.c", "executive/task.h"),
        ("blocks/io/a.c", "blocks/can/socket.h"),
    ],
)
def test_forbidden_include(tmp_path: Path, file: str, header: str) -> None:
    plant(tmp_path, {file: f'#include "{header}"\n'})
    assert problems(tmp_path) == [f"{file} must not include {header}"]


def test_header_that_is_nowhere(tmp_path: Path) -> None:
    plant(tmp_path, {"core/a.c": '#include "absent.h"\n#include <flotilla/missing.h>\n'})
    assert problems(tmp_path) == ["core/a.c: there is no absent.h", "core/a.c: there is no flotilla/missing.h"]


@pytest.mark.parametrize(
    "files",
    [
        {"core/a.h": '#include "b.h"\n', "core/b.h": '#include "a.h"\n'},
        {"core/a.h": "", "core/a.c": '#include "b.h"\n', "core/b.h": '#include "a.h"\n'},
        {
            "core/a.h": "",
            "core/a.c": "int a(void)\n{\n    fl_b();\n}\n",
            "core/b.c": '#include "a.h"\nint fl_b(void)\n{\n}\n',
        },
    ],
    ids=["headers", "header and source", "call through the public interface"],
)
def test_cycle(tmp_path: Path, files: dict[str, str]) -> None:
    plant(tmp_path, files)
    (found,) = problems(tmp_path)
    assert set(found.removeprefix("a cycle: ").split(" -> ")) == {"core/a", "core/b"}


def test_tree_that_keeps_the_rules(tmp_path: Path) -> None:
    plant(tmp_path, {"core/a.c": '/*\n#include "executive/task.h"\n*/\n'})
    assert problems(tmp_path) == []
