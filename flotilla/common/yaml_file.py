"""YAML files that users write: typed values, or all that is wrong with them: file and line, key, value, remedy."""

from __future__ import annotations

import difflib
import textwrap
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from flotilla.common import paths
from flotilla.common.errors import Problem, ProblemsError, UserError

Model = TypeVar("Model", bound=BaseModel)
Loc = tuple[str | int, ...]
"""Where a value stands: keys and indices from the file's top."""

SYNTAX = "(syntax)"
"""The key of a problem that makes a file no YAML at all."""

_NUMBERS = {f"tag:yaml.org,2002:{name}" for name in ("int", "float", "bool", "null")}


@dataclass(frozen=True)
class Entry:
    """A mapping in a file, or the file as a whole."""

    file: Path
    text: str
    key: yaml.Node
    """The mapping's own key; the file's beginning if the mapping is the file."""
    node: yaml.Node

    def at(self, node: yaml.Node) -> str:
        return f"{paths.shown(self.file)}:{node.start_mark.line + 1}"

    def written(self, node: yaml.Node) -> str:
        """A value as it stands in the file."""
        if not isinstance(node, yaml.ScalarNode):
            return "…"
        text = self.text[node.start_mark.index : node.end_mark.index]
        return textwrap.shorten(text, 60, placeholder=" …") or "(empty)"

    def locate(self, path: Loc) -> tuple[str, str] | None:
        """File with line, and text, of the value at `path`; None if the entry lacks the first step.

        What is missing further down is located at what should contain it."""
        key, node = self.key, self.node
        for depth, step in enumerate(path):
            found = child(node, step)
            if not found:
                return (self.at(key), "(missing)") if depth else None
            key, node = found
        return self.at(key), self.written(node)

    def problem(self, key: yaml.Node, path: Loc, value: yaml.Node, message: str, remedy: str) -> Problem:
        return Problem(self.at(key), dotted(path), self.written(value), message, remedy)

    def twice(self, node: yaml.Node, path: Loc = (), unnamed: Collection[str] = ()) -> Iterator[Problem]:
        """Keys at `node` and below that stand twice: YAML keeps the last. Below keys in `unnamed` paths begin anew."""
        first: dict[str, yaml.Node] = {}
        for key, value in pairs(node):
            here = (*path, key.value)
            if key.value in first:
                line = first[key.value].start_mark.line + 1
                message = f"stands twice, first in line {line}"
                yield self.problem(key, here, value, message, "give it another name, or remove one of the two")
            first.setdefault(key.value, key)
            yield from self.twice(value, () if key.value in unnamed else here, unnamed)
        if isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                yield from self.twice(item, (*path, index), unnamed)


def plain(node: yaml.Node) -> Any:
    """What a node stands for: mappings, lists, numbers, true, false, None and strings. Keys are strings, `on` too."""
    if isinstance(node, yaml.MappingNode):
        return {key.value: plain(value) for key, value in pairs(node)}
    if isinstance(node, yaml.SequenceNode):
        return [plain(item) for item in node.value]
    try:
        return yaml.constructor.SafeConstructor().construct_object(node) if node.tag in _NUMBERS else node.value
    except ValueError:  # the text contradicts its tag
        return node.value


