"""Co-simulation units of FMI 2.0 and 3.0 as blocks: what their XML says, their code, and the C file that calls it.

A unit becomes a shared object, compiled of its sources or brought as a binary, which the block loads when it starts.
What elements and attributes mean is written in the standard, https://fmi-standard.org.
"""

from __future__ import annotations

import math
import re
import shlex
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import jinja2

from flotilla.apps import app
from flotilla.common import paths, progress
from flotilla.common.errors import Problem, UserError
from flotilla.common.sources import ignored, strays
from flotilla.debian import runtime, toolchain
from flotilla.fleet.model import System

TEMPLATE = Path(__file__).parent / "templates" / "fmu_block.c.j2"
HEADERS = Path(__file__).parent / "fmi"
"""FMI's headers, which the sources of a unit leave to whoever compiles them."""
DESCRIPTION = "modelDescription.xml"
UNPACKED = "unit"
"""Folder of an app with what was in a unit, where it is not packed."""
_MOST_BYTES = 512 << 20
"""Of a unit, unpacked."""
_MOST_VALUES = 4096
"""Of all ports of a direction, or of all parameters: a step has them on the control thread's stack."""
_PLATFORMS = {
    ("2", "i386"): "linux32", ("2", "amd64"): "linux64", ("3", "i386"): "x86-linux", ("3", "amd64"): "x86_64-linux",
}  # fmt: skip
"""Folder of binaries, by FMI's version and Debian's name of the architecture."""
_FAILURES = ("logStatusDiscard", "logStatusError", "logStatusFatal")
"""FMI's categories of messages about steps that fail."""
_LACKING = re.compile(r"undefined reference to `([^']+)'|(\S+\.so\S*), needed by \S+, not found|(version `?\S+)")
"""What a linker writes of symbols and libraries that are nowhere."""
_MACHINES = {"i386": (1, 3), "amd64": (2, 62)}
"""ELF's class and machine."""
_SIGNALS = {
    ("2", "Real"): "double", ("2", "Integer"): "int32", ("2", "Enumeration"): "int32", ("2", "Boolean"): "boolean",
    ("2", "String"): "text",
    ("3", "Float64"): "double", ("3", "Float32"): "single", ("3", "Enumeration"): "int64", ("3", "Boolean"): "boolean",
    ("3", "String"): "text", ("3", "Binary"): "", ("3", "Clock"): "",
    **{("3", f"{sign}Int{bits}"): f"{sign.lower()}int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)},
}  # fmt: skip
"""The runtime's types by FMI's; text can be a parameter only, and what has none is left out."""
_C_TYPES = {"double": "double", "single": "float", "boolean": "bool"}
"""Of elements; those of integers are regular."""
_DEFINED = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\([A-Za-z0-9_, .]*\))?")
"""A preprocessor's definition, which may have arguments."""
_OPTIONS = re.compile(
    r"-O[0-3sg]?|-g[0-3]?|-std=[a-z0-9:+]+|-ansi|-pedantic|-pthread|-m32|-m64|-msse[234]?|-mfpmath=sse|-w|-W[a-z][a-z0-9=+-]*"
    r"|-f(no-)?(PIC|pic|strict-aliasing|math-errno|fast-math|finite-math-only|trapping-math|rounding-math|wrapv|common"
    r"|signed-zeros|signed-char|unsigned-char|omit-frame-pointer|exceptions|unroll-loops|tree-vectorize|short-enums)"
    r"|-fvisibility=(hidden|default)|-ffp-contract=(off|on|fast)|-fmax-errors=[0-9]+|-[DU][A-Za-z_][A-Za-z0-9_]*(=[A-Za-z0-9_.+\"'-]*)?"
)
"""What a unit may ask of the compiler. Others name files, or programs that the compiler starts."""
_RANGES = {
    "boolean": (0, 0), "text": (0, 0), "double": (-math.inf, math.inf), "single": (-3.4028234e38, 3.4028234e38),
    "int64": (-(2.0**63), 2.0**63), "uint64": (0, 2.0**64),
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32)},
}  # fmt: skip


