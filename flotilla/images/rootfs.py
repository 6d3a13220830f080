"""The root file system that all robots of a board share: read-only, compressed, bit-identical.

`build` prepares the inputs and runs this module again as a stage in namespaces (`main`), where debootstrap makes the
smallest Debian in memory from the local repository, dpkg adds all other packages, the overlay is laid over it, and
mksquashfs packs it.
"""

from __future__ import annotations

import contextlib
import fnmatch
import json
import lzma
import os
import re
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

from flotilla.common import cache, namespace, paths, progress, sources, together
from flotilla.debian import chroot, deb, kernel, pool, runtime, tools
from flotilla.debian.chroot import Chroot, mount
from flotilla.debian.lock import Lock
from flotilla.fleet import privileges
from flotilla.fleet.model import Board
from flotilla.images import debian_kernel, initramfs

DATA = paths.PROJECT / "images" / "rootfs"
COMPRESSION = ["-comp", "zstd", "-Xcompression-level", "15", "-b", "128K", "-no-fragments"]
"""zstd: a Pentium III unpacks it several times faster than xz, at about 8 % more bytes. A boot reads hundreds of small
files; packed together in fragments, each would cost it the unpacking of a whole block."""
_SIZE_LIMIT = "3g"
_PACKAGES = "packages"
_SECONDS = {_PACKAGES: 80, "kernel": 5, "runtime": 1, "overlay": 1, "clean": 0, "initramfs": 1, "squashfs": 55}
"""The stage's parts, in their order, and about how long each takes on two cores: how far a build is."""
_PACKAGE = re.compile(r"^(?:I: (?:Unpacking|Configuring) [^ ]+|(?:Unpacking|Setting up) \S+ .*)\.\.\.$", re.MULTILINE)
"""What debootstrap and dpkg say of a package, twice of each."""
_RUNTIME = "runtime"
"""A pipe in the stage's repository. It says the name of the runtime's package there, as soon as that is compiled."""
NOT_PACKED = ("dev", "proc", "sys", "run", "tmp")
"""Directories of the root that are empty in its image."""
_REPOSITORY = "/tmp/repository"
"""Where the root has the stage's repository while it is made; nothing of /tmp is packed."""
MADE_BY = (
    __file__, pool.__file__, chroot.__file__, deb.__file__, debian_kernel.__file__, initramfs.__file__,
    namespace.__file__, str(Path(__file__).with_name("init")),
)  # fmt: skip


def build(board: Board, lock: Lock, tools_lock: Lock) -> Path:
    """Directory with `root.squashfs`, `vmlinuz` and `contents.json` of the board's robots.

    Debian's kernel needs an `initrd.img` too; ours holds what a boot needs.
    """
    own = kernel.board_kernel(board) if board.kernel == "lean" else None
    if own:
        lock = lock.without("kernel")

    def make(out: Path) -> None:
        """The runtime is compiled meanwhile: the stage needs it late, and leaves a processor idle until then."""
        (out / "repository").mkdir()
        os.mkfifo(out / "repository" / _RUNTIME)
        with (out / "repository" / _RUNTIME).open("r+b", buffering=0) as name:  # both ways, so that nobody waits here

            def compile_runtime() -> None:
                package = runtime.build(board.system).package
                shutil.copy(package, out / "repository")
                name.write(f"{package.name}\n".encode())

            together.run(compile_runtime, lambda: make_root(out))

    def make_root(out: Path) -> None:
        log = paths.BUILD / f"rootfs-{board.name}.log"
        log.unlink(missing_ok=True)  # an earlier build's
        required, userland = lock.having("required"), lock.having("userland")
        packages = len(required) + len(userland)
        title = f"root file system of {board.name} ({len(lock.packages)} packages)"
        with progress.step(title, lambda: far(progress.text(log), packages)):
            repository = out / "repository"
            together.run(lambda: tools.tree(tools_lock), lambda: pool.repository(lock, repository, compressed=False))
            if own:
                shutil.copy(own.package, repository)
            stage = {
                "architecture": lock.architecture,
                "release": lock.release,
                "epoch": lock.epoch,
                "required": [package.name for package in required],
                "others": [package.path for package in userland],
                "kernel": own.package.name if own else lock.having("kernel")[0].path,
                "disk_modules": None if own else board.disk_modules,
                "console": board.console_tty,
                "tools": str(tools.tree(tools_lock)),
                "repository": str(repository),
                "out": str(out),
            }
            (out / "stage.json").write_text(json.dumps(stage))
            namespace.run_stage(__name__, [str(out / "stage.json")], log)
            shutil.rmtree(repository)
            (out / "stage.json").unlink()

    return cache.result("rootfs", key(board, lock, tools_lock), make)


