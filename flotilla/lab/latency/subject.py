"""What is measured: a board's kernel and root file system, packed so that they boot from memory.

The initramfs holds the very `root.squashfs` of the board's cards, a data partition with the identity of a robot that
exists here only, and the measurement's own files, which go to `/run`. The shipped `preinit` does the rest.
"""

from __future__ import annotations

import fnmatch
import hashlib
import json
import stat
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path, PurePosixPath
from typing import Any
from unittest import mock

from flotilla.common import cache, host, namespace, paths
from flotilla.debian import kernel
from flotilla.fleet.model import Board, Device, Fleet, Network, Robot
from flotilla.images import card, data_partition, filesystem, initramfs
from flotilla.images.build import BoardBuild, board_build
from flotilla.images.filesystem import Node
from flotilla.lab.latency import compiler, computable_keys, machine

HERE = Path(__file__).parent
MODULES = ("loop", "squashfs", "overlay", "crc32c_generic", "ext4")
"""What reaches a root in memory and the layers above it, where the kernel does not have it built in."""
_APPLETS = "sh mount insmod losetup cp cat switch_root"
_DATA_BYTES = 16 * card.MIB
UNIT = """[Unit]
Description=Latency measurement
After=multi-user.target
# Ends the guest, whatever happens to the script.
SuccessAction=reboot-immediate
FailureAction=reboot-immediate

[Service]
ExecStart=/usr/bin/python3 {directory}/measure.py {directory}/plan.json /dev/{tty}
StandardError=tty
TTYPath=/dev/{console}
"""
FIRST_STEP = """[Unit]
Description=First period of a real-time thread
DefaultDependencies=no

[Service]
Nice=-20
CPUSchedulingPolicy=fifo
CPUSchedulingPriority=90
StandardOutput=null
StandardError=null
ExecStart={directory}/first_step /run/first-step
"""
"""Ordered as a control task may be at the earliest: ARCHITECTURE.md says what it finds then."""
UNITS = {"latency": (UNIT, "multi-user.target"), "first-step": (FIRST_STEP, "sysinit.target")}
"""With the target that wants them."""
DIRECTORY = PurePosixPath("/run/latency")
"""Of the measurement's own files in the guest."""
_LINKS = {f"bin/{name}": "busybox" for name in _APPLETS.split()} | {
    "run/systemd/system/flotilla-mark-good.service": "/dev/null",  # it looks for the card
}
_ARGUMENTS = ("flotilla.slot=A", "nokaslr", "norandmaps", "random.trust_cpu=off")
"""What GRUB adds, and what a run needs to repeat."""


@dataclass(frozen=True)
class Subject:
    """A board's system as it is shipped, by its parts."""

    made: BoardBuild
    kernel: Path
    modules: bool = True
    """Whether the root's modules are the kernel's."""

    @property
    def board(self) -> Board:
        return self.made.board

    @property
    def squashfs(self) -> Path:
        return self.made.root / "root.squashfs"

    def arguments(self, without: tuple[str, ...] = ()) -> tuple[str, ...]:
        """The shipped kernel command line `without` some of its words, and what a run from memory needs.

        The measured machine has one processor, whatever the board has.
        """
        single = self.board.model_copy(update={"isolated_processors": []})
        return (*(word for word in card.kernel_arguments(single) if word not in without), *_ARGUMENTS)

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the parts whose bytes decide the results."""
        return {
            name: hashlib.sha256(path.read_bytes()).hexdigest()
            for name, path in {"kernel": self.kernel, "root": self.squashfs}.items()
        }


def build(board: Board, other_kernel: str | None = None) -> Subject:
    """The board's kernel and root, from the cache where nothing changed; or another kernel of kernel/ below it."""
    host.check()
    namespace.check()
    with cache.exclusive():
        made = board_build(board)
        if other_kernel:
            return Subject(made, kernel.build(other_kernel).image, modules=False)
        return Subject(made, made.root / "vmlinuz")


def measurement(board: Board, plan: dict[str, Any]) -> dict[str, tuple[int, bytes]]:
    """Mode and content of the measurement's own files, by name. `plan`: what `measure.py` reads."""
    files = {name: (0o755, (HERE / name).read_bytes()) for name in ("measure.py", "timerlat.py")}
    files |= {name: (0o755, content) for name, content in compiler.programs(board).items()}
    files["plan.json"] = (0o644, json.dumps(plan, sort_keys=True).encode())
    return files


def units(board: Board, directory: PurePosixPath, *, modules: bool = True) -> dict[str, bytes]:
    """The measurement's units and the drop-ins that start them, by their names below `systemd/system`."""
    tty, console = board.ports[machine.results_port(board, modules=modules)].tty, board.console_tty or "console"
    files = {}
    for name, (text, target) in UNITS.items():
        files[f"{name}.service"] = text.format(directory=directory, tty=tty, console=console).encode()
        files[f"{target}.d/{name}.conf"] = f"[Unit]\nWants={name}.service\n".encode()
    return files


