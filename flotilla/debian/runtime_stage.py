"""The stage that builds the runtime: what runs in the namespaces, in a chroot of its compiler and libraries.

Source and result lie at fixed places there, and the time is the lock's, so that the packages are the same wherever,
whenever and by whomever they are made.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from pathlib import Path

from flotilla.debian.chroot import Chroot

_PACKAGES = {
    "flotilla-runtime": ("real-time driver runtime of a robot", ["usr/bin", "usr/lib", "lib"], True),
    "flotilla-runtime-dev": ("headers for blocks of one's own", ["usr/include", "usr/share"], False),
}
"""Name, description, which parts of the installation, whether it depends on the libraries."""


def main(tools: str, out: str, architecture: str, epoch: str, depends: str) -> None:
    """Leave the packages in `out`, which holds the sources in `source/`."""
    os.umask(0o022)
    chroot = Chroot(Path(tools), int(epoch))
    chroot.environment |= {"CC": "gcc", "LDFLAGS": "-Wl,--build-id=none", "DESTDIR": "/out/installed"}
    chroot.environment["PYTHONDONTWRITEBYTECODE"] = "1"  # meson's, into the tools, which other builds share
    chroot.provide_system(out=out)
    setup = ["--prefix=/usr", "--libdir=lib", "--buildtype=release", "--strip", "-Ddds=enabled", "-Diidc=enabled"]
    chroot.log("meson", "setup", "/out/objects", "/out/source", *setup)
    chroot.log("meson", "compile", "-C", "/out/objects")
    chroot.log("meson", "install", "-C", "/out/objects", "--no-rebuild")
    version = re.search(r'"version": "([^"]+)"', (Path(out) / "objects/meson-info/intro-projectinfo.json").read_text())
    assert version, "meson writes the project's version"
    for name, (description, parts, libraries) in _PACKAGES.items():
        package = Path(out) / name
        for part in parts:
            if (place := Path(out) / "installed" / part).exists():
                shutil.copytree(place, package / part, symlinks=True)
        fields = {
            "Package": name,
            "Version": version[1],
            "Architecture": architecture,
            "Maintainer": "Flotilla <flotilla@localhost>",
            "Section": "electronics",
            "Priority": "optional",
            "Installed-Size": str(sum(path.stat().st_size for path in package.rglob("*") if path.is_file()) >> 10),
            "Depends": ", ".join(json.loads(depends)) if libraries else "",
            "Description": description,
        }
        (package / "DEBIAN").mkdir()
        control = "".join(f"{key}: {value}\n" for key, value in fields.items() if value)
        (package / "DEBIAN/control").write_text(control)
        for path in [package, *package.rglob("*")]:
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
            os.utime(path, (int(epoch),) * 2, follow_symlinks=False)
        archive = f"/out/{name}_{version[1]}_{architecture}.deb"
        chroot.run("dpkg-deb", "--root-owner-group", "-Zxz", "--threads-max=1", "--build", f"/out/{name}", archive)
    for name in ("source", "objects", "installed", *_PACKAGES):
        shutil.rmtree(Path(out) / name)


if __name__ == "__main__":
    main(*sys.argv[1:])
