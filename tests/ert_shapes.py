"""Code in the shapes in which Embedded Coder packages a model, over its releases: 37, each after public code.

All is written here, after rules that the public code shows: names of types, variables and functions, who gives what
to whom, where values lie. Code that a search of public code showed without its repository is named by its text.
The model is the same everywhere:

    command = enable ? limited(Kp * error - Weights * rates + sum, +-Limit) : 0, then sum += error / 2, count += 1

where the last two happen in each step, or in each fifth where the model has two rates.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

OLD = {"P": "Parameters", "ExtU": "ExternalInputs", "ExtY": "ExternalOutputs", "DW": "D_Work", "X": "ContinuousStates"}
VARIABLES = {"P": "P", "ExtU": "U", "ExtY": "Y", "DW": "DW", "X": "X", "RT_MODEL": "M"}
POINTERS = {"P": "defaultParam", "ExtU": "inputs", "ExtY": "outputs", "DW": "dwork", "X": "contStates"}
INPUTS = {"error": ("real_T", 1), "rates": ("real_T", 2), "enable": ("boolean_T", 1)}
OUTPUTS = {"command": ("real_T", 1), "count": ("uint32_T", 1)}
PARAMETERS = {
    "Kp": ("real_T", 1, "2.5"),
    "Limit": ("real32_T", 1, "1.0E+1F"),
    "Weights": ("real_T", 2, "{ 0.25, -0.25 }"),
}
WORD_SIZES = {"32": "0x7FFFFFFFL", "64": "0x7FFFFFFFFFFFFFFFL"}


@dataclass(frozen=True)
class Shape:
    """One packaging; what is not said is nonreusable functions, the coder's default."""

    source: str
    """The release, and public code of this shape."""
    ids: str = "long"
    """Names: `long`, `short` (without the model's), `old` (until R2013a), `old-short`, `cut` (to 31 characters)."""
    model: str = "plant"
    reusable: bool = False
    io: str = "structures"
    """Root ports: `structures`, `model` (behind pointers of the real-time model), `arguments`, `exported`, `custom` (a
    function prototype of its user's)."""
    pointers: str = "plain"
    """Of the real-time model: `plain`, `nested` (in ModelData), `void`; `none`: all are arguments of functions."""
    parameters: str = "data"
    """Where values are: `data` (MODEL_data.c), `main` (only in ert_main.c), `compact` (MODEL.c), `renamed` (data, by a
    name that no header has), `global` (not behind pointers), `exported`, `const`, `inlined`."""
    rates: str = "one"
    """`one`, `two` (step0 and step1), `tid` (step(tid)), `split` (output and update)."""
    continuous: bool = False
    error_status: bool = True
    terminate: bool = True
    first_time: bool = False
    folders: bool = False
    """As packNGo leaves them: the model's, and one of shared files."""
    word_size: str = ""
    """`32` or `64`: the code asks the compiler for it."""
    include: str = ""
    """A header that is not there."""
    language: str = "c"
    """Or `c++`, `class`."""
    bus: bool = False

    @property
    def tunable(self) -> bool:
        return self.parameters not in ("const", "inlined")

    @property
    def once(self) -> bool:
        """It has global variables."""
        return not self.reusable or self.parameters in ("global", "exported") or self.io == "exported"

    @property
    def every(self) -> int:
        return 5 if self.rates in ("two", "tid") else 1


