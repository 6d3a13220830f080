"""Models by Embedded Coder as blocks: what their generated headers say, and the C file between them and the runtime.

How the coder packages a model is a choice of its user's. Where a function takes structures, or the real-time model
(RT_MODEL…) points to them, each block has structures of its own. What is in global variables, as in nonreusable code
(the coder's default), exists once, and so does the block in a task. Root ports are fields of structures (ExtU…, ExtY…),
arguments of functions, or exported variables. Names of types follow the coder's rule for identifiers, which may leave
out or cut the model's name; so the first part of a type's name decides, and where it is used.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import jinja2
from pycparser import c_ast, c_parser

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.common.sources import LEFT_BEHIND
from flotilla.debian import runtime
from flotilla.fleet.model import System

TEMPLATE = Path(__file__).parent / "templates" / "ert_block.c.j2"
GENERATED = "generated"
"""Folder of an app with what the coder made."""
INNER = "flotilla_simulink.h"
"""A file there if the model has blocks of the runtime, which `flotilla-blocks --legacy-code` made."""
_MAINS = ("ert_main.*", "rt_main.*", "classic_main.*")
"""Programs around the model. They are read but not compiled."""
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
    "stdio.h": "typedef struct file FILE;\n",
    "uchar.h": "typedef unsigned short char16_t;\ntypedef unsigned char32_t;\n",
    "float.h": "".join(
        f"#define {kind}_{name} __{kind}_{name}__\n"
        for kind in ("FLT", "DBL", "LDBL")
        for name in ("MANT_DIG", "DIG", "EPSILON", "MIN", "MAX", "MIN_EXP", "MAX_EXP")
    ),
    # By the compiler's own word sizes: generated code compares them with those that it was made for.
    "limits.h": "".join(
        f"#define {name}_MAX __{macro}_MAX__\n#define {name}_MIN (-{name}_MAX - 1)\n"
        f"#define U{name.removeprefix('S') if name != 'SHRT' else name}_MAX (__{macro}_MAX__ * 2{suffix} + 1{suffix})\n"
        for name, macro, suffix in (
            ("SCHAR", "SCHAR", ""), ("SHRT", "SHRT", ""), ("INT", "INT", "U"), ("LONG", "LONG", "UL"),
            ("LLONG", "LONG_LONG", "ULL"),
        )
    ),
}  # fmt: skip
"""What the parser sees of the C library; of further headers nothing, since none of their types is a signal's."""
_EMPTY = (
    "assert.h", "complex.h", "ctype.h", "errno.h", "fenv.h", "inttypes.h", "iso646.h", "locale.h", "math.h", "setjmp.h",
    "signal.h", "stdalign.h", "stdarg.h", "stdatomic.h", "stdlib.h", "stdnoreturn.h", "string.h", "tgmath.h",
    "threads.h", "time.h", "wchar.h", "wctype.h",
)  # fmt: skip
"""The other headers of C, which code may ask for in quotes, too."""
_WITHOUT = (
    "__attribute__(x)=",
    "__extension__=",
    "__inline=inline",
    "__inline__=inline",
    "__restrict=",
    "__volatile__=",
)
"""Words of the compiler that the parser does not know, and what stands for them."""
_ROLES = {
    "model": ("RT_MODEL",),
    "parameters": ("P", "Parameters"),
    "inputs": ("ExtU", "ExternalInputs"),
    "outputs": ("ExtY", "ExternalOutputs"),
    "signals": ("B", "BlockIO"),
    "states": ("DW", "D_Work"),
    "continuous": ("X", "ContinuousStates"),
    "disabled": ("XDis", "StateDisabled"),
    "crossings": ("PrevZCX", "PrevZCSigStates"),
}
"""A model's structures, by the first part of their types' names: today's, and those until R2013a."""
_POINTERS = {
    "defaultParam": "parameters", "inputs": "inputs", "outputs": "outputs", "blockIO": "signals", "dwork": "states",
    "contStates": "continuous", "contStateDisabled": "disabled", "prevZCSigState": "crossings",
}  # fmt: skip
"""Fields of the real-time model, which may be pointers to void."""
_EXPORTED = re.compile(
    r"^[ \t]*extern\s+(?:volatile\s+)?(\w+)\s+(\w+)(\[\d+\])?\s*;\s*/\*\s*(?:(Variable:)|'<Root>/([^'\n]+)')", re.M
)
"""A variable for a parameter or for a root port, with the coder's comment behind it."""
_STEP_SIZE = re.compile(r"(?:->|\.)Timing\.stepSize0\s*=\s*\(?([0-9.eE+-]+)\)?\s*;")
"""The period that the code itself computes with."""
_BASE_PERIOD = re.compile(r"\bperiod\s+([0-9.eE+-]+)\s+seconds\s+\((?:the model's base sample time|base rate)")
"""What the coder's example of a main program says."""
_MISSING = re.compile(r"fatal error: ([\w./+-]+): No such file or directory")
_WORD_SIZE = re.compile(r"#error \"?Code was generated for compiler with different sized (\S+?)\.?\s")
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.S)
_PACK = f"let MATLAB collect all files with packNGo(buildInfo), and unpack them into {GENERATED}/"
_ABSENT = {
    **dict.fromkeys(
        ("rtw_continuous.h", "rtw_solver.h", "rt_logging.h", "simstruc.h", "simstruc_types.h", "fixedpoint.h",
         "tmwtypes.h", "dt_info.h", "ext_work.h", "rtw_extmode.h", "sysran_types.h", "rtw_modelmap.h",
         "solver_zc.h"),
        f"a header of MATLAB's own, which the model's options need; {_PACK}",
    ),
    **dict.fromkeys(
        ("arm_math.h", "arm_nnfunctions.h", "cmsis_compiler.h"),
        "CMSIS, the library of ARM processors, and robots have none; generate without a code replacement library",
    ),
}  # fmt: skip
"""Headers that are no part of generated code, and why it asks for them."""
_UNKNOWN = (
    (
        re.compile(r"(^|/)MW_\w+\.h$"),
        "of a hardware support package, and drives a board; generate for no hardware board",
    ),
    (
        re.compile(
            r"(^|/)(rt\w*|rtw_\w+|look\w+|plook\w+|intrp\w+|mul_\w+|div_\w+|\w+_(types|private|data|shared|defines))\.h$"
        ),
        f"part of the generated code, such as the files in slprj/ert/_sharedutils; {_PACK}",
    ),
    (
        re.compile(""),
        "neither the coder's nor the C library's, but of code that the model calls (custom code, an S-function); put "
        f"it and its sources into {GENERATED}/",
    ),
)
"""Reasons for other headers, by their names."""
_TAKE_APART = "root ports are numbers, vectors of them, or buses of these; give it another type in the model"
_TAKE_DEFAULT = "leave names of arguments and storage of root ports as the coder has them by default"


