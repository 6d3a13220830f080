"""Kernels of our own: Debian's packaged source with the patches, and configured by the fragments, in `kernel/`. The
locked compiler builds them.

`kernel/NAME.yml` says which fragments make the kernel NAME. Whatever no fragment asks for is off; whatever one asks for
must be in the final configuration, or the build fails and says why: kconfig itself drops an option silently when
something that it depends on is missing.
"""

from __future__ import annotations

import difflib
import fnmatch
import io
import json
import re
import shutil
import subprocess
import tarfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pydantic

from flotilla.common import cache, durable, host, namespace, paths, progress, sources, yaml_file
from flotilla.common.errors import Problem, ProblemsError, UserError
from flotilla.debian import chroot, kernel_stage, pool, tools
from flotilla.debian.lock import Package, read_lock
from flotilla.fleet.model import Architecture, Board

_SOURCE = re.compile(r"linux-source-[0-9.]+")
_KIND = "kernel"
"""Of results in the cache."""
MADE_BY = (kernel_stage.__file__, chroot.__file__, namespace.__file__)
_SPACE = 4 << 30
"""Bytes of disk for the source and its objects."""


MINUTES = 7
"""Of two cores for a kernel with its modules, about: what is said before one is built."""


class Recipe(pydantic.BaseModel):
    """One kernel: what its file in `kernel/` says."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    architecture: Architecture
    """Debian's name of the processor architecture."""
    fragments: tuple[str, ...]
    """Names of files in `kernel/fragments/`, without `.config`. No two set an option differently."""
    patches: tuple[str, ...] = ()
    """Names of files in `kernel/patches/`, without `.patch`, in the order in which they are applied."""
    modules: bool = True
    """`false`: leave the modules out. The kernel itself is the same without them."""
    files: int = pydantic.Field(gt=0)
    """Approximate number of compiled files, for the progress of a build."""


@dataclass(frozen=True)
class Option:
    """One line of a fragment: `CONFIG_NAME=value # reason`."""

    name: str
    """Without CONFIG_."""
    value: str
    """`y`, `m`, `n`, a number, or a text in quotes."""
    reason: str
    place: str
    """File and line, for errors."""


@dataclass(frozen=True)
class Kernel:
    """What a build makes."""

    directory: Path

    @property
    def package(self) -> Path:
        """The Debian package."""
        (package,) = self.directory.glob("*.deb")
        return package

    def file(self, pattern: str) -> bytes:
        """Content of the one file of the package whose path matches."""
        listing = ["dpkg-deb", "--fsys-tarfile", str(self.package)]
        content = subprocess.run(listing, stdout=subprocess.PIPE, check=True).stdout
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            (found,) = (entry for entry in archive if entry.isfile() and fnmatch.fnmatch(entry.name, pattern))
            extracted = archive.extractfile(found)
            assert extracted is not None, "it is a file"
            return extracted.read()

    @property
    def image(self) -> Path:
        """What a boot loader loads."""

        def unpack(out: Path) -> None:
            (out / "vmlinuz").write_bytes(self.file("./boot/vmlinuz-*"))

        return cache.result("vmlinuz", self.directory.name.removeprefix("kernel-"), unpack) / "vmlinuz"

    @property
    def release(self) -> str:
        """As `uname -r` says."""
        return str(json.loads((self.directory / "kernel.json").read_text())["release"])


def names() -> list[str]:
    """All kernels."""
    return sorted({path.stem for layer in sources.layers(paths.KERNELS) for path in layer.glob("*.yml")})


def recipe(name: str) -> Recipe:
    """What makes a kernel."""
    if name not in names():
        file = paths.shown(paths.KERNELS / f"{name}.yml")
        raise UserError(f"{file}: there is no such kernel; there are {', '.join(names())}")
    return yaml_file.read(sources.find(paths.KERNELS, f"{name}.yml"), Recipe)


