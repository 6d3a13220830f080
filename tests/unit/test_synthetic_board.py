"""A third board that exists as new files alone, in a copy of the project's descriptions: every command takes it.

It differs from the project's boards in all that a board's file can say. Seen to fail when boards stood in the code: its
lock ended in `KeyError: 'vortex'`, its kernel in "kernel/kernels.yml: no kernel 'vortex'", `check-fleet` saw it only
once a robot had it and accepted `kernel: lean` without a kernel, scenarios had no way to name it, and without a spare
serial port or ttyS1 latency ended in an IndexError. Each complaint: seen to fail without its check.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from flotilla.cli import make
from flotilla.cli.main import commands
from flotilla.common import paths, yaml_file
from flotilla.common.errors import ProblemsError, UserError
from flotilla.debian import kernel, lock
from flotilla.fleet import identity, inventory
from flotilla.fleet.model import Board, Console, Fleet, Qemu, Watchdog
from flotilla.images import card
from flotilla.lab.latency import command as latency
from flotilla.lab.latency import controls, machine, subject, virtual_loop
from flotilla.lab.qemu import qemu
from flotilla.lab.scenarios import command as scenarios
from flotilla.lab.scenarios import virtual
from tests.unit.debian_archive import Archive, signing_keys

NAME = "vortex"
BOARD = """---
board:
  description: a stack that nobody has
  architecture: i386
  kernel: lean
  kernel_arguments: [8250.nr_uarts=6, nosmp]
  console: { tty: ttyS2, baud: 38400 }
  ports:
    J1: { tty: ttyS0 }
    COM2: { tty: ttyS1 }
    J3: { tty: ttyS2 }
    J5: { tty: ttyS4, isa: { io: 0x2A0, irq: 7 } }
  network_interface: eth1
  disk_modules: [pata_legacy, sd_mod]
  modules: [w83627hf_wdt]
  watchdog:
    start: { port: 0x2E, value: 0x87 }
    stop: { port: 0x2F, value: 0xA5 }
  qemu:
    system: i386
    machine: pc-q35-7.2
    cpu: qemu32
    memory_mib: 128
    disk: virtio
    network: rtl8139
    devices: ["isa-serial,index=0,chardev=port0", "isa-serial,index=1,chardev=port1"]
"""
ROBOT = """---
robots:
  children:
    board_vortex:
      hosts:
        robot9:
          number: 9
          address: 10.42.0.9
          devices:
            gyro: { port: J5, baud: 38400 }
"""
KERNEL = "architecture: i386\nfiles: 1\nfragments: [lean, preempt-rt, pc, storage, board-vortex]\n"
FILES = {
    "inventory/group_vars/board_vortex.yml": BOARD,
    "inventory/vortex.yml": ROBOT,
    "packages/vortex.list": "kernel linux-image-rt # Debian's PREEMPT_RT kernel\n",
    "kernel/vortex.yml": KERNEL,
    "kernel/fragments/board-vortex.config": "CONFIG_R8139=y # the wired port\n",
}
"""All that the board is, but for its lock, which `make lock ONLY=vortex` writes."""
PARTS: dict[str, type[BaseModel]] = {"console": Console, "qemu": Qemu, "watchdog": Watchdog}
PLACES = {"inventory": "INVENTORY", "packages": "PACKAGES", "kernel": "KERNELS", "locks": "LOCKS"}


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "CACHE", tmp_path_factory.mktemp("cache"))
        yield


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project's descriptions, copied, with the board's files beside them."""
    for folder, name in PLACES.items():
        shutil.copytree(getattr(paths, name), tmp_path / folder)
        monkeypatch.setattr(paths, name, tmp_path / folder)
    for name in ("BUILD", "KEYS"):
        monkeypatch.setattr(paths, name, tmp_path / name.lower())
    for name, text in FILES.items():
        assert not (tmp_path / name).exists(), "only new files"
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.fixture
def fleet(own: Path) -> Fleet:
    return inventory.load_fleet()


