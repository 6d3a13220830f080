"""The initramfs: busybox, the kernel modules that reach the card, and `init`. Nothing that detects or configures."""

from __future__ import annotations

import os
import stat
import subprocess
from pathlib import Path

_ROOT_MODULES = ["squashfs", "ext4", "overlay"]
"""What the root and the layers above it need; loading it later, by name, would cost the boot a second."""
_APPLETS = "sh mount insmod cat date hexdump usleep seq switch_root touch umount uname"


def build(tools: Path, target: Path, version: str, modules: list[str]) -> bytes:
    """The archive for kernel `version`, from the busybox and the modules of `target`."""
    order = {path.name: path for path in _load_order(tools, version, modules)}
    entries: list[tuple[str, int, bytes]] = [(name, stat.S_IFDIR | 0o755, b"") for name in
        ("bin", "dev", "modules", "proc", "root", "sys")]  # fmt: skip
    entries.append(("bin/busybox", stat.S_IFREG | 0o755, (target / "bin/busybox").read_bytes()))
    entries += [(f"bin/{name}", stat.S_IFLNK | 0o777, b"busybox") for name in _APPLETS.split()]
    entries.append(("init", stat.S_IFREG | 0o755, (Path(__file__).parent / "init").read_bytes()))
    for name, path in order.items():
        entries.append((f"modules/{name}", stat.S_IFREG | 0o644, (tools / path.relative_to("/")).read_bytes()))
    names = "".join(f"{name}\n" for name in order)
    entries.append(("modules/order", stat.S_IFREG | 0o644, names.encode()))
    archive = b"".join(_entry(number, *entry) for number, entry in enumerate(sorted(entries), 1))
    return _padded(archive + _entry(0, "TRAILER!!!", 0, b""), 512)


def _load_order(tools: Path, version: str, modules: list[str]) -> list[Path]:
    """Module files in the order in which they must be loaded."""
    order: list[Path] = []
    for module in [*modules, *_ROOT_MODULES]:
        argv = ["chroot", str(tools), "modprobe", "-d", "/target", "-S", version, "--show-depends", module]
        shown = subprocess.run(argv, check=True, stdout=subprocess.PIPE, text=True, env=os.environ).stdout
        files = [Path(line.split()[1]) for line in shown.splitlines() if line.startswith("insmod ")]
        order += [path for path in files if path not in order]
    return order


def _padded(data: bytes, multiple: int) -> bytes:
    return data + bytes(-len(data) % multiple)


def _entry(number: int, name: str, mode: int, content: bytes) -> bytes:
    """One file of a cpio archive in the kernel's `newc` format (Documentation/driver-api/early-userspace)."""
    encoded = name.encode() + b"\0"
    fields = [number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(encoded), 0]
    header = b"070701" + b"".join(f"{field:08X}".encode() for field in fields)
    return _padded(_padded(header + encoded, 4) + content, 4)
