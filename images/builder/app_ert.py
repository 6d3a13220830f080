"""Models by Embedded Coder as blocks: what their generated headers say, and the C file between them and the runtime.

The code must be generated with reusable functions, so that all state is in structures that its functions are given:
the real-time model (RT_MODEL_…), and where there are any, inputs (ExtU_…), outputs (ExtY_…), parameters (P_…), states
(DW_…) and signals (B_…). Who passes which is a setting of the coder's; so types decide here, not places or names.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from pycparser import c_ast, c_parser

from images.builder import paths, runtime
from images.builder.errors import UserError

TEMPLATE = paths.PROJECT / "images" / "apps" / "ert_block.c.j2"
GENERATED = "generated"
"""Folder of an app with what the coder made."""
INNER = "flotilla_simulink.h"
"""A file there if the model has blocks of the runtime, which `flotilla-blocks --legacy-code` made."""
_TYPES = {
    "real_T": "double", "real64_T": "double", "time_T": "double", "double": "double",
    "real32_T": "single", "float": "single", "boolean_T": "boolean", "bool": "boolean", "_Bool": "boolean",
    "int_T": "int32", "uint_T": "uint32", "int": "int32",
    **{f"{name}{end}": name for name in ("int8", "int16", "int32", "int64") for end in ("_T", "_t")},
    **{f"u{name}{end}": f"u{name}" for name in ("int8", "int16", "int32", "int64") for end in ("_T", "_t")},
}  # fmt: skip
"""Simulink's types, which are the runtime's, by their names in generated code."""
_HEADERS = {
    "stdint.h": "".join(
        f"typedef {'unsigned ' if sign else ''}{c} {sign}int{bits}_t;\n"
        for sign in ("", "u")
        for bits, c in ((8, "char"), (16, "short"), (32, "int"), (64, "long long"))
    ),
    "stddef.h": "typedef unsigned long size_t;\n",
    "stdbool.h": "#define bool _Bool\n#define true 1\n#define false 0\n",
}
"""What the parser sees of the C library; of further headers nothing, since none of their types is a signal's."""
_SAMPLE_TIME = re.compile(r"_step(\d+)\s*\([^)]*\)\s*/\*\s*Sample time: \[([0-9.eE+-]+)s,")
"""What the coder writes behind the head of each rate's step function."""
_ONLY_SAMPLE_TIME = re.compile(r"rt_OneStep to a timer or interrupt service routine with[\s*/]+period ([0-9.eE+-]+) s")
"""What it writes into ert_main.c, its example of a main program, where there is one rate."""


@dataclass(frozen=True)
class Signal:
    """A root port."""

    name: str
    type: str
    """The runtime's, such as `double`."""
    width: int


@dataclass(frozen=True)
class Parameter(Signal):
    """A parameter of numbers."""

    value: float | None
    """As generated. A vector has none here: a task file that says nothing about it leaves it as it is."""

    @property
    def vector(self) -> bool:
        return self.value is None


@dataclass(frozen=True)
class Step:
    """One rate."""

    function: str
    arguments: str
    every: int
    """Runs in each so many-th step of the fastest rate."""


@dataclass
class Model:
    """What a generated model consists of."""

    name: str
    model_type: str = ""
    """Of the real-time model."""
    members: dict[str, str] = field(default_factory=dict)
    """What an instance has besides: C type by the type's first part, such as `DW`."""
    packed: dict[str, str] = field(default_factory=dict)
    """Pointers of the real-time model to be set, to which member."""
    inputs: list[Signal] = field(default_factory=list)
    outputs: list[Signal] = field(default_factory=list)
    parameters: list[Parameter] = field(default_factory=list)
    input_member: str = ""
    output_member: str = ""
    parameter_member: str = ""
    steps: list[Step] = field(default_factory=list)
    initialize: str = ""
    """Its arguments; so too of `terminate`."""
    terminate: str | None = None
    error_status: bool = False
    period_s: float | None = None
    """Of the fastest rate, where the code says so."""
    inner: bool = False
    """It calls blocks of the runtime."""


def block(directory: Path, model: str, name: str, sample_times_s: list[float], out: Path) -> None:
    """Fill `out` with the C files of a plug-in whose block is `name`."""
    generated = directory / GENERATED
    header, source = generated / f"{model}.h", generated / f"{model}.c"
    for file in (header, source):
        if not file.is_file():
            remedy = f"{GENERATED}/ holds what Embedded Coder made of the model, whose name is the key model's"
            raise UserError(f"{paths.shown(file)} is missing; {remedy}")
    shutil.copytree(generated, out, ignore=shutil.ignore_patterns("ert_main.*", "*.o"))
    said = "".join(path.read_text(errors="replace") for path in [source, *generated.glob("ert_main.*")])
    found = read(model, preprocess(out, model), said, sample_times_s)
    found.inner = (out / INNER).is_file()
    (out / "flotilla_block.c").write_text(render(found, name))