def board_kernel(board: Board) -> Kernel:
    """Our own kernel for a board: that of its name."""
    architecture = recipe(board.name).architecture
    if architecture != board.architecture:
        file = paths.shown(sources.find(paths.KERNELS, f"{board.name}.yml"))
        raise UserError(
            f"{file}: architecture: {architecture}: the board's is "
            f"{board.architecture}; make them the same here or in group_vars/board_{board.name}.yml"
        )
    return build(board.name)


# --- fragments ---

_LINE = re.compile(r'CONFIG_(?P<name>[A-Za-z0-9_]+)=(?P<value>"[^"]*"|[^\s"#]+)\s+#\s*(?P<reason>\S.*)')


def read_fragment(path: Path) -> list[Option]:
    """The options of one fragment; every malformed line is reported."""
    if not path.is_file():
        there = ", ".join(sorted(each.stem for each in path.parent.glob("*.config")))
        raise UserError(f"{paths.shown(path)}: no such fragment; there are {there}")
    options, problems = [], []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        place = f"{paths.shown(path)}:{number}"
        if not line.strip() or line.startswith("#"):
            continue
        if match := _LINE.fullmatch(line.strip()):
            options.append(Option(**match.groupdict(), place=place))
        else:
            key = line.partition("=")[0]
            problems.append(Problem(place, key, line, "is no option", "write `CONFIG_NAME=value # reason`"))
    if problems:
        raise ProblemsError(problems)
    return options


def merge(options: Iterable[Option]) -> dict[str, Option]:
    """Options by name; one that two fragments set differently is an error."""
    merged: dict[str, Option] = {}
    problems = []
    for option in options:
        first = merged.setdefault(option.name, option)
        if first.value != option.value:
            problems.append(
                Problem(
                    option.place, f"CONFIG_{option.name}", option.value,
                    f"contradicts {first.place}, which has {first.value}", "keep one of them",
                )
            )  # fmt: skip
    if problems:
        raise ProblemsError(problems)
    return merged


def wanted(name: str) -> dict[str, Option]:
    """What the fragments of a kernel ask for."""
    return merge(
        option
        for fragment in recipe(name).fragments
        for option in read_fragment(sources.find(paths.KERNELS, f"fragments/{fragment}.config"))
    )


def patches(name: str) -> list[Path]:
    """The patches of a kernel's source."""
    files = [sources.find(paths.KERNELS, f"patches/{patch}.patch") for patch in recipe(name).patches]
    for file in files:
        if not file.is_file():
            there = ", ".join(sorted(each.stem for each in file.parent.glob("*.patch")))
            raise UserError(f"{paths.shown(file)}: no such patch; there are {there}")
    return files


def request(options: Iterable[Option]) -> str:
    """The options as kconfig reads them."""
    return "".join(
        f"# CONFIG_{option.name} is not set\n" if option.value == "n" else f"CONFIG_{option.name}={option.value}\n"
        for option in sorted(options, key=lambda option: option.name)
    )


def parse_config(text: str) -> dict[str, str]:
    """Values by name of a `.config`; `n` for what is expressly not set."""
    values = dict(re.findall(r"^CONFIG_(\w+)=(.*)$", text, re.MULTILINE))
    return values | dict.fromkeys(re.findall(r"^# CONFIG_(\w+) is not set$", text, re.MULTILINE), "n")


def compare(options: Iterable[Option], config: str, kconfig: str) -> list[Problem]:
    """What was asked for and is not in the final configuration `config`.

    `kconfig` is the text of all the source's Kconfig files.
    """
    final = parse_config(config)
    problems = []
    known: list[str] = []
    for option in options:
        got = final.get(option.name, "n")
        if got == option.value:
            continue
        entries = re.findall(rf"^(?:menu)?config {option.name}\n((?:[ \t].*\n|\n)*)", kconfig, re.MULTILINE)
        if entries:
            needs = sorted({need for entry in entries for need in re.findall(r"^\s+depends on (.+)$", entry, re.M)})
            message = f"is changed by kconfig to {got}"
            remedy = f"it depends on {' and on '.join(needs)}" if needs else "another option selects or forbids it"
        else:
            known = known or re.findall(r"^(?:menu)?config (\w+)$", kconfig, re.MULTILINE)
            near = difflib.get_close_matches(option.name, set(known), 1)
            message = "is no option of this kernel"
            remedy = f"perhaps CONFIG_{near[0]} is meant" if near else "remove it"
        problems.append(Problem(option.place, f"CONFIG_{option.name}", option.value, message, remedy))
    return problems


