"""What other update engines cost on a robot, measured on Debian's packages of them: installed size beside what the root
has already, and peak memory while a bundle is installed. Nothing is installed on this computer.

`python -m evidence.engines --architecture i386`, as root: RAUC mounts its bundles. The ground of docs/decisions/0046.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from flotilla.common import namespace, paths, progress
from flotilla.common.errors import UserError
from flotilla.debian import chroot, lock, mirror, pool
from flotilla.debian.lock import Apt, Lock, Package
from flotilla.fleet import inventory

ENGINES = ("rauc-service", "swupdate", "mender-client")
"""Names of Debian's packages. Only size is measured of the last: it needs a boot environment of its own."""
_BUNDLE_TOOLS = ("squashfs-tools", "openssl", "cpio", "dbus", "mount", "coreutils", "dash")
"""What makes the bundles, and runs beside an engine."""
_MIB = 85
"""Of a slot's image, about what a root with its kernel takes."""
_SLOT = 160 << 20
"""Bytes of a slot."""
_LOOK_S = 0.005
"""Between two looks at the processes' memory."""
_DIRECTORIES = ("proc", "sys", "dev", "tmp", "run", "update", "etc")
_MERGED = ("bin", "sbin", "lib", "lib32", "lib64")
_BUS = "unix:path=/run/bus"
_ENVIRONMENT = {
    "PATH": "/usr/sbin:/usr/bin",
    "LC_ALL": "C.UTF-8",
    "HOME": "/root",
    # The session's bus, since a system's wants limits that a container may not set. It is the same program.
    "DBUS_STARTER_BUS_TYPE": "session",
    "DBUS_SESSION_BUS_ADDRESS": _BUS,
}

# --- size ---


def sizes(apt: Apt, board: str) -> dict[str, tuple[int, list[str]]]:
    """KiB that each engine adds to the board's root with all it depends on, and the packages: by Debian's index."""
    index = apt.index()
    recipe = lock.recipes(inventory.load_fleet().boards.values())[board]
    present = (
        {request.package for request in lock.requests(recipe) if not request.kernel}
        | {"apt"}
        | {
            fields["Package"]
            for _, fields in index.values()
            if fields.get("Essential") == "yes" or fields.get("Priority") == "required"
        }
    )
    base = set(apt.install(sorted(present)))
    found = {}
    for engine in ENGINES:
        added = [index[address][1] for address in set(apt.install(sorted(present | {engine}))) - base]
        names = sorted(f"{fields['Package']} {fields['Installed-Size']}" for fields in added)
        found[engine] = sum(int(fields["Installed-Size"]) for fields in added), names
    return found


# --- memory ---


def packages(apt: Apt) -> Lock:
    """Engines and what makes their bundles, with all they depend on."""
    index = apt.index()
    found = [
        Package(
            fields["Package"], fields["Version"], fields["Architecture"], "userland", archive, int(fields["Size"]),
            fields["SHA256"], fields["Filename"],
        )
        for address in apt.install([*ENGINES[:2], *_BUNDLE_TOOLS])
        for archive, fields in [index[address]]
    ]  # fmt: skip
    return Lock("engines", apt.architecture, apt.suites(), tuple(sorted(found)))


def unpack(what: Lock, tree: Path) -> None:
    """The packages' files in a directory; no maintainer script runs."""
    shutil.rmtree(tree, ignore_errors=True)
    for name in _MERGED:
        (tree / "usr" / name).mkdir(parents=True)
        (tree / name).symlink_to(f"usr/{name}")
    for package in what.packages:
        with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", str(pool.file(package))], stdout=subprocess.PIPE) as tar:
            extract = ["tar", "-x", "--keep-directory-symlink", "--no-same-owner", "-C", str(tree)]
            subprocess.run([*extract, "--exclude=./usr/share/doc"], stdin=tar.stdout, check=True)
    for name in _DIRECTORIES:
        (tree / name).mkdir(exist_ok=True)