@dataclass(frozen=True)
class Variable:
    """A port or a parameter."""

    name: str
    """As a task file has it: letters, digits and underlines."""
    original: str
    """As the unit has it."""
    reference: int
    """What FMI calls valueReference."""
    accessor: str
    """Of FMI's functions that get and set it, such as `Real` of fmi2GetReal."""
    type: str
    """The runtime's, such as `double`; `text`."""
    width: int
    array: bool
    unit: str
    summary: str
    start: str
    """The value as a task file has it; of a parameter that is no array."""
    tunable: bool
    optional: bool
    """An input that has a start value, by which the unit goes where it has no wire."""
    min: float
    max: float
    """Equal: no limit."""

    @property
    def c_type(self) -> str:
        """Of an element of a port."""
        return _C_TYPES.get(self.type, f"{self.type}_t")

    @property
    def member_type(self) -> str:
        """Of a parameter, in the block's structure of them."""
        if self.array:
            return "struct fl_doubles"
        kinds = {
            "boolean": "bool",
            "single": "double",
            "double": "double",
            "uint64": "uint64_t",
            "text": "const char *",
        }
        return kinds.get(self.type, "int64_t")


@dataclass
class Unit:
    """What `modelDescription.xml` says."""

    directory: Path
    file: str
    """The description, as messages name it."""
    version: str
    """Of FMI: `2` or `3`."""
    identifier: str
    """Of its binary; what C calls it has underlines for hyphens."""
    token: str
    """guid of 2.0, instantiationToken of 3.0."""
    once: bool
    """A process can have one of it."""
    step_s: float | None
    """The period has to be a multiple of that."""
    step_key: str
    """What says so."""
    failures: list[str] = field(default_factory=list)
    """Categories of messages that it knows and that are taken in real time, too: after them the task ends."""
    inputs: list[Variable] = field(default_factory=list)
    outputs: list[Variable] = field(default_factory=list)
    parameters: list[Variable] = field(default_factory=list)
    sizes: dict[str, str] = field(default_factory=dict)
    """Of arrays whose size could be configured (FMI 3.0's structural parameters), by reference: it stays."""
    listed: list[str] = field(default_factory=list)
    """Files to compile, where there is no buildDescription.xml."""

    @property
    def resources(self) -> bool:
        """Whether it brings any."""
        return (self.directory / "resources").is_dir()


@dataclass(frozen=True)
class Sources:
    """What to compile."""

    files: list[str]
    """Relative to `sources/`."""
    options: list[str]
    """The compiler's, in the directory that `sources/` lies in."""


def object_of(name: str) -> PurePosixPath:
    """Where an app's unit lies among what goes to a robot; the block looks there, from its own place on."""
    return PurePosixPath("blocks") / f"{name}.unit" / "binary" / "unit.so"


def unpacked(directory: Path, wanted: str | None, work: Path) -> tuple[Path, str]:
    """The unit of the app in `directory`, and what to call it. A packed one is unpacked to `work`."""
    file = directory / wanted if wanted else _only(directory)
    shown = paths.shown(file)
    if file.is_dir():
        for path, what in strays(file).items():
            raise UserError(f"{paths.shown(path)}: {what}; put a copy in its place")
        return file, shown
    if not file.is_file():
        where = paths.shown(directory / app.FILE)
        raise _wrong(where, "unit", str(wanted), "is not there", "name the app's *.fmu, or the directory of one")
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
            if size > _MOST_BYTES:
                raise UserError(f"{shown}: unpacks to {size >> 20} MiB; at most {_MOST_BYTES >> 20} MiB fit a robot")
            archive.extractall(work)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise UserError(f"{shown}: is not a unit: {error}; export it anew") from None
    return work, shown


def _only(directory: Path) -> Path:
    found = [*sorted(directory.glob("*.fmu")), *(path for path in [directory / UNPACKED] if path.is_dir())]
    if len(found) == 1:
        return found[0]
    what = ", ".join(path.name for path in found) or "none"
    remedy = f"put one *.fmu there, or its content as {UNPACKED}/, or write unit: in {app.FILE}"
    raise UserError(f"{paths.shown(directory)}: has several units or none: {what}; {remedy}")


