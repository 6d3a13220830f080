"""The runtime as Debian packages: compiled from `runtime/` by a locked compiler, for one architecture and release."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pydantic

from flotilla.common import cache, namespace, paths, progress, sandbox, sources, together
from flotilla.common.errors import UserError
from flotilla.debian import chroot, pool, runtime_stage, toolchain, tools
from flotilla.debian.lock import HOST, Lock, read_lock, runtime_lock
from flotilla.fleet.model import System

SOURCE = paths.PROJECT / "runtime"
_LIBRARIES = ("libc6", "libddsc0debian", "libdc1394-25", "libnettle8", "libsystemd0", "libyaml-0-2")
_RENAMED = {"trixie": {"libddsc0debian": "libddsc0t64", "libnettle8": "libnettle8t64"}}
"""Debian's newer names, by release."""
WARNINGS = ("-Wall", "-Wextra", "-Werror")
"""Compiler options for code that is written by hand."""
_KIND = "runtime"
"""Of results in the cache."""
MADE_BY = (runtime_stage.__file__, chroot.__file__, namespace.__file__)
_BY_SIGNAL = 128
"""What bubblewrap adds to the signal that ended a program."""
_LEFT_OUT = ("bench", "tests", "tidy.py")
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


def libraries(system: System) -> list[str]:
    """Packages whose libraries its programs load; robots have them from images/packages/robot*.list."""
    return [_RENAMED.get(system.suite, {}).get(name, name) for name in _LIBRARIES]


def command(work: Path, system: System, argv: Sequence[str], run: toolchain.Run = toolchain.run) -> None:
    """Run a command among the locked compiler and libraries of an architecture; errors are its own words.

    There, `work` is /out, and gets the public headers in /out/include. `run` says where that is; so does it below.
    It runs what others wrote: UserError where it leaves a link that leads elsewhere, or a pipe.
    """
    copy_sources(work, "include")
    before = _strays(work)
    log = paths.BUILD / f"compile-{system.suite}-{system.architecture}.log"
    with cache.locked(log.with_name(f".{log.name}.lock")):  # an error shows what the log ends with
        run(runtime_lock(system), work, argv, log)
    for path, what in _strays(work).items() - before.items():
        raise UserError(f"{path.relative_to(work)}: {what}: it was not there before the build; nothing of that is read")


def _strays(work: Path) -> dict[Path, str]:
    """Those of sources.strays, with where links lead."""
    found = sources.strays(work)
    return {path: f"{why} ({path.readlink()})" if path.is_symlink() else why for path, why in found.items()}


def compile_plugin(
    source: Path, system: System, options: Sequence[str] = WARNINGS, run: toolchain.Run = toolchain.run
) -> bytes:
    """A C file, or all of a directory, as a plug-in with blocks for robots of an architecture.

    `options` are for files that include the runtime's headers. Others are another generator's, and their
    warnings no errors.
    """
    found = sources.files(source) if source.is_dir() else [source]
    files = [path.name for path in found if path == source or (path.parent == source and path.suffix == ".c")]
    # Its functions keep their names, for the report of a crash, and are nobody else's.
    bound = ["-Wl,-Bsymbolic", "-fno-semantic-interposition"]
    common = [*bound, "-I.", "-I/out/include"]
    place = source if source.is_dir() else source.parent
    foreign = [name for name in files if not _OURS.search((place / name).read_text(errors="replace"))]
    own = [name for name in files if name not in foreign]
    theirs = ["-std=gnu11", *common, *(option for option in options if option != "-Werror")]
    return compile_shared(source, own, system, ["-std=c11", *common, *options], run, foreign, theirs)


MOST_BYTES = 64 << 20
"""Of a plug-in: it is read into memory, and a file of holes would take all of it."""
_OURS = re.compile(r'^[ \t]*#[ \t]*include[ \t]*[<"]flotilla/', re.MULTILINE)