@pytest.fixture
def board(fleet: Fleet) -> Board:
    return fleet.boards[NAME]


@pytest.fixture(scope="module")
def keys() -> Iterator[Path]:
    with signing_keys() as home:
        yield home


def test_check_fleet_accepts_it_and_leaves_the_others_as_they_are(fleet: Fleet) -> None:
    assert re.search(r"^9 +robot9 +vortex +10\.42\.0\.9 +gyro on J5$", inventory.summary(fleet), re.MULTILINE)
    before = inventory.load_fleet(Path(__file__).parents[2] / "ansible" / "inventory")
    assert {name: fleet.boards[name] for name in before.boards} == before.boards
    assert {number: fleet.robots[number] for number in before.robots} == before.robots
    assert fleet.board() == before.board(), "what commands take that are given no board"


def test_it_is_known_before_a_robot_has_it(own: Path, board: Board) -> None:
    (own / "inventory/vortex.yml").unlink()
    assert inventory.load_fleet().board(NAME) == board


def test_its_lock_is_resolved_alone(own: Path, fleet: Fleet, keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "_KEYRINGS", (keys / "trusted.gpg",))
    (own / "packages/robot.list").write_text("tool # needed\n")
    (own / "packages/robot-bookworm.list").write_text("")
    recipes = lock.recipes(fleet.boards.values())
    assert recipes[NAME] == lock.Recipe("bookworm", "i386", ("robot", "robot-bookworm", NAME))
    before = _hashes(own / "locks")
    said = lock.update_locks(lock.chosen(recipes, [NAME]), Archive(own / "archive", keys, "i386").write())
    assert said.startswith("vortex: 6 packages")
    made = lock.board_lock(fleet.boards[NAME])
    assert (made.architecture, made.release) == ("i386", "bookworm")
    assert [package.name for package in made.having("kernel")] == ["linux-image-6.1.0-9-rt"]
    assert {name: digest for name, digest in _hashes(own / "locks").items() if name != "vortex.lock"} == before


