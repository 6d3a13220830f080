"""Writing a card: refuse what is not a card, write the mapped blocks, read them back from the medium.

What the host says of its devices is read through `Host` alone, so tests put a made-up sysfs in its place.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import hashlib
import mmap
import os
import re
import shlex
import stat
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from flotilla.common import progress
from flotilla.common.errors import UserError
from flotilla.common.paths import shown
from flotilla.images.bmap import BLOCK, BlockMap, Range, bmap_of, read_bmap

CHUNK = 1 << 20
_DIRTY_LIMIT = 8 << 20
"""Written bytes after which to wait for the card; otherwise the page cache takes the whole image at once, and the
progress stands at 100 % for the minute the card really needs."""


# The host


@dataclass(frozen=True)
class Host:
    """The computer the card is written on."""

    root: Path = Path("/")

    def number(self, target: Path | int) -> str | None:
        """`major:minor` of a block device's node or descriptor, None of anything else."""
        try:
            status = os.stat(target)  # noqa: PTH116 (a Path has no descriptor)
        except OSError:
            return None
        return f"{os.major(status.st_rdev)}:{os.minor(status.st_rdev)}" if stat.S_ISBLK(status.st_mode) else None

    def text(self, path: str | Path) -> str:
        """A file of /proc, /sys or /run; the kernel leaves out what does not apply, so an absent one is empty."""
        try:
            return (self.root / path).read_text(errors="replace").strip()
        except OSError:
            return ""

    def block(self, number: str) -> Path | None:
        """The sysfs folder of a block device."""
        for entry in (self.root / "sys/class/block").iterdir():
            if self.text(entry / "dev") == number:
                return entry.resolve()
        return None

    def mounts(self) -> list[tuple[str | None, str]]:
        """Device number and mount point of each file system. btrfs shows a made-up number: ask its source instead."""
        found: list[tuple[str | None, str]] = []
        for line in self.text("proc/self/mountinfo").splitlines():
            fields = line.split()
            number, point, source = fields[2], fields[4], fields[fields.index("-") + 2]
            named = self.number(self.root / source.lstrip("/")) if source.startswith("/dev/") else None
            found.append((named or number, re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), point)))
        return found

    def swaps(self) -> list[str | None]:
        lines = self.text("proc/swaps").splitlines()[1:]
        return [self.number(self.root / line.split()[0].lstrip("/")) for line in lines]

    def lasting_names(self, number: str) -> list[Path]:
        """The device's names that stay the same over restarts and other disks coming and going."""
        return sorted(name for name in self.lasting.glob("*") if self.number(name) == number)

    @property
    def lasting(self) -> Path:
        return self.root / "dev/disk/by-id"


THIS_HOST = Host()

_BUSES = (
    ("usb", r"/usb\d+/"),
    ("mmc", r"/mmc_host/"),
    ("nvme", r"/nvme\d+/"),
    ("ata", r"/ata\d+/"),
    ("virtio", r"/virtio\d+/"),
    ("virtual", r"/devices/virtual/"),
)
"""Bus by the path of the device in sysfs; the first that matches."""