def read(directory: Path, shown: str) -> Unit:
    """The unit in `directory`; UserError with what of it cannot become a block."""
    path, file = directory / DESCRIPTION, f"{shown}/{DESCRIPTION}"
    if not path.is_file():
        raise UserError(f"{file} is missing; a unit has one at its top")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{file}: {error}") from None
    written = root.get("fmiVersion", "(nothing)")
    version = written.partition(".")[0]
    if root.tag != "fmiModelDescription" or version not in ("2", "3"):
        raise _wrong(file, "fmiVersion", written, "cannot be read", "export the unit for FMI 2.0 or 3.0")
    interface = root.find("CoSimulation")
    if interface is None:
        others = ", ".join(child.tag for child in root if child.tag in ("ModelExchange", "ScheduledExecution"))
        remedy = "export the unit for co-simulation: a robot has no solver for it"
        raise _wrong(file, "CoSimulation", "(nothing)", f"is missing, there is only {others or 'nothing'}", remedy)
    if _true(interface, "needsExecutionTool"):
        remedy = "export it with all that it needs, as sources or a binary"
        raise _wrong(
            file, "needsExecutionTool", "true", "needs the tool that made it, which robots do not have", remedy
        )
    identifier, key = interface.get("modelIdentifier", ""), {"2": "guid", "3": "instantiationToken"}[version]
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_-]*", identifier):  # FMI allows no hyphens; tools write them
        raise _wrong(file, "modelIdentifier", identifier or "(nothing)", "is no identifier of C", "export it anew")
    token = root.get(key, "")
    if not token:
        raise _wrong(file, key, "(nothing)", "is missing, so the code would not know its description", "export it anew")
    step_key, step_s = _fixed_step(root, interface, file)
    once = _true(interface, "canBeInstantiatedOnlyOncePerProcess")
    unit = Unit(directory, file, version, identifier, token, once, step_s, step_key)
    categories = [each.get("name", "") for each in root.iterfind("LogCategories/Category")]
    unit.failures = [name for name in _FAILURES if name in categories]
    unit.listed = [each.get("name", "") for each in interface.iterfind("SourceFiles/File")]
    _variables(unit, root)
    return unit


def _fixed_step(root: ElementTree.Element, interface: ElementTree.Element, file: str) -> tuple[str, float | None]:
    """Which attribute says that steps are multiples of something, and of what."""
    places = [("fixedInternalStepSize", interface)]
    experiment = root.find("DefaultExperiment")
    if experiment is not None and not _true(interface, "canHandleVariableCommunicationStepSize"):
        places.append(("stepSize", experiment))
    for key, element in places:
        if (text := element.get(key)) is not None:
            step_s = _number(text)
            if step_s is None or not 0 < step_s < math.inf:
                raise _wrong(file, key, text, "is no time", "a number of seconds above 0")
            return key, step_s
    return "", None


def _variables(unit: Unit, root: ElementTree.Element) -> None:
    """Fill in ports and parameters."""
    types: dict[str | None, ElementTree.Element] = {}
    for each in root.iterfind("TypeDefinitions/*"):
        types[each.get("name")] = next(iter(each), each) if unit.version == "2" else each
    for element in root.iterfind("ModelVariables/*[@causality='structuralParameter']"):
        unit.sizes[element.get("valueReference", "")] = element.get("start", "(nothing)")
    for element in root.iterfind("ModelVariables/*"):
        causality = element.get("causality", "local")
        lists = {"input": unit.inputs, "output": unit.outputs, "parameter": unit.parameters}
        if causality not in lists:
            continue
        typed = element
        if unit.version == "2":
            typed = next((child for child in element if ("2", child.tag) in _SIGNALS), element)
        variable = _variable(unit, element, typed, types.get(typed.get("declaredType")))
        if variable and _fits(variable, parameter=causality == "parameter"):
            lists[causality].append(variable)
    for kind, variables in (("input", unit.inputs), ("output", unit.outputs), ("parameter", unit.parameters)):
        if (values := sum(variable.width for variable in variables)) > _MOST_VALUES:
            message, remedy = (
                f"are too many {kind}s for a block",
                f"export it with {_MOST_VALUES} at most, arrays included",
            )
            raise _wrong(unit.file, "ModelVariables", str(values), message, remedy)
        names = Counter(variable.name for variable in variables)
        for variable in variables:
            if names[variable.name] > 1:
                message = f"is written {variable.name} in a task, like another {kind}"
                raise _wrong(unit.file, "name", variable.original, message, "give it another name in the model")


def _fits(variable: Variable, *, parameter: bool) -> bool:
    """Whether blocks have such ports, or such parameters. Without its variable a unit goes by what that starts with."""
    if not parameter:
        return variable.type != "text"
    return not variable.array or variable.type not in ("boolean", "text")


