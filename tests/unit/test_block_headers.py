"""Each block of the runtime says in a header comment what it does; docs/reference/blocks.md is made from these.

The form, one comment for each FL_BLOCK of a file, the first one at the file's beginning:

    /** NAME                          the block's name, as task files have it
     *
     * What it does: paragraphs.      lines that are indented by two spaces or more stay as they are
     *
     * Equations:                     optional; what it computes, an indented line each
     *   out = factor·in
     *
     * Failure: text.                 flag 0, safe values, what a time-out does, what the loader refuses
     */

Ports, parameters with their units, and the source are in the descriptor, which flotilla-blocks prints.
"""

import re
from pathlib import Path

import pytest

from flotilla.reference.blocks import SOURCES, headers

NO_EQUATIONS = {"recorder"}
"""Blocks of signal/ that compute nothing; all others say what they compute."""

_BLOCK = re.compile(r'^FL_BLOCK\(\w+\) = \{\n.*?\.name = "([^"]+)"', re.MULTILINE | re.DOTALL)


def problems(path: Path) -> list[str]:
    """What is wrong with the headers of the blocks in a C file."""
    text = path.read_text()
    blocks, found = _BLOCK.findall(text), headers(text)
    wrong = [f"{path.name}: no block is called {name}" for name in found if name not in blocks]
    if blocks and not text.startswith("/** "):
        wrong.append(f"{path.name} does not begin with a header")
    for name in blocks:
        sections = found.get(name)
        if sections is None:
            wrong.append(f"{path.name}: block {name} has no header")
            continue
        needed = ["Description", "Failure"]
        if path.parent.name == "signal" and name not in NO_EQUATIONS:
            needed.append("Equations")
        wrong += [
            f"{path.name}: header of {name} has no {part}" for part in needed if not sections.get(part, "").strip()
        ]
        for line in filter(None, sections.get("Equations", "").split("\n")):
            if not line.startswith("  "):
                wrong.append(f"{path.name}: header of {name}: an equation is not indented: {line}")
    return wrong


def test_each_block_has_a_header() -> None:
    files = sorted(SOURCES.rglob("*.c"))
    assert len([path for path in files if "\nFL_BLOCK(" in path.read_text()]) >= 36
    assert [problem for path in files for problem in problems(path)] == []


GOOD = """\
/** gain
 *
 * Multiplies a signal.
 *
 * Equations:
 *   out = factor·in
 *
 * Failure: Cannot fail.
 */
#include <flotilla/block.h>

FL_BLOCK(gain) = {
    .abi = FL_ABI,
    .name = "gain",
};
"""


def test_header_is_read() -> None:
    assert headers(GOOD) == {
        "gain": {
            "Description": "Multiplies a signal.",
            "Equations": "  out = factor·in",
            "Failure": "Cannot fail.",
        }
    }


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", []),
        ("/** gain", "/* gain", ["gain.c does not begin with a header", "gain.c: block gain has no header"]),
        ("/** gain", "/** lift", ["gain.c: no block is called lift", "gain.c: block gain has no header"]),
        ("#include", "/* about */\n#include", []),
        ("/** gain", "#include <math.h>\n/** gain", ["gain.c does not begin with a header"]),
        (" * Multiplies a signal.\n *\n", "", ["gain.c: header of gain has no Description"]),
        (" *\n * Failure: Cannot fail.\n", "", ["gain.c: header of gain has no Failure"]),
        ("Cannot fail.", "", ["gain.c: header of gain has no Failure"]),
        (" * Equations:\n *   out = factor·in\n *\n", "", ["gain.c: header of gain has no Equations"]),
        (
            " *   out =",
            " * out =",
            ["gain.c: header of gain: an equation is not indented: out = factor·in"],
        ),
        (
            "};\n",
            '};\n\nFL_BLOCK(half) = {\n    .name = "half",\n};\n',
            ["gain.c: block half has no header"],
        ),
    ],
)
def test_faulty_header(tmp_path: Path, old: str, new: str, expected: list[str]) -> None:
    file = tmp_path / "signal/gain.c"
    file.parent.mkdir()
    file.write_text(GOOD.replace(old, new, 1) if old else GOOD)
    assert sorted(problems(file)) == sorted(expected)