def compile_shared(
    source: Path,
    files: Sequence[str],
    system: System,
    options: Sequence[str],
    run: toolchain.Run = toolchain.run,
    others: Sequence[str] = (),
    their_options: Sequence[str] = (),
) -> bytes:
    """A C file, or some of a directory, as a shared object for robots of an architecture.

    `files` and paths in `options` are relative to that directory; so are `others`, which have options of their own.
    A name that the compiler would take for an option raises UserError.
    """
    if options_alike := [name for name in (*files, *others) if name.startswith("-")]:
        raise UserError(f"{options_alike[0]}: the name begins with a hyphen, as the compiler's options do; rename it")
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".plugin-") as directory:
        work = Path(directory)
        if source.is_dir():
            shutil.copytree(source, work / "source", ignore=sources.ignored)
        else:
            (work / "source").mkdir()
            shutil.copy(source, work / "source")
        gcc, objects = ["env", "-C", "/out/source", "gcc", "-O2", "-fPIC", *toolchain.LONG_TIMES], []
        if others:
            command(work, system, [*gcc, "-c", *their_options, *others], run)
            objects = [f"{Path(name).stem}.o" for name in others]
        link = ["-shared", "-s", "-Wl,--build-id=none", *options, "-o", "/out/plugin.so"]
        command(work, system, [*gcc, *link, *files, *objects, "-lm"], run)
        made = work / "plugin.so"
        if made.is_symlink() or not made.is_file():
            raise UserError(f"{made.name}: the compiler was to make this file and did not")
        if made.stat().st_size > MOST_BYTES:
            raise UserError(f"{made.name}: has {made.stat().st_size} bytes, a plug-in has at most {MOST_BYTES}")
        return made.read_bytes()


class _Parameter(pydantic.BaseModel):
    name: str
    default: str = ""
    needs: Literal["can", "io-ports", "camera"] | None = None


class _Block(pydantic.BaseModel):
    """Of what `flotilla-blocks --json` lists, what is used here."""

    name: str
    parameters: list[_Parameter]


_LISTING = pydantic.TypeAdapter(list[_Block])


def check_plugins(directory: Path, system: System) -> list[dict[str, Any]]:
    """Let the runtime judge plug-ins: the interface that they were made for, names that are taken. Returns all blocks.

    It runs on this computer as a robot of the plug-ins' `system` has it; so does it below.
    """
    done = _run(system, [directory], "flotilla-blocks", "--blocks", str(directory), "--json")
    if done.returncode:
        raise UserError(_said("flotilla-blocks", done).replace(f"{directory}/", ""))
    try:
        listing = _LISTING.validate_json(done.stdout)
    except ValueError:  # a plug-in may write there, too
        raise UserError("no list of blocks came; plug-ins must not write to standard output or end it") from None
    return [block.model_dump(exclude_none=True) for block in listing]


def check_task(path: Path, content: bytes, plugins: Path | None = None, system: System = HOST) -> None:
    """Let the runtime judge a task as the robot would; UserError with all that is wrong in `path`.

    `plugins`: a directory with blocks that the runtime lacks, for `system`.
    """
    with tempfile.TemporaryDirectory(dir=paths.BUILD, prefix=".task-") as directory:
        file = Path(directory) / path.name
        file.write_bytes(content)
        directories = ":".join(str(each) for each in (plugins, _programs(system) / "usr/lib/flotilla/blocks") if each)
        needed = [file, *([plugins] if plugins else [])]
        done = _run(system, needed, "flotilla-run", "--check", "--blocks", directories, str(file))
        if done.returncode:
            raise UserError(_said("flotilla-run", done).replace(str(file), paths.shown(path)))