def test_its_kernel_is_made_of_its_own_fragments(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    monkeypatch.setattr(kernel, "build", built.append)
    kernel.board_kernel(board)
    assert built == [NAME]
    options = kernel.wanted(NAME)
    assert {options["R8139"].value, options["PREEMPT_RT"].value} == {"y"}


def test_its_card_boots_it(board: Board) -> None:
    config = card.grub_config(board).decode()
    assert "serial --unit=2 --speed=38400\n" in config
    assert config.count("outb 46 135\n") == len(card.SLOTS), "the watchdog runs before the kernel does"
    arguments = [
        *card.COMMON_ARGUMENTS, "8250.nr_uarts=6", "nosmp", "flotilla.watchdog_stop=47:245", "console=tty0",
        "console=ttyS2,38400n8",
    ]  # fmt: skip
    assert card.kernel_arguments(board) == arguments
    two = board.model_copy(update={"processors": 4, "isolated_processors": [1, 3]})
    isolation = ["isolcpus=managed_irq,domain,1,3", "irqaffinity=0,2", "rcu_nocbs=1,3"]
    assert [each for each in card.kernel_arguments(two) if each not in arguments] == isolation
    partitions = [card.STATE, *card.SLOTS, card.DATA]
    assert [one.end for one in partitions] == [*(one.start for one in partitions[1:]), card.SIZE]
    assert [one.partuuid(board, 0xF1) for one in partitions] == [f"000000f1-0{number}" for number in (1, 2, 3, 4)]


def test_without_a_serial_console_only_the_monitor_shows_its_boot(board: Board) -> None:
    """Seen to fail: a board had to name a port, also where its computer has none."""
    other = board.model_copy(update={"console": None})
    serial = ("serial --unit=2 --speed=38400\n", "terminal_input serial console\n", "terminal_output serial console\n")
    config = card.grub_config(board).decode()
    for line in serial:
        assert config.count(line) == 1
        config = config.replace(line, "")
    assert card.grub_config(other).decode() == config
    assert [*card.kernel_arguments(other), "console=ttyS2,38400n8"] == card.kernel_arguments(board)
    assert (board.console_tty, other.console_tty) == ("ttyS2", "")


def test_a_board_may_have_no_console(own: Path) -> None:
    """Seen to fail with `board.console: (missing): is missing`."""
    file = own / "inventory/group_vars/board_vortex.yml"
    for none in ("", "  console:\n"):
        file.write_text(BOARD.replace("  console: { tty: ttyS2, baud: 38400 }\n", none))
        assert inventory.load_fleet().boards[NAME].console is None


def test_its_robot_gets_its_ports_and_modules(fleet: Fleet) -> None:
    files = {str(path): content.decode() for path, (content, _) in identity.render(fleet, fleet.robots[9]).items()}
    assert files["/etc/modules-load.d/board.conf"].splitlines()[-1] == "w83627hf_wdt"
    rules = files["/etc/udev/rules.d/70-robot.rules"]
    assert "/bin/setserial /dev/%k port 0x2a0 irq 7 uart 16550A" in rules
    assert re.search(r'KERNEL=="ttyS4".*SYMLINK\+="robot/gyro".* 38400 raw', rules)
    assert "Name=eth1" in files["/etc/systemd/network/10-fleet.network"]


def test_its_machine_in_qemu(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "qemu-system-i386"
    program.write_text("#!/bin/false\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    argv = qemu.command_line(board, tmp_path / "card", qemu.Options())
    said = " ".join(argv)
    assert argv[0] == str(program)
    assert "-machine pc-q35-7.2 -cpu qemu32 -m 128 " in said
    assert "-device virtio-blk-pci,drive=card,bootindex=0 -device rtl8139,id=nic," in said
    assert "-serial none -serial none -serial chardev:console" in said
    assert "-chardev null,id=port0 -chardev null,id=port1 -chardev null,id=port3 " in said
    assert [argv[at + 1] for at, word in enumerate(argv) if word == "-device"][2:] == board.qemu.devices


def test_its_machine_without_a_console(board: Board, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each port is a device of the board's; nothing reads the console's backend."""
    monkeypatch.setattr(qemu, "find_tool", lambda name: name)
    other = board.model_copy(update={"console": None})
    argv = qemu.command_line(other, own / "card", qemu.Options())
    assert "-serial" not in argv
    assert " ".join(f"-chardev null,id=port{index}" for index in range(4)) in " ".join(argv)
    emulator = machine.Emulator(lock.read_lock("emulator"), own)
    measured = machine.Machine(emulator, other, own, own, ())
    assert "-serial" not in measured.command_line(own / "console", own / "results")
    assert subject.tested_ports(other)["uart_own"] == "COM2"
    assert b"TTYPath=/dev/console\n" in subject.units(other, subject.DIRECTORY)["latency.service"]


def test_latency_measures_it(own: Path, board: Board) -> None:
    arguments = argparse.Namespace(board=NAME, kernel=None, plan="quick")
    assert [system.board.kernel for system in latency.systems(arguments)] == ["lean", "debian"]
    (own / "kernel/vortex-no-rt.yml").write_text(KERNEL)
    assert latency.systems(arguments)[-1].control == controls.NO_RT
    emulator = machine.Emulator(lock.read_lock("emulator"), own)
    argv = machine.Machine(emulator, board, own, own, ("quiet",)).command_line(own / "console", own / "results")
    assert {"pc-q35-7.2,usb=off,hpet=off", "qemu32", "128", f"file,id=port3,path={own}/results"} <= set(argv)
    assert subject.tested_ports(board) == {"uart_own": "COM2", "uart_shared": "J5"}
    other = board.model_copy(update={"console": Console(tty="ttyS1", baud=38400)})
    assert subject.tested_ports(other)["uart_own"] == "J1", "not the console's"
    assert virtual_loop.board_of(inventory.load_fleet(), NAME).name == NAME


def test_scenarios_fly_it(own: Path) -> None:
    board = scenarios._board(NAME)
    assert (board.name, board.kernel) == (NAME, "lean")
    flying = virtual.fleet("udp", board=board)
    assert {robot.board for robot in flying.robots.values()} == {NAME}
    assert virtual.gyro_device(flying, board) == "/dev/ttyS1"
    robot = flying.robot_with("valves")
    rules, _ = identity.render(flying, robot)[next(p for p in identity.render(flying, robot) if "70-robot" in p.name)]
    assert b"setserial /dev/%k port 0x2a0" in rules


@pytest.mark.parametrize("target", ["kernel", "latency", "boot-time", "scenarios", "latency-accept", "fleet-scale"])
def test_make_passes_its_name_on_and_has_none_by_itself(target: str) -> None:
    given = {"N": "2"} if target == "fleet-scale" else {}
    named = make.words(commands(), target, {"BOARD": NAME, **given})
    assert [word.removeprefix("--board=") for word in named].count(NAME) == 1
    assert "smartcoret3" not in " ".join(make.words(commands(), target, given))


# --- what is missing or wrong ---


def _hashes(directory: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(directory.iterdir())}


@pytest.fixture(scope="module")
def merged() -> dict[str, Any]:
    """What Ansible says of the project's own hosts: the board's file is read without it."""
    said: dict[str, Any] = json.loads(inventory._ansible_inventory([paths.INVENTORY]))
    return said


def _judged(own: Path, merged: dict[str, Any], change: dict[tuple[str, ...], Any]) -> ProblemsError:
    """The complaint about the board's file with other values; a value None is left out."""
    content = yaml.safe_load(BOARD)
    for place, value in change.items():
        inner = content
        for step in place[:-1]:
            inner = inner[step]
        if value is None:
            del inner[place[-1]]
        else:
            inner[place[-1]] = value
    (own / "inventory/vortex.yml").unlink()
    (own / "inventory/group_vars/board_vortex.yml").write_text(yaml.safe_dump(content))
    with pytest.raises(ProblemsError) as caught:
        inventory.validate(merged, inventory.Sources(own / "inventory"))
    return caught.value


def _required(model: type[BaseModel]) -> list[tuple[str, ...]]:
    """Keys that a board's file cannot do without."""
    return [(name,) for name, field in model.model_fields.items() if field.is_required() and name != "name"]


REQUIRED = _required(Board) + [(outer, *key) for outer, model in PARTS.items() for key in _required(model)]


@pytest.mark.parametrize("place", REQUIRED, ids=".".join)
def test_a_missing_key_is_named(own: Path, merged: dict[str, Any], place: tuple[str, ...]) -> None:
    found = _judged(own, merged, {("board", *place): None}).problems
    problem = next(problem for problem in found if problem.key == ".".join(("board", *place)))
    assert problem.file.startswith(f"{own}/inventory/group_vars/board_vortex.yml:")
    assert (problem.value, problem.message) == ("(missing)", "is missing")
    assert problem.remedy == "add it as its neighbours have it"


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("architecture", "arm64", "arm64: is not known; one of 'i386' or 'amd64'"),
        ("processor", "Pentium III", "Pentium III: is not a value of GCC's -march; such as pentium3, see `man gcc`"),
        ("kernel", "vanilla", "vanilla: is not known; one of 'debian' or 'lean'"),
        ("kernels", "lean", "lean: is not known; did you mean kernel?"),
        ("kernel_arguments", ["two words", "8250.nr_uarts=6"], "two words: contains blanks or nothing; one word"),
        ("console.tty", "ttyS4", "ttyS4: cannot be the console; ttyS0 to ttyS3"),
        ("console.baud", 12345, "12345: is not a console's rate; one of 300, 600, … 115200 bit/s"),
        ("ports.J5.isa.io", 0x2A1, "673: is not a serial port's base address; 0x100 to 0xFFF8"),
        ("ports.J1.tty", "ttyS1", "ttyS1: belongs to port COM2 already; each port has its own"),
        ("network_interface", "Eth0", "Eth0: is not a network interface's name; such as eth0"),
        ("disk_modules", ["ahci.ko"], "ahci.ko: is not a kernel module's name; such as ata_piix"),
        ("watchdog.stop.value", 256, "256: is out of range; 0 to 255"),
        ("qemu.system", "arm", "arm: is not known; one of 'i386' or 'x86_64'"),
        ("qemu.disk", "scsi", "scsi: is not known; one of 'ide', 'ahci', 'nvme', 'usb' or 'virtio'"),
        ("qemu.memory_mib", 16, "16: is out of range; 64 to 65536"),
    ],
)
def test_a_wrong_value_is_named(own: Path, merged: dict[str, Any], place: str, value: Any, said: str) -> None:
    (problem,) = _judged(own, merged, {("board", *place.split(".")): value}).problems
    assert problem.file.startswith(f"{own}/inventory/group_vars/board_vortex.yml:")
    assert problem.key.removesuffix(".0") == f"board.{place}"
    assert said in f"{problem.value}: {problem.message}; {problem.remedy}"


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ("packages/vortex.list", "board_vortex.yml: board: …: has no package list {}; copy another board's and name"),
        (
            "kernel/vortex.yml",
            "board_vortex.yml:5: board.kernel: lean: there is no {}; write that file as another",
        ),
    ],
)
def test_a_missing_file_is_named(own: Path, missing: str, said: str) -> None:
    (own / missing).unlink()
    with pytest.raises(ProblemsError) as caught:
        inventory.load_fleet()
    assert said.format(own / missing) in re.sub(r"yml:2: board: ", "yml: board: ", str(caught.value))