def key(board: Board, lock: Lock, tools_lock: Lock) -> str:
    """Hash of all that decides the root's bytes. `lock`: without the kernel, where the board has one of ours."""
    return cache.digest(
        lock.digest,
        tools.name(tools_lock),
        kernel.name_of(board.name) if board.kernel == "lean" else "",
        runtime.name(board.system),
        debian_kernel.PACKER,
        board.model_dump_json(include={"disk_modules", "architecture", "console"}),
        json.dumps(privileges.USERS | {privileges.UPDATE_USER: privileges.UPDATE_NUMBER}),
        cache.digest_of(DATA, lists()),
        *map(Path, MADE_BY),
        cache.digest_of_named(overlay_files()),
    )


def far(log: str, packages: int) -> progress.Far:
    """How far a build is that has written `log`, with so many packages to unpack and configure."""
    begun = re.findall(r"^== (\w+)$", log, re.MULTILINE)
    if not begun:
        return progress.Far(0, sum(_SECONDS.values()), part="repository")
    *ended, part = begun
    share = _SECONDS[part] * len(_PACKAGE.findall(log)) / (2 * packages) if part == _PACKAGES else 0
    return progress.Far(sum(_SECONDS[name] for name in ended) + share, sum(_SECONDS.values()), part=part)


def overlay_files() -> dict[PurePosixPath, Path]:
    """The overlay's files common to all robots, by their path in it; templates belong to the identity."""
    return {name: path for name, path in sources.layered(paths.OVERLAY).items() if name.suffix != ".j2"}


def lists() -> list[Path]:
    return [path for path in sources.files(DATA) if path.suffix == ".list"]


# What follows runs in the stage's own namespaces.


class Stage:
    """The chroots of a build: the tools tree, and the root being made inside it at /target, in memory."""

    def __init__(self, description: dict[str, object]) -> None:
        self.tools = Path(str(description["tools"]))
        self.target = self.tools / "target"
        self.epoch = int(str(description["epoch"]))
        self._tools = Chroot(self.tools, self.epoch)
        self._target = Chroot(self.target, self.epoch)
        for each in (self._tools, self._target):
            each.environment |= {
                "DEBIAN_FRONTEND": "noninteractive",
                "DEBCONF_NONINTERACTIVE_SEEN": "true",
                "container": "lxc",  # debootstrap then binds device nodes where it may not make them
            }
        self.in_tools = self._tools.run
        self.in_target = self._target.run
        self.shown_in_tools, self.shown_in_target = self._tools.log, self._target.log

    def mount(self, repository: str, out: str) -> None:
        """All inside the private mount namespace: nothing to undo."""
        mount("-t", "tmpfs", "-o", f"mode=755,size={_SIZE_LIMIT}", "flotilla", self.target)
        self._tools.provide_system(repository=repository, out=out)
        self._target.provide_clock()


@contextlib.contextmanager
def _timed(title: str) -> Iterator[None]:
    started = time.monotonic()
    print(f"== {title}", flush=True)
    yield
    print(f"== {title}: {time.monotonic() - started:.1f} s", flush=True)


