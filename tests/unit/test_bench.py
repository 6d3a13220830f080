"""`make bench`: its table, and what it compares with."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from evidence import bench, bench_mkosi, bench_robots
from evidence.bench import Row, Work, table
from flotilla.common.errors import UserError
from flotilla.debian.lock import read_lock
from flotilla.fleet.model import Fleet
from flotilla.images import card


def test_table_has_ratios_to_the_first_row() -> None:
    rows = [Row("cold", "card", 60.0, 85.5, 1 << 20, 1), Row("next", "card", 0.6, 0.7, 512, 5)]
    assert table(rows).splitlines() == [
        "work  seconds   ratio  processor    bytes  made",
        "cold    60.00  1.0000      85.50  1.0 MiB  card",
        "next     0.60  0.0100       0.70    512 B  card",
    ]


def test_a_row_has_the_processor_time_of_its_processes() -> None:
    burn = "import time\nwhile time.process_time() < 0.3: pass"

    def make() -> int:
        subprocess.run([sys.executable, "-c", burn], check=True)
        return 7

    row = bench._measure(Work("work", "made", make), 3)
    assert row.processor >= 0.3
    assert (row.bytes, row.runs) == (7, 3)


def test_what_is_compared_runs_in_turn_and_is_prepared_each_time() -> None:
    """Seen to fail with all runs of the one before the first of the other."""
    done: list[str] = []

    def work(name: str) -> Work:
        def make() -> int:
            done.append(name)
            return len(done)

        return Work(name, "made", make, lambda: done.append(f"before {name}"))

    rows = bench._in_turn([work("ours"), work("theirs")], 2)
    assert done == ["before ours", "ours", "before theirs", "theirs"] * 2
    assert [(row.work, row.bytes, row.runs) for row in rows] == [("ours", 6, 2), ("theirs", 8, 2)]


def test_mkosi_is_the_users_to_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MKOSI", raising=False)
    assert bench_mkosi.program() is None
    program = tmp_path / "mkosi"
    monkeypatch.setenv("MKOSI", str(program))
    with pytest.raises(UserError, match=r"MKOSI=.*/mkosi: no program; .*bin/mkosi"):
        bench_mkosi.program()
    program.touch(mode=0o755)
    assert bench_mkosi.program() == str(program)


def test_further_robots_take_what_is_free(fleet: Fleet) -> None:
    one, there = fleet.robots[3], list(fleet.robots.values())
    made = bench_robots.like(fleet, one, 100)
    for field in ("name", "number", "address"):
        values = [getattr(robot, field) for robot in [*made, *there, *fleet.stations] if hasattr(robot, field)]
        assert len(set(values)) == len(values), field
    assert {(robot.board, tuple(robot.devices)) for robot in made} == {(one.board, tuple(one.devices))}
    assert all(robot.address in fleet.network.subnet for robot in made)
    with pytest.raises(UserError, match=r"^300 robots are to be measured, and the fleet has .* for 246 more"):
        bench_robots.like(fleet, one, 300)


def test_mkosi_makes_a_disk_like_the_card(tmp_path: Path) -> None:
    grub, initramfs = tmp_path / "grub", tmp_path / "initrd"
    grub.mkdir()
    (grub / "normal.mod").write_text("module")
    initramfs.write_text("archive")
    lock, directory = read_lock("smartcoret3"), tmp_path / "mkosi"
    bench_mkosi.prepare(directory, lock, grub, initramfs)
    parts = [file.read_text() for file in sorted((directory / "partitions").iterdir())]
    assert ["Type=root-x86" in part for part in parts] == [False, False, True, False, False]
    assert "Format=squashfs\n" in parts[2]
    assert "CompressionLevel=15\n" in parts[2]
    assert f"SizeMinBytes={card.LAYOUT.slot_mib}M\n" in parts[3]
    assert (directory / "grub/usr/lib/grub/i386-pc/normal.mod").read_text() == "module"
    rules = (directory / "sandbox/etc/dpkg/dpkg.cfg.d/flotilla").read_text().splitlines()
    assert rules.index("path-exclude=/usr/share/doc/*") < rules.index("path-include=/usr/share/doc/*/copyright")
    stub = subprocess.run(
        ["dpkg-deb", "--field", directory / "stubs/stub_1_all.deb", "Provides"],
        check=True,
        capture_output=True,
        text=True,
    )
    assert "linux-initramfs-tool" in stub.stdout

    argv = bench_mkosi.command("bin/mkosi", directory, tmp_path / "tools", tmp_path / "repository", lock)
    assert {f"--package={package.name}" for package in lock.packages} < set(argv)
    assert {"--format=disk", "--bios-bootloader=grub", "--architecture=x86"} < set(argv)
    (arguments,) = (each for each in argv if each.startswith("--kernel-command-line="))
    assert "root=PARTUUID=00000000-03 " in arguments  # as flotilla/images/init reads it
    (ata,) = (
        each.partition("=")[2] for each in argv if each.startswith("--kernel-modules-include=") and "pata" in each
    )
    assert re.search(ata, "drivers/ata/pata_via.ko")
    assert not re.search(ata, "sound/drivers/ata/pata_via.ko")


def test_mkosi_is_not_compared_with_a_kernel_of_our_own(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "mkosi"
    program.touch(mode=0o755)
    monkeypatch.setenv("MKOSI", str(program))
    one = fleet.robots[3]
    lean = fleet.boards[one.board].model_copy(update={"kernel": "lean"})
    changed = fleet.model_copy(update={"boards": fleet.boards | {one.board: lean}})
    with pytest.raises(UserError, match=r"mkosi: .*robot3 has a kernel of our own .*; name another robot"):
        bench.bench(changed, one)