@dataclass(frozen=True)
class Signal:
    """A root port."""

    name: str
    type: str
    """The runtime's, such as `double`."""
    width: int
    place: str
    """Where the model has it, as C."""
    port: str = field(default="", kw_only=True)
    """Where the whole root port is, of which this is a part: of a bus, all its numbers are ports of the block."""
    rate: int = field(default=0, kw_only=True)
    """Which of the model's threads reads or writes it: 0 is the block's step, others as in `Model.slower`."""


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
    result: str = ""
    """Where what it returns goes."""
    number: int | None = None
    """The rate's, where one function is given it (tid)."""


@dataclass(frozen=True)
class Code:
    """What the coder made, with its comments."""

    header: str
    """The model's."""
    sources: str
    """All that is compiled."""
    main: str = ""
    """The example of a program around the model; none if it was not kept."""
    defines: tuple[str, ...] = ()
    """Macros that it was generated for, such as `MAT_FILE=0`."""


@dataclass
class Model:
    """What a generated model consists of."""

    name: str
    members: dict[str, str] = field(default_factory=dict)
    """What an instance has: C type by role, such as `states`."""
    arguments: list[str] = field(default_factory=list)
    """Declarations of the root ports that functions are given one by one."""
    packed: dict[str, str] = field(default_factory=dict)
    """Pointers of the real-time model to be set, to which member."""
    inputs: list[Signal] = field(default_factory=list)
    outputs: list[Signal] = field(default_factory=list)
    parameters: list[Parameter] = field(default_factory=list)
    initial: str = ""
    """The variable with the values that an instance's own parameters begin with."""
    definition: str = ""
    """Of that variable where no file that is compiled has it; else its declaration."""
    steps: list[Step] = field(default_factory=list)
    begin: str = ""
    """The function that initializes it."""
    end: str = ""
    initialize: str = ""
    """Arguments of `begin`; so too `terminate` of `end`."""
    terminate: str | None = None
    error_status: str = ""
    """Where the model says that it failed, as C."""
    stop: str = ""
    """Where a Stop Simulation block of the model asks for its end, as C."""
    period_s: float | None = None
    """Of the fastest rate, where the code says so."""
    shared: str = ""
    """A global variable of the model; because of it a task can have one such block only."""
    inner: bool = False
    """It calls blocks of the runtime."""
    threads: bool = False
    """Each slower rate has a thread."""

    @property
    def own(self) -> list[Step]:
        """Steps that the block's step calls itself."""
        return [step for step in self.steps if step.every == 1 or not self.threads]

    @property
    def slower(self) -> list[Step]:
        """Steps with threads, fastest first."""
        return sorted((step for step in self.steps if step not in self.own), key=lambda step: step.every)


DEFINES = "defines.txt"
"""Where packNGo leaves the macros that the coder's own build would define, one a line."""


def block(
    directory: Path,
    model: str,
    name: str,
    sample_times_s: list[float],
    out: Path,
    system: System,
    tasking: str | None = None,
) -> list[str]:
    """Fill `out` with the C files of a plug-in for `system`, whose block is `name`; the compiler's options for them.

    `tasking`: the key of app.yml.
    """
    code = collect(directory / GENERATED, model, out)
    found = read(model, preprocess(out, model, code, system), code, sample_times_s)
    found.inner = (out / INNER).is_file()
    if tasking != "single":
        separate(found, code, wanted=tasking == "threads")
    (out / "flotilla_block.c").write_text(render(found, name))
    return [f"-D{each}" for each in code.defines]


