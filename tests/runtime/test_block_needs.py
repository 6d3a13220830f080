"""A block's type says what its task needs a permission for; no list here or on the station knows its name."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from flotilla.fleet import privileges
from tests.runtime.tasks import HEADERS, compile_shared

BLOCK = """
#include <flotilla/block.h>
struct new { const char *bus; };
static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct new, bus, .flags = FLAG, .default_value = "can7"),
};
static int step(struct fl_block *block) { (void)block; return FL_OK; }
FL_BLOCK(new) = {
    .abi = FL_ABI, .name = "new", FL_TABLE(parameter, parameters), .parameters_size = sizeof(struct new), .step = step,
};
"""
TASK = {"blocks": {"one": {"type": "new"}, "other": {"type": "clock"}}}


def listed(flotilla_run: Path, directory: Path, text: str, flag: str) -> subprocess.CompletedProcess[str]:
    """The answer of flotilla-blocks with a plug-in of that text."""
    (source := directory / "new.c").write_text(text)
    (directory / "blocks").mkdir()
    compile_shared(source, directory / "blocks/new.so", f"-I{HEADERS}", f"-DFLAG={flag}")
    argv: list[str | Path] = [
        flotilla_run.with_name("flotilla-blocks"),
        "--blocks",
        directory / "blocks",
        "--json",
        "new",
    ]
    return subprocess.run(argv, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("flag", "can", "camera", "ports"),
    [
        ("0", False, False, False),
        ("FL_CAN_INTERFACE", True, False, False),
        ("FL_CAMERA|FL_EXCLUSIVE", False, True, False),
        ("FL_IO_PORTS", False, False, True),
    ],
)
def test_a_new_block_gets_what_it_declares(
    flotilla_run: Path, tmp_path: Path, flag: str, can: bool, camera: bool, ports: bool
) -> None:
    """Before, names of the runtime's own blocks decided."""
    listing: list[dict[str, Any]] = json.loads(listed(flotilla_run, tmp_path, BLOCK, flag).stdout)
    needs = privileges.needs_of(listing)
    lines = privileges.user(0, TASK, needs).splitlines()
    (groups,) = (line for line in lines if line.startswith("SupplementaryGroups=r"))
    assert ("RestrictAddressFamilies=~AF_CAN" not in lines) is can
    assert groups.endswith(" video") is camera
    assert privileges.drives_io_ports(TASK, needs) is ports


def test_a_can_interface_is_a_name(flotilla_run: Path, tmp_path: Path) -> None:
    number = BLOCK.replace("const char *bus", "int64_t bus").replace('"can7"', '"7"')
    done = listed(flotilla_run, tmp_path, number, "FL_CAN_INTERFACE")
    assert done.returncode
    assert "block new: the name of a CAN interface is not a string" in done.stderr