def _variable(
    unit: Unit, element: ElementTree.Element, typed: ElementTree.Element, declared: ElementTree.Element | None
) -> Variable | None:
    """A variable as a port or a parameter; None of a type that no block has."""
    original = element.get("name", "")
    kind = _SIGNALS.get((unit.version, typed.tag))
    if kind is None:
        raise _wrong(unit.file, original or "name", typed.tag, "is no type of FMI", "export it anew")
    if not kind:
        return None

    def attribute(key: str) -> str | None:
        own = typed.get(key)
        return own if own is not None or declared is None else declared.get(key)

    reference = element.get("valueReference", "")
    if not re.fullmatch(r"[0-9]{1,10}", reference) or int(reference) >= 1 << 32:
        raise _wrong(
            unit.file, f"{original}.valueReference", reference or "(nothing)", "is no number", "export it anew"
        )
    lowest, highest = _RANGES[kind]
    for key in ("min", "max"):
        value = _number(attribute(key) or "")
        if value is not None and math.isfinite(value) and kind not in ("boolean", "text"):
            lowest, highest = (max(value, lowest), highest) if key == "min" else (lowest, min(value, highest))
    if (lowest, highest) == (-math.inf, math.inf):
        lowest = highest = 0.0
    dimensions = typed.findall("Dimension")
    array = bool(dimensions)
    name = re.sub(r"[^A-Za-z0-9_]+", "_", original)
    summary = element.get("description") or "of the unit"
    tunable = element.get("variability") == "tunable" and not array and kind != "text"
    return Variable(
        name=name,
        original=original,
        reference=int(reference),
        accessor={"2": "Integer", "3": "Int64"}[unit.version] if typed.tag == "Enumeration" else typed.tag,
        type=kind,
        width=math.prod(_extent(unit, original, dimension) for dimension in dimensions),
        array=array,
        unit=attribute("unit") or "",
        summary=summary if name == original else f"{original}: {summary}",
        start="" if array or element.get("causality") != "parameter" else _start(unit, original, typed, kind),
        tunable=tunable,
        optional=typed.get("start") is not None,
        min=max(lowest, -1e300),
        max=min(highest, 1e300),
    )


def _extent(unit: Unit, variable: str, dimension: ElementTree.Element) -> int:
    """The elements of an array in one dimension."""
    text = dimension.get("start") or unit.sizes.get(dimension.get("valueReference", ""), "(nothing)")
    if not re.fullmatch(r"[1-9][0-9]{0,5}", text):
        message = "is no fixed number of elements"
        raise _wrong(unit.file, f"{variable}.Dimension.start", text, message, "export it with fixed sizes of arrays")
    return int(text)


def _start(unit: Unit, variable: str, typed: ElementTree.Element, kind: str) -> str:
    """A parameter's value as a task file has it."""
    text = typed.get("start")
    if kind == "text":
        inner = typed.find("Start")  # FMI 3.0 has a text's there
        return text or (inner.get("value") or "" if inner is not None else "")
    if text is None:
        raise _wrong(unit.file, f"{variable}.start", "(nothing)", "is missing; a parameter has one", "export it anew")
    if kind == "boolean" and text in ("true", "1", "false", "0"):
        return "true" if text in ("true", "1") else "false"
    value = _number(text)
    whole = kind not in ("double", "single")
    if kind == "boolean" or value is None or not math.isfinite(value) or (whole and not value.is_integer()):
        raise _wrong(unit.file, f"{variable}.start", text, f"is no {kind}", "export it anew")
    return str(int(text) if re.fullmatch(r"\s*[+-]?[0-9]+\s*", text) else int(value)) if whole else repr(value)


def sources(unit: Unit, system: System) -> Sources | None:
    """What to compile; None where the unit brings no sources."""
    description = unit.directory / "sources" / "buildDescription.xml"
    if not description.is_file():
        found = Sources(unit.listed, []) if unit.listed else None
        where, key = unit.file, "SourceFiles"
    else:
        where, key = f"{unit.file.removesuffix(DESCRIPTION)}sources/{description.name}", "SourceFile"
        found = _build_description(unit, description, where, _PLATFORMS["3", system.architecture])
    root = (unit.directory / "sources").resolve()
    for name in found.files if found else []:
        path = (root / name).resolve()
        if not path.is_relative_to(root) or not path.is_file():
            raise _wrong(where, key, name, "is not there", "export the unit with all its sources")
    return found