def test_a_robot_of_a_board_that_is_not_described(own: Path) -> None:
    (own / "inventory/group_vars/board_vortex.yml").unlink()
    with pytest.raises(ProblemsError, match=r"board_vortex\.yml: board: .*is not described; copy another board's file"):
        inventory.load_fleet()


def test_a_name_that_no_board_has(fleet: Fleet) -> None:
    for ask in (latency._board, lambda given: scenarios._board(given.board)):
        with pytest.raises(UserError, match=r"board vertex: there is no such board .* smartcoret3, .*vortex"):
            ask(argparse.Namespace(board="vertex"))
    with pytest.raises(UserError, match=r"vertex: there is no such lock; there are smartcoret3, .*vortex, .*tools"):
        lock.chosen(lock.recipes(fleet.boards.values()), ["vertex"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tool # needed\n", r"vortex\.list: names no kernel; add a line `kernel linux-image-… # reason`"),
        ("linux-image-rt\n", r"vortex\.list:1: 'linux-image-rt': write `PACKAGE # reason` or"),
        (None, r"vortex\.list: is missing; write `PACKAGE # reason` lines"),
    ],
)
def test_its_package_list(own: Path, fleet: Fleet, text: str | None, said: str) -> None:
    file = own / "packages/vortex.list"
    file.write_text(text) if text else file.unlink()
    with pytest.raises(UserError, match=said):
        lock.requests(lock.recipes(fleet.boards.values())[NAME])