@dataclass(frozen=True)
class Disk:
    """A block device as sysfs describes it."""

    host: Host
    path: Path
    """As the user gave it."""
    number: str
    node: Path
    """Folder in sysfs."""

    @property
    def name(self) -> str:
        return self.node.name

    def attribute(self, name: str) -> str:
        return self.host.text(self.node / name)

    @property
    def size(self) -> int:
        return int(self.attribute("size") or 0) * 512

    @property
    def bus(self) -> str:
        return next((bus for bus, pattern in _BUSES if re.search(pattern, f"{self.node}/")), "unknown bus")

    @property
    def model(self) -> str:
        parts = (self.attribute(f"device/{name}") for name in ("vendor", "model", "name"))
        return " ".join(part for part in parts if part) or "unnamed"

    @property
    def portable(self) -> bool:
        """Whether it can be taken out. An eMMC sits on the MMC bus, too, but is soldered."""
        bus = self.bus
        return (
            self.attribute("removable") == "1"
            or bus == "usb"
            or (bus == "mmc" and self.attribute("device/type") == "SD")
        )

    @property
    def partitions(self) -> list[Path]:
        return sorted(
            (entry.parent for entry in self.node.glob("*/partition")), key=lambda node: (len(node.name), node)
        )

    @property
    def holders(self) -> list[Path]:
        return [holder for node in (self.node, *self.partitions) for holder in _holders(node)]

    @cached_property
    def family(self) -> set[str]:
        """Device numbers of the disk, its partitions and everything stacked above them (LVM, LUKS, RAID)."""
        found = {}
        waiting = [self.node, *self.partitions]
        while waiting:
            node = waiting.pop()
            if node not in found:
                found[node] = self.host.text(node / "dev")
                waiting += [*_holders(node), *(entry.parent for entry in node.glob("*/partition"))]
        return set(found.values())

    @cached_property
    def mount_points(self) -> list[str]:
        return sorted({point for number, point in self.host.mounts() if number in self.family})

    def __str__(self) -> str:
        return f"{self.path} ({self.model}, {progress.size(self.size)}, {self.bus})"

    def description(self) -> str:
        """The disk and what is on it now, for somebody who has to recognise it."""
        lines = [f"{self.name}: {self.model}, {progress.size(self.size)}, {self.bus}"]
        for node in self.partitions:
            udev = dict(
                line[2:].split("=", 1)
                for line in self.host.text(f"run/udev/data/b{self.host.text(node / 'dev')}").splitlines()
                if line.startswith("E:") and "=" in line
            )
            size = progress.size(int(self.host.text(node / "size") or 0) * 512)
            content = (udev.get("ID_FS_TYPE", ""), udev.get("ID_FS_LABEL", ""))
            lines.append("  ".join(("", node.name, size, *filter(None, content))))
        return "\n".join(lines if self.partitions else [*lines, "  no partitions"])


def _holders(node: Path) -> list[Path]:
    return sorted(holder.resolve() for holder in node.glob("holders/*"))


# What is no card to write on

_SYSTEM = ("/", "/boot", "/efi", "/etc", "/home", "/nix", "/opt", "/root", "/srv", "/usr", "/var")

Check = Callable[[Disk, int], str | None]
"""What is wrong with the disk for an image of that many bytes, and what to do; None when nothing is."""


def _is_system(point: str) -> bool:
    return point in _SYSTEM or point.startswith("/boot/")


def _partition(disk: Disk, _: int) -> str | None:
    whole = f"/dev/{disk.node.parent.name}"
    return f"it is a partition; give the whole disk, {whole}" if disk.attribute("partition") else None


def _system(disk: Disk, _: int) -> str | None:
    points = [point for point in disk.mount_points if _is_system(point)]
    return f"this computer runs from it ({', '.join(points)}); give the card's device, see `lsblk`" if points else None


def _mounted(disk: Disk, _: int) -> str | None:
    points = [point for point in disk.mount_points if not _is_system(point)]
    return f"mounted at {', '.join(points)}; `{shlex.join(('umount', *points))}`" if points else None


def _swap(disk: Disk, _: int) -> str | None:
    return "in use as swap; `swapoff` it if it is the card at all" if disk.family & set(disk.host.swaps()) else None


def _held(disk: Disk, _: int) -> str | None:
    names = [next(filter(None, (disk.host.text(node / "dm/name"), node.name))) for node in disk.holders]
    return f"part of {', '.join(names)} (LVM, encryption or RAID); take that down first" if names else None


def _fixed(disk: Disk, _: int) -> str | None:
    wrong = f"neither removable nor on USB nor an SD card, but a fixed disk on {disk.bus}"
    return None if disk.portable else f"{wrong}; if it really is the card: FORCE=fixed-disk (--force fixed-disk)"


def _empty(disk: Disk, _: int) -> str | None:
    return None if disk.size else "the reader is empty; insert the card"


def _small(disk: Disk, need: int) -> str | None:
    short = 0 < disk.size < need
    return f"holds {disk.size} bytes, the image needs {need}; take a larger card" if short else None


def _read_only(disk: Disk, _: int) -> str | None:
    return "read-only; move the card's lock switch, or take another reader" if disk.attribute("ro") == "1" else None


def _sectors(disk: Disk, _: int) -> str | None:
    sector = disk.attribute("queue/logical_block_size") or "512"
    wrong = f"has sectors of {sector} bytes, the image's partition table counts in 512"
    return None if sector == "512" else f"{wrong}; take another card or reader"


CHECKS: tuple[Check, ...] = (_system, _mounted, _swap, _held, _fixed, _empty, _small, _read_only, _sectors)
OVERRIDES: dict[str, Check] = {"fixed-disk": _fixed}
"""The word that goes past a check. Past the others nothing goes."""