def _build_description(unit: Unit, file: Path, shown: str, platform: str) -> Sources:
    """What `buildDescription.xml` says for a platform."""
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{shown}: {error}") from None
    ours = [each for each in root.iterfind("BuildConfiguration") if each.get("modelIdentifier") == unit.identifier]
    fitting = [each for each in ours if each.get("platform") in (None, platform)]
    if not fitting:
        message = f"none is of {unit.identifier} for {platform}"
        raise _wrong(shown, "BuildConfiguration", "(nothing)", message, "export the unit for it")
    chosen = fitting[0]
    for library in chosen.iterfind("Library"):
        if library.get("name") != "m":
            message = "is a library that robots do not have"
            raise _wrong(shown, "Library", str(library.get("name")), message, "export the unit without, or a binary")
    files: list[str] = []
    options: list[str] = []
    for group in chosen.iterfind("SourceFileSet"):
        language = group.get("language") or "C99"
        if not re.fullmatch(r"C(\d\d)?", language):
            raise _wrong(shown, "language", language, "is not C", "export the unit as C, or a binary")
        files += [each.get("name", "") for each in group.iterfind("SourceFile")]
        for definition in group.iterfind("PreprocessorDefinition"):
            name, value = definition.get("name", ""), definition.get("value")
            if not _DEFINED.fullmatch(name):
                raise _wrong(shown, "PreprocessorDefinition", name, "is no name", "export the unit anew")
            options.append(f"-D{name}" + (f"={value}" if value is not None else ""))
        options += [f"-Isources/{each.get('name', '')}" for each in group.iterfind("IncludeDirectory")]
        if group.get("compiler") == "gcc":
            options += _compiler_options(group.get("compilerOptions") or "", shown)
    return Sources(files, options)


def _compiler_options(text: str, shown: str) -> list[str]:
    """Those of gcc, if they are among _OPTIONS."""
    try:
        options = shlex.split(text)
    except ValueError as error:
        raise _wrong(shown, "compilerOptions", text, f"cannot be read: {error}", "export the unit anew") from None
    for option in options:
        if not _OPTIONS.fullmatch(option):
            message = "is not among the options that a unit may have"
            raise _wrong(shown, "compilerOptions", option, message, "export the unit without, or a binary")
    return options


def binary(unit: Unit, system: System) -> Path:
    """The folder of the unit's binaries for an architecture."""
    platform = _PLATFORMS[unit.version, system.architecture]
    binaries = unit.directory / "binaries"
    file, shown = binaries / platform / f"{unit.identifier}.so", unit.file.removesuffix(DESCRIPTION)
    if not file.is_file():
        there = ", ".join(sorted(path.name for path in binaries.glob("*") if path.is_dir())) or "none"
        remedy = "export the unit for it, or with its sources"
        where = f"{shown}binaries/{platform}/{file.name}"
        raise UserError(
            f"{where}: is missing, and the robot is an {system.architecture}; there are binaries: {there}; {remedy}"
        )
    head = file.read_bytes()[:20]
    machine = (head[4], *struct.unpack_from("<H", head, 18)) if len(head) == 20 and head[:4] == b"\x7fELF" else None
    if machine != _MACHINES[system.architecture]:
        known = {numbers: name for name, numbers in _MACHINES.items()}
        what = f"for {known[machine]}" if machine in known else "no shared object for a PC"
        raise UserError(
            f"{shown}binaries/{platform}/{file.name}: is {what}, not for {system.architecture}; export it anew"
        )
    return file.parent


def block(unit: Unit, name: str, out: Path) -> None:
    """Fill `out` with the C files of a plug-in whose block is `name`."""
    shutil.copytree(HEADERS, out, ignore=ignored)
    (out / "flotilla_block.c").write_text(render(unit, name))