def preprocess(generated: Path, model: str) -> str:
    """The header and the file of parameters, as the compiler sees them but for the C library."""
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".ert-") as directory:
        work = Path(directory)
        shutil.copytree(generated, work / "source")
        (work / "library").mkdir()
        text = "".join(path.read_text(errors="replace") for path in (work / "source").rglob("*.[ch]"))
        for name in {*_HEADERS, *re.findall(r"#\s*include\s*<([\w./]+)>", text)}:
            (work / "library" / name).parent.mkdir(parents=True, exist_ok=True)
            (work / "library" / name).write_text(_HEADERS.get(name, ""))
        data = f'#include "{model}_data.c"\n' if (work / "source" / f"{model}_data.c").exists() else ""
        (work / "source" / "flotilla_model.c").write_text(f'#include "{model}.h"\n{data}')
        argv = ["env", "-C", "/out/source", "gcc", "-E", "-P", "-nostdinc", "-I/out/library", "-I."]
        runtime.command(work, "amd64", [*argv, "-D__attribute__(x)=", "-o", "/out/model.i", "flotilla_model.c"])
        return (work / "model.i").read_text()


def read(model: str, preprocessed: str, source: str, sample_times_s: list[float]) -> Model:
    """What the model consists of; UserError with what of it cannot become a block.

    `source` is the model's C file and ert_main.c, whose comments tell the rates where `sample_times_s` is empty.
    """
    try:
        tree = c_parser.CParser().parse(preprocessed, f"{model}.h")
    except Exception as error:  # the parser's own class moved between its versions
        raise UserError(f"{model}.h: {error}") from None
    return _Reader(model, tree).read(source, sample_times_s)