SHAPES = {
    # Nonreusable functions, the default.
    "r2014a": Shape("R2014a, Robin-upView/arduino_control_law/ert_main.c", parameters="inlined"),
    "r2024a": Shape("R2024a, j-osky/throttle_valve/ert_main.c"),
    "r2024b-const": Shape("R2024b, puneetpal-singh/cartpole-rl-codegen/ert_main.c", parameters="const"),
    "r2022b-compact": Shape("R2022b, PUT-Motorsport/putm_sim_gen/ert_main.c", parameters="compact"),
    "r2018b-data": Shape("R2018b, anthonysimeonov/bbblue_backup/untitled_ert_rtw/untitled.h"),
    "r2016b-short": Shape("R2016b, AA-CubeSat-Team/soci_cdh_sil/ert_main.c", ids="short"),
    "r2024b-short": Shape("R2024b, LukeW1999/case1/ert_main.c", ids="short", error_status=False, parameters="compact"),
    "r2022b-short": Shape(
        "R2022b, efvai/auto_generated/ert_main.c", ids="short", error_status=False, terminate=False,
        parameters="inlined",
    ),
    "r2024a-short": Shape("R2024a, anr2311/Fault_Tolerant_Design/ert_main.c", ids="short", terminate=False),
    "r2022a-short": Shape("R2022a, malaku/FW1/ert_main.c", ids="short", terminate=False, parameters="const"),
    "r2022b-exported": Shape("R2022b, dllModel.c of ert_shrlib.tlc, by its text", parameters="exported"),
    "r2014b-custom": Shape("R2014b, b12015/b1windpower/ert_main.c", io="custom", parameters="inlined"),
    "r2018b-tid": Shape("R2018b, AndrewBarth/AirTableSim/ert_main.c", rates="tid"),
    "r2025b-rates": Shape("R2025b, Hyperloop-UPV/LCU-Control-H11/ert_main.c", rates="two"),
    "folders": Shape(
        "CarlosCapili/3K04-Pacemaker-Project/Pacemaker_ert_rtw/Pacemaker.h and slprj/ert/_sharedutils/rtwtypes.h",
        rates="tid", folders=True,
    ),
    "old": Shape("until R2011b, cpu_usage.h with initialize(firstTime), by its text", ids="old", first_time=True),
    "old-short": Shape(
        "until R2013a, DemoTest.c for names and FuzzyNeuro.h for functions, by their texts", ids="old-short",
        rates="split",
    ),
    "continuous": Shape("R2022b, dllModel.h of ert_shrlib.tlc, by its text", continuous=True),
    # Reusable functions.
    "exported-ports": Shape(
        "Torque.c with Torque_step(RT_MODEL_Torque *const rtM_Torque), by its text", reusable=True, io="exported",
        parameters="const",
    ),
    "r2014a-nested": Shape(
        "R2014a, jcaplan/fingerprinting/automotive_control/CompiledC/AirbagModel_ert_rtw/AirbagModel.h",
        reusable=True, pointers="nested",
    ),
    "r2015a-main": Shape(
        "R2015a, gugu91/ACCSystem/ACC_Controller_ert_rtw/ert_main.c", reusable=True, io="arguments",
        pointers="nested", parameters="main",
    ),
    "r2015a-arguments": Shape(
        "R2015a, Gyro91/StopWatch-Autogenerated/ert_main.c", reusable=True, io="arguments", pointers="nested",
        terminate=False, parameters="const",
    ),
    "void": Shape(
        "filtLowPass.c with `ExtU *rtU = (ExtU *) rtM->inputs`, by its text", reusable=True, io="model",
        pointers="void",
    ),
    "old-arguments": Shape(
        "until R2013a, QuadRotorPlant.h with structures as arguments, by its text", ids="old", reusable=True,
        pointers="none", first_time=True,
    ),
    "cut": Shape(
        "ultrazohm/ultrazohm_sw/vitis/software/Baremetal/src/uz/uz_ParameterID/ElectricalID_6ph/"
        "ElectricalID_6ph_codegen.h",
        ids="cut", model="controller_of_a_long_name", reusable=True, io="model", error_status=False,
    ),
    "reusable-rates": Shape(
        "Controller.h with Controller_step0(…, real_T Controller_U_reference, …), by its text", reusable=True,
        io="arguments", rates="two",
    ),
    "reusable-continuous": Shape(
        "ControlVelocidad.c with X_ControlVelocidad_T, by its text", reusable=True, continuous=True
    ),
    "r2017b-renamed": Shape(
        "R2017b, EFeru/hoverboard-firmware-hack-FOC/Inc/BLDC_controller.h", ids="short", reusable=True, io="model",
        parameters="renamed", error_status=False, terminate=False,
    ),
    "r2017b-main": Shape(
        "R2017b, EFeru/bldc-motor-control-FOC/BLDC_controller_ert_rtw/ert_main.c", ids="short", reusable=True,
        io="model", parameters="main", error_status=False, terminate=False,
    ),
    "r2018a-arguments": Shape(
        "R2018a, ThierrySt-Arnaud/SmartTrackerFilter_ert_rtw/ert_main.c", ids="short", reusable=True, io="arguments",
        parameters="inlined", error_status=False, terminate=False,
    ),
    "r2020b-model": Shape(
        "R2020b, ultrazohm/ultrazohm_sw/vitis/export/Baremetal/Codegen/uz_codegen0_ert_rtw/uz_codegen0.h",
        ids="short", reusable=True, io="model", parameters="inlined", error_status=False, terminate=False,
    ),
    "global": Shape(
        "invertedparadox/SimscapeModel/Sensor_ert_rtw/Sensor.h", ids="short", reusable=True, parameters="global",
        terminate=False,
    ),
    # Refused.
    "class": Shape(
        "R2018a, wasn-lab/Taillight_Recognition_with_VGG16-WaveNet/src/control/geofence/src/Backup/untitled.h",
        language="class",
    ),
    "c++": Shape("R2025b, katesanborn/controller/controller_ert_rtw/controller.h", language="c++"),
    "solver": Shape(
        "R2019b, crabman84/torque-vectoring/playground/Caleb/CM_projects/LaunchControlFinalUpdate/src_cm4sl/"
        "RuleBasedTractionControl_CarMaker_rtw/RuleBasedTractionControl.h",
        include="rtw_continuous.h",
    ),
    "cmsis": Shape("ARM-software/CMSIS-DSP/Include/arm_math.h, by the coder's library for ARM", include="arm_math.h"),
    "bus": Shape(
        "R2026a, probstn/stugverter_simulink/foc_controller_ert_rtw/foc_controller.h", reusable=True, io="arguments",
        bus=True,
    ),
}  # fmt: skip

