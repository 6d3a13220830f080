"""The page of a task file's keys, as its reader in C lists them: `flotilla-run --keys`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flotilla.reference.markdown import MADE, code, literal, table
from flotilla.reference.programs import listing

_HEAD = f"""{MADE}
# Task file

A control task in YAML. `NAME` stands for a block's name, which the file chooses: it begins with a letter and contains
no dot, bracket or blank. A time has a unit: `ns`, `us`, `ms` or `s`. [Control tasks](../how-to/control-tasks.md) shows
how to write one, and [Blocks](blocks.md) has types, ports and parameters. `flotilla-run --check` names each
mistake with its line.

"""


def page(programs: Path) -> str:
    """From the runtime that is built in `programs`."""
    return _HEAD + table(("key", "value", "default", "meaning"), map(_row, listing(programs, "flotilla-run", "--keys")))


def _row(key: dict[str, Any]) -> tuple[str, str, str, str]:
    value = key["value"]
    if "choices" in key:
        value = " or ".join(map(code, key["choices"].split("|")))
    elif "min" in key:
        value += f", {key['min']} to {key['max']}"
    default = code(key["default"]) if "default" in key else literal(key.get("otherwise", "required"))
    return code(key["key"]), value, default, literal(key["meaning"])