def collect(generated: Path, model: str, out: Path) -> Code:
    """Bring what the coder made into one folder `out`, wherever below `generated` it lies.

    Shared files lie in folders of their own (slprj/ert/_sharedutils), and packNGo keeps those.
    """
    for kind in (".h", ".c"):
        if any(generated.rglob(f"{model}{kind}")):
            continue
        if kind == ".c" and any(generated.rglob(f"{model}.c[px][px]")):
            raise _cplusplus(model)
        remedy = f"{GENERATED}/ holds what Embedded Coder made of the model, whose name is the key model's"
        raise UserError(f"{paths.shown(generated / f'{model}{kind}')} is missing; {remedy}")
    shutil.copytree(generated, out, ignore=shutil.ignore_patterns(*LEFT_BEHIND, *_MAINS, "*.o", "html"))
    for file in sorted(out.rglob("*.[ch]")):
        place = out / file.name
        if place.exists() and place.read_bytes() != file.read_bytes():
            raise UserError(f"{GENERATED}/: two files are named {file.name}, and differ; leave the model's own")
        if place != file:
            shutil.copyfile(file, place)
    mains = [file for pattern in _MAINS for file in sorted(generated.rglob(pattern))]
    sources = "".join(file.read_text(errors="replace") for file in sorted(out.glob("*.c")))
    header = (out / f"{model}.h").read_text(errors="replace")
    main = "".join(file.read_text(errors="replace") for file in mains)
    return Code(header, sources, main, _defined(sorted(generated.rglob(DEFINES))))


def _defined(files: list[Path]) -> tuple[str, ...]:
    """The macros of such files."""
    found: dict[str, str] = {}
    for file in files:
        for number, line in enumerate(file.read_text(errors="replace").splitlines(), 1):
            macro = line.strip().removeprefix("-D")
            if macro and not re.fullmatch(r"[A-Za-z_]\w*(\(\w*\))?(=.*)?", macro):
                remedy = "a line is NAME or NAME=VALUE, as packNGo writes it"
                raise UserError(f"{GENERATED}/{file.name}: line {number}: {macro}: is no macro; {remedy}")
            name = macro.partition("=")[0]
            if found.setdefault(name, macro) != macro:
                raise UserError(f"{GENERATED}/{DEFINES}: {found[name]} and {macro}; leave the model's own file alone")
    return tuple(macro for name, macro in found.items() if name)


def preprocess(generated: Path, model: str, code: Code, system: System) -> str:
    """The header as the robot's compiler sees it but for the C library, and the definitions of parameters."""
    if re.search(r"^\s*class\s+\w+", _COMMENT.sub("", code.header), re.M):
        raise _cplusplus(model)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".ert-") as directory:
        work = Path(directory)
        shutil.copytree(generated, work / "source")
        (work / "library").mkdir()
        text = "".join(path.read_text(errors="replace") for path in (work / "source").rglob("*.[ch]"))
        for name in {*_EMPTY, *_HEADERS, *re.findall(r"#\s*include\s*<([\w./]+)>", text)}:
            (work / "library" / name).parent.mkdir(parents=True, exist_ok=True)
            (work / "library" / name).write_text(_HEADERS.get(name, ""))
        (work / "source" / "flotilla_model.c").write_text(f'#include "{model}.h"\n')
        argv = ["env", "-C", "/out/source", "gcc", "-E", "-P", "-nostdinc", "-I/out/library", "-I."]
        argv += [*(f"-D{each}" for each in (*_WITHOUT, *code.defines)), "-o", "/out/model.i", "flotilla_model.c"]
        try:
            runtime.command(work, system, argv)
        except UserError as error:
            raise explained(error, system) from None
        declared = (work / "model.i").read_text()
    return declared + "".join(f"{text}\n" for kind, text in _definitions(code) if re.search(rf"\b{kind}\b", declared))


def explained(error: UserError, system: System) -> UserError:
    """What the compiler says of generated code, in terms of the coder's options where these are the cause."""
    if missing := _MISSING.search(str(error)):
        header = missing[1]
        reason = _ABSENT.get(Path(header).name) or next(why for names, why in _UNKNOWN if names.search(header))
        return UserError(f"{GENERATED}/{header} is missing: it is {reason}")
    if size := _WORD_SIZE.search(str(error)):
        remedy = "choose the robot's processor (x86-32 or x86-64, Linux) as hardware implementation"
        return UserError(
            f"the model was generated for another size of {size[1]} than {system.architecture} has; {remedy}"
        )
    return error


def read(model: str, preprocessed: str, code: Code, sample_times_s: list[float]) -> Model:
    """What the model consists of; UserError with what of it cannot become a block.

    Its rates are `sample_times_s`; where that is empty, those that comments tell.
    """
    try:
        tree = c_parser.CParser().parse(preprocessed, f"{model}.h")
    except Exception as error:  # the parser's own class moved between its versions
        raise UserError(f"{model}.h: {error}") from None
    return _Reader(model, tree, code).read(sample_times_s)