# --- build ---


def source(packages: Iterable[Package]) -> Package:
    """The locked package of the kernel's source."""
    for package in packages:
        if _SOURCE.fullmatch(package.name):
            return package
    raise UserError(
        "images/locks/toolchain.lock: no package linux-source-…; name one in images/packages/toolchain.list and run "
        "`make lock`"
    )


def build(name: str) -> Kernel:
    """The kernel `name` as a Debian package; from the cache where nothing changed."""
    options = wanted(name)
    lock = read_lock("toolchain")
    origin = source(lock.packages)
    modules = recipe(name).modules

    def make(out: Path) -> None:
        free = shutil.disk_usage(paths.BUILD).free
        if free < _SPACE:
            raise UserError(
                f"{paths.shown(paths.BUILD)}: {progress.size(free)} free on its disk, building a kernel needs "
                f"{progress.size(_SPACE)}; make room, or choose another place with BUILD=directory"
            )
        pool.fill([lock])
        toolchain = tools.tree(lock)
        log = paths.BUILD / f"kernel-{name}.log"
        stage = kernel_stage.Description(
            tools=str(toolchain), out=str(out), architecture=recipe(name).architecture, source=origin.name,
            version=origin.version, epoch=lock.epoch, modules=modules, patches=[str(patch) for patch in patches(name)],
        )  # fmt: skip
        (out / "request.config").write_text(request(options.values()))
        with progress.step(f"configure kernel {name}"):
            _run(stage, "configure", log)
        problems = compare(options.values(), (out / "config").read_text(), (out / "kconfig").read_text())
        if problems:
            raise ProblemsError(problems)
        with progress.step(f"kernel {name}", lambda: far(progress.text(log), recipe(name).files)):
            _run(stage, "build", log)

    return Kernel(cache.result(_KIND, key(name), make))


def key(name: str) -> str:
    """Hash of all that decides a kernel's bytes."""
    lock = read_lock("toolchain")
    made_of = recipe(name)
    options = request(wanted(name).values())
    return cache.digest(
        tools.name(lock), lock.digest, source(lock.packages).name, made_of.architecture, options,
        f"modules {made_of.modules}", *patches(name), *map(Path, MADE_BY),
    )  # fmt: skip


def name_of(name: str) -> str:
    """Of the directory of what `build` makes; it need not be made yet."""
    return cache.name(_KIND, key(name))


def unbuilt(names: Iterable[str]) -> list[str]:
    """Those of these kernels that the cache lacks, which take minutes to build."""
    return [name for name in names if not cache.has(_KIND, key(name))]


def far(log: str, files: int) -> progress.Far:
    """How far a build is that has written `log`."""
    return progress.Far(sum(line.startswith("  CC") for line in log.splitlines()), files, "files compiled")


def how_long(names: Sequence[str]) -> str:
    """What is said before kernels are built."""
    return f"kernels to build first: {', '.join(names)}, each about {MINUTES} minutes on two cores"


def _run(stage: kernel_stage.Description, what: str, log: Path) -> None:
    namespace.run_stage(kernel_stage.__name__, [what, json.dumps(stage.__dict__)], log)


def report(names: Sequence[str]) -> str:
    """Build kernels, beside which images may be built; where the packages are and what they weigh."""
    lines = []
    host.check()
    namespace.check()
    if missing := unbuilt(names):
        progress.say(how_long(missing))
    with cache.locked(paths.CACHE / ".kernels.lock"):
        for name in names:
            package = build(name).package
            copy = paths.BUILD / "kernels" / name / package.name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(package, copy.with_suffix(".part"))
            durable.rename(copy.with_suffix(".part"), copy)
            lines.append(f"{paths.shown(copy)}: {progress.size(copy.stat().st_size)}")
    return "\n".join(lines)
