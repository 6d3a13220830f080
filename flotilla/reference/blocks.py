"""The page of blocks: from the listing of `flotilla-blocks`, and from the header comments of the blocks' C files."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flotilla.common import paths
from flotilla.fleet import privileges
from flotilla.reference.markdown import MADE, code, literal, table
from flotilla.reference.programs import listing

SOURCES = paths.PROJECT / "runtime" / "blocks"
AREAS = {
    "signal": "Signals",
    "devices": "Devices",
    "can": "CAN",
    "camera": "Cameras",
    "io": "Between tasks and computers",
    "dds": "DDS",
}
"""Folders of `SOURCES`, in the order of the page."""
EXAMPLES = {
    "constant": ["value=[1, 2]"],
    "dds-subscribe": ["robot=[3]"],
    "ir104-pbf": ["channels=[1, 2]"],
    "pack": ["types=[double, uint8]"],
    "queue-receive": ["name=/heading"],
    "queue-send": ["name=/heading"],
    "recorder": ["types=[double, uint8]"],
    "ros-publish": ["type=sensor_msgs/msg/LaserScan", "topic=scan", "lengths=[682]"],
    "ros-subscribe": ["type=geometry_msgs/msg/Twist", "topic=cmd_vel"],
    "thruster-mapping": [
        "positions=[0.15, 0.15, 0.15, 0.15, -0.15, 0.15, -0.15, 0.15, "
        "-0.15, -0.15, -0.15, -0.15, 0.15, -0.15, 0.15, -0.15]",
        "directions=[1, 0, 0, 1, -1, 0, 0, 1, -1, 0, 0, -1, 1, 0, 0, -1]",
        "force=0.3",
    ],
    "trajectory": ["waypoints=[0, 1]", "times=[0, 10]"],
    "udp-receive": ["length=8"],
    "udp-send": ["address=[10.42.0.2]", "length=8"],
    "unpack": ["types=[double, uint8]"],
}
"""By block: parameters that its ports are shown for. Without them it has none that depend on parameters, or fails."""

_HEADER = re.compile(r"^/\*\* ([^\n]*)\n(.*?)^ \*/$", re.MULTILINE | re.DOTALL)
_SECTION = re.compile(r"^(Equations|Failure): ?", re.MULTILINE)
_HEAD = f"""{MADE}
# Blocks

What a task can be made of. [Task file](task-file.md) says how a task names them.

- An optional input reads zero without a wire. A delayed input reads its source's value of the previous step, so it may
  close a loop of wires.
- An output marked as refusals counts what others sent and the block refused; `flotilla-param --status` and
  `make top ASK=1` name it if it is not 0.
- A tunable parameter may change while the task runs (`make param`). An exclusive one names a device, alone or with the
  others that are exclusive: one block may have it.