def _said(program: str, done: subprocess.CompletedProcess[str]) -> str:
    """Why it failed. Of a crash it does not say so itself, and a code of a block may say anything."""
    if refused := sandbox.refusal(done.stderr, sandbox.CHECK, done.returncode):
        raise refused
    if done.returncode - _BY_SIGNAL not in {each.value for each in signal.Signals}:
        return done.stderr.strip() or f"{program} ended with status {done.returncode}"
    crashed = f"{program} was ended by {signal.Signals(done.returncode - _BY_SIGNAL).name}"
    return f"{crashed}: code of a block crashes when it is loaded or configured\n{done.stderr}".strip()


def _programs(system: System) -> Path:
    """The runtime, unpacked."""
    made = build(system)

    def unpack(out: Path) -> None:
        subprocess.run(["dpkg-deb", "-x", str(made.package), str(out)], check=True)

    return cache.result("runtime-programs", made.directory.name.removeprefix("runtime-"), unpack)


def _run(system: System, needed: Sequence[Path], program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the runtime on this computer, whatever libraries that has, in a sandbox with what it needs:
    it loads plug-ins, whose code runs then."""
    tree, programs = tools.tree(read_lock(runtime_lock(system))), _programs(system)
    argv = tools.command(tree, programs / "usr/bin" / program, system.architecture)
    environment = {"LC_ALL": "C.UTF-8", "PATH": "/usr/bin"}
    needed = [tree, programs, *needed]
    sandboxed = sandbox.command([*argv, *arguments], sandbox.CHECK, readable=needed, environment=environment)
    return subprocess.run(
        sandboxed, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", errors="replace", check=False
    )


def source_files() -> list[Path]:
    """The files that decide what the packages hold; those of linters, which are hidden, do not."""
    found = ((path, path.relative_to(SOURCE).parts) for path in sources.files(SOURCE))
    return [path for path, parts in found if parts[0] not in _LEFT_OUT and not any(part[0] == "." for part in parts)]


def copy_sources(to: Path, part: str = "") -> None:
    """Copy the files, or those of one folder of them. Links stay links: what one leads to outside is not counted."""
    for path in source_files():
        if path.is_relative_to(SOURCE / part):
            place = to / path.relative_to(SOURCE)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place, follow_symlinks=False)


def key(system: System) -> str:
    """Hash of all that decides the packages' bytes."""
    lock = read_lock(runtime_lock(system))
    return cache.digest(
        tools.name(lock), lock.digest, system.architecture, json.dumps(libraries(system)),
        cache.digest_of(SOURCE, source_files()), *map(Path, MADE_BY),
    )  # fmt: skip


def build(system: System) -> Runtime:
    """The runtime for `system`; from the cache where nothing changed."""
    lock = read_lock(runtime_lock(system))

    def make(out: Path) -> None:
        together.at_low_priority(lambda: compile_it(out))  # a root that is made meanwhile needs it last

    def compile_it(out: Path) -> None:
        pool.fill([lock])
        tree = tools.tree(lock)
        copy_sources(out / "source")
        log = paths.BUILD / f"{runtime_lock(system)}.log"
        log.unlink(missing_ok=True)  # an earlier build's
        with progress.step(f"runtime for {system}", lambda: far(progress.text(log))):
            arguments = [str(tree), str(out), system.architecture, str(lock.epoch), json.dumps(libraries(system))]
            namespace.run_stage(runtime_stage.__name__, arguments, log)

    return Runtime(cache.result(_KIND, key(system), make))


def name(system: System) -> str:
    """Of the directory of what `build` makes; it need not be made yet."""
    return cache.name(_KIND, key(system))


def wanted(system: System) -> list[Lock]:
    """What `build` would have to find in the pool, which it fills otherwise."""
    return [] if cache.has(_KIND, key(system)) else [read_lock(runtime_lock(system))]


def far(log: str) -> progress.Far:
    """How far a build is that has written `log`: ninja numbers what it does."""
    numbered = re.findall(r"^\[(\d+)/(\d+)\]", log, re.MULTILINE)
    if not numbered:
        return progress.Far()
    done, total = map(int, numbered[-1])
    return progress.Far(done, total, "files")