def render(unit: Unit, name: str) -> str:
    """The C file that makes it the block `name`."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["quoted"] = _quoted
    functions, asked = _functions(unit)
    file = "/".join(Path(unit.file).parts[-2:])  # within the app: where that lies makes no difference to the code
    template = environment.from_string(TEMPLATE.read_text())
    return template.render(unit=unit, name=name, groups=_groups, functions=functions, asked=asked, file=file)


def _functions(unit: Unit) -> tuple[list[str], list[str]]:
    """Those that the block calls, without their prefixes, and those that it calls where there are any."""
    begin = {"2": ["Instantiate", "SetupExperiment"], "3": ["InstantiateCoSimulation"]}[unit.version]
    functions = [*begin, "SetDebugLogging", "EnterInitializationMode", "ExitInitializationMode", "DoStep", "Terminate"]
    functions += ["FreeInstance", *(f"Get{accessor}" for accessor in _groups(unit.outputs))]
    functions += [f"Set{accessor}" for accessor in _groups([*unit.inputs, *unit.parameters])]
    return functions, {"2": ["GetBooleanStatus", "GetRealStatus"], "3": []}[unit.version]


def build(unit: Unit, name: str, system: System, out: Path, run: toolchain.Run = toolchain.run) -> None:
    """Fill `out` with the unit as a robot of an architecture needs it: its shared object, and its resources.

    `run` says where sources are compiled.
    """
    final = out / object_of(name)
    final.parent.mkdir(parents=True)
    try:
        found = sources(unit, system)
        made = _compiled(unit, found, system, run) if found else None
    except UserError as error:
        try:
            binary(unit, system)
        except UserError:
            raise error from None  # what is wrong with its sources says more
        progress.say(f"{unit.file}: takes the unit's binary, because of its sources: {str(error).splitlines()[0]}")
        made = None
    if made:
        final.write_bytes(made)
        final.chmod(0o755)  # as linkers leave it
    else:
        place = binary(unit, system)
        shutil.copytree(place, final.parent, ignore=ignored, dirs_exist_ok=True)
        (final.parent / f"{unit.identifier}.so").rename(final)
    _check(unit, final.parent, system, run)
    if unit.resources:
        shutil.copytree(unit.directory / "resources", final.parent.parent / "resources", ignore=ignored)


def _check(unit: Unit, place: Path, system: System, run: toolchain.Run) -> None:
    """Refuse a unit that robots could not load, or without functions that its block calls: here, not there.

    A program that is linked with it needs what it needs: the linker looks for that among the robot's libraries.
    """
    functions, _ = _functions(unit)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".fmu-") as directory:
        work = Path(directory)
        shutil.copytree(place, work / "unit")
        (work / "probe.c").write_text("int main(void) { return 0; }\n")
        link = ["gcc", "-o", "/out/probe", "/out/probe.c", "-Wl,--no-as-needed,--no-allow-shlib-undefined"]
        link += ["-Wl,--fatal-warnings,-rpath-link,/out/unit", "/out/unit/unit.so", "-lm", "-ldl", "-lpthread"]
        try:
            runtime.command(work, system, link, run)
        except UserError as error:
            lacking = sorted(set(_LACKING.findall(str(error))))
            what = ", ".join(" ".join(filter(None, each)) for each in lacking) or str(error)
            raise UserError(
                f"{unit.file}: its code needs what is missing on robots: {what}; export the unit with all that it needs"
            ) from None
        runtime.command(work, system, ["sh", "-c", "nm -D --defined-only /out/unit/unit.so >/out/symbols"], run)
        defined = {line.split()[-1].partition("@")[0] for line in (work / "symbols").read_text().splitlines()}
    prefix = unit.identifier.replace("-", "_")
    names = [f"fmi{unit.version}{function}" for function in functions]
    if missing := [name for name in names if not {name, f"{prefix}_{name}"} & defined]:
        raise UserError(f"{unit.file}: its code has no function {', '.join(missing)}; export the unit anew")


def _compiled(unit: Unit, found: Sources, system: System, run: toolchain.Run) -> bytes:
    """The unit's sources as a shared object."""
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".fmu-") as directory:
        tree = Path(directory) / "source"
        shutil.copytree(unit.directory / "sources", tree / "sources", ignore=ignored)
        shutil.copytree(HEADERS, tree / "fmi", ignore=ignored)
        # Sources of one tool for both versions ask which one it is; FMI 3.0's build description may say so, too.
        options = ["-std=gnu17", "-Wall", "-Wl,-Bsymbolic,-z,defs", f"-DFMI_VERSION={unit.version}"]
        options += ["-Isources", "-Ifmi", *found.options]
        files = [f"sources/{name}" for name in found.files]
        return runtime.compile_shared(tree, files, system, options, run)


def _groups(variables: list[Variable]) -> dict[str, list[tuple[int, Variable]]]:
    """By the functions that get and set them, with their places among all."""
    found: dict[str, list[tuple[int, Variable]]] = {}
    for place, variable in enumerate(variables):
        found.setdefault(variable.accessor, []).append((place, variable))
    return found


def _quoted(text: str) -> str:
    """A string of C."""
    plain = "".join(
        c if " " <= c <= "~" and c not in '"\\?' else "".join(f"\\{b:03o}" for b in c.encode()) for c in text
    )
    return f'"{plain}"'


def _true(element: ElementTree.Element, key: str) -> bool:
    return element.get(key) in ("true", "1")


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _wrong(file: str, key: str, value: str, message: str, remedy: str) -> UserError:
    return UserError(str(Problem(file, key, value, message, remedy)))