def main(description_file: str) -> None:
    """The stage: everything from an empty directory to the packed root."""
    description = json.loads(Path(description_file).read_text())
    os.umask(0o022)
    os.nice(5)
    stage = Stage(description)
    stage.mount(description["repository"], description["out"])
    print(f"clock of the stage: {time.strftime('%F')}")
    stage.in_tools("date", "+clock of the tools: %F")
    repository, out = Path(description["repository"]), Path(description["out"])
    with _timed(_PACKAGES):
        together.run(
            lambda: _prepare_kernel(repository / description["kernel"], out / "vmlinuz"),
            lambda: _bootstrap(stage, description["architecture"], description["release"], description["required"]),
        )
        _install(stage, repository, description["others"], description["kernel"])
    stage.in_target("perl", "-MPOSIX=strftime", "-e", 'print strftime("clock of the target: %F\\n", gmtime)')
    with _timed("kernel"):
        version = _prune_modules(stage, description["architecture"])
    with _timed("runtime"):
        with (repository / _RUNTIME).open() as name:
            package = name.readline().rstrip()  # once it is compiled
        stage.in_target("dpkg", "--install", f"{_REPOSITORY}/{package}")
    with _timed("overlay"):
        _remove_excluded(stage.target)
        lay_overlay(stage.target)
        _configure(stage, description["console"])
    with _timed("clean"):
        contents = _clean(stage)
        check_privileged(stage.target, privileged_list(description["release"]))
    packing: list[Callable[[], object]] = []
    if description["disk_modules"] is not None:
        with _timed("initramfs"):
            image = initramfs.build(stage.tools, stage.target, version, description["disk_modules"])
            (stage.tools / "tmp/initrd").write_bytes(image)
            compress = ["zstd", "-19", "-q", "-f", "/tmp/initrd", "-o", "/out/initrd.img"]
            packing.append(lambda: stage.in_tools(*compress))  # on one processor: beside the root
    shutil.rmtree(stage.target / "boot")
    (stage.target / "boot").mkdir()
    with _timed("squashfs"):
        _settle_times(stage)
        actions = [f'uncompressed@pathname("{pattern.lstrip("/")}")\n' for pattern in _list("uncompressed.list")]
        (stage.tools / "tmp/actions").write_text("".join(actions))
        squash = [
            "env", "-u", "SOURCE_DATE_EPOCH", "mksquashfs", "/target", "/out/root.squashfs", *COMPRESSION,
            "-noappend", "-no-progress", "-exports", "-action-file", "/tmp/actions",
            "-mkfs-time", str(stage.epoch), "-all-time", str(stage.epoch),
            "-wildcards", "-e", *(f"{name}/*" for name in NOT_PACKED), "debootstrap",
        ]  # fmt: skip
        together.run(*packing, lambda: stage.in_tools(*squash))
    contents |= {"kernel": version, "root_bytes": (out / "root.squashfs").stat().st_size}
    (out / "contents.json").write_text(json.dumps(contents, indent=1, sort_keys=True) + "\n")


def _bootstrap(stage: Stage, architecture: str, release: str, packages: list[str]) -> None:
    """The smallest Debian: what it requires, with apt."""
    include = ",".join(packages)
    stage.shown_in_tools(
        "debootstrap", "--no-check-gpg", "--foreign", "--variant=minbase", f"--arch={architecture}",
        f"--include={include}", release, "/target", "file:///repository",
    )  # fmt: skip
    # Maintainer scripts look for configuration files, so those go afterwards (_remove_excluded), the rest never comes.
    rules = [(keep, pattern) for keep, pattern in path_rules() if not pattern.startswith("/etc/")]
    config = ["force-unsafe-io", *(f"path-{'include' if keep else 'exclude'}={pattern}" for keep, pattern in rules)]
    (stage.target / "etc/dpkg/dpkg.cfg.d").mkdir(parents=True, exist_ok=True)
    (stage.target / "etc/dpkg/dpkg.cfg.d/flotilla").write_text("\n".join(config) + "\n")
    (stage.target / "etc/ssh").mkdir()
    for kind in ("rsa", "ecdsa", "ed25519"):  # so that the server's package draws none, which takes seconds
        (stage.target / f"etc/ssh/ssh_host_{kind}_key").touch()  # leftovers.list has them
    stage.shown_in_target("/debootstrap/debootstrap", "--second-stage")


def _list(name: str) -> list[str]:
    """The entries of a list file, without comments."""
    return [entry for line in (DATA / name).read_text().splitlines() if (entry := line.split("#")[0].strip())]


def module_patterns(architecture: str) -> list[str]:
    """Which kernel modules to keep: shell patterns over their path below kernel/, without .ko."""
    return _list_with_own("modules", architecture)


def privileged_list(release: str) -> list[str]:
    """The files of a root that are privileged, as images/rootfs/privileged.list describes them."""
    return _list_with_own("privileged", release)


def _list_with_own(name: str, of: str) -> list[str]:
    """What stands in a list for all, and in the one of an architecture or a release, if there is one."""
    own = f"{name}-{of}.list"
    return _list(f"{name}.list") + (_list(own) if (DATA / own).is_file() else [])


def path_rules() -> list[tuple[bool, str]]:
    """What to keep (True) or leave out, as shell patterns; the last that matches counts."""
    rules = []
    for entry in _list("exclude.list"):
        pattern = entry.removeprefix("+")
        # Packages still name their files by the old places.
        places = [pattern, pattern.removeprefix("/usr")] if pattern.startswith("/usr/lib/") else [pattern]
        rules += [(entry.startswith("+"), place) for place in places]
    return rules


def _remove_excluded(target: Path) -> None:
    """debootstrap unpacks the first packages without asking dpkg's rules, and dpkg exempts links."""
    rules = [(keep, re.compile(fnmatch.translate(pattern))) for keep, pattern in path_rules()]
    for parent, _, names in os.walk(target):
        place = "/" + os.path.relpath(parent, target) + "/"
        for name in names:
            verdicts = [keep for keep, pattern in rules if pattern.match(place + name)]
            if verdicts and not verdicts[-1]:
                (Path(parent) / name).unlink()


