"""The draft of a board's file from a computer: what is made of its answer, and what is no board.

The answers of QEMU's computers are in tests/boot: each guest is asked there.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from flotilla.common import paths
from flotilla.common.errors import ProblemsError, UserError
from flotilla.fleet import inventory
from flotilla.robot import board_draft

NUC = """\
machine\tx86_64
product\tIntel(R) Client Systems NUC7i5BNK
firmware\t64
processors\t4
memory_kib\t8052372
flags\t fpu vme tsc pae cmov nopl constant_tsc
clock\ttsc
disk\tnvme0n1 nvme
disk\tsda sd_mod uas xhci_pci
ethernet\teno1 e1000e
radio\twlp58s0 iwlwifi
watchdog\tiTCO_wdt / iTCO_wdt i2c_i801
loaded\tiTCO_wdt nvme e1000e
uart\t0 uart:16550A port:000003F8 irq:4 tx:0 rx:0
end\t
"""
PC104 = """\
machine\ti686
product\t
firmware\tbios
processors\t1
memory_kib\t253312
flags\t fpu vme tsc pae cmov
clock\tpit
disk\tsda sd_mod ata_generic
disk\tsr0 sr_mod ata_generic
ethernet\teth0 e100
loaded\tib700wdt ata_generic e100
uart\t0 uart:16550A port:000003F8 irq:4
uart\t1 uart:16550A port:000002F8 irq:3
uart\t4 uart:ST16654 port:00000100 irq:5
end\t
"""


def drafted(answer: str) -> dict[str, Any]:
    board: dict[str, Any] = yaml.safe_load(board_draft.render(board_draft.read(answer), "drafted"))["board"]
    return board


def test_a_pc_with_uefi() -> None:
    board = drafted(NUC)
    assert (board["architecture"], board["suite"], board["firmware"], board["processors"]) == (
        "amd64",
        "trixie",
        "uefi",
        4,
    )
    assert board["disk_modules"][:5] == ["nvme", "sd_mod", "uas", "xhci_pci", "ahci"]
    assert board["ports"] == {"COM1": {"tty": "ttyS0"}}
    assert (board["kernel_arguments"], board["modules"]) == ([], [])
    assert board["acceptance"] == {"memory_mib": 7627, "clock_source": "tsc"}


def test_a_pc104_computer() -> None:
    """Of a serial port beyond the fourth the kernel has to know, and no bus announces the watchdog."""
    board = drafted(PC104)
    assert (board["architecture"], board["suite"], board["firmware"]) == ("i386", "bookworm", "bios")
    assert board["disk_modules"] == ["sd_mod", "ata_generic"]
    assert board["ports"] == {"COM1": {"tty": "ttyS0"}, "COM2": {"tty": "ttyS1"}, "COM5": {"tty": "ttyS4"}}
    assert (board["kernel_arguments"], board["modules"]) == (["8250.nr_uarts=5"], ["ib700wdt"])


def test_a_computer_without_serial_ports() -> None:
    text = board_draft.render(board_draft.read(NUC.replace("uart\t0", "other\t0")), "drafted")
    assert "# No serial port was found: the monitor shows the boot, and login is by SSH only.\n" in text
    board = yaml.safe_load(text)["board"]
    assert "console" not in board
    assert (board["ports"], board["qemu"]["devices"]) == ({}, [])
    assert "console" in drafted(NUC)


@pytest.mark.parametrize("answer", [NUC, PC104], ids=["uefi", "bios"])
def test_the_inventory_takes_the_draft(tmp_path: Path, answer: str) -> None:
    """All but its list of packages, which the page on porting has as the next step, is there."""
    groups = tmp_path / "group_vars"
    groups.mkdir()
    (groups / "board_drafted.yml").write_text(board_draft.render(board_draft.read(answer), "drafted"))
    shutil.copy(paths.PROJECT / "ansible/inventory/group_vars/all.yml", groups)
    hosts = "{ robot1: { number: 1, address: 10.42.0.1 } }"
    (tmp_path / "robots.yml").write_text(f"robots: {{ children: {{ board_drafted: {{ hosts: {hosts} }} }} }}\n")
    with pytest.raises(ProblemsError) as refused:
        inventory.load_fleet(tmp_path)
    (problem,) = refused.value.problems
    assert "has no package list" in problem.message


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("machine\ti686", "machine\taarch64", "aarch64: there are images for PCs alone"),
        ("pae ", "", "no `pae`.*`kernel: lean`"),
        ("cmov", "", "no `cmov`"),
        ("firmware\tbios", "firmware\t32", "UEFI of 32 bits"),
        ("processors\t1", "processors\t0", "processors: .*board_pc_uefi.yml"),
    ],
)
def test_a_computer_without_an_image_is_named(old: str, new: str, reason: str) -> None:
    assert old in PC104
    with pytest.raises(UserError, match=reason):
        drafted(PC104.replace(old, new))


@pytest.fixture
def remote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An `ssh` and a `sudo` that run on this computer what they are given; the folder of outputs."""
    for name, last in (("ssh", 'while [ "$1" != -- ]; do shift; done; exec sh -c "$3"'), ("sudo", 'shift; exec "$@"')):
        (tmp_path / name).write_text(f"#!/bin/sh\n{last}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setattr(paths, "BUILD", tmp_path)
    return tmp_path


def test_this_computer_is_drafted(remote: Path) -> None:
    assert "board_here.yml: compare it" in board_draft.draft("ssh:root@localhost", "here")
    board = yaml.safe_load((remote / "reports/board_here.yml").read_text())["board"]
    assert (board["architecture"], board["processors"]) == ("amd64", os.sysconf("SC_NPROCESSORS_CONF"))


def test_a_computer_that_lets_nobody_in_is_named(remote: Path) -> None:
    (remote / "ssh").write_text("#!/bin/sh\necho 'Permission denied (publickey).' >&2\nexit 255\n")
    with pytest.raises(UserError, match=r"root@host: Permission denied.*a login without a question"):
        board_draft.draft("ssh:root@host", "nuc")
    assert not (remote / "reports").exists()


REQUIRED = ("product", "firmware", "processors", "memory_kib", "flags", "clock", "loaded")
INVALID = {f"without {key}": PC104.replace(f"\n{key}\t", "\nother\t") for key in REQUIRED} | {
    "nothing": "end\t\n",
    "a number that is none": PC104.replace("processors\t1", "processors\tmany"),
    "half a port": PC104.replace("0 uart:16550A port:000003F8 irq:4", "0"),
}


@pytest.mark.parametrize("answer", INVALID.values(), ids=INVALID)
def test_an_answer_that_is_none_is_named_and_nothing_is_written(remote: Path, answer: str) -> None:
    """Seen to fail: each ended in a traceback."""
    (remote / "answer").write_text(answer)
    (remote / "ssh").write_text(f"#!/bin/sh\nexec cat {remote}/answer\n")
    with pytest.raises(UserError, match="root@host: its answer is invalid"):
        board_draft.draft("ssh:root@host", "pc104")
    assert not (remote / "reports").exists()


@pytest.mark.parametrize("way", ["root@host", "ssh:", "ssh:-oProxyCommand=true"])
def test_another_target_is_named(way: str) -> None:
    with pytest.raises(UserError, match=r"give ssh:USER@HOST"):
        board_draft.draft(way, "nuc")


@pytest.mark.parametrize("name", ["", "../x", "Nuc", "-x"])
def test_another_name_is_named(name: str) -> None:
    with pytest.raises(UserError, match=r"no name of a board"):
        board_draft.draft("ssh:root@host", name)


def test_control_characters_of_the_computer_are_shown() -> None:
    text = board_draft.render(board_draft.read(NUC.replace("NUC7i5BNK", "\x1b[2J: #x")), "drafted")
    assert "\x1b" not in text
    assert yaml.safe_load(text)["board"]["description"] == "Intel(R) Client Systems \\x1b[2J: #x"