def compose(path: Path) -> Entry | Problem | None:
    """The file as a whole; the problem that makes it no YAML; None for an empty one."""
    try:
        text = path.read_text(encoding="utf-8")
        root = yaml.compose(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        value = text.splitlines()[mark.line].strip() if mark and mark.line < len(text.splitlines()) else "(text)"
        message = f"is not YAML: {getattr(error, 'problem', None) or error}"
        remedy = "look at indentation (blanks, no tabs), colons and quotes here and in the lines above"
        return Problem(paths.shown(path) + line, SYNTAX, value, message, remedy)
    return Entry(path, text, root, root) if root else None


def read(path: Path, model: type[Model]) -> Model:
    """What a file says that comes with the project; UserError or ProblemsError with all that is wrong in it."""
    if not path.exists():
        raise UserError(f"{paths.shown(path)}: is missing; restore it from git")
    entry = compose(path)
    if isinstance(entry, Problem):
        raise ProblemsError([entry])
    try:
        return model.model_validate(yaml.safe_load(entry.text) if entry else {})
    except ValidationError as error:
        raise ProblemsError([_problem(path, entry, model, detail) for detail in error.errors()]) from None


def _problem(path: Path, entry: Entry | None, model: type[BaseModel], detail: ErrorDetails) -> Problem:
    loc = tuple(step for step in detail["loc"] if step != "[key]")
    place, value = (entry.locate(loc) if entry else None) or (f"{paths.shown(path)}:1", "(missing)")
    return Problem(place, dotted(loc) or "(file)", value, *explained(model, loc, detail))


def pairs(node: yaml.Node) -> list[tuple[yaml.ScalarNode, yaml.Node]]:
    """Key and value nodes of a mapping with plain keys; none of anything else."""
    found = node.value if isinstance(node, yaml.MappingNode) else []
    return [(key, value) for key, value in found if isinstance(key, yaml.ScalarNode)]


def child(node: yaml.Node, step: str | int) -> tuple[yaml.Node, yaml.Node] | None:
    """Key and value nodes at `step` of a mapping or list."""
    if isinstance(node, yaml.SequenceNode):
        return (node.value[step],) * 2 if isinstance(step, int) and step < len(node.value) else None
    return next(((key, value) for key, value in reversed(pairs(node)) if key.value == str(step)), None)


def dotted(path: Loc) -> str:
    return ".".join(map(str, path))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    known = sorted(known)
    close = difflib.get_close_matches(name, known, 1, 0.5)
    return f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"


_EXPLANATIONS = {
    "missing": ("is missing", "add it as its neighbours have it"),
    "int_type": ("is not a whole number", "digits without quotes"),
    "float_type": ("is not a number", "digits without quotes"),
    "string_type": ("is not a text", "put it in quotes"),
    "bool_type": ("is neither true nor false", "true or false, without quotes"),
    "literal_error": ("is not known", "one of {expected}"),
    "ip_v4_address": ("is not an IPv4 address", "four numbers from 0 to 255, such as 10.42.0.5"),
    "ip_v4_network": ("is not an IPv4 network", "address/length with zeros in the hosts' part, such as 10.42.0.0/24"),
    "dict_type": ("is not a mapping", "`name: value` lines below it, or remove it"),
    "model_type": ("is not a mapping", "`name: value` lines below it"),
    "list_type": ("is not a list", "`- item` lines below it, or [] for none"),
    "tuple_type": ("is not a list", "`- item` lines below it, or [] for none"),
    "extra_forbidden": ("is not known", "{similar}"),
    "flotilla": ("{message}", "{remedy}"),
}
"""By pydantic's error type: what is wrong, what would be right."""


UNEXPLAINED = "the comments in the file list its values"
"""The remedy of last resort."""


def explained(root: type[BaseModel], loc: Loc, detail: ErrorDetails) -> tuple[str, str]:
    """What is wrong, and what would be right, where pydantic found an error at `loc` of `root`."""
    message, remedy = _EXPLANATIONS.get(detail["type"], (detail["msg"], UNEXPLAINED))
    context = detail.get("ctx", {})
    if detail["type"] == "extra_forbidden":
        context = {"similar": did_you_mean(str(loc[-1]), _model_at(root, loc[:-1]).model_fields.keys() - {"name"})}
    return message.format(**context), remedy.format(**context)


def _model_at(root: type[BaseModel], loc: Loc) -> type[BaseModel]:
    """The model that describes the mapping at `loc`."""
    here: Any = root
    for step in loc:
        if get_origin(here) in (dict, list, tuple):
            here = get_args(here)[1 if get_origin(here) is dict else 0]
        else:
            here = here.model_fields[step].annotation
        if get_origin(here) is UnionType:  # Ibss | None
            here = get_args(here)[0]
    model: type[BaseModel] = here
    return model