def _disk(device: Path, need: int, force: str | None, host: Host) -> Disk:
    """The disk behind a path, once nothing speaks against writing on it; otherwise everything that does, at once."""
    if force is not None and force not in OVERRIDES:
        raise UserError(f"--force {force}: no such word; there is {', '.join(OVERRIDES)}")
    if not device.exists():
        raise UserError(f"{device}: no such device; insert the card and see `lsblk`")
    number = host.number(device)
    node = number and host.block(number)
    if not number or not node:
        raise UserError(f"{device}: not a block device; give the card's device (`lsblk`), or CARD=file for a file")
    disk = Disk(host, device, number, node)
    # Of a partition nothing else is worth saying: the whole disk is another device.
    checks = (_partition,) if disk.attribute("partition") else CHECKS
    findings = [check(disk, need) for check in checks if check != OVERRIDES.get(force or "")]
    wrong = [finding for finding in findings if finding]
    if wrong:
        raise UserError("\n  ".join((f"{disk} was rejected, nothing was written:", *wrong)))
    return disk


# The medium

_PULLED = "it was pulled out"
_FULL = "the disk is full; make room or choose another place"
_REFUSED = "you may not write to it; choose another place"


class Target:
    """An open card, or a file that stands for one."""

    noun = "file"
    unfaithful = "the disk it is on fails"
    """Why it may read back otherwise than written."""
    next_step = "The file holds what the card would; boot it as an IDE disk."
    reasons: Mapping[int, str] = {
        errno.EACCES: _REFUSED,
        errno.EPERM: _REFUSED,
        errno.ENOSPC: _FULL,
        errno.EDQUOT: _FULL,
        errno.EFBIG: "the file system takes no file of that size; choose another place",
        errno.EIO: "the disk reports an error; choose another one",
    }

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self.descriptor = descriptor
        self._dirty = 0
        self._buffer = mmap.mmap(-1, CHUNK)
        """Page-aligned, as O_DIRECT wants it."""

    def write(self, offset: int, data: memoryview | bytes) -> None:
        with memoryview(data) as view:
            done = 0
            while done < len(view):
                done += os.pwrite(self.descriptor, view[done:], offset + done)
            self._dirty += done
        if self._dirty >= _DIRTY_LIMIT:
            os.fdatasync(self.descriptor)
            self._dirty = 0

    def settle(self) -> None:
        """Everything to the medium, nothing left in memory that a later read could be answered from."""
        os.fsync(self.descriptor)
        os.posix_fadvise(self.descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        self._dirty = 0

    def bypass_cache(self) -> None:
        """Read from the medium from now on. Not every file system can; there the emptied cache has to do."""
        flags = fcntl.fcntl(self.descriptor, fcntl.F_GETFL)
        try:
            fcntl.fcntl(self.descriptor, fcntl.F_SETFL, flags | os.O_DIRECT)
            os.preadv(self.descriptor, [self._buffer], 0)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            fcntl.fcntl(self.descriptor, fcntl.F_SETFL, flags)

    def read(self, offset: int, length: int) -> memoryview:
        """Up to a chunk. Asks for whole blocks, because O_DIRECT does not read less."""
        whole = (length + BLOCK - 1) // BLOCK * BLOCK
        with memoryview(self._buffer) as view:
            got = os.preadv(self.descriptor, [view[:whole]], offset)
        return memoryview(self._buffer)[: min(got, length)]

    def finish(self) -> None:
        """Let others see what is there now."""

    def explain(self, error: OSError) -> str:
        """An error of the medium in words."""
        return self.reasons.get(error.errno or 0, error.strerror or str(error))


class Card(Target):
    noun = "card"
    unfaithful = "the card is worn out or a fake, take another one"
    next_step = "Take the card out, put it into robot {robot}, power on, then: make ssh ROBOT={robot}"
    reasons: Mapping[int, str] = {
        errno.ENOSPC: "it ends earlier than it claims, so it is a fake; take another card",
        errno.EIO: "the card or its reader fails; take another one",
        errno.ENXIO: _PULLED,
        errno.ENODEV: _PULLED,
        errno.ENOMEDIUM: _PULLED,
    }

    _BLKRRPART = 0x125F
    _BLKFLSBUF = 0x1261

    def settle(self) -> None:
        super().settle()
        # Needs privileges the rest does not; without it O_DIRECT still reads from the medium.
        with contextlib.suppress(OSError):
            fcntl.ioctl(self.descriptor, self._BLKFLSBUF)

    def finish(self) -> None:
        # Only a convenience: the kernel reads the partitions anew, too, when the card is put in again.
        with contextlib.suppress(OSError):
            fcntl.ioctl(self.descriptor, self._BLKRRPART)


def _open_card(disk: Disk) -> Card:
    try:
        # O_EXCL has the kernel refuse whatever anybody uses, seen in sysfs or not, and keeps others off meanwhile.
        card = Card(disk.path, os.open(disk.path, os.O_RDWR | os.O_EXCL | os.O_CLOEXEC))
    except PermissionError as error:
        group = grp.getgrgid(disk.path.stat().st_gid).gr_name
        raise UserError(
            f"{disk.path}: you may not write to it, it belongs to the group {group}; "
            f"`sudo chown $USER {disk.path}` lends you this card until it is taken out "
            f"(the group {group}, `sudo usermod -aG {group} $USER`, would give you every disk)"
        ) from error
    except OSError as error:
        reasons = {
            errno.EBUSY: "in use by another program; end that and try again",
            errno.EROFS: "read-only; move the card's lock switch, or take another reader",
            errno.ENOMEDIUM: "the reader is empty; insert the card",
        }
        raise UserError(f"{disk.path}: {reasons.get(error.errno or 0, error.strerror)}") from error
    if disk.host.number(card.descriptor) != disk.number:
        os.close(card.descriptor)
        raise UserError(f"{disk.path} has become another device meanwhile; try again")
    return card


def _open_file(file: Path, image: Path, size: int) -> Target:
    if file.exists() and not file.is_file():
        raise UserError(f"{file}: not a file but something else; CARD= takes a file, a card's device goes into DEV=")
    if file.parent.resolve() == Path("/dev"):
        raise UserError(f"{file}: a file in /dev would be no device; a card's device goes into DEV=")
    if file.exists() and file.samefile(image):
        raise UserError(f"{file}: that is the image itself; give another file")
    try:
        target = Target(file, os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
    except OSError as error:
        raise UserError(f"{file}: cannot be opened, {error.strerror}; choose another place") from error
    try:
        # QEMU locks the disks it runs from.
        fcntl.lockf(target.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.fchmod(target.descriptor, 0o600)  # the image holds a private key
        if os.fstat(target.descriptor).st_size < size:
            os.ftruncate(target.descriptor, size)
    except OSError as error:
        os.close(target.descriptor)
        used = error.errno in (errno.EAGAIN, errno.EACCES)
        reason = "in use by another program, probably a guest that runs from it" if used else target.explain(error)
        raise UserError(f"{file}: {reason}") from error
    return target


# The work


def flash(
    image: Path,
    *,
    device: Path | None,
    file: Path | None,
    force: str | None,
    yes: bool,
    robot: str,
    host: Host = THIS_HOST,
) -> None:
    """Write robot `robot`'s image on a card, or into a file that stands for one, and read it back."""
    remedy = f"make image ROBOT={robot}"
    bmap = _map(image, remedy)
    if (device is None) == (file is None):
        raise UserError("say where to: DEV=/dev/sdX (--device), or CARD=file (--file)")
    disk = _disk(device, bmap.image_size, force, host) if device else None
    if disk and yes and disk.path.parent != host.lasting:
        # A script outlives the order in which disks happened to be found today.
        names = ", ".join(map(str, host.lasting_names(disk.number))) or f"one of {host.lasting}"
        raise UserError(f"{disk.path}: --yes wants a name that stays with the device: {names}")
    with image.open("rb") as source:
        read = _reader(source.fileno(), f"{shown(image)} does not match its block map", remedy)
        for _ in _checked(bmap, *read):
            pass
        if disk:
            target: Target = _open_card(disk)
        else:
            assert file is not None
            target = _open_file(file, image, bmap.image_size)
        try:
            if disk:
                _confirm(disk, bmap, robot, yes)
            _transfer(bmap, read, target)
        finally:
            os.close(target.descriptor)
    print(_next_steps(target, bmap, robot))


def _map(image: Path, remedy: str) -> BlockMap:
    for path in (image, bmap_of(image)):
        if not path.is_file():
            raise UserError(f"{shown(path)} is missing; `{remedy}`")
    bmap = read_bmap(bmap_of(image))
    size = image.stat().st_size
    if size != bmap.image_size:
        raise UserError(f"{shown(image)} has {size} bytes, its block map has {bmap.image_size}; `{remedy}`")
    return bmap


def _confirm(disk: Disk, bmap: BlockMap, robot: str, yes: bool) -> None:
    sys.stderr.write(disk.description() + "\n")
    if yes:
        return
    if not sys.stdin.isatty():
        raise UserError(
            "no terminal to ask on; a script gives --yes and a name from /dev/disk/by-id; nothing was written"
        )
    size = progress.size(bmap.image_size)
    sys.stderr.write(f"Robot {robot}'s image ({size}) replaces all of it. Type {disk.name} to continue: ")
    sys.stderr.flush()
    try:
        answer = sys.stdin.readline().strip()
    except KeyboardInterrupt:
        sys.stderr.write("\n")
        answer = ""
    if answer != disk.name:
        raise UserError(f"not confirmed ({answer or 'nothing'} instead of {disk.name}); nothing was written")


Read = Callable[[int, int], memoryview | bytes]
Mismatch = Callable[[str], UserError]


def _reader(descriptor: int, wrong: str, remedy: str) -> tuple[Read, Mismatch]:
    """How to read the image, and what to say when it is not what its map says."""

    def read(offset: int, length: int) -> bytes:
        return os.pread(descriptor, length, offset)

    return read, lambda place: UserError(f"{wrong} at {place}; `{remedy}`")


def _checked(bmap: BlockMap, read: Read, mismatch: Mismatch) -> Iterator[tuple[int, memoryview | bytes]]:
    """Offset and bytes of all that is mapped, each range held against its checksum once it is through."""
    for blocks in bmap.ranges:
        digest = hashlib.sha256()
        offset, end = bmap.span(blocks)
        while offset < end:
            data = read(offset, min(CHUNK, end - offset))
            if not data:
                break
            digest.update(data)
            yield offset, data
            offset += len(data)
        if digest.hexdigest() != blocks.sha256:
            raise mismatch(_place(bmap, blocks))


def _place(bmap: BlockMap, blocks: Range) -> str:
    start, end = bmap.span(blocks)
    return f"blocks {blocks.first} to {blocks.last} ({progress.size(start)} to {progress.size(end)})"


def _transfer(bmap: BlockMap, source: tuple[Read, Mismatch], target: Target) -> None:
    """Write and read back; however it fails, say that the card is not to be used."""
    advice = f"the {target.noun} {target.path} is incomplete, do not use it before it is flashed again"
    try:
        _write(bmap, source, target)
        _verify(bmap, target)
    except KeyboardInterrupt as error:
        raise UserError(f"interrupted: {advice}") from error
    except OSError as error:
        raise UserError(f"{target.path}: {target.explain(error)}; {advice}") from error
    except UserError as error:
        raise UserError(f"{error}; {advice}") from error


def _write(bmap: BlockMap, source: tuple[Read, Mismatch], target: Target) -> None:
    with progress.step(f"Write {target.path}") as step:
        meter = _Meter(step, bmap.mapped)
        boot: bytes | None = None
        for offset, data in _checked(bmap, *source):
            meter.add(len(data))
            if offset == 0:
                # The boot sector goes last: a card that was interrupted does not start, rather than start half.
                boot = bytes(data[:BLOCK])
                data = bytes(len(boot)) + bytes(data[BLOCK:])
            target.write(offset, data)
        target.settle()
        if boot is not None:
            target.write(0, boot)
            target.settle()


def _verify(bmap: BlockMap, target: Target) -> None:
    def mismatch(place: str) -> UserError:
        kept = f"{target.path} did not keep what was written: {place} read back otherwise"
        return UserError(f"{kept}; {target.unfaithful}")

    with progress.step(f"Read back {target.path}") as step:
        meter = _Meter(step, bmap.mapped)
        target.bypass_cache()
        for _, data in _checked(bmap, target.read, mismatch):
            meter.add(len(data))
        target.finish()


class _Meter:
    """Bytes done as a line of progress: share and rate."""

    def __init__(self, step: progress.Step, total: int) -> None:
        self._step = step
        self._total = total
        self._done = 0
        self._started = time.monotonic()

    def add(self, count: int) -> None:
        self._done += count
        rate = self._done / max(time.monotonic() - self._started, 1e-6)
        self._step.at(self._done >> 20, self._total >> 20, "MiB")
        self._step.note(f"{rate / 1e6:.1f} MB/s")


def _next_steps(target: Target, bmap: BlockMap, robot: str) -> str:
    done = f"{target.path} is robot {robot}: {progress.size(bmap.mapped)} written, read back and right."
    return f"{done}\n{target.next_step.format(robot=robot)}"