class Memory:
    """Resident memory of all processes that run in a tree, in KiB."""

    def __init__(self, tree: Path) -> None:
        self._tree = str(tree)
        self.peak = self.anonymous = 0
        """Most at one moment; and of that kind which cannot be dropped and read again."""
        self.programs: dict[str, int] = {}
        """Peak of the largest process of each program, as the kernel counts it (VmHWM)."""

    def look(self) -> int:
        """What it is now."""
        resident = anonymous = 0
        for process in Path("/proc").glob("[0-9]*"):
            try:
                if str((process / "root").readlink()) != self._tree:
                    continue
                program = (process / "exe").readlink().name
                lines = (process / "status").read_text().splitlines()
            except OSError:  # it has ended
                continue
            status = {name: int(value.split()[0]) for name, _, value in (line.partition(":") for line in lines)
                      if name in ("VmHWM", "VmRSS", "RssAnon")}  # fmt: skip
            if status:  # else it has just ended
                resident += status["VmRSS"]
                anonymous += status["RssAnon"]
                self.programs[program] = max(self.programs.get(program, 0), status["VmHWM"])
        self.peak, self.anonymous = max(self.peak, resident), max(self.anonymous, anonymous)
        return resident

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Look all the time while the body runs."""
        done = threading.Event()

        def watch() -> None:
            while not done.wait(_LOOK_S):
                self.look()

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


class Stage:
    """An engine's world: the tree with a slot, a key and an image."""

    def __init__(self, tree: Path, mib: int) -> None:
        self.tree, self.work = tree, tree / "update"
        self._mib = mib
        for directory in ("tmp", "run"):
            chroot.mount("-t", "tmpfs", "flotilla", tree / directory)
        chroot.mount("-t", "proc", "proc", tree / "proc")
        chroot.mount("-t", "proc", "proc", "/proc")  # of this namespace of processes, for `Memory`
        chroot.mount("--rbind", "/dev", tree / "dev")
        chroot.mount("--rbind", "/sys", tree / "sys")
        (tree / "etc/passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")
        (tree / "etc/group").write_text("root:x:0:\n")

    def run(self, *argv: str, cwd: str = "/") -> subprocess.CompletedProcess[str]:
        inside = ["chroot", str(self.tree), "env", "-C", cwd, *argv]
        return subprocess.run(inside, env=_ENVIRONMENT, capture_output=True, text=True, check=False)

    def must(self, *argv: str, cwd: str = "/") -> None:
        done = self.run(*argv, cwd=cwd)
        if done.returncode:
            raise SystemExit(f"{' '.join(argv)}: status {done.returncode}: {done.stdout}{done.stderr}")

    def start(self, *argv: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(["chroot", str(self.tree), *argv], env=_ENVIRONMENT)

    def prepare(self) -> None:
        """Key, image and empty slots."""
        (self.work / "in").mkdir(exist_ok=True)
        self.must(
            "openssl", "req", "-x509", "-newkey", "rsa:4096", "-nodes", "-days", "3650", "-subj", "/CN=engines",
            "-addext", "extendedKeyUsage=emailProtection,codeSigning",
            "-keyout", "/update/key.pem", "-out", "/update/cert.pem",
        )  # fmt: skip
        with (self.work / "in/rootfs.img").open("wb") as image:
            for _ in range(self._mib):
                image.write(os.urandom(1 << 20))
        for slot in ("A", "B"):
            with (self.work / slot).open("wb") as file:
                file.truncate(_SLOT)

    def installed(self) -> bool:
        """Whether slot B begins with the image."""
        image = self.work / "in/rootfs.img"
        size = image.stat().st_size
        with (self.work / "B").open("rb") as slot:
            return hashlib.sha256(slot.read(size)).digest() == hashlib.sha256(image.read_bytes()).digest()


def rauc(stage: Stage, memory: Memory) -> str:
    """RAUC: client, service and bus, which is all that it needs; and what it says without the bus."""
    (stage.work / "in/manifest.raucm").write_text(
        "[update]\ncompatible=robot\nversion=1\n[bundle]\nformat=plain\n[image.rootfs]\nfilename=rootfs.img\n"
    )
    slots = "".join(
        f"[slot.rootfs.{number}]\ndevice=/update/{name}\ntype=raw\nbootname={name}\n"
        for number, name in enumerate("AB")
    )
    (stage.tree / "etc/rauc").mkdir(exist_ok=True)
    (stage.tree / "etc/rauc/system.conf").write_text(
        f"[system]\ncompatible=robot\nbootloader=noop\nmountprefix=/run/rauc\n[keyring]\npath=/update/cert.pem\n{slots}"
    )
    sign = ("--cert", "/update/cert.pem", "--key", "/update/key.pem")
    stage.must("rauc", "bundle", *sign, "/update/in", "/update/bundle.raucb")
    alone = stage.run("rauc", "install", "/update/bundle.raucb")
    bus = stage.start("dbus-daemon", "--session", f"--address={_BUS}", "--nofork", "--print-address=1")
    service = stage.start("rauc", "service", "--override-boot-slot=A")
    while not stage.run("rauc", "status").stdout:  # which the service answers
        if bus.poll() is not None or service.poll() is not None:
            raise SystemExit("bus or service ended")
    idle = memory.look()
    with memory.watched():
        stage.must("rauc", "install", "/update/bundle.raucb")
    memory.look()
    for process in (service, bus):
        process.terminate()
        process.wait()
    message = alone.stderr.strip().splitlines()[0]
    return f"bus and service before it begins: {idle}; without a bus: status {alone.returncode}, {message}"


def swupdate(stage: Stage, memory: Memory) -> str:
    """SWUpdate: one program, started for one bundle, which it streams to the slot."""
    digest = hashlib.sha256((stage.work / "in/rootfs.img").read_bytes()).hexdigest()
    (stage.work / "in/sw-description").write_text(
        'software = {\n version = "1";\n hardware-compatibility: ["1.0"];\n images: ({ filename = "rootfs.img"; '
        f'device = "/update/B"; type = "raw"; installed-directly = true; sha256 = "{digest}"; }});\n}}\n'
    )
    (stage.tree / "etc/hwrevision").write_text("robot 1.0\n")
    stage.must(
        "openssl", "cms", "-sign", "-in", "sw-description", "-out", "sw-description.sig", "-signer", "/update/cert.pem",
        "-inkey", "/update/key.pem", "-outform", "DER", "-nosmimecap", "-binary", cwd="/update/in",
    )  # fmt: skip
    members = "printf '%s\\n' sw-description sw-description.sig rootfs.img"
    stage.must("sh", "-c", f"{members} | cpio -o -H crc --quiet >/update/bundle.swu", cwd="/update/in")
    with memory.watched():
        stage.must("swupdate", "-k", "/update/cert.pem", "-i", "/update/bundle.swu")
    return "needs no bus"


STAGES: dict[str, Callable[[Stage, Memory], str]] = {"rauc": rauc, "swupdate": swupdate}


def _stage(engine: str, tree: Path, mib: int) -> None:
    """Inside the namespaces: one engine installs one bundle."""
    stage, memory = Stage(tree, mib), Memory(tree)
    stage.prepare()
    remark = STAGES[engine](stage, memory)
    if not stage.installed():
        raise SystemExit(f"{engine}: slot B has not the image")
    found = {"peak": memory.peak, "anonymous": memory.anonymous, "programs": memory.programs, "remark": remark}
    print(json.dumps(found))


# --- the command ---


def measure(architecture: str, mib: int) -> str:
    """The table. UserError where this computer does not let RAUC mount, or has no mirror."""
    if os.geteuid() != 0:
        raise UserError("evidence.engines: RAUC mounts its bundle, which root alone may; run it as root")
    boards = inventory.load_fleet().boards.items()
    board = next(name for name, board in boards if board.architecture == architecture)
    mirrors = mirror.resolve()
    missing = lock.read_lock(board).missing_suites
    suites = [(archive, name) for archive, name in lock.suites("bookworm") if name not in missing]
    apt = Apt(architecture, mirrors, suites)
    with progress.step("indexes"):
        apt.update()
    lines = [f"added to the root of {board}, KiB as Debian declares them:"]
    for engine, (kib, names) in sizes(apt, board).items():
        lines.append(f"  {engine}: {kib} in {len(names)} packages: {', '.join(names)}")
    what = packages(apt)
    pool.fill([what], mirrors)
    tree = paths.BUILD / "engines" / architecture
    lines.append(f"peak resident memory while {mib} MiB are installed, KiB:")
    for engine in STAGES:
        with progress.step(engine):
            unpack(what, tree)
            argv = [*namespace.prefix(), sys.executable, "-m", __spec__.name, "--stage", engine]
            done = subprocess.run(
                [*argv, "--tree", str(tree), "--mib", str(mib)], stdout=subprocess.PIPE, text=True, check=False
            )
        if done.returncode:
            raise UserError(f"{engine}: the measurement failed (status {done.returncode})")
        measured = json.loads(done.stdout.splitlines()[-1])
        each = ", ".join(f"{program} {kib}" for program, kib in sorted(measured["programs"].items()))
        lines.append(
            f"  {engine}: {measured['peak']} at one moment, {measured['anonymous']} of it anonymous; "
            f"largest process of each program: {each}; {measured['remark']}"
        )
    shutil.rmtree(tree)
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m evidence.engines", description=__doc__)
    parser.add_argument("--architecture", choices=("i386", "amd64"), default="i386", help="Debian's name (%(default)s)")
    parser.add_argument("--mib", type=int, default=_MIB, help="size of the image (%(default)s)")
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    parser.add_argument("--tree", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args(words)
    if arguments.stage:
        _stage(arguments.stage, arguments.tree, arguments.mib)
        return 0
    try:
        print(measure(arguments.architecture, arguments.mib))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
