"""Looks for the words that docs/style.md forbids: `python -m tests.prose`.

    show [PATH…]   prints each place: file, line, words, remedy
    lower          writes lower numbers into prose_left.txt, and removes files that have none left; makes the whole
                   list if there is none

tests/prose.yml has the words. Numbers in prose_left.txt only go down: tests/unit/test_prose.py fails otherwise.
"""

from __future__ import annotations

import functools
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from flotilla.common import paths

WORDS = Path(__file__).with_suffix(".yml")
LEFT = Path(__file__).with_name("prose_left.txt")
BEGIN = "¶"
"""Marks the beginning of a piece of prose."""
OTHERS = {"docs/style.md", "tests/prose.yml", "tests/prose.py", "tests/prose_left.txt", "tests/unit/test_prose.py"}
"""Files that list the words."""
GENERATED = "<!-- Made from the sources"
_PYTHON = re.compile(
    r'(?P<string>[rbfRBF]{0,2}(?:"""(?:\\.|.)*?"""|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'))|#(?P<comment>[^\n]*)',
    re.DOTALL,
)
_C = re.compile(
    r'(?P<string>"(?:\\.|[^"\\\n])*")|\'(?:\\.|[^\'\\\n])\'|/\*(?P<block>.*?)\*/|//(?P<comment>[^\n]*)', re.DOTALL
)
_HASH = re.compile(r"(?:^|(?<=[ \t]))#+(?P<comment>[^\n]*)", re.MULTILINE)
_PERCENT = re.compile(r"%(?P<comment>[^\n]*)")
_YAML_TEXT = re.compile(
    r"^[ \t-]*(?:name|msg|fail_msg|success_msg):[ \t]*(?P<text>[^\n#]*[a-z]+ [^\n#]*)$", re.MULTILINE
)
_SPAN = r"(?<!`)(`+)(?!`)[^¶]+?(?<!`)\1(?!`)"
_MAKE = re.compile(r"(?:^|(?<=[ \t]))#(?P<comment>[^#=@][^\n]*)", re.MULTILINE)
_MARKUP = re.compile(r"<(script|style).*?</\1>|\{[%#{].*?[%#}]\}|<[^>]*>", re.DOTALL)
_TEXT = re.compile(r"(?P<text>[A-Za-z][^\n]*)")
_HELP = re.compile(r"^[a-z-]+:[^#\n]*##(?P<help>[^|\n]*)", re.MULTILINE)


@dataclass(frozen=True)
class Rule:
    """Words, and what to write instead."""

    expression: re.Pattern[str]
    instead: str


@dataclass(frozen=True)
class Place:
    """Where forbidden words are."""

    file: str
    line: int
    words: str
    instead: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.words!r}; instead: {self.instead}"


@functools.cache
def rules() -> tuple[Rule, ...]:
    found = []
    for each in yaml.safe_load(WORDS.read_text(encoding="utf-8")):
        words = each.get("pattern") or rf"(?<![\w-])(?:{each['words']})(?![\w-])".replace(" ", r"\s+")
        flags = re.NOFLAG if "pattern" in each else re.IGNORECASE
        found.append(Rule(re.compile(words, flags), each["instead"]))
    return tuple(found)


# --- prose of a file ---

Piece = tuple[int, str]
"""Number of its first line, and text without the marks of comments. It begins with BEGIN, unless it is a heading."""


def prose(file: str, text: str) -> list[Piece]:
    """Pieces of prose of a file of the checkout; none for kinds of files that have no prose."""
    name = file.rpartition("/")[2]
    if text.startswith(GENERATED) or file in OTHERS:
        return []
    if name.endswith(".md"):
        return list(_markdown(text))
    tests = file.startswith(("tests/", "runtime/tests/"))
    spans: Iterable[tuple[int, int]] = ()
    if name.endswith(".html.j2"):
        spans = _groups(_TEXT, _MARKUP.sub(_blank, text))
    elif name.endswith(".py"):
        spans = _of_source(_PYTHON, text, tests)
    elif name.endswith((".c", ".h", ".js", ".css", ".idl")):
        spans = _of_source(_C, text, tests)
    elif name.endswith(".m"):
        spans = _comments(_PERCENT, text)
    elif name == "Makefile" or name.endswith(".mk"):
        spans = [*_groups(_HELP, text), *_comments(_MAKE, text)]
    elif name.endswith((".yml", ".yaml")):
        spans = [*_comments(_HASH, text), *_groups(_YAML_TEXT, text)]
    elif name.endswith((".j2", ".service", ".conf", ".in", ".list", ".txt", ".config", ".sh", ".build", ".toml")) or (
        "." not in name and text.startswith("#!")
    ):
        spans = _comments(_HASH, text)
    return [(text.count("\n", 0, begin) + 1, BEGIN + _plain(text[begin:end])) for begin, end in spans]