- A task gets the permissions that its blocks need: `can`, `io-ports`, `camera`.
- `doubles` and `strings` are lists, or one value. A `device` is a path that begins with a slash.
"""


def headers(text: str) -> dict[str, dict[str, str]]:
    """The headers of a C file by block: `Description`, `Failure` and, where there are any, `Equations`."""
    found = {}
    for name, body in _HEADER.findall(text):
        plain = re.sub(r"^ \*(?: |$)", "", body, flags=re.MULTILINE)
        parts = _SECTION.split(plain)
        found[name] = {"Description": parts[0].strip()}
        found[name] |= {title: part.strip("\n") for title, part in zip(parts[1::2], parts[2::2], strict=True)}
    return found


def needs(programs: Path) -> str:
    """What blocks need permissions for, for `privileges.RUNTIME_NEEDS`."""
    return privileges.needs_page(listing(programs, "flotilla-blocks", "--blocks", str(programs), "--json"))


def page(programs: Path) -> str:
    """From the runtime that is built in `programs`, with all of its plug-ins; KeyError for a block without a header."""
    command = ("flotilla-blocks", "--blocks", str(programs), "--json")
    known = {block["name"]: block for block in listing(programs, *command)}
    words = [
        word for name, block in known.items() if block.get("configures") for word in (name, *EXAMPLES.get(name, []))
    ]
    configured = known | {block["name"]: block for block in listing(programs, *command, *words)}
    described = {
        name: (file.relative_to(SOURCES).parts[0], header)
        for file in sorted(SOURCES.rglob("*.c"))
        for name, header in headers(file.read_text(encoding="utf-8")).items()
    }
    areas: dict[str, list[str]] = {area: [] for area in AREAS}
    for name in sorted(known):
        area, header = described[name]
        areas[area].append(_block(known[name], configured[name], header))
    return _HEAD + "".join(f"\n## {AREAS[area]}\n{''.join(texts)}" for area, texts in areas.items())


def _block(block: dict[str, Any], configured: dict[str, Any], header: dict[str, str]) -> str:
    parts = [f"### {block['name']}", *_prose(header["Description"])]
    if "Equations" in header:
        parts += _prose(header["Equations"])
    failure = list(_prose(header["Failure"]))
    parts += [f"**On failure.** {failure[0]}", *failure[1:]]
    if block.get("triggers"):
        parts.append("It can be the `trigger` of a task.")
    if block.get("actuates"):
        parts.append("Its outputs go to their reset state when the task ends, in whatever way.")
    if any(len(configured[side]) > len(block[side]) for side in ("inputs", "outputs")):
        example = ", ".join(code(word.replace("=", ": ", 1)) for word in EXAMPLES.get(block["name"], []))
        parts.append(f"Ports depend on parameters; these are for {example or 'the defaults'}.")
    ports = ("type", "unit", "meaning")
    parts += [
        table(("input", *ports), map(_port, configured["inputs"])) if configured["inputs"] else "",
        table(("output", *ports), map(_port, configured["outputs"])) if configured["outputs"] else "",
        table(("parameter", "value", "unit", "default", "meaning"), map(_parameter, block["parameters"]))
        if block["parameters"]
        else "",
    ]
    if "source" in block:
        parts.append(f"Source: {literal(block['source'])}.")
    return "".join(f"\n{part.rstrip()}\n" for part in parts if part)


def _prose(text: str) -> Iterator[str]:
    """Paragraphs; lines that are indented stay as they are, with what is indented after them."""
    indented: list[str] = []
    for paragraph in re.split(r"\n\s*\n", text):
        if paragraph.startswith("  "):
            indented.append(paragraph)
            continue
        if indented:
            yield _verbatim(indented)
            indented = []
        yield literal(paragraph)
    if indented:
        yield _verbatim(indented)


def _verbatim(paragraphs: list[str]) -> str:
    lines = textwrap.dedent("\n\n".join(paragraphs))
    return f"```\n{lines}\n```"


def _port(port: dict[str, Any]) -> tuple[str, str, str, str]:
    width = f"\\[{port['width']}\\]" if port["width"] > 1 else ""
    flags = "".join(f"; {flag}" for flag in ("optional", "delayed", "refusals") if port.get(flag))
    return code(port["name"]), port["type"] + width, port.get("unit", ""), literal(port.get("summary", "")) + flags


def _parameter(parameter: dict[str, Any]) -> tuple[str, str, str, str, str]:
    marks = [mark for mark in ("tunable", "exclusive") if parameter.get(mark)]
    if "needs" in parameter:
        marks.append(f"needs permission: {parameter['needs']}")
    if parameter.get("timeout"):
        marks.append("ends the task if no step ends for this long")
    return (
        code(parameter["name"]),
        _value(parameter),
        parameter.get("unit", ""),
        "required" if parameter.get("required") else code(parameter["default"]) if "default" in parameter else "none",
        "; ".join([literal(parameter.get("summary", "")), *marks]),
    )


def _value(parameter: dict[str, Any]) -> str:
    """What it takes, with its range: `double, 0 to 1`."""
    if "choices" in parameter:
        return " or ".join(map(code, parameter["choices"].split("|")))
    least, most = (f"{parameter[end]:.6g}" if end in parameter else "" for end in ("min", "max"))
    limits = (
        f"{least} to {most}" if least and most else f"at least {least}" if least else f"at most {most}" if most else ""
    )
    kind: str = parameter["kind"]
    return ", ".join(filter(None, (kind, ("each " if limits and kind == "doubles" else "") + limits)))