def test_its_lock(own: Path, board: Board) -> None:
    with pytest.raises(UserError, match=r"vortex\.lock: missing; `make lock ONLY=vortex` writes it"):
        lock.board_lock(board)
    shutil.copy(own / "locks/x86_64.lock", own / "locks/vortex.lock")
    with pytest.raises(UserError, match=r"vortex\.lock: architecture: amd64: the board's is i386; run `make lock"):
        lock.board_lock(board)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("architecture: i386\n", "", r"vortex\.yml:1: architecture: \(missing\): is missing; add it"),
        ("i386", "arm64", r"vortex\.yml:1: architecture: arm64: is not known; one of 'i386' or 'amd64'"),
        ("i386", "amd64", r"vortex\.yml: architecture: amd64: the board's is i386; make them the same here or in"),
        ("fragments:", "fragment:", r"vortex\.yml:3: fragment: …: is not known; did you mean fragments\?"),
        ("preempt-rt", "preempt", r"fragments/preempt\.config: no such fragment; there are "),
        ("board-vortex]", "board-vortex", r"vortex\.yml:4: \(syntax\): .*: is not YAML: "),
    ],
)
def test_its_kernel(own: Path, board: Board, old: str, new: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "build", kernel.wanted)
    (own / "kernel/vortex.yml").write_text(KERNEL.replace(old, new))
    with pytest.raises(UserError, match=said):
        kernel.board_kernel(board)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("suite: bookworm", "suit: bookworm", r"locks\.yml:\d+: suit: bookworm: is not known; did you mean suite\?"),
        ("suite: bookworm", "", r"locks\.yml:1: suite: \(missing\): is missing; add it"),
        ("tools: { architecture: amd64 }", "tools: {}", r"locks\.yml:\d+: locks\.tools\.architecture: \(missing\): "),
        (
            "verify: { architecture: i386 }",
            "verify: { architecture: i686 }",
            r"architecture: i686: is not known",
        ),
        ("  verify:", "  vortex:", r"locks\.yml: locks\.vortex: is a board's name, too; give one of them another"),
    ],
)
def test_the_other_locks(own: Path, fleet: Fleet, old: str, new: str, said: str) -> None:
    file = own / "packages/locks.yml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(UserError, match=said):
        lock.recipes(fleet.boards.values())


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("data_mib: 32", "data_mib: 0", r"card\.yml:\d+: data_mib: 0: is out of range; 8 to 16384 MiB"),
        ("slot_mib: 176", "", r"card\.yml:\d+: slot_mib: \(missing\): is missing; add it"),
        ("layout: 2", "layout: '2'", r"card\.yml:\d+: layout: '2': is not a whole number; digits without"),
        ("data_mib", "date_mib", r"card\.yml:\d+: date_mib: 32: is not known; did you mean data_mib\?"),
    ],
)
def test_the_layout_of_cards(tmp_path: Path, old: str, new: str, said: str) -> None:
    text = (paths.PROJECT / "images/boot/card.yml").read_text()
    assert old in text
    (tmp_path / "card.yml").write_text(text.replace(old, new, 1))
    with pytest.raises(ProblemsError, match=said):
        yaml_file.read(tmp_path / "card.yml", card.Layout)


def test_ports_that_latency_needs(board: Board) -> None:
    console = board.model_copy(update={"ports": {"J3": board.ports["J3"]}})
    with pytest.raises(UserError, match=r"board_vortex\.yml: board\.ports: J3: results leave a guest by a serial port"):
        machine.results_port(console)
    assert subject.tested_ports(console) == {}
    with pytest.raises(UserError, match=r"board_vortex\.yml: board\.ports: J3: the loop needs a port with an"):
        virtual_loop.run(console, Path())
    late = board.model_copy(update={"ports": {name: board.ports[name] for name in ("J3", "J5")}})
    assert machine.results_port(late) == "J5"
    with pytest.raises(UserError, match=r"board\.ports: J3, J5: results leave"):
        machine.results_port(late, modules=False)


def test_ports_that_the_scenario_needs(board: Board) -> None:
    others = board.model_copy(update={"ports": {name: board.ports[name] for name in ("J1", "J3")}})
    with pytest.raises(UserError, match=r"robot1\.devices\.gyro\.port: COM2: the board vortex has no .* it has J1$"):
        virtual.fleet("udp", board=others)
