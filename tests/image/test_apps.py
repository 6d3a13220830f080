"""Apps on a card: built the same wherever and whenever, and laid into the data partition as a robot finds them."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

import pytest

from flotilla.apps import app, builder, remote, scaffold
from flotilla.debian import tools
from flotilla.debian.lock import read_lock
from flotilla.debian.tools import Tools
from flotilla.fleet import apps, inventory
from flotilla.fleet.apps import BuiltApp
from flotilla.images import card, data_partition
from tests.image.test_image import Ext

TELLTALE = 'const char telltale[] __attribute__((used)) = __FILE__ " " __DATE__ " " __TIME__;\n'
"""What a program may have of where and when it was compiled."""


@pytest.fixture(scope="module")
def toolset() -> Tools:
    lock = read_lock("tools")
    return Tools(tools.tree(lock), lock.epoch)


def built(directory: Path, architecture_of: str = "smartcoret3") -> list[BuiltApp]:
    """A new block and a new program, made in `directory`, without the cache."""
    board = inventory.load_fleet().boards[architecture_of]
    made = []
    for kind in ("block", "make"):
        scaffold.create(kind, f"my-{kind}", directory)
        source = next((directory / f"my-{kind}").glob("*.c"))
        source.write_text(source.read_text() + TELLTALE)
        subject = app.load(directory / f"my-{kind}")
        out = directory / "out" / kind
        builder.build(subject, board, out)
        made.append(apps.read(subject.name, out, remote.linked(subject)))
    return made


def test_apps_have_the_same_bytes_wherever_built_and_lie_on_the_card(tmp_path: Path, toolset: Tools) -> None:
    """Elsewhere, with another umask, later. Seen to fail without SOURCE_DATE_EPOCH for the compiler, and with the modes
    that a umask left."""
    fleet = inventory.load_fleet()
    robot = fleet.robots[4].model_copy(update={"apps": ["my-block", "my-make"]})
    partitions = []
    before = os.umask(0o022)
    for place, umask in (("one", 0o022), ("else/where", 0o077)):
        os.umask(umask)
        try:
            (tmp_path / place).mkdir(parents=True)
            made = built(tmp_path / place)
        finally:
            os.umask(before)
        image = tmp_path / f"{umask}.img"
        card.data_partition(
            fleet.boards[robot.board],
            toolset,
            image,
            data_partition.nodes(fleet, robot, made),
            read_lock("smartcoret3").epoch,
        )
        partitions.append((made, image))
    (first, image), (second, other) = partitions
    assert [each.listing for each in first] == [each.listing for each in second]
    assert image.read_bytes() == other.read_bytes()

    data, block, program = Ext(toolset, image), *first
    assert data.mode(f"/apps/.my-make@{program.version}/my-make") == (0o755, 0, 0)
    assert data.read(f"/A/etc/flotilla/apps/{block.name}").encode() == block.listing
    plugin = block.files[PurePosixPath("blocks/my-block.so")][0]
    assert b".debug_info" not in plugin, "the plug-in has what only debuggers read; names of functions tell of a crash"
    assert re.search(rb"my_block\.c \w{3} [ \d]\d \d{4} \d\d:\d\d:\d\d", plugin), "nothing tells when it was compiled"
    for link, target in {**block.links, **program.links}.items():
        inside = PurePosixPath("/", link.relative_to("/data")) if link.is_relative_to("/data") else Path(f"/A{link}")
        shown = toolset.run("usr/sbin/debugfs", "-R", f"stat {inside}", image)
        assert "Type: symlink" in shown
        linked = re.search(r'Fast link dest: "(.*)"', shown)
        found = linked[1] if linked else data.read(str(inside))
        assert found == target


def test_an_app_may_do_what_its_own_block_declares(tmp_path: Path) -> None:
    """Also what a block within it does. Seen to fail: only tasks that name the runtime's own block of relays got the
    privilege for I/O ports."""
    board = inventory.load_fleet().boards["smartcoret3"]
    scaffold.create("block", "ports", tmp_path)
    source = tmp_path / "ports/ports.c"
    text = source.read_text()
    relays = '#include <flotilla/inner.h>\nvoid inside(void);\nvoid inside(void) { fl_inner_new("ir104-pbf", 0); }\n'
    ways = {text: False, text.replace("FL_TUNABLE", "FL_TUNABLE | FL_IO_PORTS"): True, text + relays: True}
    for number, (code, drives) in enumerate(ways.items()):
        source.write_text(code)
        out = tmp_path / f"out{number}"
        builder.build(app.load(tmp_path / "ports"), board, out)
        assert (out / "unit.d/io-ports.conf").exists() is drives