def _prepare_kernel(package: Path, image: Path) -> None:
    """Write the kernel of a package to `image`, and leave the package without compression."""
    os.nice(5)  # this thread: debootstrap needs one processor, and takes longer
    beside = package.with_suffix(".part")
    deb.without_compression(package, beside)
    beside.replace(package)  # not into it: it may be a link to the pool's
    image.write_bytes(debian_kernel.of_package(package))


def _install(stage: Stage, repository: Path, packages: list[str], kernel_package: str) -> None:
    """All packages but those that debootstrap has installed, by their paths in the repository.

    debootstrap would install them, too, but looks each up several times.
    """
    place = stage.target / _REPOSITORY.lstrip("/")
    place.mkdir()
    mount("--bind", repository, place)
    mount("-t", "proc", "proc", stage.target / "proc")  # debootstrap has taken its own away
    no_services = stage.target / "usr/sbin/policy-rc.d"  # for invoke-rc.d: nothing is started here
    no_services.write_text("#!/bin/sh\nexit 101\n")
    no_services.chmod(0o755)
    # As debootstrap unpacks what Debian requires: all at once, whatever depends on what, before any is configured.
    places = [f"{_REPOSITORY}/{path}" for path in packages]
    stage.shown_in_target("dpkg", "--unpack", "--force-depends", "--skip-same-version", *places)
    stage.shown_in_target("dpkg", "--configure", "--pending")
    # The kernel depends on programs for its scripts, whose work, initramfs and links, is done here.
    stage.shown_in_target("dpkg", "--unpack", "--force-depends", f"{_REPOSITORY}/{kernel_package}")
    for script in (stage.target / "var/lib/dpkg/info").glob("linux-image-*.*"):
        if script.suffix in (".preinst", ".postinst", ".prerm", ".postrm"):
            script.unlink()
    stage.shown_in_target("dpkg", "--configure", "--pending", "--force-depends")
    no_services.unlink()


def _prune_modules(stage: Stage, architecture: str) -> str:
    """Leave the modules that robots use; the kernel's version."""
    (version,) = (path.name for path in (stage.target / "lib/modules").iterdir())
    directory = stage.target / "lib/modules" / version
    stage.in_tools("depmod", "-b", "/target", version)
    needs = dict(line.split(":", 1) for line in (directory / "modules.dep").read_text().splitlines())
    kept: set[str] = set()
    for pattern in module_patterns(architecture):
        for module in fnmatch.filter(needs, f"kernel/{pattern}.ko*"):
            kept |= {module, *needs[module].split()}
    for path in sorted((directory / "kernel").rglob("*.ko*")):
        content = path.read_bytes()
        path.unlink()
        if str(path.relative_to(directory)) in kept:
            if path.suffix == ".xz":  # as Debian 13 packs them: squashfs packs better what is not, and insmod needs it
                path, content = path.with_suffix(""), lzma.decompress(content)
            path.write_bytes(debian_kernel.without_signature(content))
    stage.in_tools("depmod", "-b", "/target", version)
    return version


def lay_overlay(target: Path) -> None:
    for name, source in overlay_files().items():
        place = target / name
        # Nothing is written through a link: an absolute one of the root's would lead to this computer's files.
        if (leads := place.parent.resolve()) != (there := target.resolve()) and there not in leads.parents:
            raise SystemExit(
                f"{paths.shown(source)}: a folder of this path is a link to {leads} in the root; put the file where "
                "that leads to"
            )
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        if source.is_symlink():
            place.symlink_to(source.readlink())
        else:
            place.write_bytes(source.read_bytes())
            place.chmod(0o755 if sources.executable(source) else 0o644)


def _configure(stage: Stage, console: str) -> None:
    """Accounts, services, the console's log-in and mount points: what the overlay's files cannot say by themselves."""
    stage.in_target("groupadd", "--system", "realtime")
    # Whom control tasks, apps and what parses updates run as.
    for name, number in [*privileges.USERS.items(), (privileges.UPDATE_USER, privileges.UPDATE_NUMBER)]:
        stage.in_target(
            "useradd", "--system", "--uid", str(number), "--user-group", "--no-create-home",
            "--home-dir", "/nonexistent", "--shell", "/usr/sbin/nologin", name,
        )  # fmt: skip
    stage.in_target(
        "useradd", "--uid", "1000", "--user-group", "--no-create-home", "--home-dir", "/home/robot",
        "--shell", "/bin/bash", "--groups", ",".join(["dialout,video,realtime", *privileges.USERS]), "robot",
    )  # fmt: skip
    stage.in_target("systemctl", "preset-all", "--preset-mode=full")
    stage.in_target("systemctl", "set-default", "multi-user.target")
    if console:
        stage.in_target("systemctl", "enable", f"serial-getty@{console}.service")
    (stage.target / "data").mkdir()
    _link_moved_files(stage.target)