def render(model: Model, name: str) -> str:
    """The C file that makes it the block `name`."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["written"] = _written
    return environment.from_string(TEMPLATE.read_text()).render(model=model, name=name)


def separate(model: Model, code: Code, *, wanted: bool) -> None:
    """Give each slower rate a thread where the code permits it; UserError where it does not, and that is `wanted`.

    Root ports are in structures that all rates share. The coder gives a port one sample time, so the functions of one
    rate use it; only at that rate's releases is it copied.
    """
    model.threads = True
    if not model.slower or model.inner:
        model.threads = False
        if wanted:
            reason = "its blocks of the runtime run in one thread" if model.inner else "it has one rate"
            raise UserError(f"{GENERATED}/{model.name}.h: tasking: threads: {reason}; leave the key out")
        return
    bodies = _bodies(code.sources)
    roots = [[step.function for step in model.own], *([step.function] for step in model.slower)]
    if any(step.number is not None for step in model.slower):  # one function that is given the rate
        roots = [
            [f"{model.name}_step{step.number}" for step in steps]
            for steps in (model.own, *([each] for each in model.slower))
        ]
    missing = [name for names in roots for name in names if name not in bodies]
    if missing:
        model.threads = False
        if wanted:
            remedy = "one function for all rates runs in one thread; leave the key out"
            raise UserError(f"{GENERATED}/{model.name}.c: tasking: threads: has no function {missing[0]}; {remedy}")
        return
    used = [_reached(bodies, names) for names in roots]
    model.inputs = [_owned(model, signal, used, code.sources) for signal in model.inputs]
    model.outputs = [_owned(model, signal, used, code.sources) for signal in model.outputs]


def _owned(model: Model, signal: Signal, used: list[str], sources: str) -> Signal:
    """The port with the rate whose functions name it."""
    place = signal.port or signal.place
    field_of = re.search(r"\.(\w+)$", place)
    if place.startswith("instance->arguments.") or not field_of:
        pattern = rf"(?<![.>\w]){re.escape(place.rpartition('.')[2])}\b"
    else:
        role = "inputs" if signal in model.inputs else "outputs"
        kinds = "|".join(_ROLES[role])
        # Whatever is of the structure's type: the variable, a pointer to it, an argument.
        names = set(re.findall(rf"\b(?:{kinds})(?:_\w+)?\s*\*?\s*(?:const\s+)?(\w+)\s*[;,)=]", _plain(sources)))
        if not place.startswith("instance->"):
            names.add(re.sub(r"\W", "", place.rpartition(".")[0]))
        if not names:
            return signal
        pattern = rf"\b(?:{'|'.join(sorted(names))})\s*(?:\.|->)\s*{re.escape(field_of[1])}\b"
    rates = [number for number, text in enumerate(used) if re.search(pattern, text)]
    if len(rates) > 1:
        times = " and ".join(f"every {[model.own[0], *model.slower][rate].every}." for rate in rates)
        remedy = "give the port one sample time, with a Rate Transition block behind it, or write tasking: single"
        raise UserError(
            f"{GENERATED}/{model.name}.c: the root port {signal.name} is used in {times} step of the block; {remedy}"
        )
    return replace(signal, rate=rates[0] if rates else 0)


def _plain(sources: str) -> str:
    """Without comments, strings and directives."""
    text = re.sub(r'"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'', '""', _COMMENT.sub(" ", sources))
    return re.sub(r"^[ \t]*#(?:[^\n]*\\\n)*[^\n]*", "", text, flags=re.M)


def _bodies(sources: str) -> dict[str, str]:
    """Heads and bodies of the functions that are defined, by name."""
    text, found = _plain(sources), dict[str, str]()
    depth, begin, head = 0, 0, ""
    for match in re.finditer(r"[{};]", text):
        if match[0] == "{":
            if depth == 0:
                head, begin = text[begin : match.start()], match.end()
            depth += 1
        elif match[0] == "}":
            depth -= 1
            if depth == 0:
                named = re.search(r"(\w+)\s*\(", head) if head.rstrip().endswith(")") else None
                if named:
                    found[named[1]] = f"{found.get(named[1], '')}{head}{text[begin : match.start()]}\n"
                begin = match.end()
        elif depth == 0:
            begin = match.end()
    return found


def _reached(bodies: dict[str, str], names: list[str]) -> str:
    """What those functions and all that they call consist of."""
    reached = list(dict.fromkeys(names))
    for name in reached:
        reached += [
            each for each in dict.fromkeys(re.findall(r"\w+", bodies[name])) if each in bodies and each not in reached
        ]
    return "".join(bodies[name] for name in reached)


def _cplusplus(model: str) -> UserError:
    remedy = "generate C (code generation, language: C)"
    return UserError(f"{GENERATED}/{model} is C++, and the locked compiler for robots is one for C only; {remedy}")


def _definitions(code: Code) -> list[tuple[str, str]]:
    """Variables with the values of parameters: type, and the text up to the semicolon, without comments."""
    found = []
    text = _COMMENT.sub(" ", code.sources + "\n" + code.main)
    kinds = "|".join(_ROLES["parameters"])
    for match in re.finditer(rf"^[ \t]*(?:(?:static|const)\s+)*((?:{kinds})(?:_\w+)?)\s+\w+\s*=\s*\{{", text, re.M):
        depth, end = 1, match.end()
        while depth and end < len(text):
            depth += {"{": 1, "}": -1}.get(text[end], 0)
            end += 1
        found.append((match[1], f"{match[0].strip()}{text[match.end() : end]};"))
    for kind, name, vector, parameter, _ in _EXPORTED.findall(code.header):
        value = re.search(rf"^[ \t]*(?:volatile\s+)?{kind}\s+{name}\s*=\s*([^;{{]+);", text, re.M)
        if parameter and not vector and value:
            found.append((kind, f"{kind} {name} = {value[1]};"))
    return found


def _written(value: float, kind: str) -> str:
    """A number as a task file has it."""
    if kind == "boolean":
        return "true" if value else "false"
    return repr(value) if kind in ("double", "single") else str(int(value))


class _Reader:
    def __init__(self, model: str, tree: Any, code: Code) -> None:
        self.model = model
        self.code = code
        self.types: dict[str, Any] = {}
        self.structures: dict[str, Any] = {}
        self.functions: dict[str, Any] = {}
        self.values: dict[str, Any] = {}
        self.variables: dict[str, Any] = {}
        self.ports: dict[str, Any] = {}
        self.kinds: dict[str, str] = {}
        self.period_s: float | None = None
        for declaration in tree.ext:
            if isinstance(declaration, c_ast.Typedef):
                self.types[declaration.name] = declaration.type
                self._note(declaration.type)
            elif isinstance(declaration, c_ast.Decl):
                self._note(declaration.type)
                if isinstance(declaration.type, c_ast.FuncDecl):
                    self.functions[declaration.name] = declaration.type
                elif declaration.name:
                    self.variables.setdefault(declaration.name, declaration)
                    if declaration.init:
                        self.values[declaration.name] = declaration.init

    def read(self, sample_times_s: list[float]) -> Model:
        found = Model(self.model)
        if self.model in self.functions:
            remedy = "unset its option to use dynamic memory allocation for model initialization"
            raise self._no(f"allocates its structures in {self.model}(); {remedy}")
        entries = self._entries()
        functions = self._steps(sample_times_s, entries["step"])
        found.begin, found.end = entries["initialize"], entries["terminate"]
        names = [found.begin, *(name for name, _, _ in functions)]
        if found.end in self.functions:
            names.append(found.end)
        self._arguments(found, names)
        if "model" in found.members:
            self._pack(found)
        self.kinds = {role: kind.removeprefix("struct ") for role, kind in found.members.items()}
        places = {role: f"instance->{role}" for role in found.members}
        if not found.members:
            found.shared = "those of its functions"
        self._globals(found, places)
        if "inputs" in places:
            found.inputs += self._signals(places["inputs"], self.kinds["inputs"])
        if "outputs" in places:
            found.outputs += self._signals(places["outputs"], self.kinds["outputs"])
        if "parameters" in places:
            self._parameters(found, places["parameters"])
        self._exported(found)
        self._ports(found)
        if "model" in places:
            if any(path == "errorStatus" for path, _ in self._leaves(self.kinds["model"])):
                found.error_status = f"{places['model']}.errorStatus"
            if any(path == "Timing.stopRequestedFlag" for path, _ in self._leaves(self.kinds["model"])):
                found.stop = f"{places['model']}.Timing.stopRequestedFlag"
        found.initialize = self._call(found.begin, 0)
        found.terminate = self._call(found.end, 0) if found.end in self.functions else None
        for name, number, every in functions:
            result = self._returned(found, self.functions[name].type)
            given = number if "tid" in self._parameter_names(name) and name.endswith("_step") else None
            found.steps.append(Step(name, self._call(name, number), every, result, given))
        found.period_s = self.period_s
        for kind, signals in (("input", found.inputs), ("output", found.outputs)):
            for name, count in Counter(signal.name for signal in signals).items():
                if count > 1:
                    raise self._no(f"has {count} {kind}s named {name}, with those of buses; give a port another name")
        return found

    def _entries(self) -> dict[str, str]:
        """Names of the model's functions by what they are for: the coder's, or those that its user has given them."""
        said = {"initialize": "Initialize model", "step": "Step the model", "terminate": "Terminate model"}
        section = re.search(r"/\* Model entry point functions \*/(.*?)(?:/\*|#|\Z)", self.code.header, re.S)
        left = re.findall(r"(\w+)\s*\(", section[1]) if section else []
        left = [name for name in left if name in self.functions and not re.fullmatch(rf"{self.model}_step\d+", name)]
        found = {}
        for role, comment in said.items():
            called = re.search(rf"/\* {comment}[^*]*\*/\s*(?:[^;=(]*=)?\s*(\w+)\s*\(", self.code.main)
            names = [f"{self.model}_{role}", called[1] if called else ""]
            found[role] = next((name for name in names if name in self.functions), names[0])
        left = [name for name in left if name not in found.values()]
        unknown = [role for role, name in found.items() if name not in self.functions]
        if len(left) == 1 and unknown == ["terminate"]:
            found["terminate"] = left[0]
        return found

    def _steps(self, times_s: list[float], step: str) -> list[tuple[str, int, int]]:
        """The step functions, each with its rate's number, and how often it runs."""
        sample_times = {
            int(number): float(time)
            for number, time in re.findall(
                rf"\b{self.model}_step(\d+)\s*\([^)]*\)\s*/\*\s*Sample time: \[([0-9.eE+-]+)s,", self.code.sources
            )
        }
        size = _STEP_SIZE.search(self.code.sources)
        base = size or _BASE_PERIOD.search(self.code.main)
        numbered = sorted(
            int(match[1]) for name in self.functions if (match := re.fullmatch(rf"{self.model}_step(\d+)", name))
        )
        single = next((name for name in (step, f"{self.model}_custom") if name in self.functions), "")
        if numbered:
            names, numbers = [f"{self.model}_step{number}" for number in numbered], numbered
        elif single and "tid" in self._parameter_names(single):
            numbers = sorted(sample_times) or list(range(len(times_s)))
            names = [f"{self.model}_step"] * len(numbers)
        elif single:
            names, numbers = [single], [0]
        elif f"{self.model}_output" in self.functions and f"{self.model}_update" in self.functions:
            self.period_s = times_s[0] if times_s else float(base[1]) if base else None
            self._contradiction(times_s, {}, [], base, "Timing.stepSize0" if size else "its main program")
            return [(f"{self.model}_{each}", 0, 1) for each in ("output", "update")]
        else:
            has = ", ".join(sorted(name for name in self.functions)) or "none at all"
            raise self._no(f"has no function {self.model}_step (it has: {has}); models of exported functions have none")
        times = times_s or [sample_times[number] for number in numbers if number in sample_times]
        if base and times and times[0] == 0 and not times_s:  # continuous: runs with the solver's step
            times[0] = float(base[1])
        if not times and len(numbers) == 1 and base:
            times = [float(base[1])]
        self._contradiction(times_s, sample_times, numbers, base, "Timing.stepSize0" if size else "its main program")
        if (len(times) != len(numbers) or 0 in times) and (times_s or len(numbers) != 1):
            remedy = "say sample_times: [0.01, 0.05], fastest first, in seconds"
            known = len([time for time in times if time])
            raise self._no(f"has {len(numbers)} step functions, and {known} sample times are known; {remedy}")
        if 0 in times:
            times = []
        found = []
        for name, number, time in zip(names, numbers, times or [1.0], strict=True):
            every = round(time / (times[0] if times else 1.0))
            if every < 1 or (times and not math.isclose(every * times[0], time, rel_tol=1e-6)):
                raise self._no(f"has a step{number} each {time:g} s, which is no multiple of {times[0]:g} s")
            found.append((name, number, every))
        self.period_s = times[0] if times else None
        return found

    def _contradiction(
        self, times_s: list[float], said: dict[int, float], numbers: list[int], base: re.Match[str] | None, by: str
    ) -> None:
        """Refuse sample times other than those that the code was generated for."""
        known = [
            (time, said[number], "a comment")
            for time, number in zip(times_s, numbers, strict=False)
            if said.get(number)
        ]
        if base and times_s:
            known.append((times_s[0], float(base[1]), by))
        for time, generated, where in known:
            if not math.isclose(time, generated, rel_tol=1e-6):
                message = f"is not what the code was generated for: {where} has {generated:g}"
                raise self._no(f"sample_times: {time:g}: {message}; leave the key out, or generate for {time:g} s")

    def _arguments(self, found: Model, names: list[str]) -> None:
        """Structures and single ports that functions are given."""
        for name in names:
            if name not in self.functions:
                raise self._no(f"has no function {name}; {GENERATED}/ has to be of one model, made by Embedded Coder")
            for parameter in self._given(name):
                pointed = _pointed(parameter.type)
                if role := self._role(pointed):
                    found.members.setdefault(role, self._written(pointed))
                elif parameter.name not in ("tid", "firstTime", None):
                    # What a step function has by value, the others have by pointers.
                    known = self.ports.get(parameter.name)
                    if known is None or isinstance(known.type, c_ast.PtrDecl):
                        self.ports[parameter.name] = parameter

    def _pack(self, found: Model) -> None:
        """Pointers of the real-time model: the coder leaves setting them to who calls it."""
        for path, node in self._leaves(found.members["model"].removeprefix("struct ")):
            if not isinstance(node, c_ast.PtrDecl):
                continue
            name, pointed = path.rpartition(".")[2], _type_name(node.type)
            role = self._role(pointed)
            if not role and name in _POINTERS:
                role, pointed = _POINTERS[name], self._likeliest(_POINTERS[name])
            if role and role != "model" and pointed:
                found.members.setdefault(role, self._written(pointed))
                found.packed[path] = role
            elif self._structure(pointed) or pointed == "void":
                used = re.search(rf"(?:->|\.){name}\b", self.code.sources)
                if used and not re.search(rf"(?:->|\.){name}\s*=[^=]", self.code.sources):
                    raise self._no(f"uses {path} of its real-time model, a pointer that nothing here sets")

    def _globals(self, found: Model, places: dict[str, str]) -> None:
        """What of the model is in global variables, which all blocks of it would share."""
        for name, declaration in self.variables.items():
            kind = _type_name(declaration.type) or _pointed(declaration.type)
            role = self._role(kind)
            if not role or "const" in declaration.quals or declaration.storage != ["extern"]:
                continue
            if role == "parameters" and role in found.members:
                continue  # what each instance's own begin with
            found.shared = name
            if role not in places:
                places[role] = f"(*{name})" if isinstance(declaration.type, c_ast.PtrDecl) else name
                self.kinds[role] = kind or ""

    def _exported(self, found: Model) -> None:
        """Parameters and root ports that are variables."""
        plain = _plain(self.code.sources)
        for _, name, _, parameter, port in _EXPORTED.findall(self.code.header):
            if name not in self.variables:
                continue
            node = self.variables[name].type
            if parameter:
                if self._number(node)[0]:
                    found.shared = found.shared or name
                    self._parameter(found, name, name, node, self.values.get(name))
                continue
            of = {
                kind
                for kind in ("Inport", "Outport")
                if re.search(rf"\b{kind}: '<Root>/{re.escape(port)}'", self.code.sources)
            }
            found.shared = found.shared or name
            written = re.search(rf"(?<![.>\w]){name}\b[^;{{}}=]*=[^=]", plain)
            if not of and written:  # a signal within the model, which its user wants to be seen
                if self._number(node)[0]:
                    found.outputs += self._spread(name, name, node)
            elif "Inport" in of or not of:  # or unknown: an input that the model does not use has no comment
                found.inputs += self._spread(_identifier(port) or name, name, node)
            else:
                found.outputs += self._spread(_identifier(port) or name, name, node)

    def _ports(self, found: Model) -> None:
        """Root ports that functions are given one by one."""
        for name, parameter in self.ports.items():
            node = parameter.type.type if isinstance(parameter.type, c_ast.PtrDecl) else parameter.type
            match = re.match(rf"(?:rt|{self.model}_)([UY])_", name) or re.match(r"(?:rt|\w+?_)([UY])_|arg_", name)
            port = name[match.end() :] if match else name
            signals = self._spread(port, f"instance->arguments.{name}", node)
            found.arguments.append(self._declared(name, node))
            if self._is_input(parameter, port, match[1] if match else None):
                found.inputs += signals
            else:
                found.outputs += signals

    def _declared(self, name: str, node: Any) -> str:
        """A member of that name and type."""
        ends = ""
        while isinstance(node, c_ast.ArrayDecl):
            ends += f"[{int(_value(node.dim) or 0)}]"
            node = node.type
        return f"{self._written(_type_name(node))} {name}{ends};"

    def _spread(self, name: str, place: str, node: Any, port: str = "") -> list[Signal]:
        """A root port; of a bus, its numbers, one by one. UserError where some of it is no number."""
        port = port or place
        kind, width = self._number(node)
        if kind:
            return [Signal(name, kind, width, place, port=port)]
        if isinstance(node, c_ast.ArrayDecl):
            elements = range(int(_value(node.dim) or 0))
            parts = [(f"{name}_{i + 1}", f"{place}[{i}]", node.type) for i in elements]
        else:
            structure = getattr(node, "type", None)
            inner = structure.decls if isinstance(structure, c_ast.Struct) else None
            fields = inner or self._fields(_type_name(node) or "")
            parts = [(f"{name}_{each.name}", f"{place}.{each.name}", each.type) for each in fields]
        if not parts:
            raise self._not_a_port(name, node)
        return [signal for part in parts for signal in self._spread(*part, port)]

    def _returned(self, found: Model, node: Any) -> str:
        """Where what a step function returns goes: to a port of its own."""
        if _type_name(node) == "void":
            return ""
        kind, width = self._number(node)
        if not kind:
            raise self._not_a_port("that its step function returns", node)
        place = "instance->arguments.out"
        found.arguments.append(f"{_type_name(node)} out;")
        found.outputs.append(Signal("out", kind, width, place))
        return place

    def _is_input(self, parameter: Any, port: str, letter: str | None) -> bool:
        """By its name as the coder makes it; else by its type in C; else by comments."""
        if letter:
            return letter == "U"
        if isinstance(parameter.type, c_ast.TypeDecl):
            return True
        if "const" in (parameter.type.type.quals or []):
            return True
        block = rf"port: '<Root>/{re.escape(port)}'"
        outward = re.search(rf"\bOut{block}", self.code.sources)
        if bool(outward) == bool(re.search(rf"\bIn{block}", self.code.sources)):
            raise self._no(f"does not show whether the argument {parameter.name} is an input; {_TAKE_DEFAULT}")
        return not outward

    def _call(self, function: str, number: int) -> str:
        """The arguments that a function takes, from an instance."""
        given = []
        for parameter in self._given(function):
            role = self._role(_pointed(parameter.type))
            if role:
                given.append(f"&instance->{role}")
            elif parameter.name == "tid":
                given.append(str(number))
            elif parameter.name == "firstTime":
                given.append("1")
            else:
                scalar = isinstance(parameter.type, c_ast.PtrDecl) and isinstance(parameter.type.type, c_ast.TypeDecl)
                stored = self.ports[parameter.name].type
                by_address = scalar and not isinstance(stored, c_ast.ArrayDecl)
                given.append(f"{'&' if by_address else ''}instance->arguments.{parameter.name}")
        return ", ".join(given)

    def _given(self, function: str) -> list[Any]:
        parameters = self.functions[function].args.params if self.functions[function].args else []
        return [each for each in parameters if _type_name(each.type) != "void"]

    def _parameter_names(self, function: str) -> list[str]:
        return [each.name for each in self._given(function)]

    def _signals(self, place: str, type_name: str) -> list[Signal]:
        return [
            signal
            for part in self._fields(type_name)
            for signal in self._spread(part.name, f"{place}.{part.name}", part.type)
        ]

    def _parameters(self, found: Model, place: str) -> None:
        """Those that are numbers; others keep what was generated."""
        type_name = self.kinds["parameters"]
        own = "parameters" in found.members
        defined = [
            (name, declaration)
            for name, declaration in self.variables.items()
            if _type_name(declaration.type) == type_name and name in self.values
        ]
        if not defined:
            remedy = f"{self.model}_data.c or ert_main.c has them; keep both in {GENERATED}/"
            raise self._no(f"has parameters of type {type_name}, and nothing here has their values; {remedy}")
        variable, declaration = defined[0]
        if own:
            found.initial = variable
            constant = "const " if "const" in declaration.quals else ""
            found.definition = f"extern {constant}{type_name} {variable};"
            if declaration.storage == ["static"] or not re.search(rf"\b{variable}\s*=", self.code.sources):
                text = next(text for kind, text in _definitions(self.code) if kind == type_name)
                found.initial = "generated_parameters"
                found.definition = re.sub(
                    rf"^.*?\b{variable}\b", f"static const {type_name} {found.initial}", text, count=1, flags=re.S
                )
        fields = self._fields(type_name)
        initial = _items(self.values[variable], [part.name for part in fields])
        for part in fields:
            self._parameter(found, part.name, f"{place}.{part.name}", part.type, initial.get(part.name))

    def _parameter(self, found: Model, name: str, place: str, node: Any, initial: Any) -> None:
        kind, width = self._number(node)
        value = _value(initial)
        if isinstance(node, c_ast.ArrayDecl):
            if kind and kind != "boolean":
                found.parameters.append(Parameter(name, kind, width, place, None))
        elif kind and value is not None and math.isfinite(value):
            found.parameters.append(Parameter(name, kind, width, place, value))

    def _number(self, node: Any) -> tuple[str, int]:
        """Type and width of a number or a vector; no type for anything else."""
        width = 1
        while isinstance(node, c_ast.ArrayDecl):
            width *= int(_value(node.dim) or 0)
            node = node.type
        name = _type_name(node)
        for _ in self.types:  # a type may be another name of another name
            if name in _TYPES or name not in self.types:
                break
            if isinstance(getattr(self.types[name], "type", None), c_ast.Enum):
                return "int32", width
            name = _type_name(self.types[name])
        return _TYPES.get(name or "", ""), width

    def _role(self, type_name: str | None) -> str:
        """What a structure is to the model; nothing for types that are no such structure."""
        for role, parts in _ROLES.items():
            if any(re.fullmatch(rf"{part}(_\w+)?", type_name or "") for part in parts):
                return role if self._structure(type_name) else ""
        return ""

    def _likeliest(self, role: str) -> str | None:
        """The model's own structure of a role: subsystems have such, too, and names may be cut."""
        named = [(name, part) for part in _ROLES[role] for name in self.types if re.fullmatch(rf"{part}(_\w+)?", name)]
        ranked = [
            (len(list(takewhile(_same, zip(name[len(part) + 1 :], self.model, strict=False)))), -len(name), name)
            for name, part in named
            if self._structure(name)
        ]
        return max(ranked)[2] if ranked else None

    def _written(self, type_name: str | None) -> str:
        return type_name if type_name in self.types else f"struct {type_name}"

    def _structure(self, type_name: str | None) -> bool:
        return bool(self._fields(type_name or ""))

    def _fields(self, type_name: str) -> list[Any]:
        """The fields of a structure; none of what is no structure."""
        if type_name not in self.types:
            return list(self.structures.get(type_name) or [])
        structure = getattr(self.types[type_name], "type", None)
        if not isinstance(structure, c_ast.Struct):
            return []
        return list(structure.decls or self.structures.get(structure.name) or [])

    def _leaves(self, type_name: str) -> list[tuple[str, Any]]:
        """The fields of a structure and of those without a name within it: path, and type."""
        found: list[tuple[str, Any]] = []
        waiting = [("", part) for part in self._fields(type_name)]
        for prefix, part in waiting:
            structure = getattr(part.type, "type", None)
            if isinstance(part.type, c_ast.TypeDecl) and isinstance(structure, c_ast.Struct) and structure.decls:
                waiting += [(f"{prefix}{part.name}.", inner) for inner in structure.decls]
            else:
                found.append((f"{prefix}{part.name}", part.type))
        return found

    def _note(self, node: Any) -> None:
        """Remember a structure that is defined here."""
        while isinstance(node, (c_ast.TypeDecl, c_ast.PtrDecl, c_ast.ArrayDecl)):
            node = node.type
        if isinstance(node, c_ast.Struct) and node.name and node.decls:
            self.structures[node.name] = node.decls

    def _not_a_port(self, name: str, node: Any) -> UserError:
        while isinstance(node, (c_ast.PtrDecl, c_ast.ArrayDecl)) and not _type_name(node):
            node = node.type
        return self._no(f"has a root port {name} of type {_type_name(node) or 'struct'}; {_TAKE_APART}")

    def _no(self, message: str) -> UserError:
        return UserError(f"{GENERATED}/{self.model}.h: {message}")


def _type_name(node: Any) -> str | None:
    """The name of a plain type, or of a structure that is called by its own name."""
    if isinstance(node, c_ast.TypeDecl) and isinstance(node.type, c_ast.IdentifierType):
        return " ".join(node.type.names)
    if isinstance(node, c_ast.TypeDecl) and isinstance(node.type, c_ast.Struct) and not node.type.decls:
        return str(node.type.name)
    return None


def _identifier(name: str) -> str:
    """A block's name where it can be a port's; else nothing."""
    return name if re.fullmatch(r"[A-Za-z_]\w*", name) else ""


def _same(pair: tuple[str, str]) -> bool:
    return pair[0] == pair[1]


def _pointed(node: Any) -> str | None:
    """The name of the plain type that a pointer points to."""
    return _type_name(node.type) if isinstance(node, c_ast.PtrDecl) else None


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
    if isinstance(node, c_ast.ID) and node.name in ("true", "false"):
        return float(node.name == "true")
    if isinstance(node, c_ast.Constant) and node.type not in ("string", "char"):
        text = node.value.rstrip("uUlL")
        return float(int(text, 0)) if re.fullmatch(r"0[xX][0-9a-fA-F]+|[0-9]+", text) else float(text.rstrip("fF"))
    return None
