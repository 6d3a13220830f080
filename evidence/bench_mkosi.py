"""What `make bench` compares a cold build with: mkosi, as near to the card as it comes.

It makes a disk that GRUB starts from the BIOS: a compressed root of the same packages from the same files, with the
kernel, the paths and the modules that the card has, a second slot and a data partition. What is not like the card:

- Partitions are in a GPT, and GRUB loads the kernel from an EFI system partition: mkosi makes no other disk.
- Its initramfs is the card's, ready-made, which takes nothing of mkosi's time: the packages of mkosi's own are not in
  the lock. mkosi adds its modules to it.
- Nothing of ours is on it: runtime, overlay, identity, bills of materials.
"""

from __future__ import annotations

import fnmatch
import os
import shutil
import subprocess
from pathlib import Path

from flotilla.common import progress
from flotilla.common.errors import UserError
from flotilla.debian import mirror
from flotilla.debian.lock import Lock
from flotilla.images import card, rootfs

MISSING = (
    "mkosi: give MKOSI=… to compare: bin/mkosi in a checkout of a release of github.com/systemd/mkosi (25.3 works)"
)
_TOOLS = Path(__file__).with_name("mkosi-packages.txt")
_TOOLS_SUITE = "trixie"
"""Debian's first release whose systemd-repart is new enough."""
_ARCHITECTURES = {"i386": "x86", "amd64": "x86-64"}
_BIOS_BOOT = "21686148-6449-6e6f-744e-656564454649"
"""GPT type of the partition that GRUB's core image is in."""
_STUB = """\
Package: flotilla-no-initramfs
Version: 1
Architecture: all
Maintainer: Flotilla <flotilla@localhost>
Section: kernel
Priority: optional
Provides: linux-initramfs-tool, linux-base (= 99)
Description: in place of what makes an initramfs on the robot
"""
_ROOT_NUMBER = 3
"""Of the partition, in the order of `_partitions`."""
_ARGUMENTS = f"root=PARTUUID=00000000-{_ROOT_NUMBER:02} ro rootfstype=squashfs quiet"
"""The card's initramfs finds the disk by the identifier in its MBR; systemd-repart leaves that zero beside a GPT."""


def program() -> str | None:
    """The mkosi that the user names; it runs from its checkout, without installation."""
    if not (named := os.environ.get("MKOSI")):
        return None
    if not (found := shutil.which(named)):
        raise UserError(f"MKOSI={named}: no program; {MISSING}")
    return str(Path(found).resolve())


def prepare(directory: Path, lock: Lock, grub: Path, initramfs: Path) -> None:
    """Lay what mkosi reads into `directory`, which is new. `grub`: modules for the BIOS. `initramfs`: the card's."""
    for name in ("workspace", "packages", "partitions"):
        (directory / name).mkdir(parents=True)
    for name, lines in _partitions(lock.architecture).items():
        (directory / "partitions" / f"{name}.conf").write_text("\n".join(["[Partition]", *lines, ""]))
    rules = [(keep, pattern) for keep, pattern in rootfs.path_rules() if not pattern.startswith("/etc/")]
    dpkg = directory / "sandbox/etc/dpkg/dpkg.cfg.d"
    dpkg.mkdir(parents=True)
    (dpkg / "flotilla").write_text("".join(f"path-{'include' if keep else 'exclude'}={each}\n" for keep, each in rules))
    shutil.copytree(grub, directory / "grub/usr/lib/grub/i386-pc")
    shutil.copyfile(initramfs, directory / "initrd.img")
    stub = directory / "stub"
    (stub / "DEBIAN").mkdir(parents=True)
    (stub / "DEBIAN/control").write_text(_STUB)
    (stub / "usr/bin").mkdir(parents=True)
    (stub / "usr/bin/linux-update-symlinks").symlink_to("true")  # which the kernel's package calls
    (directory / "stubs").mkdir()
    _run(["dpkg-deb", "--root-owner-group", "--build", str(stub), str(directory / "stubs/stub_1_all.deb")])


def tools(directory: Path, source: str | None = None) -> None:
    """Make the tree of programs for mkosi in `directory`, by mmdebstrap from a mirror of Debian's."""
    source = source or mirror.resolve().of(mirror.DEBIAN)
    names = ",".join(
        line.split("#")[0].strip() for line in _TOOLS.read_text().splitlines() if line[:1] not in ("", "#")
    )
    archive = directory.with_suffix(".tar")  # not a directory, whose files may be of other users
    with progress.step("programs for mkosi"):
        _run(["mmdebstrap", "--quiet", "--variant=apt", f"--include={names}", _TOOLS_SUITE, str(archive), source])
        directory.mkdir()
        _run(["tar", "-x", "-f", str(archive), "-C", str(directory), "--no-same-owner", "--exclude=./dev/*"])
        archive.unlink()


def command(mkosi: str, directory: Path, tools: Path, repository: Path, lock: Lock) -> list[str]:
    """What makes `directory`/disk.raw of `prepare`'s files, with `tools`' programs, from a package repository."""
    modules = [f"^{fnmatch.translate(f'{pattern}.ko')}" for pattern in rootfs.module_patterns(lock.architecture)]
    return [
        mkosi, f"--directory={directory}", "--build-sources=", "--distribution=debian", f"--release={lock.release}",
        f"--architecture={_ARCHITECTURES[lock.architecture]}", f"--local-mirror=file://{repository}",
        "--repository-key-check=no", "--with-docs=no", f"--source-date-epoch={lock.epoch}", "--manifest-format=",
        f"--workspace-directory={directory}/workspace", f"--package-cache-dir={directory}/packages",
        f"--tools-tree={tools}", f"--sandbox-tree={directory}/sandbox", f"--extra-tree={directory}/grub",
        "--format=disk", "--output=disk", f"--repart-directory={directory}/partitions",
        "--bootable=yes", "--bootloader=none", "--bios-bootloader=grub",
        f"--initrd={directory}/initrd.img", f"--kernel-command-line={_ARGUMENTS}",
        "--kernel-modules-exclude=.*", *(f"--kernel-modules-include={pattern}" for pattern in modules),
        f"--package-directory={directory}/stubs", "--package=flotilla-no-initramfs",
        *(f"--package={package.name}" for package in lock.packages),
        "build",
    ]  # fmt: skip


def _partitions(architecture: str) -> dict[str, list[str]]:
    """Definitions for systemd-repart, in the disk's order."""

    def of(kind: str, mib: int, *more: str) -> list[str]:
        return [f"Type={kind}", f"SizeMinBytes={mib}M", f"SizeMaxBytes={mib}M", *more]

    root = [f"Type=root-{_ARCHITECTURES[architecture]}", "Format=squashfs", "CopyFiles=/", "Minimize=best"]
    level = rootfs.COMPRESSION[rootfs.COMPRESSION.index("-Xcompression-level") + 1]
    root += ["Compression=zstd", f"CompressionLevel={level}"]
    root += [f"ExcludeFiles={place}" for place in ("/boot/", "/efi/", "/usr/lib/grub/")]
    return {
        "1-esp": of("esp", 64, "Format=vfat", "CopyFiles=/boot:/", "CopyFiles=/efi:/"),
        "2-grub": of(_BIOS_BOOT, 1),
        f"{_ROOT_NUMBER}-root": root,
        "4-slot": of("linux-generic", card.LAYOUT.slot_mib),
        "5-data": of("linux-generic", card.LAYOUT.data_mib, "Format=ext4"),
    }


def _run(argv: list[str]) -> None:
    progress.command(argv)
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"{argv[0]} failed (status {done.returncode}): {done.stderr.strip()[-2000:]}")
