"""A supported host as a tree of its own, made by debootstrap: a computer on which nobody has built an image yet.

What a command writes there goes to a layer above the tree, which is made once and kept in the cache.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from flotilla.common import cache, namespace, paths
from flotilla.common.errors import UserError
from flotilla.debian import mirror


class Host(NamedTuple):
    """A supported host by its os-release."""

    id: str
    version: str
    codename: str


SUPPORTED = [
    Host(*line.partition("#")[0].split())
    for line in (paths.PROJECT / "images/hosts.txt").read_text().splitlines()
    if not line.startswith("#")
]
USER = "u"
_ENTER = Path(__file__).with_name("enter.sh")
_INSTALLED = ("ca-certificates", "git", "locales", "make", "sudo")
"""What a computer has on which somebody cloned the checkout; `make` installs all else."""
_AUTHORITIES = Path("usr/local/share/ca-certificates")
_NETWORK = ("etc/resolv.conf", "etc/hosts")
_CERTIFICATES = "/etc/ssl/certs/ca-certificates.crt"
_PREPARE = f"""
update-ca-certificates
touch /etc/subuid /etc/subgid
useradd --create-home --shell /bin/bash {USER}
echo '{USER} ALL=(ALL) NOPASSWD: ALL' >/etc/sudoers.d/{USER}
echo 'de_DE ISO-8859-1' >/etc/locale.gen
locale-gen
"""


@dataclass(frozen=True)
class Tree:
    """An unpacked Debian, and the layer above it in which commands run."""

    directory: Path
    layer: Path

    def run(
        self, *argv: str, user: str = "root", umask: int = 0o022, variables: Mapping[str, str] | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run a command there as `user` with a login's environment, and the network of this computer."""
        home = "/root" if user == "root" else f"/home/{user}"
        environment = {
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
            "HOME": home,
            "USER": user,
            "LANG": "C.UTF-8",
            **_certificates(),
            **(variables or {}),
        }
        inside = ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups", "env", "-C", home]
        inside += ["sh", "-c", f'umask {umask:03o} && exec "$@"', "sh", *argv]
        whole = [*namespace.prefix(), str(_ENTER), str(self.directory), str(self.layer), *inside]
        pipe = subprocess.PIPE
        return subprocess.run(
            whole, env=environment, stdin=subprocess.DEVNULL, stdout=pipe, stderr=subprocess.STDOUT, text=True,
            errors="replace", check=False,
        )  # fmt: skip

    def path(self, inside: str) -> Path:
        """Where a file that a command wrote there lies."""
        return self.layer / "upper" / inside.lstrip("/")

    def give(self, files: Iterable[Path], directory: str, user: str) -> None:
        """Copy files to a directory there, as the user's own."""
        target = self.path(directory)
        new = next(path for path in [*reversed(target.parents), target] if not path.exists() or path == target)
        target.mkdir(parents=True, exist_ok=True)
        for file in files:
            shutil.copyfile(file, target / file.name)
        self._must("chown", "-R", f"{user}:{user}", str(Path("/") / new.relative_to(self.path("/"))))

    def _must(self, *argv: str) -> None:
        done = self.run(*argv)
        if done.returncode:
            raise UserError(f"{' '.join(argv)}: status {done.returncode}: {done.stdout.strip()}")


def make(suite: str, layer: Path) -> Tree:
    """The tree of a release of Debian, from the cache where it was made before, below an empty `layer`."""
    if os.geteuid() != 0:
        raise UserError("trees of other hosts need root, for overlays and device nodes; be root of a container")

    def bootstrap(out: Path) -> None:
        mirrors = mirror.resolve()
        argv = ["debootstrap", "--variant=minbase", f"--include={','.join(_INSTALLED)}"]
        base = mirrors.of(mirror.DEBIAN)
        done = subprocess.run([*argv, suite, str(out), base], capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(f"debootstrap {suite}: status {done.returncode}: {done.stdout[-2000:]}")
        (out / "etc/apt/sources.list").write_text(
            f"deb {base} {suite} main\ndeb {base} {suite}-updates main\n"
            f"deb {mirrors.of(mirror.SECURITY)} {suite}-security main\n"
        )
        for file in Path("/", _AUTHORITIES).glob("*.crt"):
            shutil.copy(file, out / _AUTHORITIES)
        inside = ["sh", "-ec", 'mount -t proc proc "$0/proc" && exec chroot "$0" sh -ec "$1"', str(out), _PREPARE]
        done = subprocess.run([*namespace.prefix(), *inside], capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(f"{suite}: status {done.returncode} in its tree: {done.stdout}{done.stderr}")

    key = cache.digest(suite, Path(__file__), _ENTER)
    tree = Tree(cache.result("host", key, bootstrap), layer)
    layer.mkdir(parents=True)
    for name in _NETWORK:
        target = tree.path(name)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path("/", name), target)
    return tree


def clone(tree: Tree, directory: str, user: str, umask: int) -> None:
    """A clone of this checkout's commit, as the user makes it there."""
    bundle = tree.path("/srv/flotilla.git")
    bundle.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(["git", "-C", paths.PROJECT, "bundle", "create", "--quiet", bundle, "HEAD"], check=True)
    done = tree.run("git", "clone", "--quiet", "/srv/flotilla.git", directory, user=user, umask=umask)
    if done.returncode:
        raise UserError(f"git clone: status {done.returncode}: {done.stdout.strip()}")


def _certificates() -> dict[str, str]:
    """Variables by which this computer names the authorities that it trusts; the tree has them at the same place."""
    return {name: value for name, value in os.environ.items() if value == _CERTIFICATES}