def render(model: Model, name: str) -> str:
    """The C file that makes it the block `name`."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["written"] = _written
    return environment.from_string(TEMPLATE.read_text()).render(model=model, name=name)


def _written(value: float, kind: str) -> str:
    """A number as a task file has it."""
    if kind == "boolean":
        return "true" if value else "false"
    return repr(value) if kind in ("double", "single") else str(int(value))


class _Reader:
    def __init__(self, model: str, tree: Any) -> None:
        self.model = model
        self.types: dict[str, Any] = {}
        self.structures: dict[str, Any] = {}
        self.functions: dict[str, Any] = {}
        self.values: dict[str, Any] = {}
        self.variables: dict[str, str] = {}
        for declaration in tree.ext:
            if isinstance(declaration, c_ast.Typedef):
                self.types[declaration.name] = declaration.type
                self._note(declaration.type)
            elif isinstance(declaration, c_ast.Decl):
                self._note(declaration.type)
                if isinstance(declaration.type, c_ast.FuncDecl):
                    self.functions[declaration.name] = declaration.type
                elif declaration.name and (named := _type_name(declaration.type)):
                    self.variables[declaration.name] = named
                    if declaration.init:
                        self.values[declaration.name] = declaration.init

    def read(self, source: str, sample_times_s: list[float]) -> Model:
        found = Model(self.model)
        names = [name for name in self.types if re.fullmatch(rf"[A-Za-z_]+_{self.model}(_T)?", name)]
        models = [name for name in names if name.startswith("RT_MODEL_")]
        if not models:
            raise self._no(
                f"has no RT_MODEL_{self.model}…: generate it with reusable functions (code interface packaging)"
            )
        found.model_type = models[0]
        for name in names:
            if name != found.model_type and self._fields(name):
                found.members[name.partition(f"_{self.model}")[0]] = name
        by_type = {type_name: member for member, type_name in found.members.items()}
        for part in self._fields(found.model_type):
            pointed = _type_name(part.type.type) if isinstance(part.type, c_ast.PtrDecl) else None
            if pointed in by_type:
                found.packed[part.name] = by_type[pointed]
            found.error_status |= part.name == "errorStatus"
        for member, type_name in found.members.items():
            if member in ("ExtU", "ExternalInputs"):
                found.input_member, found.inputs = member, self._signals(type_name)
            elif member in ("ExtY", "ExternalOutputs"):
                found.output_member, found.outputs = member, self._signals(type_name)
            elif member in ("P", "Parameters") and (variable := self._variable(type_name)):
                found.parameter_member, found.parameters = member, self._parameters(type_name, variable)
        arguments = {found.model_type: "&instance->model", **{t: f"&instance->{m}" for t, m in by_type.items()}}
        found.initialize = self._call("initialize", arguments)
        found.terminate = self._call("terminate", arguments) if f"{self.model}_terminate" in self.functions else None
        self._rates(found, arguments, source, sample_times_s)
        return found

    def _rates(self, found: Model, arguments: dict[str, str], source: str, times_s: list[float]) -> None:
        """The step functions, and how often each runs."""
        numbers = [str(n) for n in range(len(self.functions)) if f"{self.model}_step{n}" in self.functions] or [""]
        said = {number: float(time) for number, time in _SAMPLE_TIME.findall(source)}
        if numbers == [""] and (only := _ONLY_SAMPLE_TIME.search(source)):
            said[""] = float(only[1])
        times = times_s or [said[number] for number in numbers if number in said]
        if len(times) != len(numbers) and (times_s or len(numbers) > 1):
            remedy = "say sample_times: [0.01, 0.05], fastest first, in seconds"
            raise self._no(f"has {len(numbers)} step functions, and {len(times)} sample times are known; {remedy}")
        for number, time in zip(numbers, times or [1.0], strict=True):
            every = round(time / (times[0] if times else 1.0))
            if every < 1 or (times and not math.isclose(every * times[0], time, rel_tol=1e-6)):
                raise self._no(f"has a step{number} each {time:g} s, which is no multiple of {times[0]:g} s")
            step = f"step{number}"
            found.steps.append(Step(f"{self.model}_{step}", self._call(step, arguments), every))
        found.period_s = times[0] if times else None

    def _call(self, function: str, arguments: dict[str, str]) -> str:
        """The arguments that a function takes, from an instance."""
        name = f"{self.model}_{function}"
        if name not in self.functions:
            raise self._no(f"has no function {name}; generate it with reusable functions")
        parameters = self.functions[name].args.params if self.functions[name].args else []
        given = []
        for parameter in parameters:
            named = _type_name(parameter.type.type) if isinstance(parameter.type, c_ast.PtrDecl) else None
            if named in arguments:
                given.append(arguments[named])
            elif _type_name(parameter.type) != "void":
                remedy = "pass root-level I/O as a structured reference, or as part of the model's data structure"
                raise self._no(f"has a {name} with a parameter {parameter.name}, whose type is no structure; {remedy}")
        if function.startswith("step") and "&instance->model" not in given:
            raise self._no(f"has a {name} that is given no model; generate it with reusable functions")
        return ", ".join(given)

    def _signals(self, type_name: str) -> list[Signal]:
        found = []
        for part in self._fields(type_name):
            kind, width = self._number(part.type)
            if not kind:
                remedy = "root ports are numbers or vectors of them; take a bus apart in the model"
                raise self._no(f"has a root port {part.name} of another kind; {remedy}")
            found.append(Signal(part.name, kind, width))
        return found

    def _parameters(self, type_name: str, variable: str) -> list[Parameter]:
        """Those that are numbers; others keep what was generated."""
        found = []
        initial = _items(self.values.get(variable), [part.name for part in self._fields(type_name)])
        for part in self._fields(type_name):
            kind, width = self._number(part.type)
            value = _value(initial.get(part.name))
            if isinstance(part.type, c_ast.ArrayDecl):
                if kind and kind != "boolean":
                    found.append(Parameter(part.name, kind, width, None))
            elif kind and value is not None and math.isfinite(value):
                found.append(Parameter(part.name, kind, width, value))
        return found

    def _number(self, node: Any) -> tuple[str, int]:
        """Type and width of a number or a vector; no type for anything else."""
        width = 1
        if isinstance(node, c_ast.ArrayDecl):
            width = int(_value(node.dim) or 0)
            node = node.type
        name = _type_name(node)
        for _ in self.types:  # a type may be another name of another name
            if name in _TYPES or name not in self.types:
                break
            name = _type_name(self.types[name])
        return _TYPES.get(name or "", ""), width

    def _fields(self, type_name: str) -> list[Any]:
        """The fields of a structure; none of what is no structure."""
        node = self.types.get(type_name)
        structure = getattr(node, "type", None)
        if not isinstance(structure, c_ast.Struct):
            return []
        return list(structure.decls or self.structures.get(structure.name) or [])

    def _variable(self, type_name: str) -> str | None:
        return next((name for name, named in self.variables.items() if named == type_name), None)

    def _note(self, node: Any) -> None:
        """Remember a structure that is defined here."""
        while isinstance(node, (c_ast.TypeDecl, c_ast.PtrDecl, c_ast.ArrayDecl)):
            node = node.type
        if isinstance(node, c_ast.Struct) and node.name and node.decls:
            self.structures[node.name] = node.decls

    def _no(self, message: str) -> UserError:
        return UserError(f"{GENERATED}/{self.model}.h: {message}")


def _type_name(node: Any) -> str | None:
    """The name of a plain type."""
    if isinstance(node, c_ast.TypeDecl) and isinstance(node.type, c_ast.IdentifierType):
        return " ".join(node.type.names)
    return None


def _items(node: Any, names: list[str]) -> dict[str, Any]:
    """The initial values of a structure's fields."""
    found = {}
    for name, item in zip(names, node.exprs if isinstance(node, c_ast.InitList) else [], strict=False):
        if isinstance(item, c_ast.NamedInitializer):
            found[item.name[0].name] = item.expr
        else:
            found[name] = item
    return found


def _value(node: Any) -> float | None:
    """A constant's value; None of anything else."""
    if isinstance(node, c_ast.Cast):
        return _value(node.expr)
    if isinstance(node, c_ast.UnaryOp) and node.op in "+-":
        value = _value(node.expr)
        return -value if value is not None and node.op == "-" else value
    if isinstance(node, c_ast.Constant) and node.type not in ("string", "char"):
        text = node.value.rstrip("uUlL")
        return float(int(text, 0)) if re.fullmatch(r"0[xX][0-9a-fA-F]+|[0-9]+", text) else float(text.rstrip("fF"))
    return None
