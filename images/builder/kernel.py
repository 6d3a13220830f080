"""Kernels of our own: Debian's packaged source, configured by the fragments in `kernel/`, built by the locked compiler.

`kernel/kernels.yml` says which fragments make which kernel. Whatever no fragment asks for is off; whatever one asks for
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
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pydantic
import yaml

from images.builder import cache, host, kernel_stage, namespace, paths, pool, progress, tools
from images.builder.errors import Problem, ProblemsError, UserError
from images.builder.lock import Package, read_lock

DIRECTORY = paths.PROJECT / "kernel"
_SOURCE = re.compile(r"linux-source-[0-9.]+")
_SPACE = 4 << 30
"""Bytes of disk for the source and its objects."""


class Recipe(pydantic.BaseModel):
    """One kernel: an entry of kernels.yml."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    architecture: Literal["i386", "amd64"]
    """Debian's name of the architecture."""
    fragments: tuple[str, ...]
    """Names of files in `kernel/fragments/`, without `.config`."""
    modules: bool = True
    """Whether its modules are built and packaged. The kernel itself is the same without them."""


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


def recipes(path: Path = DIRECTORY / "kernels.yml") -> dict[str, Recipe]:
    """All kernels, by name."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        return pydantic.TypeAdapter(dict[str, Recipe]).validate_python(content)
    except (yaml.YAMLError, pydantic.ValidationError) as error:
        raise UserError(f"{paths.shown(path)}: {error}") from None


def recipe(name: str) -> Recipe:
    known = recipes()
    if name not in known:
        raise UserError(f"kernel/kernels.yml: no kernel '{name}'; there are {', '.join(known)}")
    return known[name]


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
                    f"contradicts {first.place}, which says {first.value}", "keep one of them",
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
        for option in read_fragment(DIRECTORY / "fragments" / f"{fragment}.config")
    )


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
            message = f"is refused by kconfig, which makes it {got}"
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
    made_by = [Path(kernel_stage.__file__), Path(kernel_stage.__file__).with_name("chroot.py")]
    modules = recipe(name).modules
    key = cache.digest(
        lock.digest, recipe(name).architecture, request(options.values()), f"modules {modules}", *made_by
    )

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
            version=origin.version, epoch=lock.epoch, modules=modules,
        )  # fmt: skip
        (out / "request.config").write_text(request(options.values()))
        with progress.step(f"configure kernel {name}"):
            _run(stage, "configure", log)
        problems = compare(options.values(), (out / "config").read_text(), (out / "kconfig").read_text())
        if problems:
            raise ProblemsError(problems)
        with progress.step(f"kernel {name}") as step:
            _run(stage, "build", log, lambda: step.note(f"{_compiled(log)} files compiled"))

    return Kernel(cache.result("kernel", key, make))


def _run(stage: kernel_stage.Description, what: str, log: Path, watch: Callable[[], object] | None = None) -> None:
    namespace.run_stage(kernel_stage.__name__, [what, json.dumps(stage.__dict__)], log, watch)


def _compiled(log: Path) -> int:
    return sum(line.startswith("  CC") for line in log.read_text(errors="replace").splitlines())


def report(names: Sequence[str]) -> str:
    """Build kernels, beside which images may be built; where the packages are and what they weigh."""
    lines = []
    host.check()
    namespace.check()
    with cache.locked(paths.CACHE / ".kernels.lock"):
        for name in names:
            package = build(name).package
            copy = paths.BUILD / "kernels" / name / package.name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(package, copy.with_suffix(".part"))
            copy.with_suffix(".part").replace(copy)
            lines.append(f"{paths.shown(copy)}: {progress.size(copy.stat().st_size)}")
    return "\n".join(lines)
