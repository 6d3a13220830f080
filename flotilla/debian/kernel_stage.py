"""The stage that configures and builds a kernel: what runs in the namespaces, in a chroot of the toolchain.

The source always lies at the same place there, and user, host name and time are fixed, so that the package is the same
wherever, whenever and by whomever it is made.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flotilla.debian.chroot import Chroot

_ARCHITECTURES = {"i386": "i386", "amd64": "x86_64"}
"""Debian's names and the kernel's."""
_UNUSED = [
    "Documentation/*/*", "arch/[!x]*.[chS]", "arch/[!x]*.dts*", "drivers/gpu/drm/*.[ch]", "samples/*.[ch]",
    "sound/*.[ch]", "tools/perf/*", "tools/testing/*",
]  # fmt: skip
"""Not unpacked: more than half of the source's bytes, of which such a kernel needs only the Kconfig files."""
_FASTER = "-pipe -ftrack-macro-expansion=0"
"""Of the compiler, with the same objects as result: a twentieth of the time, most of which goes into headers."""


@dataclass(frozen=True)
class Description:
    """What to build, out of what, where to."""

    tools: str
    """Tree of the toolchain."""
    out: str
    """Directory of the result; holds `request.config`."""
    architecture: str
    source: str
    """Package of the source, such as linux-source-6.12."""
    version: str
    """Of that package."""
    epoch: int
    modules: bool
    """Whether the package holds modules, too."""
    patches: Sequence[str]
    """Files, in the order in which they are applied to the source."""


def apply(patches: Sequence[str], source: Path, what: str) -> None:
    """Apply patches to a source, exactly; SystemExit with the one that does not fit `what`."""
    # Without a repository above, whose folder git would take the paths to be in, and without this computer's settings.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    environment |= {"GIT_CEILING_DIRECTORIES": str(source.parent), "GIT_CONFIG_NOSYSTEM": "1"}
    environment |= {"GIT_CONFIG_GLOBAL": os.devnull}
    for patch in patches:
        argv = ["git", "apply", "--whitespace=nowarn", patch]
        if subprocess.run(argv, cwd=source, env=environment, check=False).returncode:
            raise SystemExit(f"{patch}: does not apply to {what}; bring it up to date, or take it out of `patches`")


class Stage:
    def __init__(self, description: Description) -> None:
        self.description = description
        self.out = Path(description.out)
        self.chroot = Chroot(Path(description.tools), description.epoch)
        self.chroot.environment |= {
            "KBUILD_BUILD_TIMESTAMP": f"@{description.epoch}",
            "KBUILD_BUILD_USER": "flotilla",
            "KBUILD_BUILD_HOST": "flotilla",
            "KBUILD_BUILD_VERSION": "1",
            "KCONFIG_ALLCONFIG": "/out/request.config",
        }
        # kbuild with the locked programs, whatever their usual names would be.
        self.make = [
            "make", "-C", "/out/source", "O=/out/objects", f"ARCH={_ARCHITECTURES[description.architecture]}",
            "CC=gcc-12", "HOSTCC=gcc-12", "YACC=bison", f"KCFLAGS={_FASTER}", "--no-print-directory",
            f"-j{os.cpu_count()}",
        ]  # fmt: skip
        self.chroot.provide_system(out=self.out)

    def configure(self) -> None:
        """Unpack and patch the source; leave `config`, what kconfig makes of the request, and `kconfig`, its texts."""
        archive = f"/usr/src/{self.description.source}.tar.xz"
        (self.out / "source").mkdir()
        (self.out / "objects").mkdir()
        unused = [f"--exclude={self.description.source}/{pattern}" for pattern in _UNUSED]
        self.chroot.run(
            "tar", "-I", "xz -T0", "-xf", archive, "-C", "/out/source", "--strip-components=1", "--wildcards", *unused
        )
        what = f"{self.description.source} {self.description.version}"
        apply(self.description.patches, self.out / "source", what)
        self.chroot.run(*self.make, "-s", "allnoconfig")
        shutil.copy(self.out / "objects/.config", self.out / "config")
        files = sorted(path for path in (self.out / "source").rglob("Kconfig*") if path.is_file())
        (self.out / "kconfig").write_text("\n".join(path.read_text(errors="replace") for path in files))

    def build(self) -> None:
        """Compile, and leave the Debian package and `kernel.json`."""
        targets = ["bzImage", "modules"] if self.description.modules else ["bzImage"]
        self.chroot.log(*self.make, *targets)
        release = self.chroot.run(*self.make, "-s", "kernelrelease").strip()
        package = self.out / "package"
        package.mkdir()
        if self.description.modules:
            install = ["INSTALL_MOD_PATH=/out/package", "INSTALL_MOD_STRIP=1", "DEPMOD=/usr/sbin/depmod"]
            self.chroot.run(*self.make, "-s", *install, "modules_install")
            (package / "lib/modules" / release / "build").unlink(missing_ok=True)  # a link into this build
        boot = package / "boot"
        boot.mkdir()
        shutil.copy(self.out / "objects/arch/x86/boot/bzImage", boot / f"vmlinuz-{release}")
        shutil.copy(self.out / "objects/System.map", boot / f"System.map-{release}")
        shutil.copy(self.out / "config", boot / f"config-{release}")
        self._control(package, release)
        self._settle(package)
        name = f"linux-image-{release}_{self._version()}_{self.description.architecture}.deb"
        # Nearly all in it is packed already: more effort takes four seconds more for a twentieth of the size.
        pack = ["dpkg-deb", "--root-owner-group", "-Zxz", "-z1", "--threads-max=1"]
        self.chroot.run(*pack, "--build", "/out/package", f"/out/{name}")
        (self.out / "kernel.json").write_text(json.dumps({"release": release}) + "\n")
        for directory in ("source", "objects", "package"):
            shutil.rmtree(self.out / directory)
        (self.out / "kconfig").unlink()

    def _version(self) -> str:
        return f"{self.description.version}+flotilla1"

    def _control(self, package: Path, release: str) -> None:
        kib = sum(path.stat().st_size for path in package.rglob("*") if path.is_file()) >> 10
        fields = {
            "Package": f"linux-image-{release}",
            "Version": self._version(),
            "Source": f"linux ({self.description.version})",
            "Architecture": self.description.architecture,
            "Maintainer": "Flotilla <flotilla@localhost>",
            "Section": "kernel",
            "Priority": "optional",
            "Installed-Size": str(kib),
            "Provides": "linux-image",
            "Description": "PREEMPT_RT kernel of a robot's board\n"
            " Debian's kernel source with the options of kernel/fragments: everything a boot needs is built in.",
        }
        (package / "DEBIAN").mkdir()
        (package / "DEBIAN/control").write_text("".join(f"{key}: {value}\n" for key, value in fields.items()))

    def _settle(self, package: Path) -> None:
        """One time and the same modes for all files."""
        for path in [package, *package.rglob("*")]:
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() else 0o644)
            os.utime(path, (self.description.epoch,) * 2, follow_symlinks=False)


def main(what: str, description: str) -> None:
    os.umask(0o022)
    os.nice(5)
    stage = Stage(Description(**json.loads(description)))
    {"configure": stage.configure, "build": stage.build}[what]()


if __name__ == "__main__":
    main(*sys.argv[1:])