def _plain(text: str) -> str:
    """Without marks of comments; a placeholder is in the place of code."""
    return re.sub(rf"{_SPAN}|\{{[^{{}}]*\}}", _code, re.sub(r"\n[ \t]*(?:#|\*|//|%)+", "\n", text))


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match[0])


def _code(match: re.Match[str]) -> str:
    return "_" + "\n" * match[0].count("\n")


def _markdown(text: str) -> Iterator[Piece]:
    """Paragraphs, list items, headings and cells of tables."""
    text = re.sub(r"^(```|~~~|:::).*?^\1[^\n]*$|<!--.*?-->", _blank, text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"\]\([^)\s]*\)", "]", re.sub(_SPAN, _code, text))
    line, begin, piece = 0, 0, ""
    for line, each in enumerate([*text.splitlines(), ""], 1):
        words = each.strip(" >")
        if not words or re.match(r"(?:[-*#|]|\d+\.) ?", words):
            if piece:
                yield begin, piece
            piece = ""
        if words.startswith("|"):
            yield from ((line, BEGIN + cell.strip()) for cell in words.split("|") if cell.strip(" -:"))
        elif words:
            mark = "" if words.startswith("#") else BEGIN
            begin, piece = (begin, f"{piece}\n{words}") if piece else (line, mark + words.lstrip("-*# "))


def _groups(expression: re.Pattern[str], text: str) -> Iterator[tuple[int, int]]:
    for match in expression.finditer(text):
        yield match.span(match.lastgroup or 0)


def _comments(expression: re.Pattern[str], text: str) -> Iterator[tuple[int, int]]:
    return _joined((match.span("comment") for match in expression.finditer(text)), text)


def _joined(spans: Iterable[tuple[int, int]], text: str) -> Iterator[tuple[int, int]]:
    """Comments in lines that follow each other are one."""
    begin = end = -1
    for span in spans:
        if end >= 0 and not text[end : span[0]].strip(" \t\n#%/") and text.count("\n", end, span[0]) == 1:
            end = span[1]
            continue
        if end >= 0:
            yield begin, end
        begin, end = span
    if end >= 0:
        yield begin, end


def _of_source(expression: re.Pattern[str], text: str, tests: bool) -> Iterator[tuple[int, int]]:
    """Docstrings, comments and messages; tests have no messages, but strings that imitate others'."""
    comments = []
    for match in expression.finditer(text):
        string = match["string"]
        if string is None:
            comments.append(match.span(match.lastgroup or 0))
        elif '"""' in string[:5]:
            if not text[text.rfind("\n", 0, match.start()) + 1 : match.start()].strip():
                yield match.start() + string.index('"""') + 3, match.end() - 3
        elif not tests and _is_prose(string):
            yield match.start() + 1, match.end() - 1
    yield from _joined(comments, text)


def _is_prose(string: str) -> bool:
    return len(re.findall(r"(?<![\w/-])[a-z]+(?![\w/-])", string)) >= 3


# --- what is found ---


def places(file: str, text: str) -> list[Place]:
    """Each place of forbidden words in a file."""
    found = [
        Place(file, line + piece.count("\n", 0, match.start()), _words(match), rule.instead)
        for line, piece in prose(file, text)
        for rule in rules()
        for match in rule.expression.finditer(piece)
    ]
    return sorted(found, key=lambda place: place.line)


def _words(match: re.Match[str]) -> str:
    """With what follows, to find it."""
    after = match.string[match.end() : match.end() + 20].partition("\n")[0]
    return " ".join(f"{match[0]}{after}".replace(BEGIN, " ").split())


def files() -> list[str]:
    """Files of the checkout that git knows or would add."""
    argv = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, check=True).stdout.splitlines()
    return sorted(
        {file for file in listed if (paths.PROJECT / file).is_file() and not (paths.PROJECT / file).is_symlink()}
    )


def found(names: Iterable[str]) -> dict[str, list[Place]]:
    """By file, where there is any."""
    each = {name: _read(paths.PROJECT / name) for name in names}
    return {name: there for name, text in each.items() if (there := places(name, text))}


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def left() -> dict[str, int]:
    """Numbers of the list."""
    lines = [line for line in LEFT.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return {name: int(number) for number, _, name in (line.strip().partition(" ") for line in lines)}


_HEAD = """\
# How many forbidden words each file has (tests/prose.yml). A number only goes down: correct prose, then run
# `build/venv/bin/python -m tests.prose lower`.
"""


def lower() -> None:
    counts = {name: len(there) for name, there in found(files()).items()}
    if LEFT.exists():
        counts = {name: min(counts[name], number) for name, number in left().items() if name in counts}
    LEFT.write_text(
        _HEAD + "".join(f"{number:4} {name}\n" for name, number in sorted(counts.items())), encoding="utf-8"
    )


def main(argv: list[str]) -> None:
    if argv == ["lower"]:
        lower()
    elif argv[:1] == ["show"]:
        wanted = [name for name in files() if not argv[1:] or {name, *map(str, Path(name).parents)} & set(argv[1:])]
        for there in found(wanted).values():
            print(*there, sep="\n")
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