RTWTYPES = """\
#ifndef RTWTYPES_H
#define RTWTYPES_H
typedef signed char int8_T;
typedef unsigned char uint8_T;
typedef int int32_T;
typedef unsigned int uint32_T;
typedef float real32_T;
typedef double real_T;
typedef double time_T;
typedef unsigned char boolean_T;
typedef int int_T;
typedef char char_T;
#endif
"""
RTW_SOLVER = """\
#ifndef RTW_SOLVER_H
#define RTW_SOLVER_H
typedef struct { time_T *tPtr; } RTWSolverInfo;
#endif
"""
"""Stands for what MATLAB has and packNGo collects."""


def write(shape: Shape, generated: Path) -> None:
    """Leave the code in a folder, as the coder does."""
    written = _Writer(shape)
    own, shared = (f"{shape.model}_ert_rtw/", "slprj/ert/_sharedutils/") if shape.folders else ("", "")
    end = "c" if shape.language == "c" else "cpp"
    files = {
        f"{own}{shape.model}.h": written.header(),
        f"{own}{shape.model}.{end}": written.source(),
        f"{own}ert_main.{end}": written.main(),
        f"{shared}rtwtypes.h": RTWTYPES,
    }
    if shape.parameters in ("data", "global", "renamed"):
        files[f"{own}{shape.model}_data.{end}"] = f'#include "{shape.model}.h"\n{written.private()}{written.values()}'
    if shape.continuous:
        files[f"{own}rtw_continuous.h"] = '#include "rtw_solver.h"\n'
        files[f"{own}rtw_solver.h"] = RTW_SOLVER
    for name, text in files.items():
        (generated / name).parent.mkdir(parents=True, exist_ok=True)
        (generated / name).write_text(text)