def _link_moved_files(target: Path) -> None:
    """Make the links that Debian 13 makes at each boot, from former places of files: the robot would differ from its
    image. Debian 12 makes none of them."""
    text = (target / "usr/lib/tmpfiles.d/debian.conf").read_text()
    for place, to in re.findall(r"^L\+ /(etc/default/locale|etc/vconsole\.conf) .* (\S+)$", text, re.MULTILINE):
        link = target / place
        if link.exists():
            link.rename(link.parent / to)
        link.symlink_to(to)


def _clean(stage: Stage) -> dict[str, object]:
    """Remove what differs from build to build; return what is left, by package."""
    sizes = stage.in_target("dpkg-query", "-W", "-f", "${Package} ${Version} ${Installed-Size}\\n")
    for pattern in _list("leftovers.list"):
        for path in stage.target.glob(pattern):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    for name in ("proc", "sys"):
        subprocess.run(["umount", "-R", str(stage.target / name)], stderr=subprocess.DEVNULL, check=False)
    return {"packages": [line.split() for line in sizes.splitlines()]}


_PLAIN = "of root, without special bits and attributes"


def check_privileged(target: Path, listed: Iterable[str]) -> None:
    """SystemExit with the files of a root that are privileged otherwise than the lines `listed` say.

    Maintainer scripts do without a capability that this computer refuses them: without setcap(8), ping is set-user-ID.
    """
    wanted = {line.split()[3]: line for line in listed}
    found = _privileged(target)
    plain = {path for path in wanted.keys() - found.keys() if os.path.lexists(f"{target}{path}")}
    problems = [
        f"{path}: is {found.get(path, _PLAIN)}; listed: {wanted.get(path, 'no')}"
        for path in sorted(found.keys() | plain)
        if wanted.get(path) != found.get(path)
    ]
    if problems:
        raise SystemExit(
            "\n".join(problems)
            + "\nthe root has other privileged files than images/rootfs/privileged.list; correct that list where they "
            "are meant; otherwise this computer refused what makes them so (capabilities, extended attributes in tmpfs)"
        )


def _privileged(target: Path) -> dict[str, str]:
    """By path, as a line of privileged.list."""
    users, groups = (
        {fields[2]: fields[0] for line in (target / name).read_text().splitlines() if (fields := line.split(":"))}
        for name in ("etc/passwd", "etc/group")
    )
    found = {}
    for parent, directories, names in os.walk(target):
        if parent in (f"{target}/{name}" for name in NOT_PACKED):
            directories.clear()
            continue
        for path in (f"{parent}/{name}" for name in directories + names):
            status = os.lstat(path)
            special = status.st_mode & 0o7000 and not stat.S_ISLNK(status.st_mode)
            attributes = sorted(os.listxattr(path, follow_symlinks=False))
            if special or status.st_uid or status.st_gid or attributes:
                owner, group = (
                    users.get(str(status.st_uid), status.st_uid),
                    groups.get(str(status.st_gid), status.st_gid),
                )
                words = [f"{stat.S_IMODE(status.st_mode):04o}", str(owner), str(group), path.removeprefix(str(target))]
                words += [f"{name}=0x{os.getxattr(path, name, follow_symlinks=False).hex()}" for name in attributes]
                found[words[3]] = " ".join(words)
    return found


def _settle_times(stage: Stage) -> None:
    """Nothing may carry the time of the build, in names or contents; squashfs itself gets one time for all."""
    shadow = (stage.target / "etc/shadow").read_text().splitlines()
    day = str(stage.epoch // 86400)
    late = [line.split(":")[0] for line in shadow if line.split(":")[2] not in (day, "")]
    if late:
        fixed = [":".join([*line.split(":")[:2], day, *line.split(":")[3:]]) for line in shadow]
        path = stage.target / "etc/shadow"
        mode = stat.S_IMODE(path.stat().st_mode)
        path.write_text("\n".join(fixed) + "\n")
        path.chmod(mode)


if __name__ == "__main__":
    main(sys.argv[1])