def write_initrd(
    subject: Subject, out: Path, plan: dict[str, Any], more: Mapping[str, bytes], nodes: Sequence[Node] | None = None
) -> str:
    """Write the archive that QEMU loads beside the kernel; SHA-256 of all in it but the root.

    `plan`: what `measure.py` reads. `more`: further files, by their path. `nodes`: of a data partition that is not the
    measured robot's.
    """
    absolute = {str(DIRECTORY / name): file for name, file in measurement(subject.board, plan).items()}
    absolute |= {path: (0o644, content) for path, content in more.items()}
    started = units(subject.board, DIRECTORY, modules=subject.modules)
    absolute |= {f"/run/systemd/system/{name}": (0o644, content) for name, content in started.items()}
    files = {path.removeprefix("/"): file for path, file in absolute.items()}
    files |= {
        "init": (0o755, (HERE / "init").read_bytes()),
        "root.squashfs": (0o644, subject.squashfs.read_bytes()),
    }
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        directory = Path(temporary)
        files |= _from_root(subject, directory / "root")
        files["data.ext4"] = (0o644, _data_partition(subject, directory / "data", nodes))
    directories = {"dev", "proc", "sys", "root"}
    for name in [*files, *_LINKS]:
        directories |= {str(parent) for parent in PurePosixPath(name).parents} - {"."}
    entries = [(name, stat.S_IFDIR | 0o755, b"") for name in directories]
    entries += [(name, stat.S_IFREG | mode, content) for name, (mode, content) in files.items()]
    entries += [(name, stat.S_IFLNK | 0o777, target.encode()) for name, target in _LINKS.items()]
    with out.open("wb") as archive:
        for number, entry in enumerate(sorted(entries), 1):
            archive.write(initramfs._entry(number, *entry))
        archive.write(initramfs._entry(0, "TRAILER!!!", 0, b""))
    parts = [f"{name} {mode} {hashlib.sha256(content).hexdigest()}" for name, mode, content in sorted(entries)]
    return cache.digest("\n".join(part for part in parts if not part.startswith("root.squashfs ")))


def load_order(dependencies: str, modules: tuple[str, ...]) -> list[str]:
    """Module files in the order in which they must be loaded, by `modules.dep`; what is not in it is built in."""
    needs = dict(line.split(":", 1) for line in dependencies.splitlines())
    order: list[str] = []
    for module in modules:
        for path in fnmatch.filter(needs, f"*/{module}.ko"):
            order += [each for each in (*reversed(needs[path].split()), path) if each not in order]
    return order


def _from_root(subject: Subject, directory: Path) -> dict[str, tuple[int, bytes]]:
    """Busybox and the modules, out of the root itself."""

    def extract(*patterns: str) -> None:
        subject.made.tools.run("usr/bin/unsquashfs", "-f", "-q", "-n", "-d", directory, subject.squashfs, *patterns)

    extract("usr/bin/busybox", "usr/lib/modules/*/modules.dep")
    files = {"bin/busybox": (0o755, (directory / "usr/bin/busybox").read_bytes())}
    order = []
    for listed in directory.glob("usr/lib/modules/*/modules.dep"):
        base = listed.parent.relative_to(directory)
        order = [base / path for path in load_order(listed.read_text(), MODULES)]
        extract(*map(str, order))
        files |= {f"modules/{path.name}": (0o644, (directory / path).read_bytes()) for path in order}
    files["modules/order"] = (0o644, "".join(f"{path.name}\n" for path in order).encode())
    return files


def robot(board: Board) -> tuple[Fleet, Robot]:
    """The robot that is measured: the same whatever the fleet's description says, with a device on each tested port."""
    network = Network(subnet=IPv4Network("10.42.0.0/24"), link="ethernet", dds_domain=0, udp_ports=[])
    devices = {name: Device(port=port, baud=115200) for name, port in tested_ports(board).items()}
    measured = Robot(name="latency", number=1, address=IPv4Address("10.42.0.1"), board=board.name, devices=devices)
    fleet = Fleet(name="latency", network=network, boards={board.name: board}, robots={1: measured}, stations=[])
    return fleet, measured


def tested_ports(board: Board) -> dict[str, str]:
    """Serial connectors that are measured: `uart_own` has its interrupt to itself, `uart_shared` not.

    The first two ports have interrupts of their own, and one of them may be the console; those after the fourth share
    one. A board may lack either.
    """
    own = "ttyS0" if board.console_tty == "ttyS1" else "ttyS1"
    named = {port.tty: name for name, port in board.ports.items()}
    return {name: named[tty] for name, tty in {"uart_own": own, "uart_shared": "ttyS4"}.items() if tty in named}


def identity_nodes(board: Board, keys: Path) -> list[Node]:
    """The measured robot's identity, with keys that are made in the directory `keys`."""
    fleet, measured = robot(board)
    keys.mkdir()
    with mock.patch.object(paths, "KEYS", keys):
        computable_keys.write([f"{measured.name}_ed25519", "operator_ed25519", "operator_authority"])
        return data_partition.nodes(fleet, measured)


def _data_partition(subject: Subject, image: Path, given: Sequence[Node] | None) -> bytes:
    nodes = list(given) if given else identity_nodes(subject.board, image.with_name("keys"))
    # The card is in memory: it neither grows nor needs to.
    nodes += [Node(PurePosixPath(path)) for path in ("/var/lib", "/var/lib/flotilla")]
    nodes.append(Node(PurePosixPath("/var/lib/flotilla/grown"), b"", 0o644))
    filesystem.make(
        subject.made.tools, image, _DATA_BYTES, sorted(nodes, key=lambda node: node.path.parts), kind="ext4",
        label="data", uuid="5b0e4a3c-6f1d-4c58-9d0a-000000000004", epoch=subject.made.lock.epoch,
    )  # fmt: skip
    return image.read_bytes()