class _Writer:
    def __init__(self, shape: Shape) -> None:
        self.shape = shape
        self.m = shape.model
        self.nested = "ModelData." if shape.pointers == "nested" else ""
        self.kinds = ["DW"]
        if shape.continuous:
            self.kinds.append("X")
        if shape.parameters in ("data", "main", "compact", "renamed", "global"):
            self.kinds.append("P")
        if shape.io in ("structures", "model"):
            self.kinds += ["ExtU", "ExtY"]

    # Names.

    def type(self, kind: str) -> str:
        ids = self.shape.ids
        if ids == "cut":
            return f"{kind}_{self.m[: 31 - len(kind) - 3]}_t"
        if ids.startswith("old"):
            kind = OLD.get(kind, kind)
            return kind if ids == "old-short" else f"{kind}_{self.m}"
        return kind if ids == "short" else f"{kind}_{self.m}_T"

    def variable(self, kind: str) -> str:
        name = "DWork" if kind == "DW" and self.shape.ids.startswith("old") else VARIABLES[kind]
        if kind == "P" and self.shape.parameters == "renamed":
            return "rtP_Left"
        return {"short": f"rt{name}", "old-short": name, "cut": f"rt{self.m}_{name}"}.get(
            self.shape.ids, f"{self.m}_{name}"
        )

    def argument(self, name: str) -> str:
        if self.shape.io == "custom":
            return f"arg_{name}"
        return self.variable("ExtU" if name in INPUTS else "ExtY") + f"_{name}"

    def exported(self, name: str) -> str:
        return f"{name}_{self.m}"

    def place(self, kind: str, name: str) -> str:
        """A field within a function."""
        if kind == "P" and self.shape.parameters in ("exported", "const", "inlined"):
            return {"exported": name, "const": f"{self.m}_ConstP.{name}", "inlined": f"{name}_value"}[
                self.shape.parameters
            ]
        if kind in ("ExtU", "ExtY") and self.shape.io in ("arguments", "custom"):
            if name == "command" and self.shape.io == "custom":
                return "out"
            return self.argument(name) if kind == "ExtU" else f"*{self.argument(name)}"
        if kind in ("ExtU", "ExtY") and self.shape.io == "exported":
            return self.exported(name)
        local = self.shape.reusable and not (kind == "P" and self.shape.parameters == "global")
        return f"{self.variable(kind)}{'->' if local else '.'}{name}"

    # What functions are given.

    def packed(self) -> list[str]:
        """Structures behind pointers of the real-time model."""
        if not self.shape.reusable or self.shape.pointers == "none":
            return []
        return [
            kind
            for kind in self.kinds
            if (self.shape.io == "model" or kind not in ("ExtU", "ExtY"))
            and not (kind == "P" and self.shape.parameters == "global")
        ]

    def given(self, names: list[str], *, initialize: bool = False, structures: bool = True) -> str:
        """The arguments of a function in which ports `names` are used."""
        found = []
        if self.shape.first_time and initialize:
            found.append("boolean_T firstTime")
        if self.shape.reusable:
            found.append(f"{self.type('RT_MODEL')} *const {self.variable('RT_MODEL')}")
            if structures:
                found += [
                    f"{self.type(kind)} *{self.variable(kind)}"
                    for kind in self.kinds
                    if kind not in self.packed() and not (kind == "P" and self.shape.parameters == "global")
                ]
        if self.shape.io == "arguments" or (self.shape.io == "custom" and not initialize):
            for name in names:
                kind, width = (INPUTS | OUTPUTS)[name]
                by_pointer = width == 1 and (initialize or name in OUTPUTS)
                ends = f"[{width}]" if width > 1 else ""
                if not (name == "command" and self.shape.io == "custom"):
                    found.append(f"{kind} {'*' if by_pointer else ''}{self.argument(name)}{ends}")
            if self.shape.bus:
                found.append(f"measurement *{self.m}_U_measurements")
        return ", ".join(found) or "void"

    def functions(self) -> dict[str, str]:
        """Heads by name."""
        m, every = self.m, [*INPUTS, *OUTPUTS]
        found = {f"{m}_initialize": f"void {m}_initialize({self.given(every, initialize=True)})"}
        if self.shape.rates == "two":
            found[f"{m}_step0"] = f"void {m}_step0({self.given([*INPUTS, 'command'])})"
            found[f"{m}_step1"] = f"void {m}_step1({self.given(['count'])})"
        elif self.shape.rates == "tid":
            found[f"{m}_step"] = f"void {m}_step(int_T tid)"
        elif self.shape.rates == "split":
            found |= {f"{m}_{each}": f"void {m}_{each}(int_T tid)" for each in ("output", "update")}
        elif self.shape.io == "custom":
            found[f"{m}_custom"] = f"real_T {m}_custom({self.given(every)})"
        else:
            found[f"{m}_step"] = f"void {m}_step({self.given(every)})"
        if self.shape.terminate:
            found[f"{m}_terminate"] = f"void {m}_terminate({self.given([], structures=False)})"
        return found

    # Files.

    def header(self) -> str:
        shape, m = self.shape, self.m
        lines = [
            f"#ifndef RTW_HEADER_{m}_h_",
            f"#define RTW_HEADER_{m}_h_",
            "#include <stddef.h>",
            '#include "rtwtypes.h"',
        ]
        if shape.include:
            lines.append(f'#include "{shape.include}"')
        if shape.bus:
            lines.append("typedef struct { real_T current[3]; } measurement;")
        if shape.continuous:
            lines += ['#include "rtw_continuous.h"', '#include "rtw_solver.h"']
        rtm = self.type("RT_MODEL")
        tag = rtm if shape.ids == "old" else f"tag_RTM_{m}"
        lines.append(f"typedef struct {tag} {rtm};")
        lines += [self.structure("DW", {"sum": ("real_T", 1), "buffer": ("real_T", 1)})]
        if "X" in self.kinds:
            lines.append(self.structure("X", {"Integrator_CSTATE": ("real_T", 1)}))
        if "ExtU" in self.kinds:
            lines += [self.structure("ExtU", INPUTS), self.structure("ExtY", OUTPUTS)]
        # A subsystem has structures of its own, which are no business of who calls the model.
        lines.append(
            f"typedef struct {{ real_T UnitDelay; }} {'DW_Filter' if shape.ids == 'short' else f'DW_Filter_{m}_T'};"
        )
        fields = {name: (kind, width) for name, (kind, width, _) in PARAMETERS.items()}
        if "P" in self.kinds:
            lines.append(f"struct {self.type('P')}_ {{ {self.fields(fields)} }};")
            lines.append(f"typedef struct {self.type('P')}_ {self.type('P')};")
        if shape.parameters == "const":
            lines.append(
                f"typedef struct {{ {self.fields(fields)} }} ConstP_{m}_T;\nextern const ConstP_{m}_T {m}_ConstP;"
            )
        pointers = "".join(
            f"{'real_T' if kind == 'X' else 'void' if shape.pointers == 'void' else self.type(kind)} *{POINTERS[kind]};"
            for kind in self.packed()
        )
        status = "const char_T * volatile errorStatus; " if shape.error_status else ""
        inner = f"struct {{ {pointers}}} ModelData; " if shape.pointers == "nested" else pointers
        solver = "RTWSolverInfo solverInfo; " if shape.continuous else ""
        timing = "struct { uint32_T clockTick0; } Timing;"
        lines.append(f"struct {tag} {{ {status}{solver}{inner}{timing} }};")
        if not shape.reusable:
            lines += [f"extern {self.type(kind)} {self.variable(kind)};" for kind in self.kinds]
            pointer = f"struct {rtm} *" if shape.ids == "old" else f"{rtm} *const "
            lines.append(f"extern {pointer}{self.variable('RT_MODEL')};")
        elif "P" in self.kinds and shape.parameters not in ("main", "renamed"):
            lines.append(f"extern {self.type('P')} {self.variable('P')};")
        if shape.io == "exported":
            for name, (kind, width) in (INPUTS | OUTPUTS).items():
                ends = f"[{width}]" if width > 1 else ""
                lines.append(f"extern {kind} {self.exported(name)}{ends}; /* '<Root>/{name}' */")
        if shape.parameters == "exported":
            for name, (kind, width, _) in PARAMETERS.items():
                ends = f"[{width}]" if width > 1 else ""
                lines.append(f"extern {kind} {name}{ends}; /* Variable: {name}\n * Referenced by: '<S1>/Gain' */")
        if shape.language == "class":
            lines.append(f"class {m}ModelClass {{\n public:\n  void initialize();\n  void step();\n}};")
        else:
            lines += [f"extern {head};" for head in self.functions().values()]
        return "\n".join([*lines, "#endif", ""])

    def fields(self, fields: dict[str, tuple[str, int]]) -> str:
        return " ".join(f"{kind} {name}{f'[{width}]' if width > 1 else ''};" for name, (kind, width) in fields.items())

    def structure(self, kind: str, fields: dict[str, tuple[str, int]]) -> str:
        return f"typedef struct {{ {self.fields(fields)} }} {self.type(kind)};"

    def private(self) -> str:
        """What the coder writes into MODEL_private.h."""
        if not self.shape.word_size:
            return ""
        return f"""\
#ifndef UCHAR_MAX
#include <limits.h>
#endif
#if ( UCHAR_MAX != (0xFFU) ) || ( SCHAR_MAX != (0x7F) )
#error Code was generated for compiler with different sized uchar/char.
#endif
#if ( LONG_MAX != ({WORD_SIZES[self.shape.word_size]}) )
#error Code was generated for compiler with different sized ulong/long.
#endif
"""

    def values(self) -> str:
        """The definition of the parameters' structure."""
        static = "static " if self.shape.parameters == "main" else ""
        values = ",\n\n".join(f"  /* Variable: {name}\n   */\n  {value}" for name, (_, _, value) in PARAMETERS.items())
        return f"{static}{self.type('P')} {self.variable('P')} = {{\n{values}\n}};                /* Modifiable */\n"

    def source(self) -> str:
        shape, m = self.shape, self.m
        parts = [f'#include "{m}.h"\n', self.private()]
        if not shape.reusable:
            parts += [f"{self.type(k)} {self.variable(k)};\n" for k in self.kinds if k != "P"]
            rtm, variable = self.type("RT_MODEL"), self.variable("RT_MODEL")
            constant = "" if shape.ids == "old" else "const "
            parts.append(f"static {rtm} {variable}_;\n{rtm} *{constant}{variable} = &{variable}_;\n")
        if shape.parameters == "compact":
            parts.append(self.values())
        if shape.io == "exported":
            parts += [
                f"{k} {self.exported(n)}{f'[{w}]' if w > 1 else ''};\n" for n, (k, w) in (INPUTS | OUTPUTS).items()
            ]
        for name, (kind, width, value) in PARAMETERS.items():
            ends = f"[{width}]" if width > 1 else ""
            if shape.parameters == "exported":
                parts.append(f"{kind} {name}{ends} = {value}; /* Variable: {name} */\n")
            elif shape.parameters == "inlined":
                parts.append(f"static const {kind} {name}_value{ends} = {value};\n")
        if shape.parameters == "const":
            values = ", ".join(value for _, _, value in PARAMETERS.values())
            parts.append(f"const ConstP_{m}_T {m}_ConstP = {{ {values} }};\n")
        return "".join([*parts, *self.bodies()])

    def bodies(self) -> list[str]:
        shape, m, functions = self.shape, self.m, self.functions()
        first, second = self.first(), self.second()
        rate = ["  /* Sample time: [0.01s, 0.0s] */", "  /* Sample time: [0.05s, 0.0s] */"]
        found = [f"{functions[f'{m}_initialize']}\n{{\n{self.locals()}{self.begin()}}}\n"]
        if shape.rates == "two":
            found.append(f"{functions[f'{m}_step0']}{rate[0]}\n{{\n{self.locals()}{first}}}\n")
            found.append(f"{functions[f'{m}_step1']}{rate[1]}\n{{\n{self.locals()}{second}}}\n")
        elif shape.rates == "tid":
            found.append(f"void {m}_step0(void);\nvoid {m}_step1(void);\n")
            found.append(
                f"void {m}_step0(void){rate[0]}\n{{\n{first}}}\nvoid {m}_step1(void){rate[1]}\n{{\n{second}}}\n"
            )
            found.append(
                f"{functions[f'{m}_step']}\n{{\n  if (tid == 0)\n    {m}_step0();\n  else\n    {m}_step1();\n}}\n"
            )
        elif shape.rates == "split":
            unused = "  (void)tid;\n"
            found.append(f"{functions[f'{m}_output']}\n{{\n{unused}{first}}}\n")
            found.append(f"{functions[f'{m}_update']}\n{{\n{unused}{second}}}\n")
        elif shape.io == "custom":
            body = f"  real_T out;\n{first}{second}  return out;\n"
            found.append(f"{functions[f'{m}_custom']}\n{{\n{body}}}\n")
        else:
            found.append(f"{functions[f'{m}_step']}\n{{\n{self.locals()}{first}{second}}}\n")
        if shape.terminate:
            unused = f"  (void){self.variable('RT_MODEL')};\n" if shape.reusable else ""
            found.append(f"{functions[f'{m}_terminate']}\n{{\n{unused}}}\n")
        return found

    def locals(self) -> str:
        """Structures from the real-time model."""
        rtm = self.variable("RT_MODEL")
        found = [
            f"  {self.type(k)} *{self.variable(k)} = ({self.type(k)} *) {rtm}->{self.nested}{POINTERS[k]};\n"
            for k in self.packed()
        ]
        unused = [self.variable(kind) for kind in self.packed()] + ([rtm] if self.shape.reusable else [])
        return "".join(found) + "".join(f"  (void){name};\n" for name in unused)

    def begin(self) -> str:
        """Registration: what is not zeroed here is as whoever calls has it."""
        lines = [f"  {self.place('DW', 'sum')} = 0.0;\n"]
        if self.shape.io not in ("custom",):
            lines.append(f"  {self.place('ExtY', 'count')} = 0U;\n")
        if self.shape.error_status:
            lines.append(f"  {self.variable('RT_MODEL')}->errorStatus = (NULL);\n")
        if self.shape.first_time:
            lines.append("  (void)firstTime;\n")
        return "".join(lines)

    def sum(self) -> str:
        return self.place("X", "Integrator_CSTATE") if self.shape.continuous else self.place("DW", "sum")

    def first(self) -> str:
        """Outputs."""
        p = {name: self.place("P", name) for name in PARAMETERS}
        u = {name: self.place("ExtU", name) for name in INPUTS}
        y = self.place("ExtY", "command")
        return f"""\
  /* Outport: '<Root>/command' incorporates:
   *  Inport: '<Root>/error'
   *  Inport: '<Root>/rates'
   *  Inport: '<Root>/enable'
   */
  {self.place("DW", "buffer")} = {u["error"]};
  {y} = {p["Kp"]} * {u["error"]} - ({p["Weights"]}[0] * {u["rates"]}[0] + {p["Weights"]}[1] * {u["rates"]}[1]) +
    {self.sum()};
  if ({y} > {p["Limit"]}) {{
    {y} = {p["Limit"]};
  }} else if ({y} < -{p["Limit"]}) {{
    {y} = -{p["Limit"]};
  }}

  if (!{u["enable"]}) {{
    {y} = 0.0;
  }}

"""

    def second(self) -> str:
        """States."""
        return f"""\
  {self.sum()} += 0.5 * {self.place("DW", "buffer")};

  /* Outport: '<Root>/count' */
  ({self.place("ExtY", "count")})++;
"""

    def main(self) -> str:
        """The example of a program, as far as it is read."""
        values = self.values() if self.shape.parameters == "main" else ""
        rtm = self.variable("RT_MODEL")
        pack = "".join(f"  {rtm}->{self.nested}{POINTERS[k]} = &{self.variable(k)};\n" for k in self.packed())
        return f"""\
#include "{self.m}.h"
{values}
int_T main(int_T argc, const char *argv[])
{{
  /* Pack model data into RTM */
{pack}
  /* Attach rt_OneStep to a timer or interrupt service routine with
   * period 0.01 seconds (the model's base sample time) here.  The
   * call syntax for rt_OneStep is
   */
}}
"""
