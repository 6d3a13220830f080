"""The runtime as Debian packages: compiled from `runtime/` by a locked compiler, for one architecture."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from images.builder import cache, namespace, paths, pool, progress, runtime_stage, toolchain, tools
from images.builder.errors import UserError
from images.builder.lock import read_lock

SOURCE = paths.PROJECT / "runtime"
LIBRARIES = ("libc6", "libddsc0debian", "libdc1394-25", "libsystemd0", "libyaml-0-2")
"""Packages whose libraries its programs load; robots have them from images/packages/robot.list."""
_LEFT_OUT = ("bench", "station", "tests")
"""Folders of the source that no package comes from."""


@dataclass(frozen=True)
class Runtime:
    """What a build makes."""

    directory: Path

    @property
    def package(self) -> Path:
        """What robots get."""
        (package,) = self.directory.glob("flotilla-runtime_*.deb")
        return package

    @property
    def development_package(self) -> Path:
        """Headers, for blocks built elsewhere."""
        (package,) = self.directory.glob("flotilla-runtime-dev_*.deb")
        return package


def compile_plugin(source: Path, architecture: str) -> bytes:
    """A C file as a plug-in with blocks for robots of an architecture; errors are the compiler's own words."""
    command = ["gcc", "-std=c11", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC", "-s", "-I/out/include"]
    command += ["-Wl,--build-id=none"]
    return toolchain.compile_by(f"runtime-{architecture}", command, [source, SOURCE / "include"], ["-lm"])


def check_task(name: str, content: bytes) -> None:
    """Let the runtime judge a task as the robot would; UserError with all that is wrong."""
    made = build("amd64")
    tree = tools.tree(read_lock("runtime-amd64"))

    def unpack(out: Path) -> None:
        subprocess.run(["dpkg-deb", "-x", str(made.package), str(out)], check=True)

    programs = cache.result("runtime-programs", made.directory.name.removeprefix("runtime-"), unpack)
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".task-") as directory:
        file = Path(directory) / f"{name}.yml"
        file.write_bytes(content)
        loader = f"{tree}/lib64/ld-linux-x86-64.so.2", "--library-path", f"{tree}/usr/lib/x86_64-linux-gnu"
        check = f"{programs}/usr/bin/flotilla-run", "--check", "--blocks", f"{programs}/usr/lib/flotilla/blocks"
        done = subprocess.run([*loader, *check, file], capture_output=True, encoding="utf-8", check=False)
        if done.returncode:
            raise UserError(done.stderr.replace(str(file), paths.shown(paths.TASKS / file.name)).strip())


def sources() -> list[Path]:
    """The files that decide what the packages hold; those of linters, which are hidden, do not."""
    return sorted(
        path for path in SOURCE.rglob("[!.]*") if path.is_file() and path.relative_to(SOURCE).parts[0] not in _LEFT_OUT
    )


def key(architecture: str) -> str:
    """Hash of all that decides the packages' bytes."""
    made_by = [Path(runtime_stage.__file__), Path(runtime_stage.__file__).with_name("chroot.py")]
    names = "\n".join(str(path.relative_to(SOURCE)) for path in sources())
    return cache.digest(read_lock(f"runtime-{architecture}").digest, names, *sources(), *made_by)


def build(architecture: str) -> Runtime:
    """The runtime for Debian's `architecture`; from the cache where nothing changed."""
    lock = read_lock(f"runtime-{architecture}")

    def make(out: Path) -> None:
        pool.fill([lock])
        tree = tools.tree(lock)
        for path in sources():
            place = out / "source" / path.relative_to(SOURCE)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)
        with progress.step(f"runtime for {architecture}"):
            arguments = [str(tree), str(out), architecture, str(lock.epoch), json.dumps(LIBRARIES)]
            log = paths.BUILD / f"runtime-{architecture}.log"
            namespace.run_stage(runtime_stage.__name__, arguments, log)

    return Runtime(cache.result("runtime", key(architecture), make))
